"""Find how stiff living skin is (kPa, if it is 1 mm thick), from points that a camera saw and the force of a pull.

Pads of 8 x 8 mm are attached to the skin, 32 mm apart; one is pulled by 1 mm. Not simulated: see docs/measured.md.
"""

import shutil
import sys
import tempfile
from pathlib import Path

import meshio
import numpy as np

import palpate

SEEN = Path(__file__).parent / "skin"  # of Elouneg et al., MIT licence; a camera sees no motion along z
GROUPS = {"moving": [1, 2], "fixed": [2, 2], "border": [3, 2], "underside": [4, 2], "skin": [5, 3]}  # tag, dimension


def write_sheet(path: Path) -> None:
    """Write a sheet of 100 x 50 x 1 mm with holes of 8 x 8 mm for the pads, and its surfaces as groups."""
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
    nodes = np.concatenate([np.c_[plane, np.full(n, z)] for z in (0.0, 1.0)])
    cells = [("triangle", walls), ("triangle", flat), ("tetra", tets)]
    groups = {name: np.array(of) for name, of in GROUPS.items()}
    mesh = meshio.Mesh(nodes, cells, None, dict.fromkeys(("gmsh:physical", "gmsh:geometrical"), tags), groups)
    meshio.write(path, mesh, "gmsh22", binary=False)


def main() -> float:
    """Write the mesh beside the case, estimate, print the result, and return the skin's modulus (kPa)."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(SEEN, folder, dirs_exist_ok=True)
        write_sheet(Path(folder, "skin.msh"))
        result = palpate.estimate(palpate.read_case(Path(folder, "case.toml")))
    sys.stdout.write(f"{result}\n")
    return result.estimation.estimates[0].value


if __name__ == "__main__":
    main()
