import numpy as np
import pytest

from palpate.mechanics.laws.registry import law_named
from palpate.mesh.space import lagrange_space
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.phantoms.motion import AffineMotion
from palpate.phantoms.scene import BoundaryMotion, displacements
from palpate.phantoms.shapes import rotation_about
from palpate.phantoms.spheres import SpheresOptions, spheres, spheres_anatomy

OPTIONS = SpheresOptions(seed=1, kind="pushed", truth_edge_mm=10.0, spacing_mm=(3.0, 3.0, 3.0))
PULL = AffineMotion(np.diag([0.02, 0.0, -0.01]), np.zeros(3), np.array([0.5, 0.0, 1.0]))


@pytest.fixture(scope="module")
def space():
    return lagrange_space(tetrahedralise(spheres_anatomy(OPTIONS), edge_length_mm=10.0), "P2")


def border(space):
    return np.unique(space.facets(space.mesh.boundary[space.mesh.beyond == -1]))


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_the_border_moves_as_it_is_told_and_the_walls_as_they_are(space, law):
    cavity = AffineMotion(0.1 * np.eye(3), np.zeros(3), np.zeros(3))
    (found,) = displacements(space, [BoundaryMotion({"cavity": cavity}, PULL)], law=law_named(law))
    wall = np.unique(space.facets(space.mesh.boundary[space.mesh.beyond == space.mesh.tissue_index("cavity")]))
    assert found[border(space)] == pytest.approx(PULL.at(space.points[border(space)]))
    assert found[wall] == pytest.approx(cavity.at(space.points[wall]))


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_a_boundary_that_moves_as_one_takes_the_body_along(space, law):
    # under the linear law a rotation is not free of strain, so that only the other one is turned
    turn = rotation_about(np.array([1.0, 2.0, 0.5]), 4.0) - np.eye(3) if law != "linear" else np.zeros((3, 3))
    rigid = AffineMotion(turn, np.array([1.0, 0.0, 2.0]), np.array([3.0, -2.0, 1.0]))
    (found,) = displacements(space, [BoundaryMotion({"cavity": rigid}, rigid)], law=law_named(law))
    assert found == pytest.approx(rigid.at(space.points), abs=1e-4)


def test_motions_of_the_linear_law_add_up_and_share_no_part(space):
    cavity = {"cavity": AffineMotion(0.1 * np.eye(3), np.zeros(3), np.zeros(3))}
    asked = [BoundaryMotion(cavity), BoundaryMotion({}, PULL), BoundaryMotion(cavity, PULL)]
    walls, outside, both = displacements(space, asked, law=law_named("linear"))
    assert both == pytest.approx(walls + outside, abs=1e-9)
    (alone,) = displacements(space, asked[:1], law=law_named("linear"))
    assert walls == pytest.approx(alone, abs=1e-9)


def test_a_scene_holds_its_border():
    scene = spheres(OPTIONS)
    assert np.abs(scene.displacement[border(scene.space)]).max() == 0.0
