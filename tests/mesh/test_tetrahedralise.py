from dataclasses import dataclass

import numpy as np
import pytest

from palpate.errors import GeometryError, ResourceError
from palpate.images.tissue import Role, Tissue
from palpate.mesh.anatomy import Anatomy, Box
from palpate.mesh.quality import check_mesh
from palpate.mesh.surface import tissue_surface
from palpate.mesh.tet_mesh import OUTER
from palpate.mesh.tetrahedralise import tetrahedralise


@dataclass(frozen=True)
class Ball:
    centre: tuple[float, float, float]
    radius: float

    def at(self, points):
        return np.linalg.norm(points - np.array(self.centre), axis=1) - self.radius

    def gradient_at(self, points):
        away = points - np.array(self.centre)
        return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)


TUMOUR = Tissue("tumour", Role.ESTIMATE, (4,))
ORGAN = Tissue("organ", Role.ESTIMATE, (1,))
DRIVER = Tissue("driver", Role.DRIVER, (2,))
REST = Tissue("rest", Role.KNOWN, youngs_modulus_kpa=10.0)
BOX = Box(np.full(3, -30.0), np.eye(3), np.full(3, 60.0))


@pytest.fixture(scope="module")
def anatomy():
    """An organ with a tumour, and a driver cut by the box and so near that no tetrahedron fits between."""
    shapes = (Ball((-2.0, 0.0, 1.0), 6.0), Ball((0.0, 0.0, 0.0), 14.0), Ball((0.0, 26.3, 0.0), 12.0), None)
    return Anatomy((TUMOUR, ORGAN, DRIVER, REST), shapes, BOX)


@pytest.fixture(scope="module")
def mesh(anatomy):
    return tetrahedralise(anatomy, edge_length_mm=4.0)


def test_organs_that_contain_or_touch_each_other_pass_the_gate(mesh, anatomy):
    quality = check_mesh(mesh, anatomy)
    assert quality.min_dihedral_deg > 8.0
    assert set(np.unique(mesh.region)) == {0, 1, 3}


@pytest.fixture(scope="module")
def coarse(anatomy):
    return tetrahedralise(anatomy, edge_length_mm=8.0)


def test_the_same_anatomy_gives_the_same_mesh_in_whatever_room_mmg_takes(coarse, anatomy, monkeypatch, capfd):
    monkeypatch.setattr("palpate.mesh.remeshing.SMALL_TETS", 0)
    wide = tetrahedralise(anatomy, edge_length_mm=8.0)
    assert np.array_equal(wide.nodes, coarse.nodes)
    assert np.array_equal(wide.tets, coarse.tets)
    assert capfd.readouterr() == ("", "")


def test_mmg_without_room_is_a_lack_of_memory_that_says_what_to_do(anatomy, monkeypatch, capfd):
    monkeypatch.setattr("palpate.mesh.remeshing.LEAST_MB", 8)
    with pytest.raises(ResourceError, match=r"make mesh\.edge_length_mm larger"):
        tetrahedralise(anatomy, edge_length_mm=8.0)
    assert capfd.readouterr() == ("", "")


def test_the_wall_of_the_driver_is_known_from_the_cut_of_the_image(mesh):
    corners = mesh.nodes[mesh.boundary]
    on_box = BOX.faces_of(corners).any(axis=1)
    assert np.array_equal(mesh.beyond == OUTER, on_box)
    assert set(np.unique(mesh.beyond)) == {OUTER, 2}
    wall = mesh.nodes[tissue_surface(mesh, 2).nodes]
    assert np.percentile(np.abs(Ball((0.0, 26.3, 0.0), 12.0).at(wall)), 95) < 0.35


def test_the_surface_of_the_organ_knows_where_it_touches(mesh):
    other = tissue_surface(mesh, 1).other
    assert set(np.unique(other)) == {0, 2, 3}


def test_organs_have_edges_of_their_own_length(mesh, anatomy):
    """The tumour's stay; elsewhere, also far from all organs, they are longer, and its surface is nearly as exact."""
    graded = tetrahedralise(anatomy, edge_length_mm=4.0, longer_mm={"driver": 8.0, "organ": 6.0})

    def edge(of, tissue):
        """Median edge length, mm, of a tissue's surface."""
        corners = of.nodes[tissue_surface(of, tissue).triangles]
        return float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))

    assert edge(graded, 0) == pytest.approx(edge(mesh, 0), rel=0.2)
    assert edge(graded, 2) > 1.3 * edge(mesh, 2)
    assert len(graded.tets) < 0.6 * len(mesh.tets)
    check_mesh(graded, anatomy)
    off = [
        np.abs(Ball((-2.0, 0.0, 1.0), 6.0).at(of.nodes[tissue_surface(of, 0).nodes])).mean() for of in (graded, mesh)
    ]
    assert off[0] < 1.5 * off[1]


def test_a_body_in_air_has_a_free_surface():
    tissues = (DRIVER, ORGAN, Tissue("air", Role.VOID))
    shapes = (Ball((0.0, 0.0, 0.0), 8.0), Ball((0.0, 0.0, 0.0), 20.0), None)
    mesh = tetrahedralise(Anatomy(tissues, shapes, BOX), edge_length_mm=5.0)
    radius = np.linalg.norm(mesh.nodes[mesh.boundary].mean(axis=1), axis=1)
    assert np.array_equal(mesh.beyond, np.where(radius < 14.0, 0, 2))
    assert abs(mesh.volumes.sum() / (4 / 3 * np.pi * (20.0**3 - 8.0**3)) - 1.0) < 0.01


def test_an_impossible_edge_length_is_refused(anatomy):
    with pytest.raises(GeometryError, match="edge_length_mm"):
        tetrahedralise(anatomy, edge_length_mm=0.0)
    with pytest.raises(GeometryError, match="edge_length_mm"):
        tetrahedralise(anatomy, edge_length_mm=100.0)
