"""A factor, a further one, and 91 solutions: this package in two precisions, and SciPy's SuperLU with the same order.

The matrix is that of a grid of nodes, three unknowns each, every neighbour coupled, diagonals of cells included. A line
of JSON for each solver: seconds on the clock, seconds of the processors, the relative residual.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

import multifrontal

Matrix = sparse.csr_matrix
Solve = Callable[[NDArray[np.float64]], NDArray[np.float64]]
SOLUTIONS = 91


def grid_stiffness(side: int) -> Matrix:
    """Symmetric positive definite (n, n), n = 3 side^3: springs along all neighbours' directions, on weak ground."""
    index = np.arange(side**3).reshape(side, side, side)
    rows, columns, blocks = [], [], []
    for step in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1)):
        a, b, c = step
        ends = index[: side - a, : side - b, : side - c].ravel(), index[a:, b:, c:].ravel()
        along = np.array(step) / np.linalg.norm(step)
        spring = np.outer(along, along) + 0.1 * np.eye(3)
        for i, j, sign in ((0, 0, 1.0), (1, 1, 1.0), (0, 1, -1.0), (1, 0, -1.0)):
            rows.append(ends[i])
            columns.append(ends[j])
            blocks.append(np.broadcast_to(sign * spring, (len(ends[0]), 3, 3)))
    node = np.concatenate(rows), np.concatenate(columns)
    place = [(3 * node[0][:, None, None] + np.arange(3)[:, None]), (3 * node[1][:, None, None] + np.arange(3))]
    data = np.concatenate(blocks)
    ij = tuple(np.broadcast_to(numbers, data.shape).ravel() for numbers in place)
    n = 3 * side**3
    return sparse.csr_matrix(sparse.csr_matrix((data.ravel(), ij), shape=(n, n)) + 1e-3 * sparse.eye_array(n))


def superlu(matrix: Matrix) -> Solve:
    """In its symmetric mode, without pivoting; 16 columns at once, for more of them fall out of the cache."""
    order = multifrontal.nested_dissection(matrix)
    ordered = sparse.csc_matrix(matrix[order][:, order])
    factors = splu(ordered, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def solve(rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        solution = np.empty_like(rhs)
        for start in range(0, rhs.shape[1], 16):
            columns = slice(start, start + 16)
            solution[order, columns] = factors.solve(np.asfortranarray(rhs[order, columns]))
        return solution

    return solve


SOLVERS: dict[str, Callable[[Matrix], Solve]] = {
    "double": lambda matrix: multifrontal.factorise(matrix).solve,
    "single": lambda matrix: multifrontal.factorise(matrix, dtype=np.float32).solve,
    "superlu": superlu,
}


def measured(name: str, matrix: Matrix) -> dict[str, float | str]:
    """Seconds of one solver, on the clock and of the processors, and its relative residual."""
    rhs = np.random.default_rng(0).standard_normal((matrix.shape[0], SOLUTIONS))
    SOLVERS[name](grid_stiffness(2))  # libraries are loaded
    clocks = [(time.perf_counter(), time.process_time())]
    solve = SOLVERS[name](matrix)
    clocks.append((time.perf_counter(), time.process_time()))
    solution = solve(rhs)
    clocks.append((time.perf_counter(), time.process_time()))
    SOLVERS[name](matrix)
    clocks.append((time.perf_counter(), time.process_time()))
    found: dict[str, float | str] = {"solver": name}
    for step, (wall, processors) in zip(("first", "solutions", "again"), np.diff(clocks, axis=0), strict=True):
        found |= {f"{step}_s": round(float(wall), 3), f"{step}_cpu_s": round(float(processors), 3)}
    residual = np.linalg.norm(matrix @ solution - rhs) / np.linalg.norm(rhs)
    return found | {"residual": float(f"{residual:.1g}")}


def main() -> None:
    """A line of JSON for each solver."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--side", type=int, default=20, help="nodes along each side of the grid")
    side = parser.parse_args().side
    matrix = grid_stiffness(side)
    print(json.dumps({"unknowns": matrix.shape[0], "entries": matrix.nnz, "threads": multifrontal.processors()}))
    for name in SOLVERS:
        print(json.dumps(measured(name, matrix)), flush=True)


if __name__ == "__main__":
    main()
