"""Sections: a plane through known shapes shows them where they are, the right way round."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.images.label_image import VoxelGrid
from palpate.mesh.surface import tissue_surface
from palpate.report.rows import number
from palpate.report.section import VIEWS, Plane, cut_image, cut_triangles, joined

LOW, HIGH = np.array([0.0, 0.0, 0.0]), np.array([40.0, 40.0, 40.0])


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.name)
def test_a_linear_field_is_cut_exactly(view):
    turned = np.array([[0, 2.0, 0, -5.0], [1.5, 0, 0, -5.0], [0, 0, -3.0, 50.0], [0, 0, 0, 1]])
    grid = VoxelGrid((40, 30, 20), turned)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), axis=-1).reshape(-1, 3)
    field = (grid.world(index.astype(float)) @ [1.0, 10.0, 100.0]).reshape(grid.shape)
    plane = Plane(view, 17.3, LOW, HIGH)
    np.testing.assert_allclose(cut_image(field, grid, plane), plane.points @ [1.0, 10.0, 100.0], rtol=1e-9)


def test_outside_its_grid_an_image_is_nothing():
    grid = VoxelGrid((10, 10, 10), np.eye(4))
    cut = cut_image(np.ones((10, 10, 10)), grid, Plane(VIEWS[0], 5.0, LOW, HIGH))
    assert 0.9 < np.isfinite(cut).sum() * (40 / cut.shape[0]) ** 2 / 100 < 1.1


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.name)
def test_a_closed_surface_is_cut_in_closed_lines(case_result, view):
    mesh = case_result.space.mesh
    triangles = tissue_surface(mesh, 0).triangles
    segments = cut_triangles(mesh.nodes, triangles, Plane(view, 14.0, LOW, HIGH))[0]
    assert len(segments) > 8
    _, count = np.unique(np.round(segments.reshape(-1, 2), 6), axis=0, return_counts=True)
    assert (count % 2 == 0).all()


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.name)
def test_joined_lines_hold_every_segment_once_and_close(case_result, view):
    mesh = case_result.space.mesh
    triangles = tissue_surface(mesh, 0).triangles
    plane = Plane(view, 14.0, LOW, HIGH)
    lines = joined(mesh.nodes, triangles, plane)
    assert sum(len(line) - 1 for line in lines) == len(cut_triangles(mesh.nodes, triangles, plane)[0])
    for line in lines:
        np.testing.assert_allclose(line[0], line[-1])


def test_an_open_surface_is_cut_in_one_line_from_end_to_end():
    x = np.arange(6.0)
    points = np.concatenate([np.stack([x, 0 * x, 0 * x - 1], axis=1), np.stack([x, 0 * x, 0 * x + 1], axis=1)])
    triangles = np.array([t for i in range(5) for t in ((i, i + 1, i + 6), (i + 1, i + 7, i + 6))])[
        [4, 2, 7, 0, 9, 1, 3, 8, 6, 5]
    ]
    (line,) = joined(points, triangles, Plane(VIEWS[0], 0.1, LOW, HIGH))
    assert sorted((line[0, 0], line[-1, 0])) == [0.0, 5.0]
    assert len(line) == 11


def test_a_plane_through_nodes_is_no_special_case(case_result):
    mesh = case_result.space.mesh
    segments = cut_triangles(mesh.nodes, tissue_surface(mesh, 0).triangles, Plane(VIEWS[0], 12.0, LOW, HIGH))[0]
    assert np.isfinite(segments).all()
    assert len(segments) > 8


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (58.94, "58.9"),
        (1234.0, "1230"),
        (0.99999, "1.00"),
        (999.9, "1000"),
        (0.02, "0.0200"),
        (0.0, "0"),
        (None, "–"),
        (float("nan"), "–"),
        (1e-9, "1.00e-09"),
    ],
)
def test_numbers_have_three_digits(value, text):
    assert number(value) == text
