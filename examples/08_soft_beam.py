"""Find the Young's modulus of a soft beam from forty markers, before and after its clamp is turned over."""

import sys
import tempfile
from pathlib import Path

import meshio
import numpy as np

import palpate
from palpate.images import Role, Tissue
from palpate.mechanics import choose_element, equilibrium, gravity, law_named, outer_constraint
from palpate.mesh import Anatomy, Box, lagrange_space, located, point_interpolation, tetrahedralise

SILICONE = Tissue("silicone", Role.ESTIMATE, (1,))
BODY = Anatomy((SILICONE,), (None,), Box(np.zeros(3), np.eye(3), np.array([50.0, 10.0, 10.0])))  # mm
CASE = """
body.mesh = "beam.vtu"
surfaces = [{ name = "clamp", where = "x_min", boundary = "fixed" }]
tissues.silicone = { label = 1, role = "estimate" }
discrepancy.heterogeneity_sd = 0.0  # of one material
estimate = { starts_kpa = [100.0, 500.0], bounds_kpa = [1.0, 10000.0] }
data = [{ kind = "landmarks", file = "markers.csv", sd_mm = 0.05 }]
loads = [{ kind = "gravity", state = 0, acceleration_m_s2 = [0.0, 0.0, -9.81] },  # its own weight, in both states
         { kind = "gravity", state = 1, acceleration_m_s2 = [0.0, 0.0, 9.81] }]
"""


def write_beam(folder: Path) -> None:
    """Write the hanging beam (200 kPa) as a coarse mesh, and forty markers in it; a finer mesh simulates both."""
    space = lagrange_space(tetrahedralise(BODY, edge_length_mm=0.9), "P2")
    none, held = np.zeros((space.points.size, 0)), space.points[:, 0] < 0.001
    clamp = outer_constraint(space, outer="free", modes=none, offset=none.sum(axis=1), prescribed=held)
    how = {"law": law_named("neo-hookean"), "dilatation": choose_element("auto").dilatation}
    weights = [gravity(space, np.array([1000.0]), np.array([0.0, 0.0, g])) for g in (-9.81, 9.81)]
    down, up = (equilibrium(space, clamp, np.array([200.0]), loads=(w,), **how).displacement for w in weights)
    mesh, rng = tetrahedralise(BODY, edge_length_mm=1.3), np.random.default_rng(0)
    points = rng.uniform(1.0, [49.0, 9.0, 9.0], (40, 3))
    at_nodes, at_points = (point_interpolation(space, located(space.mesh, x)) for x in (mesh.nodes, points))
    meshio.write(folder / "beam.vtu", meshio.Mesh(mesh.nodes + at_nodes @ down, [("tetra", mesh.tets)]))
    table = np.c_[points + at_points @ down, points + at_points @ up + 0.05 * rng.standard_normal((40, 3))]
    head = "before_x,before_y,before_z,after_x,after_y,after_z"
    np.savetxt(folder / "markers.csv", table, delimiter=",", header=head, comments="")


def main() -> float:
    """Write the case, estimate, print the result, and return the modulus (kPa)."""
    with tempfile.TemporaryDirectory() as name:
        write_beam(Path(name))
        (Path(name) / "case.toml").write_text(CASE)
        result = palpate.estimate(palpate.read_case(Path(name) / "case.toml"))
    sys.stdout.write(f"{result}\n")
    return result.estimation.estimates[0].value


if __name__ == "__main__":
    main()
