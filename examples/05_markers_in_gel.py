"""How stiff is a ball in a gel? Sixty markers are seen before and after the top of the gel is pushed down.

No image is needed, as the block is given as a mesh. The markers are simulated on a finer mesh than the estimate's.
"""

import sys
import tempfile
from pathlib import Path

import meshio
import numpy as np

import palpate
from palpate.images import Role, Tissue
from palpate.mechanics import linear_model, outer_constraint
from palpate.mesh import Anatomy, Box, lagrange_space, located, point_interpolation, tetrahedralise
from palpate.phantoms import ball

TISSUES = (Tissue("ball", Role.ESTIMATE, (1,)), Tissue("gel", Role.KNOWN, (2,), youngs_modulus_kpa=10.0))
BOX = Box(np.full(3, -20.0), np.eye(3), np.full(3, 40.0))  # 40 mm each way
BODY = Anatomy(TISSUES, (ball(np.zeros(3), 10.0), None), BOX)  # a ball of 10 mm radius; the gel fills the rest
CASE = """
body.mesh = "block.vtu"
surfaces = [{ name = "floor", where = "z_min", boundary = "fixed" }, { name = "top", where = "z_max" }]
data = [{ kind = "landmarks", file = "markers.csv", sd_mm = 0.02 }]
mechanics.law = "linear"  # as in the simulation
tissues.ball = { label = 1, role = "estimate" }
tissues.gel = { label = 2, role = "known", youngs_modulus_kpa = 10.0 }
"""


def markers() -> np.ndarray:
    """Sixty markers (n, 6) mm, before and after the top has moved down by 2 mm; the ball has 40 kPa."""
    space, rng = lagrange_space(tetrahedralise(BODY, edge_length_mm=4.0), "P2"), np.random.default_rng(0)
    z, none = space.points[:, 2], np.zeros((space.points.size, 0))
    offset = np.where(z[:, None] > 19.999, [0.0, 0.0, -2.0], 0.0).ravel()
    held = outer_constraint(space, outer="free", modes=none, offset=offset, prescribed=np.abs(z) > 19.999)
    solution = linear_model(space, held).solve(np.array([40.0, 10.0]), np.zeros(0))
    points = rng.uniform(-17.0, 17.0, (60, 3))
    moved = point_interpolation(space, located(space.mesh, points)) @ solution.displacement
    return np.c_[points, points + moved + 0.02 * rng.standard_normal((60, 3))]


def main() -> float:
    """Write the case, estimate, print the result, and return the ball's modulus (kPa)."""
    with tempfile.TemporaryDirectory() as name:
        folder, mesh = Path(name), tetrahedralise(BODY, edge_length_mm=6.0)
        data = {"tissue": [mesh.region + 1]}
        meshio.write(folder / "block.vtu", meshio.Mesh(mesh.nodes, [("tetra", mesh.tets)], cell_data=data))
        head = "before_x,before_y,before_z,after_x,after_y,after_z"
        np.savetxt(folder / "markers.csv", markers(), delimiter=",", header=head, comments="")
        (folder / "case.toml").write_text(CASE)
        result = palpate.estimate(palpate.read_case(folder / "case.toml"))
    sys.stdout.write(f"{result}\n")
    return result.estimation.estimates[0].value


if __name__ == "__main__":
    main()
