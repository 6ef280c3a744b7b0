from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate.errors import GeometryError, InputDataError
from palpate.images.distance import distance_map
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.mesh.anatomy import Anatomy, Box, anatomy_of, domain_box, margin_box, volume_preserving
from palpate.mesh.closing import closed
from palpate.mesh.snapping import Union
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.phantoms import ball

ORGAN = Tissue("organ", Role.ESTIMATE, (1,))
DRIVER = Tissue("driver", Role.DRIVER, (2,))
REST = Tissue("rest", Role.KNOWN, youngs_modulus_kpa=10.0)


def _grid(shape=(20, 24, 28), spacing=(1.0, 1.0, 2.0), origin=(5.0, -3.0, 2.0)):
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = origin
    return VoxelGrid(shape, affine)


def _touching_slabs():
    grid = _grid()
    index = np.full(grid.shape, 2, dtype=np.int16)
    index[:, 6:12] = 0
    index[:, 12:18] = 1
    return Segmentation(index, grid, (ORGAN, DRIVER, REST))


def test_the_domain_reaches_to_the_outer_faces_of_the_voxels():
    box = domain_box([_grid()])
    assert np.allclose(box.origin, [4.5, -3.5, 1.0])
    assert np.allclose(box.lengths, [20.0, 24.0, 56.0])


def test_the_domain_is_what_the_images_have_in_common():
    box = domain_box([_grid(), _grid(origin=(9.0, -3.0, 2.0))])
    assert np.allclose(box.origin, [8.5, -3.5, 1.0])
    assert np.allclose(box.lengths, [16.0, 24.0, 56.0])


ORDERS = [((0, 1, 2), (True, True, False), 0.0), ((2, 0, 1), (False, True, True), 0.0), ((1, 2, 0), (True,) * 3, 20.0)]


def _ball(radius):
    """A ball in its surroundings, off the middle of a voxel."""
    grid = _grid(shape=(20, 21, 11), origin=(-9.7, -10.2, -10.4))
    places = grid.world(np.argwhere(np.ones(grid.shape, dtype=bool)).astype(float))
    inside = (np.linalg.norm(places, axis=1) < radius).reshape(grid.shape)
    return Segmentation(np.where(inside, 0, 1).astype(np.int16), grid, (ORGAN, REST))


def _stored(segmentation, order, flipped):
    """The same voxels at the same places in another order on disk."""
    index, affine = segmentation.index.transpose(order), segmentation.grid.affine.copy()
    affine[:3, :3] = affine[:3, order]
    for axis in np.flatnonzero(flipped):
        affine[:3, 3] += affine[:3, axis] * (index.shape[axis] - 1)
        affine[:3, axis] *= -1.0
        index = np.flip(index, axis)
    return replace(segmentation, index=index, grid=VoxelGrid(index.shape, affine))


@pytest.mark.parametrize(("order", "flipped", "turn_deg"), ORDERS)
def test_the_order_of_the_voxels_on_disk_changes_neither_domain_nor_mesh(order, flipped, turn_deg):
    plain = _ball(6.0)
    affine = np.array(plain.grid.affine)
    affine[:3, :3] = Rotation.from_euler("xyz", [turn_deg, 0.0, turn_deg], degrees=True).as_matrix() @ affine[:3, :3]
    images = [replace(plain, grid=VoxelGrid(plain.grid.shape, affine))]
    images.append(_stored(images[0], order, flipped))
    boxes = [domain_box([image.grid]) for image in images]
    for one, other in zip(*((box.origin, box.axes, box.lengths) for box in boxes), strict=True):
        assert other == pytest.approx(one, abs=1e-9)
    pairs = zip(images, boxes, strict=True)
    meshes = [tetrahedralise(anatomy_of(i, box=b, smoothing_mm=1.0), edge_length_mm=4.0) for i, b in pairs]
    assert np.array_equal(meshes[1].tets, meshes[0].tets)
    assert meshes[1].nodes == pytest.approx(meshes[0].nodes, abs=1e-8)


def test_images_without_a_common_part_are_refused():
    with pytest.raises(GeometryError, match="same place"):
        domain_box([_grid(), _grid(origin=(500.0, 0.0, 0.0))])


