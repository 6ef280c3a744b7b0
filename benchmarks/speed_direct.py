"""Direct solvers beside each other: ours in double and single precision, PARDISO, SuperLU; one stiffness, 91 solutions.

Each runs in a process of its own, so that its peak memory is its own; all get the order that METIS finds on the graph
of the nodes. What precedes the first factorisation (libraries loaded, a tiny system solved) is not timed.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from memory import peak_mb
from scipy import sparse
from scipy.sparse.linalg import splu

from multifrontal import nested_dissection
from palpate.mechanics import SOLVERS as OURS
from palpate.mechanics import Hints, linear_model, outer_constraint, weighted_sum
from palpate.mesh import lagrange_space, tetrahedralise
from palpate.observation import prescribed_motion
from palpate.phantoms import PelvisOptions, pelvis_anatomy

__all__ = ["beside_each_other"]

Matrix = sparse.csr_matrix
Solve = Callable[[np.ndarray], np.ndarray]
N_RHS = 91
FEW_RHS = (1, 2, 4, 8, 16, 32)


def _write_stiffness(path: Path, edge_mm: float, seed: int) -> None:
    """The stiffness of a pelvis of quadratic tetrahedra whose wall is held, moduli 4 to 1, mN/mm."""
    anatomy = pelvis_anatomy(PelvisOptions(seed=seed))
    space = lagrange_space(tetrahedralise(anatomy, edge_length_mm=edge_mm), "P2")
    motion = prescribed_motion(space, {}, n_modes=3, kernel_mm=20.0, prior_mm=5.0)
    constraint = outer_constraint(
        space, outer="fixed", modes=motion.modes, offset=motion.offset, prescribed=motion.prescribed
    )
    model = linear_model(space, constraint)
    moduli = np.array([{"known": 10.0}.get(t.role.value, 40.0) for t in space.mesh.tissues if t.meshed])
    sparse.save_npz(path, weighted_sum(moduli, model.free_stiffness), compressed=False)


def _ours(name: str) -> Callable[[Matrix], Solve]:
    return lambda matrix: OURS[name].factorise(matrix, Hints()).solve


def _pardiso(matrix: Matrix) -> Solve:
    """Symmetric positive definite, our order, without its own refinement, which trebles the price of a solution."""
    _tell_where_mkl_is()
    pypardiso = importlib.import_module("pypardiso")
    upper = sparse.csr_matrix(sparse.triu(matrix, format="csr"))
    upper.sort_indices()
    solver = pypardiso.PyPardisoSolver(mtype=2, size_limit_storage=np.inf)
    for number, value in {1: 1, 5: 1, 8: 0}.items():
        solver.set_iparm(number, value)
    solver.perm = (nested_dissection(matrix) + 1).astype(np.int32)
    solver.factorize(upper)
    solver.factorized_A = upper  # the wrapper would keep a copy to compare with
    return lambda rhs: np.asarray(solver.solve(upper, np.asfortranarray(rhs)))


def _tell_where_mkl_is() -> None:
    """Set pypardiso's own variable: without it every factorisation searches the whole environment for MKL."""
    files = importlib.metadata.files("mkl") or []
    found = [path for file in files if "mkl_rt" in file.name and (path := Path(str(file.locate())).resolve()).exists()]
    if found:
        os.environ.setdefault("PYPARDISO_MKL_RT", str(found[0]))


def _superlu(matrix: Matrix) -> Solve:
    """In its symmetric mode, without pivoting; 16 columns at once, for more of them fall out of the cache."""
    order = nested_dissection(matrix)
    ordered = sparse.csc_matrix(matrix[order][:, order])
    factors = splu(ordered, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def solve(rhs: np.ndarray) -> np.ndarray:
        solution = np.empty_like(rhs)
        for start in range(0, rhs.shape[1], 16):
            columns = slice(start, start + 16)
            solution[order, columns] = factors.solve(np.asfortranarray(rhs[order, columns]))
        return solution

    return solve


SOLVERS = {
    "multifrontal": _ours("multifrontal"),
    "multifrontal-single": _ours("multifrontal-single"),
    "pardiso": _pardiso,
    "superlu": _superlu,
}
CLOCKS = ("factor", "again", "solve")
FEW = tuple(f"solve_{number}_s" for number in FEW_RHS)
KEYS = ("unknowns", *(f"{name}{unit}" for name in CLOCKS for unit in ("_s", "_cpu_s")), "residual", "peak_mb", *FEW)


def beside_each_other(edge_mm: float, seed: int, *, repeats: int, say: Callable[[str], None]) -> dict[str, Any]:
    """All solvers on one stiffness, in separate processes and in turns: median seconds and peak memory, for JSON."""
    rows: dict[str, list[dict[str, float | None]]] = {name: [] for name in SOLVERS}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stiffness.npz"
        _write_stiffness(path, edge_mm, seed)
        for turn in range(repeats):
            for name, found in rows.items():
                if turn == 0 or name != "superlu":
                    found.append(_in_a_process(name, path))
                    say(json.dumps({"solver": name, **found[-1]}))
    middle = {name: {key: _median(found, key) for key in found[0]} for name, found in rows.items()}
    return {"solver_of_rows": middle, "solver_ratio": _ratios(middle)}


def _in_a_process(name: str, path: Path) -> dict[str, float | None]:
    """What one solver takes, from a new process; null where it is not installed."""
    command = [sys.executable, __file__, name, str(path)]
    return dict(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout))


