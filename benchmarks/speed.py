"""Speed: whole cases as a user runs them, and the parts of an estimate beside those of other programs.

    python benchmarks/speed.py [--parts default,signals,field,map,linear,...] [--quick] [--json]

Simulated data. Four parts run `palpate estimate` from label images on disk to the report, each in a process of its own,
on a pelvis in a box of 140 mm: `default`, at default settings; `signals`, cases whose images tell more or less;
`field`, with a measured displacement field beside the surfaces; `map`, with the prostate's modulus as a map of it.

The others time parts: `linear` and `nonlinear` an estimate in forward solves, with 90 modes of the rectum's wall;
`solver` direct solvers in turns, ours beside PARDISO (null where it is not installed: `make pardiso`) and SuperLU, with
the order that METIS finds on the graph of the nodes; `scaling` multigrid by the size of the mesh.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rows import peak_gb, said, silent
from scipy import sparse
from scipy.ndimage import gaussian_filter
from scipy.sparse.linalg import splu

from multifrontal import nested_dissection
from palpate.body import aligned, inverse_problem, make_body
from palpate.case import Case, Mechanics, MeshSettings, Phantom
from palpate.images import Role, segment, write_label_image
from palpate.inversion import InverseProblem, Inversion, InversionSettings, invert
from palpate.mechanics import SOLVERS as OURS
from palpate.mechanics import Hints, linear_model, outer_constraint, weighted_sum
from palpate.mesh import Constraint, LagrangeSpace, lagrange_space, located, point_interpolation, tetrahedralise
from palpate.observation import prescribed_motion
from palpate.phantoms import Noise, PelvisOptions, Scene, pelvis, pelvis_anatomy
from palpate.study import inversion_settings
from palpate.uncertainty import sandwich_covariance

Result = dict[str, Any]  # of JSON

LAWS = ("linear", "neo-hookean")
STARTS = (0.5, 1.0, 2.0, 4.0, 8.0)  # moduli to the surroundings'


@dataclass(frozen=True)
class Sizes:
    """Edge lengths (mm) at the organs, repetitions, the side (mm) and the settings of whole cases, a map's modes."""

    estimate: float = 4.5  # 130 k unknowns
    solver: float = 4.5  # 122 k unknowns, 111 k of them free
    scaling: tuple[float, ...] = (9.0, 6.0, 4.0, 2.7, 1.85, 1.65)  # 30 k to 1 M unknowns
    repeats: int = 3
    side: float = 140.0
    settings: tuple[str, ...] = ()
    map_settings: tuple[str, ...] = ("mesh.edge_length_mm=5.4",)  # 104 k unknowns
    modes: int = 1000


_COARSE = ("mesh.edge_length_mm=10",)
QUICK = Sizes(9.0, 10.0, (12.0, 9.0), 1, 110.0, _COARSE, _COARSE, 100)


def main() -> int:
    """Run the parts that were asked for and print one JSON document."""
    if sys.argv[1:2] == ["--child"]:
        print(json.dumps(CHILDREN[sys.argv[2]](*sys.argv[3:])))
        return 0
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--edge", type=float, help="edge length (mm) of the linear and the nonlinear part")
    parser.add_argument("--sizes", help="edge lengths (mm) of the scaling, with commas")
    parser.add_argument("--quick", action="store_true", help="small meshes: to see that it works")
    parser.add_argument("--json", action="store_true", help="print the JSON alone")
    asked = parser.parse_args()
    sizes = QUICK if asked.quick else Sizes()
    sizes = replace(sizes, estimate=asked.edge or sizes.estimate)
    if asked.sizes:
        sizes = replace(sizes, scaling=tuple(float(part) for part in asked.sizes.split(",")))
    result: Result = {"machine": platform.processor() or platform.machine()}
    for part in asked.parts.split(","):
        result |= PARTS[part](sizes, asked.seed)
        if not asked.json:
            said(json.dumps(result))
    print(json.dumps(result, indent=1))
    return 0


