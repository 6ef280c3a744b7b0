import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate.mesh.anatomy import Box
from palpate.mesh.cutting import cut, edge_lengths, graded_grid, signed_volumes
from palpate.mesh.tet_mesh import FACES, tet_dihedrals

BOX = Box(np.array([-20.0, -20.0, -20.0]), Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix(), np.full(3, 40.0))


class Sphere:
    def at(self, points):
        return np.linalg.norm(points - BOX.world(np.full((1, 3), 20.0)), axis=1) - 11.0

    def gradient_at(self, points):
        away = points - BOX.world(np.full((1, 3), 20.0))
        return away / np.linalg.norm(away, axis=1, keepdims=True)


def _size(points):
    return 5.0 + 0.5 * np.abs(Sphere().at(points))


@pytest.fixture(scope="module")
def grid():
    return graded_grid(BOX, _size, coarsest_mm=12.0, region=1)


def _face_counts(tets):
    return np.unique(np.sort(tets[:, FACES].reshape(-1, 3), axis=1), axis=0, return_counts=True)[1]


def _border_area(grid):
    faces, _, count = np.unique(
        np.sort(grid.tets[:, FACES].reshape(-1, 3), axis=1), axis=0, return_index=True, return_counts=True
    )
    corner = grid.nodes[faces[count == 1]]
    return 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()


def test_the_grid_fills_the_box_and_conforms(grid):
    assert signed_volumes(grid.nodes, grid.tets).min() > 0.0
    assert np.isclose(signed_volumes(grid.nodes, grid.tets).sum(), BOX.volume)
    assert _face_counts(grid.tets).max() == 2
    assert np.isclose(_border_area(grid), 6 * 40.0**2), "a hanging node would leave faces inside the box"


def test_the_grid_is_as_fine_as_asked_and_well_shaped(grid):
    assert (edge_lengths(grid).max(axis=1) <= _size(grid.nodes[grid.tets].mean(axis=1)) + 1e-9).all()
    assert tet_dihedrals(grid.nodes[grid.tets]).min() > 29.0


def test_a_cut_conforms_and_keeps_the_volume(grid):
    touch = np.full(len(grid.nodes), 0.8)
    divided = cut(grid, Sphere(), inside=0, splittable=grid.region == 1, touch_mm=touch, box=BOX)
    volumes = signed_volumes(divided.nodes, divided.tets)
    assert volumes.min() > 0.0
    assert np.isclose(volumes.sum(), BOX.volume)
    assert np.isclose(_border_area(divided), 6 * 40.0**2)
    inside = volumes[divided.region == 0].sum()
    assert abs(inside / (4 / 3 * np.pi * 11.0**3) - 1.0) < 0.08
    centres = divided.nodes[divided.tets].mean(axis=1)
    assert Sphere().at(centres[divided.region == 0]).max() < 0.5


def test_a_cut_leaves_other_regions_alone(grid):
    half = np.where(BOX.local(grid.nodes[grid.tets].mean(axis=1))[:, 0] < 20.0, 2, 1)
    halves = type(grid)(grid.nodes, grid.tets, half)
    touch = np.full(len(grid.nodes), 0.8)
    divided = cut(halves, Sphere(), inside=0, splittable=half == 1, touch_mm=touch, box=BOX)
    before = signed_volumes(grid.nodes, grid.tets)[half == 2].sum()
    after = signed_volumes(divided.nodes, divided.tets)[divided.region == 2].sum()
    assert np.isclose(before, after)
    assert np.isclose(_border_area(divided), 6 * 40.0**2)
