"""Find the Young's modulus (kPa) of a block under a press, from a mesh, a table of displacements and the force.

The displacements are simulated on a finer mesh, as digital volume correlation gives them. The force sets the scale.
"""

import sys
import tempfile
from pathlib import Path

import meshio
import numpy as np

import palpate
from palpate.images import Role, Tissue
from palpate.mechanics import choose_element, equilibrium, law_named, outer_constraint, traction
from palpate.mesh import Anatomy, Box, lagrange_space, tetrahedralise

BLOCK = Tissue("block", Role.ESTIMATE, (1,), poisson_ratio=0.4)
BODY = Anatomy((BLOCK,), (None,), Box(np.zeros(3), np.eye(3), np.array([20.0, 20.0, 30.0])))  # mm
CASE = """
body.mesh = "block.vtu"
surfaces = [{ name = "table", where = "z_min" }, { name = "plate", where = "z_max" }]  # how they move is unknown
tissues.block = { label = 1, role = "estimate", poisson_ratio = 0.4 }
discrepancy.heterogeneity_sd = 0.0  # the block is of one material
estimate = { starts_kpa = [50.0, 500.0], bounds_kpa = [1.0, 10000.0] }
data = [
  { kind = "displacement-field", file = "field.csv", sd_mm = 0.02 },
  { kind = "force", surface = "plate", direction = [0.0, 0.0, 1.0], force_n = -3.0, sd_n = 0.03 },
]
"""


def field(rng: np.random.Generator) -> np.ndarray:
    """Points (n, 6) mm before and after a plate presses by 7.5 kPa on 150 kPa, with 0.02 mm of noise."""
    space = lagrange_space(tetrahedralise(BODY, edge_length_mm=1.0), "P2")
    faces, no_motion = space.mesh.boundary, np.zeros((space.points.size, 0))
    table, plate = space.points[:, 2] < 0.001, (space.points[faces][..., 2] > 29.999).all(axis=1)
    held = outer_constraint(space, outer="free", modes=no_motion, offset=no_motion.sum(axis=1), prescribed=table)
    press = traction(space, faces[plate], np.array([0.0, 0.0, -7.5]))
    how = {"law": law_named("neo-hookean"), "dilatation": choose_element("auto").dilatation, "loads": (press,)}
    moved = equilibrium(space, held, np.array([150.0]), **how).displacement
    return np.c_[space.points, space.points + moved + 0.02 * rng.standard_normal(moved.shape)]


def main() -> float:
    """Write the case, estimate, print the result, and return the block's modulus (kPa)."""
    with tempfile.TemporaryDirectory() as name:
        folder, mesh = Path(name), tetrahedralise(BODY, edge_length_mm=1.5)
        meshio.write(folder / "block.vtu", meshio.Mesh(mesh.nodes, [("tetra", mesh.tets)]))
        head = "before_x,before_y,before_z,after_x,after_y,after_z"
        np.savetxt(folder / "field.csv", field(np.random.default_rng(0)), delimiter=",", header=head, comments="")
        (folder / "case.toml").write_text(CASE)
        result = palpate.estimate(palpate.read_case(folder / "case.toml"))
    sys.stdout.write(f"{result}\n")
    return result.estimation.estimates[0].value


if __name__ == "__main__":
    main()