def test_the_margin_is_clipped_to_the_image():
    box = domain_box([_grid()])
    cut = margin_box(box, np.array([[6.0, 5.0, 30.0]]), margin_mm=5.0)
    assert np.allclose(cut.origin, [4.5, 0.0, 25.0])
    assert np.allclose(cut.lengths, [6.5, 10.0, 10.0])


def test_a_level_set_crosses_the_tissue_that_wins():
    segmentation = _touching_slabs()
    anatomy = anatomy_of(segmentation, box=domain_box([segmentation.grid]), smoothing_mm=1.2)
    assert anatomy.priority == (1, 0)
    y = np.linspace(4.0, 14.0, 41)
    points = np.column_stack([np.full(41, 14.0), y, np.full(41, 28.0)])
    organ = anatomy.level_sets[0].at(points)
    beside = (y > 6.0) & (y < 10.0)
    assert (organ[beside] < 0.0).all(), "the organ's level set must run on under the driver that it touches"
    inside = anatomy.values(points[(y > 9.0) & (y < 14.0)]) < 0.0
    assert set(np.array(anatomy.priority)[inside.argmax(axis=0)]) == {1}


def test_a_tissue_without_voxels_is_named():
    segmentation = _touching_slabs()
    empty = Segmentation(
        np.where(segmentation.index == 1, 2, segmentation.index), segmentation.grid, segmentation.tissues
    )
    with pytest.raises(InputDataError, match="driver"):
        anatomy_of(empty, box=domain_box([empty.grid]), smoothing_mm=1.2)


def test_an_anatomy_has_one_filler():
    box = Box(np.zeros(3), np.eye(3), np.ones(3))
    with pytest.raises(GeometryError, match="exactly one"):
        Anatomy((ORGAN, REST), (None, None), box)


@pytest.mark.parametrize(("radius", "spacing", "smoothing"), [(11.0, (1.0, 1.0, 2.5), 1.5), (8.0, (1.5,) * 3, 0.9)])
def test_a_small_ball_keeps_the_volume_of_its_voxels(radius, spacing, smoothing):
    half = 1.6 * radius
    counts = np.ceil(2.0 * half / np.array(spacing)).astype(int)
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = -half + np.array([0.13, 0.31, 0.22])
    grid = VoxelGrid(tuple(int(n) for n in counts), affine)
    places = grid.world(np.argwhere(np.ones(grid.shape, dtype=bool)).astype(float))
    mask = (np.linalg.norm(places, axis=1) < radius).reshape(grid.shape)
    plain = distance_map(mask, grid, smoothing_mm=smoothing)
    kept = volume_preserving(plain, mask)
    voxels = mask.sum() * grid.voxel_volume

    def volume(distance):
        """From the radius along many directions, r^3 averaged."""
        directions = np.random.default_rng(3).normal(size=(4000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        radii = np.full(len(directions), radius)
        for _ in range(6):
            radii -= distance.at(radii[:, None] * directions)
        return 4.0 / 3.0 * np.pi * np.mean(radii**3)

    assert volume(plain) < 0.97 * voxels
    assert volume(kept) == pytest.approx(voxels, rel=0.01)


def test_a_closed_surface_has_the_same_value_with_its_gradient_as_without():
    """Of two balls with a thin gap, and of both as one."""
    first, second = ball(np.array([-10.5, 0.0, 0.0]), 10.0), ball(np.array([10.5, 0.0, 0.0]), 10.0)
    anatomy = Anatomy((DRIVER, ORGAN, REST), (first, second, None), Box(np.full(3, -30.0), np.eye(3), np.full(3, 60.0)))
    shut = closed(anatomy, gap_mm=3.0).level_sets[1]
    points = np.random.default_rng(0).normal(scale=4.0, size=(400, 3))
    assert np.any(np.abs(shut.at(points) - second.at(points)) > 0.5)  # the gap is shut
    for phi in (shut, Union((first, shut))):
        assert phi.values_and_gradients(points)[0] == pytest.approx(phi.at(points), abs=1e-12)
