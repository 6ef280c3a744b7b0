"""Surfaces of a report: where the organs are, and how far the model is from the later image."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from bodies import with_first_pair
from palpate.body.imaged import LaterImage
from palpate.images.distance import observation_width, tissue_distance_map
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.report.pairs import bone_distances
from palpate.report.surfaces import carried_outline, image_surface, model_surface, outer_first

TURNED = np.array([[0, 1.5, 0, -5.0], [1.0, 0, 0, -5.0], [0, 0, -2.0, 50.0], [0, 0, 0, 1]])


def ball(radius):
    grid = VoxelGrid((60, 40, 30), TURNED)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), axis=-1)
    points = grid.world(index.reshape(-1, 3).astype(float))
    inside = np.linalg.norm(points - points.mean(axis=0), axis=1) < radius
    tissues = (Tissue("rest", Role.VOID), Tissue("ball", Role.VOID, (1,)))
    return Segmentation(inside.reshape(grid.shape).astype(np.int16), grid, tissues), points.mean(axis=0)


@pytest.mark.parametrize(("most", "tolerance"), [(40_000, 0.4), (600, 1.0)])
def test_the_surface_of_a_ball_is_a_sphere_at_its_place(most, tolerance):
    image, centre = ball(18.0)
    surface = image_surface(image, 1, smoothing_mm=1.2, most_triangles=most)
    radius = np.linalg.norm(surface.points - centre, axis=1)
    assert radius.mean() == pytest.approx(18.0, abs=tolerance)
    assert radius.std() < 2.0 * tolerance
    assert 0 < len(surface.triangles) < 2.0 * most


def test_the_surface_of_a_ball_is_closed():
    surface = image_surface(ball(15.0)[0], 1, smoothing_mm=1.2)
    edges = np.sort(surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()


def test_the_line_of_an_inner_organ_lies_on_top_of_that_of_the_organ_around_it():
    radii = (6.0, 14.0, 0.0, 10.0)
    found = outer_first(image_surface(ball(radius)[0], 1, smoothing_mm=1.2) for radius in radii)
    widths = [float(np.ptp(of.points, axis=0).max()) for of in found]
    assert len(found) == 3, "what has no voxel has no line"
    assert widths == sorted(widths, reverse=True)


def test_a_tissue_without_voxels_has_no_surface():
    assert len(image_surface(ball(0.0)[0], 1, smoothing_mm=1.2).triangles) == 0


def test_the_true_motion_brings_the_model_onto_the_later_image(case_result):
    model = model_surface(case_result, 0, 0)
    seen = np.isfinite(model.distance_fitted)
    np.testing.assert_array_equal(seen, model.area > 0)
    image, width = case_result.after[0], observation_width(case_result.before.grid, case_result.after[0].grid)
    whole = tissue_distance_map(image, 0, smoothing_mm=width).at(model.fitted.astype(float))
    whole -= tissue_distance_map(case_result.before, 0, smoothing_mm=width).at(model.rest.astype(float))
    np.testing.assert_allclose(model.distance_fitted[seen], whole[seen], atol=1e-3)
    rest, fitted = (np.sqrt(np.nanmean(d**2)) for d in (model.distance_rest, model.distance_fitted))
    assert fitted < 0.6 * rest  # the fixture's mesh is a staircase; what moved is 0.6 mm in the mean


def test_an_outline_is_carried_as_the_model_moves(case_result):
    displacement = case_result.space.points @ np.diag([0.02, -0.01, 0.03]) + [1.0, 2.0, -0.5]
    estimation = dataclasses.replace(case_result.estimation, displacements=(displacement,))
    result = dataclasses.replace(case_result, estimation=estimation)
    outline = image_surface(result.before, 0, smoothing_mm=1.2)
    carried = carried_outline(result, outline, 0)
    np.testing.assert_array_equal(carried.triangles, outline.triangles)
    motion = carried.points - outline.points
    # an outline lies beside the staircase of the fixture's mesh, by 4 mm at the most, and moves as its nearest point
    expected = outline.points @ np.diag([0.02, -0.01, 0.03]) + [1.0, 2.0, -0.5]
    assert np.abs(motion - expected).max() < 0.03 * 4.0
    assert np.abs(motion - expected).mean() < 0.03


def test_a_uniform_motion_carries_every_outline_exactly(case_result):
    motion = np.array([1.0, 2.0, -0.5])
    displacement = np.tile(motion, (len(case_result.space.points), 1))
    estimation = dataclasses.replace(case_result.estimation, displacements=(displacement,))
    outline = image_surface(case_result.before, 1, smoothing_mm=1.2)
    carried = carried_outline(dataclasses.replace(case_result, estimation=estimation), outline, 0)
    np.testing.assert_allclose(
        carried.points - outline.points, np.broadcast_to([1.0, 2.0, -0.5], outline.points.shape), atol=1e-5
    )


@pytest.mark.parametrize("shift", [0.0, 1.5])
def test_bones_are_as_far_off_as_they_were_shifted(case_result, shift):
    before, _ = ball(15.0)
    rigid = tuple(dataclasses.replace(t, role=Role.RIGID) for t in before.tissues)
    affine = before.grid.affine.copy()
    affine[0, 3] += shift
    later = Segmentation(before.index, VoxelGrid(before.grid.shape, affine), rigid)
    mesh, most = case_result.space.mesh, len(rigid) - 1
    numbers = {"region": np.minimum(mesh.region, most), "beyond": np.minimum(mesh.beyond, most)}
    mesh = dataclasses.replace(mesh, tissues=rigid, **numbers)
    space = dataclasses.replace(case_result.space, mesh=mesh)
    result = with_first_pair(case_result, space=space, before=before, later=(LaterImage(1, later),))
    surfaces = [(image_surface(image, 1, smoothing_mm=1.2),) for image in (before, later)]
    (bone,) = bone_distances(result, 0, *surfaces)
    # of a shifted ball: |cos| of the angle to the shift times that, half of it in the mean
    assert bone.mean_mm == pytest.approx(0.5 * shift, abs=0.05)
    assert 0.85 * shift <= bone.p95_mm <= shift + 1e-6
