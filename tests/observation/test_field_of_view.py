"""A later image with a smaller field of view shows less of the surfaces, and changes nothing of what it shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import GeometryError
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.mesh.anatomy import anatomy_of, domain_box
from palpate.mesh.space import lagrange_space
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.observation.contract import ImagedBody
from palpate.observation.observed_surface import field_of_view, observed_surfaces
from palpate.observation.surface_distance import surface_distances

SHAPE = (44, 40, 40)
TISSUES = (
    Tissue("organ", Role.ESTIMATE, (1,)),
    Tissue("fat", Role.KNOWN, (2,), youngs_modulus_kpa=5.0),
    Tissue("tube", Role.DRIVER, (3,)),
    Tissue("bone", Role.RIGID, (4,)),
    Tissue("air", Role.VOID, (5,)),
    Tissue("rest", Role.KNOWN, (), youngs_modulus_kpa=10.0),
)
SMOOTHING = 1.5


def image(shift: float = 0.0) -> Segmentation:
    """An organ beside a tube, fat above them, air in front of all and a bone in a corner, on voxels of 1.5 mm."""
    affine = np.diag([1.5, 1.5, 1.5, 1.0])
    affine[:3, 3] = -0.75 * (np.array(SHAPE) - 1.0)
    grid = VoxelGrid(SHAPE, affine)
    x, y, z = grid.world(np.indices(SHAPE).reshape(3, -1).T.astype(float)).T
    index = np.full(len(x), 5)
    index[(x / 20.0) ** 2 + (y / 18.0) ** 2 + ((z - 24.0) / 7.0) ** 2 < 1.0] = 1
    index[(x - shift) ** 2 / 16.0**2 + (y / 13.0) ** 2 + ((z - 2.0) / 12.0) ** 2 < 1.0] = 0
    index[(y + 21.0) ** 2 + z**2 < 5.0**2] = 2
    index[(x - 26.0) ** 2 + (y + 24.0) ** 2 + (z + 24.0) ** 2 < 6.0**2] = 3
    index[y > 24.0 + 0.004 * x**2] = 4
    return Segmentation(index.reshape(SHAPE), grid, TISSUES)


def cropped(whole: Segmentation, low: tuple[int, int, int], high: tuple[int, int, int]) -> Segmentation:
    """The image without so many voxels at its low and high ends."""
    part = tuple(slice(a, n - b) for a, b, n in zip(low, high, whole.index.shape, strict=True))
    affine = whole.grid.affine.copy()
    affine[:3, 3] = whole.grid.world(np.array([low], dtype=float))[0]
    index = whole.index[part]
    return replace(whole, index=index, grid=VoxelGrid(index.shape, affine))


@pytest.fixture(scope="module")
def space():
    before = image()
    anatomy = anatomy_of(before, box=domain_box([before.grid]), smoothing_mm=0.9)
    return lagrange_space(tetrahedralise(anatomy, edge_length_mm=7.5), "P1")


def seen(space, *later: Segmentation):
    return surface_distances(ImagedBody(space, image(), later, SMOOTHING))


@pytest.fixture(scope="module")
def whole(space):
    """What is compared of a later image that shows as much as the first."""
    (found,) = seen(space, image(1.0))
    return found


def by_place(residuals):
    """Residual by its place, to micrometres."""
    return {tuple(np.round(place, 3)): value for place, value in zip(residuals.places, residuals.values, strict=True)}


def test_every_surface_that_both_images_show_is_compared_but_the_bones_and_the_fillers(whole):
    assert [o.name for o in whole] == ["organ", "fat", "tube", "air"]
    assert [o.of_driver for o in whole] == [False, False, True, False]
    for observation in whole:
        residuals = observation.residuals(np.zeros(len(observation.dofs)))
        assert residuals.weights.sum() == pytest.approx(1.0)
        assert 0.5 < observation.observed_share <= 1.0


def test_an_estimate_tissue_is_compared_even_where_it_fills_what_others_leave(space):
    tissues = (*TISSUES[:-1], replace(TISSUES[-1], role=Role.ESTIMATE, youngs_modulus_kpa=None))
    mesh = replace(space.mesh, tissues=tissues)
    found = observed_surfaces(lagrange_space(mesh, "P1"), replace(image(), tissues=tissues))
    assert [surface.name for surface in found] == ["organ", "fat", "tube", "air", "rest"]


def test_a_surface_that_a_later_image_does_not_show_is_left_out_there_alone(space):
    later = image(1.0)
    without = replace(later, index=np.where(later.index == 4, 5, later.index))
    found = seen(space, without, later)
    assert [[o.name for o in of] for of in found] == [["organ", "fat", "tube"], ["organ", "fat", "tube", "air"]]


@pytest.mark.parametrize(("low", "high"), [((5, 0, 0), (0, 0, 0)), ((0, 0, 0), (9, 0, 0)), ((3, 1, 2), (3, 1, 0))])
def test_a_smaller_field_of_view_leaves_the_residuals_of_what_both_show_as_they_are(space, whole, low, high):
    (part,) = seen(space, cropped(image(1.0), low, high))
    for all_of, some in zip(whole, part, strict=False):
        assert some.name == all_of.name
        still = np.zeros(len(some.dofs))
        every, left = by_place(all_of.residuals(still)), by_place(some.residuals(still))
        model = {place: value for place, value in left.items() if place in every}
        assert len(model) > 0.4 * len(left)
        np.testing.assert_allclose(list(model.values()), [every[place] for place in model], atol=2e-2)
        assert some.observed_share <= all_of.observed_share


def test_the_flat_face_of_an_organ_that_the_later_image_cuts_has_no_weight(space):
    """The organ ends at x = 16 mm; the later image ends at x = 10.5 mm."""
    (found,) = seen(space, cropped(image(0.0), (0, 0, 0), (15, 0, 0)))
    organ = found[0]
    residuals = organ.residuals(np.zeros(len(organ.dofs)))
    assert residuals.places[:, 0].max() < 10.5 - 2.0 * SMOOTHING
    assert np.abs(residuals.values).max() < 0.5
    assert organ.observed_share < 0.9


def test_points_that_the_motion_brings_into_view_are_compared_and_such_that_leave_it_are_not(space):
    (found,) = seen(space, cropped(image(0.0), (0, 0, 0), (12, 0, 0)))
    organ = found[0]
    motion = np.zeros((len(organ.dofs) // 3, 3))
    motion[:, 0] = -4.0
    assert organ.rematched(motion.ravel()).observed_share > organ.rematched(0.0 * motion.ravel()).observed_share
    assert organ.rematched(-motion.ravel()).observed_share < organ.rematched(0.0 * motion.ravel()).observed_share


def test_an_image_that_shows_next_to_nothing_of_an_organ_is_refused_by_name(space):
    with pytest.raises(GeometryError, match="'organ': the field of view of 'after"):
        seen(space, image(1.0), cropped(image(1.0), (0, 0, 0), (33, 0, 0)))


def test_images_of_one_field_cut_nothing_wherever_their_grids_lie():
    grid = image().grid
    nudged = grid.affine.copy()
    nudged[:3, 3] += 0.6
    for other in (grid, VoxelGrid(SHAPE, nudged)):
        assert not len(field_of_view(grid, other, smoothing_mm=1.0).least)
    smaller = cropped(image(), (4, 0, 0), (0, 0, 0)).grid
    assert len(field_of_view(grid, smaller, smoothing_mm=1.0).least) == 1
    assert not len(field_of_view(smaller, grid, smoothing_mm=1.0).least)
