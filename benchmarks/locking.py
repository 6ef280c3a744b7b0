"""The error of a modulus by locking: a stiff inclusion, fitted with each element at rising Poisson's ratios.

    python benchmarks/locking.py [--finest 24] [--ratios 0.3,0.45,0.49,0.4999] [--json]

A unit cube (modulus 1 kPa, the side z = 0 pushed in by a bump of 0.05, the sides held, the top free) holds a cube of
half its edge (3 kPa) and a soft slab on top (0.4 kPa). The displacement on the inclusion's surface is extrapolated
from three meshes (P2-P0, edge 1/8, 1/16, 1/finest, by the observed rate; a quarter of the cube, for its symmetry) and
is what the inclusion's modulus is fitted to with every element on coarser meshes: 4 and 8 elements across. Simulated.
"""

from __future__ import annotations

import argparse
import json
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import brentq
from scipy.spatial import cKDTree

from palpate.images import Role, Tissue
from palpate.mechanics import ELEMENTS, LinearModel, linear_model
from palpate.mesh import Constraint, LagrangeSpace, TetMesh, boundary_of, lagrange_space

TRUTH = np.array([1.0, 3.0, 0.4])
TINY = 1e-9
TRIALS = (("P1", (8, 16)), ("P2", (8, 16)), ("P2-P0", (8, 16)), ("auto", (8, 16)))


def quarter(n: int, poisson_ratio: float) -> TetMesh:
    """The quarter x, y < 1/2 of the cube in Kuhn's tetrahedra with edges 1 / n."""
    cells = (n // 2, n // 2, n)
    grid = np.stack(np.meshgrid(*[np.arange(k + 1) for k in cells], indexing="ij"), axis=-1)
    number = np.arange(grid[..., 0].size).reshape(grid.shape[:3])
    tets = []
    for order in permutations(range(3)):
        steps = np.cumsum(np.vstack([np.zeros(3, int), np.eye(3, dtype=int)[list(order)]]), axis=0)
        corners = [number[tuple(slice(s, s + k) for s, k in zip(step, cells, strict=True))].ravel() for step in steps]
        odd = np.linalg.det(np.eye(3)[list(order)]) < 0
        tets.append(np.stack(corners, axis=1)[:, [1, 0, 2, 3] if odd else [0, 1, 2, 3]])
    nodes, cells_ = grid.reshape(-1, 3) / n, np.concatenate(tets)
    centre = nodes[cells_].mean(axis=1)
    inside = (centre[:, 0] < 0.25) & (centre[:, 1] < 0.25) & (np.abs(centre[:, 2] - 0.5) < 0.25)
    region = np.where(inside, 1, np.where(centre[:, 2] > 0.75, 2, 0))
    tissues = [
        Tissue(name, Role.KNOWN, poisson_ratio=poisson_ratio, youngs_modulus_kpa=float(modulus))
        for name, modulus in zip(("block", "inclusion", "slab"), TRUTH, strict=True)
    ]
    boundary = boundary_of(cells_)
    return TetMesh(nodes, cells_, region, boundary, np.full(len(boundary), -1), tuple(tissues))


def constraint_of(space: LagrangeSpace) -> Constraint:
    """Symmetry on x = 0 and y = 0, the other sides and the floor held, a bump pushed into the floor."""
    p = space.points
    held = np.zeros(p.shape, dtype=bool)
    for axis in (0, 1):
        held[p[:, axis] < TINY, axis] = True
        held[p[:, axis] > 0.5 - TINY] = True
    floor = p[:, 2] < TINY
    held[floor] = True
    offset = np.zeros_like(p)
    offset[floor, 2] = 0.05 * np.prod(np.cos(np.pi * p[floor, :2]) ** 2, axis=1)
    unknown = np.flatnonzero(~held.ravel())
    entries = (np.ones(len(unknown)), (unknown, np.arange(len(unknown))))
    free = sparse.csr_matrix(entries, shape=(held.size, len(unknown)))
    return Constraint(free=free, modes=np.zeros((held.size, 0)), offset=offset.ravel())


def model_of(n: int, poisson_ratio: float, element: str) -> LinearModel:
    """The model with edges 1 / n."""
    chosen = ELEMENTS[element]
    space = lagrange_space(quarter(n, poisson_ratio), chosen.space)
    return linear_model(space, constraint_of(space), dilatation=chosen.dilatation)


def observed(model: LinearModel, modulus: float) -> NDArray[np.float64]:
    """Displacement at the places of a grid of 1/8 on the inclusion's surface."""
    grid = np.stack(np.meshgrid(*[np.arange(3) / 8] * 2, np.arange(2, 7) / 8, indexing="ij"), axis=-1).reshape(-1, 3)
    shell = (grid[:, :2].max(axis=1) > 0.25 - TINY) | (np.abs(grid[:, 2] - 0.5) > 0.25 - TINY)
    _, places = cKDTree(model.space.points).query(grid[shell])
    u = model.solve(np.array([TRUTH[0], modulus, TRUTH[2]]), np.zeros(0)).displacement
    return u[places].ravel()


def reference(poisson_ratio: float, finest: int) -> tuple[NDArray[np.float64], float]:
    """Extrapolated displacement, and how far the finest mesh is from it (relative)."""
    sizes = (8, 16, finest)
    a, b, c = (observed(model_of(n, poisson_ratio, "P2-P0"), TRUTH[1]) for n in sizes)
    wanted = np.linalg.norm(b - a) / np.linalg.norm(c - b)
    h = 1.0 / np.array(sizes)
    rate = brentq(lambda p: (h[0] ** p - h[1] ** p) / (h[1] ** p - h[2] ** p) - wanted, 0.2, 6.0)
    exact = c + (c - b) * h[2] ** rate / (h[1] ** rate - h[2] ** rate)
    return exact, float(np.linalg.norm(exact - c) / np.linalg.norm(exact))


def fitted_error(model: LinearModel, data: NDArray[np.float64]) -> float:
    """Relative error of the inclusion's modulus in the least-squares fit (Gauss-Newton with secant slopes on ln E)."""
    theta, step = np.log(TRUTH[1]), 0.05
    for _ in range(15):
        u = observed(model, np.exp(theta))
        slope = (observed(model, np.exp(theta + step)) - u) / step
        change = float(np.clip(slope @ (data - u) / (slope @ slope), -1.0, 1.0))
        theta += change
        step = float(np.clip(abs(change), 1e-4, 0.05))
        if abs(change) < 1e-4:
            break
    return float(np.exp(theta) / TRUTH[1] - 1.0)


def main() -> None:
    """Print a row for each Poisson's ratio, element and mesh."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--finest", type=int, default=24)
    parser.add_argument("--ratios", default="0.3,0.45,0.49,0.4999")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = []
    for nu in map(float, arguments.ratios.split(",")):
        data, gap = reference(nu, arguments.finest)
        for element, sizes in TRIALS:
            for n in sizes:
                error = fitted_error(model_of(n, nu, element), data)
                row = {"nu": nu, "element": element, "across": n // 2, "modulus_error": error, "reference_gap": gap}
                rows.append(row)
                if not arguments.json:
                    print(f"nu {nu:<7g} {element:6s} {n // 2} across: {100 * error:+10.2f} %", flush=True)
    if arguments.json:
        print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