def _child(name: str, *words: object) -> Any:
    """What a function of CHILDREN returns in a process of its own, whose peak memory is its own."""
    command = [sys.executable, __file__, "--child", name, *map(str, words)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


# ---- whole cases -----------------------------------------------------------------------------------------------------

HELD = (  # what the model leaves out known, and the frame held
    'domain.outer_boundary="fixed"',
    "discrepancy.heterogeneity_sd=0",
    "discrepancy.poisson_sd=0",
    "discrepancy.surface_offset_mm=0",
)
N_POINTS, FIELD_SD_MM, ALIKE_MM = 100_000, 0.5, 5.0  # of a measured field, on a lattice; its errors
MAPPED = "prostate"
BODIES: dict[str, dict[str, Any]] = {
    "default": {},
    "small motion": {"filling_mm": 3.0},
    "bones": {"bones": True},
    "three tissues": {"tumour": True},
    "thick slices": {"spacing_mm": (1.0, 1.0, 4.0)},
    "noise": {"noise": Noise(surface_sd_mm=0.3, correlation_length_mm=6.0)},
    "far driver": {"moduli_kpa": {"prostate": 10.0}},  # as the surroundings, of which it is a part: the bladder is left
}


def _default(sizes: Sizes, seed: int) -> Result:
    """Seconds, peak memory (MB) and size under each law, and what `palpate check` predicts.

    held: the same with what the model leaves out known, and the frame held; discrepancy_ratio: what these unknowns
    cost, in time. at_once: both laws side by side, two processes that share the machine.
    """
    with tempfile.TemporaryDirectory() as folder:
        _child("make", folder, "default", seed, sizes.side)
        found: Result = {law: _ended(*_started(folder, law, sizes.settings)) for law in LAWS}
        for law in LAWS:
            found[law]["expected"] = _expected(folder, law, sizes.settings)
        found["held"] = {law: _ended(*_started(folder, law, (*sizes.settings, *HELD))) for law in LAWS}
        ratios = {law: found[law]["seconds"] / found["held"][law]["seconds"] for law in LAWS}
        found["discrepancy_ratio"] = {law: round(ratio, 2) for law, ratio in ratios.items()}
        found["at_once"] = [_ended(*of) for of in [_started(folder, law, sizes.settings) for law in LAWS]]
    return {"default": found}


def _signals(sizes: Sizes, seed: int) -> Result:
    """The default case and others of its size with more or less information, under each law."""
    found: Result = {}
    for body in BODIES:
        with tempfile.TemporaryDirectory() as folder:
            _child("make", folder, body, seed, sizes.side)
            found[body] = {law: _ended(*_started(folder, law, sizes.settings)) for law in LAWS}
        for law, of in found[body].items():
            of["over_default"] = round(of["seconds"] / found["default"][law]["seconds"], 2)
    return {"signals": found}


def _field(sizes: Sizes, seed: int) -> Result:
    """The default case by its surfaces alone and with a field of 100 000 points, under each law, and their ratios."""
    return {"field": _beside(sizes, seed, {"surfaces": "case.toml", "field": "field.toml"}, sizes.settings)}


def _map(sizes: Sizes, seed: int) -> Result:
    """The case with that field, the prostate's modulus as one and as a map, under each law."""
    cases = {"one modulus": "field.toml", "map": "map.toml"}
    return {"map": {"modes_asked": sizes.modes} | _beside(sizes, seed, cases, sizes.map_settings)}


def _beside(sizes: Sizes, seed: int, cases: Mapping[str, str], settings: Sequence[str]) -> Result:
    """Two cases of the default body beside each other."""
    found: Result = {}
    with tempfile.TemporaryDirectory() as folder:
        _child("make", folder, "default", seed, sizes.side, sizes.modes)
        for law in LAWS:
            rows = {name: _ended(*_started(folder, law, settings, case)) for name, case in cases.items()}
            one, other = rows.values()
            ratios = {f"{key}_ratio": round(other[key] / one[key], 2) for key in ("seconds", "processor_s", "peak_mb")}
            found[law] = rows | ratios
    return found


def _words(folder: str, command: str, law: str, settings: Sequence[str], case: str = "case.toml") -> list[str]:
    flags = [part for setting in (*settings, f'mechanics.law="{law}"') for part in ("--set", setting)]
    return [sys.executable, "-m", "palpate", command, str(Path(folder) / case), "--quiet", *flags]


def _expected(folder: str, law: str, settings: Sequence[str]) -> Result:
    """Unknowns, seconds and memory that `palpate check` expects."""
    words = [*_words(folder, "check", law, settings), "--json"]
    said_of = json.loads(subprocess.run(words, check=False, stdout=subprocess.PIPE, text=True).stdout)
    return dict(said_of["expected"] or {})


def _started(
    folder: str, law: str, settings: Sequence[str], case: str = "case.toml"
) -> tuple[subprocess.Popen[bytes], Path, float]:
    """An estimate of a case in a folder: its process, where it writes, when it began."""
    output = Path(folder) / f"{law}-{Path(case).stem}-{len(settings)}"
    words = [*_words(folder, "estimate", law, settings, case), "--output", str(output)]
    began = time.perf_counter()
    return subprocess.Popen(words, stdout=subprocess.DEVNULL), output, began


def _ended(process: subprocess.Popen[bytes], output: Path, began: float) -> Result:
    """What it has cost, once it has ended."""
    _, status, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - began
    document = json.loads((output / "result.json").read_text())
    return {
        "exit": os.waitstatus_to_exitcode(status),
        "dofs": document["mesh"]["dofs"],
        "seconds": round(seconds, 1),
        "processor_s": round(used.ru_utime + used.ru_stime, 1),
        "peak_mb": round(used.ru_maxrss / 1024.0),
        "evaluations": document["counts"]["evaluations"],
        "factorisations": document["counts"]["factorisations"],
        "verdicts": {e["tissue"]: e["verdict"] for e in document["estimates"]},
    }


def _make(name: str, body: str, seed: str, side: str, modes: str = "0") -> None:
    """The files of a case; its truth needs more memory than an estimate."""
    folder, box = Path(name), (float(side), max(float(side), 120.0), max(float(side), 120.0))
    scene = pelvis(PelvisOptions(seed=int(seed), truth_edge_mm=4.0, **{"field_mm": box, **BODIES[body]}))
    write_label_image(folder / "before.nii.gz", scene.before)
    write_label_image(folder / "after.nii.gz", scene.after)
    lines = ["[images]", 'before = "before.nii.gz"', 'after = ["after.nii.gz"]', "[tissues]"]
    lines += ['surroundings = {label = "remaining", role = "known", youngs_modulus_kpa = 10.0}']
    unnamed = BODIES[body].get("moduli_kpa", ())  # is a part of the surroundings
    for tissue in scene.tissues:
        if tissue.role in (Role.ESTIMATE, Role.DRIVER, Role.RIGID) and tissue.name not in unnamed:
            lines += [f'"{tissue.name}" = {{label = {tissue.labels[0]}, role = "{tissue.role.value}"}}']
    text = "\n".join(lines) + "\n"
    (folder / "case.toml").write_text(text)
    if body == "default":
        text += f'[[data]]\nkind = "displacement-field"\nfile = "field.csv"\nsd_mm = {FIELD_SD_MM}\n'
        text += f"correlation_mm = {ALIKE_MM}\n"
        (folder / "field.toml").write_text(text)
        one = f'"{MAPPED}" = {{'
        (folder / "map.toml").write_text(text.replace(one, f'{one}modulus = "field", field_modes = {modes}, '))
        _write_field(folder / "field.csv", scene)


def _write_field(path: Path, scene: Scene) -> None:
    """A table of displacements on a lattice, whose errors are correlated in space."""
    low, high = scene.mesh.nodes.min(axis=0), scene.mesh.nodes.max(axis=0)
    spacing = float(np.prod(high - low) / N_POINTS) ** (1.0 / 3.0)
    n = np.ceil((high - low) / spacing).astype(int)
    axes = [a + (b - a) * (np.arange(k) + 0.5) / k for a, b, k in zip(low, high, n, strict=True)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    errors = np.random.default_rng(scene.seed).standard_normal(lattice.shape)
    errors = gaussian_filter(errors, ALIKE_MM / spacing, axes=(0, 1, 2))
    places = located(scene.mesh, lattice.reshape(-1, 3))
    before = lattice.reshape(-1, 3)[places.inside]
    moved = point_interpolation(scene.space, places.of(places.inside)) @ scene.displacement
    after = before + moved + FIELD_SD_MM * (errors / errors.std()).reshape(-1, 3)[places.inside]
    names = ",".join(f"{state}_{axis}" for state in ("before", "after") for axis in "xyz")
    np.savetxt(path, np.hstack([before, after]), fmt="%.4f", delimiter=",", header=names, comments="")


# ---- parts of an estimate --------------------------------------------------------------------------------------------


def problem_of(edge_mm: float, seed: int, law: str) -> tuple[InverseProblem, InversionSettings, NDArray[np.float64]]:
    """What a simulated pelvis poses at an edge length, five starts, and the true moduli (n_regions,) kPa."""
    scene = pelvis(PelvisOptions(seed=seed, truth_edge_mm=4.0, law=law))
    mechanics = Mechanics(law, "P2" if law == "linear" else "auto")
    case = Case(f"speed-{seed}", phantom=Phantom("pelvis", seed), mesh=MeshSettings(edge_mm), mechanics=mechanics)
    before, after = (segment(image, scene.tissues) for image in (scene.before, scene.after))
    body = make_body(aligned(before, (after,), method="none"), case, progress=silent)
    problem = inverse_problem(body, case, progress=silent)
    starts = tuple(np.full(problem.parameters.n_parameters, np.log(start)) for start in STARTS)
    settings = replace(inversion_settings(case, problem.parameters), starts=starts)
    return problem, settings, np.array([scene.moduli_kpa[name] for name in problem.states[0].model.names])


def timed(work: Callable[[], object]) -> float:
    """Seconds that `work` took."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def alternating(repeats: int, works: Mapping[str, Callable[[], object]]) -> dict[str, float]:
    """Median seconds of each work, taken in turns."""
    rounds = [{name: timed(work) for name, work in works.items()} for _ in range(repeats)]
    return {name: float(np.median([seconds[name] for seconds in rounds])) for name in works}


def _linear(sizes: Sizes, seed: int) -> Result:
    return _estimated(sizes, seed, "linear")


def _nonlinear(sizes: Sizes, seed: int) -> Result:
    return {"nonlinear": _estimated(sizes, seed, "neo-hookean")}


def _estimated(sizes: Sizes, seed: int, law: str) -> Result:
    """An estimate from an assembled problem to moduli with linearised intervals, beside one forward solve."""
    problem, settings, moduli = problem_of(sizes.estimate, seed, law)
    model = problem.states[0].model
    model.solve(moduli, np.zeros(model.n_modes))  # the solver's library is loaded
    inversions: list[Inversion] = []

    def estimate() -> None:
        """Once."""
        inversions.append(invert(problem, settings, progress=silent))
        sandwich_covariance(inversions[-1].objective, inversions[-1].minimum.evaluation)

    seconds = alternating(sizes.repeats if law == "linear" else 1, {"estimate_s": estimate})
    inversion = inversions[-1]
    objective, unknowns = inversion.objective, inversion.minimum.unknowns
    forward, coefficients = objective.states[0].finite_strain or model, objective.parameters.coefficients(unknowns)[0]
    seconds |= alternating(sizes.repeats, {"forward_solve_s": lambda: forward.solve(moduli, coefficients)})
    return {
        "dofs": 3 * len(model.space.points),
        "law": law,
        **seconds,
        "estimate_over_forward": seconds["estimate_s"] / seconds["forward_solve_s"],
        "outcome": inversion.minimum.outcome.name,
        "ratios": np.exp(unknowns[: objective.n_parameters]).tolist(),
        "evaluations": inversion.evaluations,
        "factorisations": inversion.counts.factorisations,
        "peak_mb": 1e3 * peak_gb(),
    }


# ---- solvers ---------------------------------------------------------------------------------------------------------

N_RHS = 91
Matrix = sparse.csr_matrix
Solve = Callable[[np.ndarray], np.ndarray]


def _pardiso(matrix: Matrix) -> Solve:
    """Symmetric positive definite, our order, without its own refinement, which trebles the price of a solution."""
    files = importlib.metadata.files("mkl") or []
    found = [path for file in files if "mkl_rt" in file.name and (path := Path(str(file.locate())).resolve()).exists()]
    if found:  # else every factorisation searches the whole environment for MKL
        os.environ.setdefault("PYPARDISO_MKL_RT", str(found[0]))
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


SOLVERS: dict[str, Callable[[Matrix], Solve]] = {
    "multifrontal": lambda matrix: OURS["multifrontal"].factorise(matrix, Hints()).solve,
    "multifrontal-single": lambda matrix: OURS["multifrontal-single"].factorise(matrix, Hints()).solve,
    "pardiso": _pardiso,
    "superlu": _superlu,
}
CLOCKS = ("factor", "solve", "again")


def _held_pelvis(edge_mm: float, seed: int) -> tuple[LagrangeSpace, Constraint, NDArray[np.float64]]:
    """A pelvis of quadratic tetrahedra whose wall is held, and moduli of 4 to 1."""
    space = lagrange_space(tetrahedralise(pelvis_anatomy(PelvisOptions(seed=seed)), edge_length_mm=edge_mm), "P2")
    motion = prescribed_motion(space, {}, n_modes=3, kernel_mm=20.0, prior_mm=5.0)
    constraint = outer_constraint(
        space, outer="fixed", modes=motion.modes, offset=motion.offset, prescribed=motion.prescribed
    )
    moduli = [10.0 if t.role is Role.KNOWN else 40.0 for t in space.mesh.tissues if t.meshed]
    return space, constraint, np.array(moduli)


def _solvers(sizes: Sizes, seed: int) -> Result:
    """One stiffness and 91 solutions by all direct solvers, in separate processes and in turns: medians, and ratios."""
    rows: dict[str, list[Result]] = {name: [] for name in SOLVERS}
    with tempfile.TemporaryDirectory() as folder:
        space, constraint, moduli = _held_pelvis(sizes.solver, seed)
        path = Path(folder) / "stiffness.npz"
        sparse.save_npz(path, weighted_sum(moduli, linear_model(space, constraint).free_stiffness), compressed=False)
        for turn in range(sizes.repeats):
            for name, found in rows.items():
                if turn == 0 or name != "superlu":
                    found.append(_child("solver", name, path))
    middle = {n: {key: float(np.median([row[key] for row in of])) for key in of[0]} for n, of in rows.items()}
    ratios = {
        f"{key}{ours.removeprefix('multifrontal')}": middle[ours][key] / middle["pardiso"][key]
        for ours in ("multifrontal", "multifrontal-single")
        for key in ("factor_s", "solve_s", "factor_cpu_s", "solve_cpu_s", "peak_mb")
        if middle["pardiso"].get(key)
    }
    return {"solver_of_rows": middle, "solver_ratio": ratios}


def _solver(name: str, path: str) -> Result:
    """What one solver takes; what precedes the first factorisation (libraries, a tiny system) is not timed."""
    if name == "pardiso" and importlib.util.find_spec("pypardiso") is None:
        return dict.fromkeys(("unknowns", "residual", "peak_mb"))
    matrix = sparse.csr_matrix(sparse.load_npz(path))
    rhs = np.random.default_rng(0).standard_normal((matrix.shape[0], N_RHS))
    SOLVERS[name](sparse.csr_matrix(np.diag(np.arange(1.0, 9.0))))(np.ones((8, 1)))
    clocks = [_clock()]
    solve = SOLVERS[name](matrix)
    clocks.append(_clock())
    solution = solve(rhs)
    clocks.append(_clock())
    peak, residual = 1e3 * peak_gb(), float(np.linalg.norm(matrix @ solution - rhs) / np.linalg.norm(rhs))
    if name != "superlu":
        del solve, solution
        began = _clock()
        SOLVERS[name](matrix)
        clocks.append(clocks[-1] + _clock() - began)
    wall, processor = np.diff(np.array(clocks), axis=0).T.tolist()
    found = {"unknowns": matrix.shape[0], "residual": residual, "peak_mb": peak}
    for key, seconds in (("_s", wall), ("_cpu_s", processor)):
        found |= {f"{clock}{key}": value for clock, value in zip(CLOCKS, seconds, strict=False)}
    return found


def _clock() -> NDArray[np.float64]:
    """On the wall, and of the processors in this program (not of the kernel, which gives it memory)."""
    return np.array([time.perf_counter(), os.times().user])


def _scaling(sizes: Sizes, seed: int) -> Result:
    """Each size in a process of its own, so that its peak memory is its own."""
    rows = [_child("size", edge, seed) for edge in sizes.scaling]
    unknowns, seconds = np.log([[row["dofs"], row["seconds"]] for row in rows]).T
    exponent = float(np.polyfit(unknowns, seconds, 1)[0]) if len(rows) > 1 else None
    return {"scaling": rows, "scaling_exponent": exponent}


def _one_size(edge_mm: str, seed: str) -> Result:
    """Assembly, one forward solve and two modulus sensitivities with multigrid."""
    space, constraint, moduli = _held_pelvis(float(edge_mm), int(seed))
    began, cpu = time.perf_counter(), time.process_time()
    model = linear_model(space, constraint, solver="multigrid")
    system = model.system(moduli)
    values = system.solve(np.ones(model.n_modes)).values
    system.modulus_responses(values[:, None], regions=np.flatnonzero(moduli > 10.0))
    seconds, processor = time.perf_counter() - began, time.process_time() - cpu
    return {"dofs": 3 * len(space.points), "seconds": seconds, "processor_s": processor, "peak_mb": 1e3 * peak_gb()}


CHILDREN: dict[str, Callable[..., Any]] = {"make": _make, "solver": _solver, "size": _one_size}
PARTS: dict[str, Callable[[Sizes, int], Result]] = {
    "default": _default,
    "signals": _signals,
    "field": _field,
    "map": _map,
    "linear": _linear,
    "nonlinear": _nonlinear,
    "solver": _solvers,
    "scaling": _scaling,
}

if __name__ == "__main__":
    sys.exit(main())
