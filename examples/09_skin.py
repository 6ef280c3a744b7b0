"""Find how stiff living skin is (kPa, if it is 1 mm thick), from points that cameras saw and the force of a pull.

Pads of 8 x 8 mm are glued to a forearm, 32 mm apart; one is pulled by 1 mm. Not simulated: see docs/measured.md.
"""

import shutil
import sys
import tempfile
from pathlib import Path

import meshio
import numpy as np

import palpate

SEEN = Path(__file__).parent / "skin" / "healthy.csv"  # Elouneg et al., MIT licence; cameras see no motion along z
GROUPS = {"moving": [1, 2], "fixed": [2, 2], "border": [3, 2], "underside": [4, 2], "skin": [5, 3]}  # tag, dimension
CASE = """
body.mesh = "skin.msh"
surfaces = [{ name = "underside", where = "underside", boundary = "sliding" }, { name = "moving", where = "moving" },
            { name = "fixed", where = "fixed" }, { name = "border", where = "border" }]  # how these move is unknown
tissues.skin = { label = "skin", role = "estimate", poisson_ratio = 0.3 }
mechanics = { law = "neo-hookean", element = "P1" }
estimate = { starts_kpa = [10.0, 100.0], bounds_kpa = [0.1, 10000.0] }
[[data]]
kind = "displacement-field"
file = "healthy.csv"
correlation_mm = 4.0
[[data]]
kind = "force"
surface = "moving"
direction = [-1.0, 0.0, 0.0]
force_n = 0.0234
sd_n = 0.0005
offset_sd_n = 0.0018
"""


def write_sheet(path: Path) -> None:
    """Write a sheet of 100 x 50 x 1 mm with holes for the pads, and its surfaces as groups."""
    x, y = np.arange(0.0, 101.0, 2.0), np.arange(-5.0, 46.0)
    plane = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    n, (i, j) = len(plane), np.meshgrid(np.arange(len(x) - 1), np.arange(len(y) - 1))
    in_pad = (y[j] >= 16.0) & (y[j] < 24.0) & (np.abs(np.abs(x[i] - 49.0) - 20.0) < 4.0)  # their middles: 30 and 70
    a = (i + len(x) * j)[~in_pad]
    flat = np.concatenate([np.c_[a, a + 1, a + len(x) + 1], np.c_[a, a + len(x), a + len(x) + 1]])
    tets = np.concatenate([np.c_[flat[:, : k + 1], flat[:, k:] + n] for k in range(3)])  # three to a prism
    edges, count = np.unique(flat[:, [0, 1, 1, 2, 0, 2]].reshape(-1, 2), axis=0, return_counts=True)
    p, q = edges[count == 1].T
    walls, (u, v) = np.concatenate([np.c_[p, q, q + n], np.c_[p, p + n, q + n]]), 0.5 * (plane[p] + plane[q]).T
    of_walls = np.where((np.abs(v - 20.0) > 4.5) | (np.abs(u - 50.0) > 25.0), 3, np.where(u < 50.0, 1, 2))
    tags = [np.tile(of_walls, 2), np.full(len(flat), 4), np.full(len(tets), 5)]
    mesh = meshio.Mesh(np.concatenate([np.c_[plane, np.full(n, z)] for z in (0.0, 1.0)]), [])
    mesh.cells = [meshio.CellBlock(*of) for of in (("triangle", walls), ("triangle", flat), ("tetra", tets))]
    mesh.cell_data = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    mesh.field_data = {name: np.array(of) for name, of in GROUPS.items()}
    meshio.write(path, mesh, "gmsh22", binary=False)


def main() -> float:
    """Write the case, estimate, print the result, and return the skin's modulus (kPa)."""
    with tempfile.TemporaryDirectory() as folder:
        write_sheet(Path(folder, "skin.msh"))
        shutil.copy(SEEN, folder)
        Path(folder, "case.toml").write_text(CASE)
        result = palpate.estimate(palpate.read_case(Path(folder, "case.toml")))
    sys.stdout.write(f"{result}\n")
    return result.estimation.estimates[0].value


if __name__ == "__main__":
    main()