def _ratios(rows: dict[str, dict[str, float | None]]) -> dict[str, object]:
    """Ours over PARDISO's (factor, 91 solutions, both, memory), and over SuperLU's factor; wall and processor time."""
    found: dict[str, object] = {}
    for name, clock in (("", "_s"), ("_cpu", "_cpu_s")):
        for ours, suffix in (("multifrontal", ""), ("multifrontal-single", "_single")):
            both = [f"factor{clock}", f"solve{clock}"]
            found[f"factor{suffix}{name}"] = _ratio(rows, ours, "pardiso", both[:1])
            found[f"solve{suffix}{name}"] = _ratio(rows, ours, "pardiso", both[1:])
            found[f"both{suffix}{name}"] = _ratio(rows, ours, "pardiso", both)
        found[f"superlu_factor{name}"] = _ratio(rows, "multifrontal", "superlu", [f"factor{clock}"])
    for ours, suffix in (("multifrontal", ""), ("multifrontal-single", "_single")):
        found[f"memory{suffix}"] = _ratio(rows, ours, "pardiso", ["peak_mb"])
    return found


def _median(found: list[dict[str, float | None]], key: str) -> float | None:
    values = [value for row in found if (value := row[key]) is not None]
    return float(np.median(values)) if values else None


def _ratio(rows: dict[str, dict[str, float | None]], ours: str, other: str, keys: list[str]) -> float | None:
    if any(rows[name][key] is None for name in (ours, other) for key in keys):
        return None
    return sum(rows[ours][key] for key in keys) / sum(rows[other][key] for key in keys)  # type: ignore[misc]


def _measured(name: str, path: Path) -> dict[str, float | None]:
    if name == "pardiso" and not _installed("pypardiso"):
        return dict.fromkeys(KEYS)
    matrix = sparse.csr_matrix(sparse.load_npz(path))
    rhs = np.random.default_rng(0).standard_normal((matrix.shape[0], N_RHS))
    SOLVERS[name](sparse.csr_matrix(np.diag(np.arange(1.0, 9.0))))(np.ones((8, 1)))
    clocks = [_clock()]
    solve = SOLVERS[name](matrix)
    clocks.append(_clock())
    solution = solve(rhs)
    clocks.append(_clock())
    peak = peak_mb()
    residual = float(np.linalg.norm(matrix @ solution - rhs) / np.linalg.norm(rhs))
    few = _few(solve, rhs)
    del solve, solution
    clocks.append(_clock())
    if name != "superlu":
        SOLVERS[name](matrix)
    clocks.append(_clock())
    steps = np.diff(np.array(clocks), axis=0)
    return {
        "unknowns": matrix.shape[0],
        "factor_s": steps[0, 0],
        "factor_cpu_s": steps[0, 1],
        "again_s": steps[3, 0],
        "again_cpu_s": steps[3, 1],
        "solve_s": steps[1, 0],
        "solve_cpu_s": steps[1, 1],
        "residual": residual,
        "peak_mb": peak,
        **few,
    }


def _few(solve: Solve, rhs: np.ndarray) -> dict[str, float]:
    """The least of three times on the wall for each of a few right-hand sides, s."""
    found = {}
    for key, number in zip(FEW, FEW_RHS, strict=True):
        ends = []
        for _ in range(3):
            began = time.perf_counter()
            solve(rhs[:, :number])
            ends.append(time.perf_counter() - began)
        found[key] = min(ends)
    return found


def _clock() -> tuple[float, float]:
    """On the wall, and of the processors in this program (not of the kernel, which gives it memory)."""
    return time.perf_counter(), os.times().user


def _installed(module: str) -> bool:
    try:
        importlib.import_module(module)
    except (ImportError, OSError):  # the package, or MKL itself
        return False
    return True


if __name__ == "__main__":
    print(json.dumps(_measured(sys.argv[1], Path(sys.argv[2]))))
