"""A reference that bears loads itself: moduli as if the state without stress had been seen."""

from __future__ import annotations

import meshio
import numpy as np
import pytest

import palpate
from bodies import box_cells
from palpate.case.file import read_case
from palpate.errors import ConfigurationError, NotConverged
from palpate.images.tissue import Role, Tissue
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.equilibrium import equilibrium
from palpate.mechanics.laws.registry import LAWS
from palpate.mechanics.loads import gravity
from palpate.mesh.space import lagrange_space
from palpate.mesh.tet_mesh import TetMesh
from palpate.mesh.tetrahedralise import boundary_of
from palpate.observation.prescribed_motion import prescribed_motion
from palpate.study.run import estimate

MODULUS, SIZE = 60.0, (60.0, 10.0, 10.0)
CASE = """
[body]
mesh = "beam.vtu"

[[surfaces]]
name = "clamp"
where = "x_min"
within_mm = 0.1
boundary = "fixed"

[tissues.gel]
label = "remaining"
role = "estimate"

[mechanics]
law = "LAW"
element = "P1"

[discrepancy]
heterogeneity_sd = 0.0
poisson_sd = 0.0
layer_sd = 0.0

[estimate]
starts_kpa = [80.0]
bounds_kpa = [1.0, 5000.0]

[[data]]
kind = "displacement-field"
file = "field.csv"
sd_mm = 0.02
"""


def weighs(state, m_s2):
    return f'[[loads]]\nkind = "gravity"\nstate = {state}\nacceleration_m_s2 = [0.0, 0.0, {m_s2}]\n'


def beam():
    """A straight beam of P1 tetrahedra, clamped where x is 0."""
    nodes, tets = box_cells((12, 3, 3), SIZE)
    volumes = np.linalg.det(nodes[tets[:, 1:]] - nodes[tets[:, :1]])
    tets = np.where(volumes[:, None] < 0.0, tets[:, [0, 2, 1, 3]], tets)
    boundary = boundary_of(tets)
    behind = np.where((nodes[boundary][:, :, 0] < 1e-9).all(axis=1), 1, 2)
    tissues = (Tissue("gel", Role.ESTIMATE), Tissue("clamp", Role.RIGID), Tissue("air", Role.VOID))
    return lagrange_space(TetMesh(nodes, tets, np.zeros(len(tets), int), boundary, behind, tissues), "P1")


def moved(space, law, m_s2):
    """The beam's displacement under its weight, from where it is free of stress."""
    held = prescribed_motion(space, {}, n_modes=0, kernel_mm=1.0, prior_mm=1.0).prescribed
    n = 3 * len(space.points)
    constraint = outer_constraint(space, outer="free", modes=np.zeros((n, 0)), offset=np.zeros(n), prescribed=held)
    weight = gravity(space, np.full(3, 1000.0), np.array([0.0, 0.0, m_s2]))
    stated = {"law": LAWS[law], "dilatation": Dilatation.BLENDED, "loads": (weight,)}
    return equilibrium(space, constraint, np.array([MODULUS]), **stated).displacement


def write(folder, law, *, before=-9.81, after=9.81):
    """The beam as it lies under its weight, and where its points then lie under another."""
    space = beam()
    first, second = (moved(space, law, m_s2) for m_s2 in (before, after))
    seen = space.points + (first if law == "neo-hookean" else 0.0)  # a linear body keeps its shape
    meshio.write(folder / "beam.vtu", meshio.Mesh(seen, [("tetra", space.mesh.tets)]))
    head = "before_x,before_y,before_z,after_x,after_y,after_z"
    inside = seen + 1e-6 * (seen.mean(axis=0) - seen)
    np.savetxt(folder / "field.csv", np.c_[inside, inside + second - first], delimiter=",", header=head, comments="")


def estimated(folder, law, *loads):
    (folder / "case.toml").write_text(CASE.replace("LAW", law) + "".join(loads))
    return estimate(read_case(folder / "case.toml"))


def found(folder, law, *loads):
    return estimated(folder, law, *loads).estimation.estimates[0].value


def test_a_linear_body_that_bears_a_load_is_moved_by_what_is_added_to_it(tmp_path):
    write(tmp_path, "linear", after=-29.43)
    tripled = found(tmp_path, "linear", weighs(0, -9.81), weighs(1, -29.43))
    assert tripled == pytest.approx(MODULUS, rel=1e-5)
    assert found(tmp_path, "linear", weighs(1, -19.62)) == pytest.approx(tripled, rel=1e-6)


def test_a_beam_that_hangs_and_is_turned_over_or_relieved_tells_the_modulus_that_bends_it(tmp_path):
    """Its tip hangs by 14 of 60 mm; the increment of loads alone is wrong by per cents, and that is in no interval."""
    for after in (9.81, 0.0, -19.62):
        write(tmp_path, "neo-hookean", after=after)
        rest = found(tmp_path, "neo-hookean", weighs(0, -9.81), weighs(1, after))
        assert rest == pytest.approx(MODULUS, rel=1e-3)
    increment = found(tmp_path, "neo-hookean", weighs(1, -9.81))
    assert abs(increment / MODULUS - 1.0) > 0.03


def test_a_strained_mesh_is_not_written_for_programs_that_take_it_for_free_of_stress(tmp_path):
    write(tmp_path, "neo-hookean")
    result = estimated(tmp_path, "neo-hookean", weighs(0, -9.81), weighs(1, 9.81))
    with pytest.raises(ConfigurationError, match="free of stress; export to vtu"):
        palpate.export(result, tmp_path / "febio", format="febio")
    assert palpate.export(result, tmp_path / "vtu", format="vtu")


def test_loads_that_no_state_without_stress_can_bear_end_in_a_sentence(tmp_path):
    write(tmp_path, "neo-hookean")
    with pytest.raises(NotConverged, match="stress-free state of the reference"):
        found(tmp_path, "neo-hookean", weighs(0, -100.0), weighs(1, -98.0))


@pytest.mark.parametrize(
    ("law", "loads", "warned"),
    [
        ("neo-hookean", ((1, 9.81),), True),
        ("mooney-rivlin", ((1, 9.81),), True),
        ("neo-hookean", ((0, -9.81), (1, 9.81)), False),
        ("linear", ((1, 9.81),), False),
        ("neo-hookean", (), False),
    ],
)
def test_weight_in_a_later_state_alone_is_asked_about_at_finite_strain(tmp_path, law, loads, warned):
    write(tmp_path, "linear")
    (tmp_path / "case.toml").write_text(CASE.replace("LAW", law) + "".join(weighs(*load) for load in loads))
    codes = [problem.code for problem in palpate.check(tmp_path / "case.toml").problems]
    assert ("weightless-reference" in codes) is warned
