"""How fast: an estimate in forward solves, the online gradient beside its peers, the posterior, the cost by mesh size.

    python benchmarks/speed.py [--parts solver,linear,nonlinear,gradient,...] [--quick] [--json]

The body is a simulated pelvis with prostate and bladder to estimate, seen through voxels, with 90 modes of the rectum's
wall. What is compared is measured in one run, alternating. A peer that is not installed gives null; `make
benchmark-setup` installs them. Simulated data.
"""

from __future__ import annotations

import argparse
import cProfile
import functools
import json
import platform
import pstats
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import speed_direct as direct
import speed_peers as peers
from memory import peak_mb

from palpate.images.segmentation import segment
from palpate.inversion.invert import invert
from palpate.inversion.posterior import sandwich_covariance
from palpate.inversion.problem import InverseProblem, Inversion, InversionSettings
from palpate.inversion.sampling import sample_posterior
from palpate.inversion.surrogate import first_surrogate, with_modulus_series
from palpate.inversion.weighting import SEGMENTATION_LAW, objective_of
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.solvers.registry import expected_of_size
from palpate.mesh.space import lagrange_space
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.observation.prescribed_motion import prescribed_motion
from palpate.phantoms.pelvis import PelvisOptions, pelvis, pelvis_anatomy
from palpate.phantoms.scene import Scene
from palpate.study.body import aligned, inverse_problem, make_body
from palpate.study.case import Case, Mechanics, MeshSettings, Phantom
from palpate.study.run import estimate_states, inversion_settings

PARTS = ("solver", "linear", "nonlinear", "gradient", "posterior", "scaling", "front_end")
IN_A_ROW = 20  # gradients, as an optimiser asks for them
STARTS = (0.5, 1.0, 2.0, 4.0, 8.0)  # moduli to the surroundings'
SCALING_EDGES = (9.0, 6.0, 4.0, 2.7, 1.85, 1.65)  # mm: 30 k to 1 M unknowns


@dataclass(frozen=True)
class Sizes:
    """Edge lengths (mm) at the organs, repetitions, evaluations."""

    solver: float = 4.5  # 122 k unknowns, 111 k of them free
    linear: float = 4.5  # 130 k unknowns
    nonlinear: float = 4.5
    gradient: float = 8.5  # 28 k unknowns
    scaling: tuple[float, ...] = SCALING_EDGES
    repeats: int = 3
    evaluations: int = 100_000
    starts_of_peers: int = 1


QUICK = Sizes(10.0, 9.0, 9.0, 10.0, (12.0, 9.0), 1, 5_000)


def main() -> int:
    """Run the parts that were asked for and print one JSON document."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--edge", type=float, help="edge length (mm) of the linear and the nonlinear part")
    parser.add_argument("--sizes", help="edge lengths (mm) of the scaling, with commas")
    parser.add_argument("--quick", action="store_true", help="small meshes: to see that it works")
    parser.add_argument("--json", action="store_true", help="print the JSON alone")
    parser.add_argument("--one-size", type=float, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one_size:
        print(json.dumps(_one_size(arguments.one_size, arguments.seed)))
        return 0
    sizes = QUICK if arguments.quick else Sizes()
    if arguments.edge:
        sizes = replace(sizes, linear=arguments.edge, nonlinear=arguments.edge)
    if arguments.sizes:
        sizes = replace(sizes, scaling=tuple(float(part) for part in arguments.sizes.split(",")))
    say = _silent if arguments.json else _say
    result: dict[str, object] = {"machine": platform.processor() or platform.machine(), "solver": _solver(130_000)}
    for part in arguments.parts.split(","):
        say(f"{part} ...")
        result |= PART[part](sizes, arguments.seed, say)
        say(json.dumps(result))
    print(json.dumps(result, indent=1))
    return 0


Say = Callable[[str], None]


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


def _silent(message: str) -> None:
    del message


def _solver(unknowns: int) -> str:
    return expected_of_size(unknowns, 120)[0]


def problem_of(edge_mm: float, seed: int, law: str = "linear") -> tuple[InverseProblem, InversionSettings, np.ndarray]:
    """The inverse problem of a pelvis at an edge length, five starts, and the true moduli (n_regions,) kPa."""
    scene = _scene(seed, law)
    mechanics = Mechanics(law, "P2" if law == "linear" else "auto")
    case = Case(f"speed-{seed}", phantom=Phantom("pelvis", seed), mesh=MeshSettings(edge_mm), mechanics=mechanics)
    before, after = (segment(image, scene.tissues) for image in (scene.before, scene.after))
    body = make_body(aligned(before, (after,), method="none"), case, progress=_silent)
    problem = inverse_problem(body, case, progress=_silent)
    settings = inversion_settings(case, problem.modulus_map)
    n = len(problem.modulus_map.tissues)
    settings = replace(settings, starts=tuple(np.full(n, np.log(start)) for start in STARTS))
    return problem, settings, np.array([scene.moduli_kpa[name] for name in problem.models[0].names])


@functools.lru_cache(maxsize=1)
def _scene(seed: int, law: str) -> Scene:
    return pelvis(PelvisOptions(seed=seed, truth_edge_mm=4.0, law=law))


def timed(work: Callable[[], object]) -> tuple[float, object]:
    """Seconds that `work` took, and what it gave."""
    began = time.perf_counter()
    result = work()
    return time.perf_counter() - began, result


def alternating(repeats: int, works: dict[str, Callable[[], object] | None]) -> dict[str, float | None]:
    """Median seconds of each work, taken in turns; null for one that is not there."""
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeats):
        for name, work in works.items():
            if work is not None:
                seconds[name].append(timed(work)[0])
    return {name: float(np.median(values)) if values else None for name, values in seconds.items()}


def _estimate(problem: InverseProblem, settings: InversionSettings) -> Inversion:
    """From an assembled problem to moduli with linearised intervals."""
    inversion = invert(problem, settings, progress=_silent)
    sandwich_covariance(inversion.minimum.evaluation, inversion.law, inversion.objective.n_parameters)
    return inversion


def _linear(sizes: Sizes, seed: int, say: Say) -> dict[str, object]:
    problem, settings, moduli = problem_of(sizes.linear, seed)
    model = problem.models[0]
    coefficients = np.random.default_rng(seed).standard_normal(model.n_modes)
    say(f"{3 * len(model.space.points)} unknowns")
    model.solve(moduli, coefficients)  # the solver's library is loaded
    inversions: list[Inversion] = []
    seconds = alternating(
        sizes.repeats,
        {
            "forward_solve_s": lambda: model.solve(moduli, coefficients),
            "estimate_s": lambda: inversions.append(_estimate(problem, settings)),
        },
    )
    inversion = inversions[-1]
    theta = inversion.minimum.unknowns[: inversion.objective.n_parameters]
    return {
        "dofs": 3 * len(model.space.points),
        **seconds,
        "estimate_over_forward": seconds["estimate_s"] / seconds["forward_solve_s"],
        "outcome": inversion.minimum.outcome.name,
        "ratios": np.exp(theta).tolist(),
        "basis": inversion.surrogates[0].reduced.n_basis,
        "evaluations": inversion.evaluations,
        "factorisations": inversion.counts.factorisations,
        "peak_mb": peak_mb(),
    }


def _nonlinear(sizes: Sizes, seed: int, say: Say) -> dict[str, object]:
    problem, settings, moduli = problem_of(sizes.nonlinear, seed, "neo-hookean")
    model = problem.finite_strain[0]
    linear = invert(replace(problem, finite_strain=()), settings, progress=_silent)
    coefficients = linear.objective.coefficients(linear.minimum.unknowns)[0]
    say(f"{3 * len(model.space.points)} unknowns")
    inversions: list[Inversion] = []
    seconds = alternating(
        1,
        {
            "forward_solve_s": lambda: model.solve(moduli, coefficients),
            "estimate_s": lambda: inversions.append(_estimate(problem, settings)),
        },
    )
    found = {
        "dofs": 3 * len(model.space.points),
        "law": "neo-hookean",
        **seconds,
        "estimate_over_forward": seconds["estimate_s"] / seconds["forward_solve_s"],
        "factorisations": inversions[0].counts.factorisations,
    }
    return {"nonlinear": found}


def _gradient(sizes: Sizes, seed: int, say: Say) -> dict[str, object]:
    problem, settings, moduli = problem_of(sizes.gradient, seed)
    model, mapping = problem.models[0], problem.modulus_map
    say(f"{3 * len(model.space.points)} unknowns")
    middle = mapping.moduli(np.median(np.stack(settings.starts), axis=0))
    coefficients = 0.3 * np.random.default_rng(seed).standard_normal(model.n_modes)

    def offline() -> object:
        return with_modulus_series(first_surrogate(model, middle), coefficients, mapping.columns)

    offline_s, surrogate = timed(offline)
    objective = objective_of(problem, (surrogate.reduced,), SEGMENTATION_LAW)
    theta = np.log(moduli[mapping.columns] / mapping.scale_kpa)
    unknowns = np.concatenate([theta, coefficients])
    objective = objective.with_fresh_correspondence(unknowns)
    frozen = peers.frozen_misfit(objective, unknowns)
    works = {
        "gradient_s": lambda: [objective.value_and_gradient(unknowns) for _ in range(IN_A_ROW)],
        "torch_fem_gradient_s": peers.torch_fem(problem, frozen, unknowns),
        "scikit_fem_gradient_s": peers.scikit_fem(problem, frozen, unknowns),
    }
    for name, work in works.items():
        if work is not None and name != "gradient_s":
            say(f"{name}: gradient off by {peers.disagreement(work(), frozen, surrogate, unknowns):.1e}")
    objective.value_and_gradient(unknowns)
    seconds = alternating(sizes.repeats, works)
    seconds["gradient_s"] /= IN_A_ROW
    say(json.dumps(seconds))
    few = replace(settings, starts=settings.starts[: sizes.starts_of_peers])
    both = alternating(
        1,
        {
            "finite_difference_lm_s": lambda: peers.finite_difference_lm(problem, few),
            "estimate_of_the_same_s": lambda: _estimate(problem, few),
        },
    )
    torch = seconds["torch_fem_gradient_s"]
    return {
        "gradient_dofs": 3 * len(model.space.points),
        "offline_s": offline_s,
        **seconds,
        "gradient_ratio": None if torch is None else seconds["gradient_s"] / torch,
        **both,
        "finite_difference_lm_starts": sizes.starts_of_peers,
    }


def _posterior(sizes: Sizes, seed: int, say: Say) -> dict[str, object]:
    problem, settings, _ = problem_of(sizes.linear, seed)
    inversion = _estimate(problem, settings)
    say("sampling")
    seconds, samples = timed(
        lambda: sample_posterior(
            inversion.objective,
            inversion.minimum.unknowns,
            bounds=settings.bounds,
            evaluations=sizes.evaluations,
            rng=np.random.default_rng(seed),
        )
    )
    return {
        "posterior_100k_s": seconds * 100_000 / sizes.evaluations,
        "posterior_accepted": samples.accepted,
        "posterior_refreshed": samples.refreshed,
        "posterior_gap": samples.gap,
        "posterior_sd": samples.theta.std(axis=0).tolist(),
        "gauss_newton_sd": np.sqrt(np.diag(np.linalg.inv(inversion.minimum.evaluation.matrix))[:2]).tolist(),
    }


def _scaling(sizes: Sizes, seed: int, say: Say) -> dict[str, object]:
    """Each size in a process of its own, so that its peak memory is its own."""
    rows = []
    for edge in sizes.scaling:
        command = [sys.executable, str(Path(__file__)), "--one-size", str(edge), "--seed", str(seed)]
        rows.append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
        say(json.dumps(rows[-1]))
    unknowns, seconds = np.log([[row["dofs"], row["seconds"]] for row in rows]).T
    exponent = float(np.polyfit(unknowns, seconds, 1)[0]) if len(rows) > 1 else None
    return {"scaling": rows, "scaling_exponent": exponent}


def _one_size(edge_mm: float, seed: int) -> dict[str, object]:
    """Assembly, one forward solve and two modulus sensitivities with multigrid."""
    options = PelvisOptions(seed=seed)
    space = lagrange_space(tetrahedralise(pelvis_anatomy(options), edge_length_mm=edge_mm), "P2")
    motion = prescribed_motion(space, {}, n_modes=3, kernel_mm=20.0, prior_mm=5.0)
    given = {"modes": motion.modes, "offset": motion.offset, "prescribed": motion.prescribed}
    constraint = outer_constraint(space, outer="fixed", **given)
    before = peak_mb()
    began, cpu = time.perf_counter(), time.process_time()
    model = linear_model(space, constraint, solver="multigrid")
    assembled = time.perf_counter()
    moduli = np.array([{"known": 10.0}.get(t.role.value, 40.0) for t in space.mesh.tissues if t.meshed])
    system = model.system(moduli)
    ready = time.perf_counter()
    values = system.solve(np.ones(model.n_modes)).values
    solved = time.perf_counter()
    estimated = np.flatnonzero(moduli > 10.0)
    system.modulus_responses(values[:, None], regions=estimated)
    ended = time.perf_counter()
    return {
        "dofs": 3 * len(space.points),
        "seconds": ended - began,
        "processor_s": time.process_time() - cpu,
        "peak_mb": peak_mb(),
        "mesh_peak_mb": before,
        "assemble_s": assembled - began,
        "set_up_s": ready - assembled,
        "solve_s": solved - ready,
        "sensitivities_s": ended - solved,
    }


STAGES = {  # functions whose time, with all that they call, is a stage of its own
    "images checked and aligned": ("body.py", "aligned"),
    "level sets": ("anatomy.py", "anatomy_of"),
    "tetrahedra cut": ("tetrahedralise.py", "_cut_grid"),
    "tetrahedra remeshed": ("remeshing.py", "remeshed"),
    "surfaces fitted, tetrahedra smoothed": ("tetrahedralise.py", "_fitted"),
    "mesh gate": ("quality.py", "check_mesh"),
    "distance maps and targets": ("body.py", "surface_targets"),
    "wall modes": ("prescribed_motion.py", "prescribed_motion"),
    "stiffness assembled": ("linear_model.py", "linear_model"),
    "finite-strain model": ("finite_strain.py", "finite_strain_model"),
    "responses and series": ("surrogate.py", "first_surrogate"),
    "linear estimate": ("invert.py", "invert_with"),
    "finite-strain estimate": ("continuation.py", "continued_at_finite_strain"),
    "intervals and fits": ("conclude.py", "conclude"),
}
WITHIN = {  # parts of the stages above
    "closest points": ("misfit.py", "_closest"),
    "voxels of the model": ("voxelise.py", "voxelise"),
    "noise law": ("noise.py", "fit_noise_law"),
}


def _front_end(sizes: Sizes, seed: int, say: Say) -> dict[str, object]:
    """Where the time of a whole case goes, from label images in memory to intervals; under a profiler."""
    scene = _scene(seed, "neo-hookean")
    case = Case(f"speed-{seed}", phantom=Phantom("pelvis", seed), mesh=MeshSettings(sizes.nonlinear))
    profile = cProfile.Profile()
    profile.enable()
    before, after = (segment(image, scene.tissues) for image in (scene.before, scene.after))
    result = estimate_states(aligned(before, (after,), method="none"), case)
    profile.disable()
    known = pstats.Stats(profile)
    total = known.total_tt  # type: ignore[attr-defined]
    spent = {name: _cumulative(known, *of) for name, of in (STAGES | WITHIN).items()}
    say(f"{total:.0f} s for {3 * len(result.space.points)} unknowns")
    return {
        "front_end": {
            "dofs": 3 * len(result.space.points),
            "total_s": total,
            "shares": {name: spent[name] / total for name in STAGES},
            "within": {name: spent[name] / total for name in WITHIN},
        }
    }


def _cumulative(stats: pstats.Stats, file: str, function: str) -> float:
    """Seconds in a function and what it calls."""
    rows = stats.stats.items()  # type: ignore[attr-defined]
    return float(sum(row[3] for (path, _, name), row in rows if name == function and Path(path).name == file))


def _solvers(sizes: Sizes, seed: int, say: Say) -> dict[str, object]:
    """Direct solvers on one stiffness, each in processes of its own, in turns: medians of seconds, and peak memory."""
    rows: dict[str, list[dict]] = {name: [] for name in direct.SOLVERS}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stiffness.npz"
        direct.write_stiffness(path, sizes.solver, seed)
        for turn in range(sizes.repeats):
            for name, found in rows.items():
                if turn == 0 or name != "superlu":
                    found.append(direct.in_a_process(name, path))
                    say(json.dumps({"solver": name, **found[-1]}))
    middle = {name: {key: _median(found, key) for key in found[0]} for name, found in rows.items()}
    return {"solvers": middle, "solver_ratio": direct.ratios(middle)}


def _median(found: list[dict], key: str) -> float | None:
    values = [row[key] for row in found if row[key] is not None]
    return float(np.median(values)) if values else None


PART = {
    "solver": _solvers,
    "linear": _linear,
    "nonlinear": _nonlinear,
    "gradient": _gradient,
    "posterior": _posterior,
    "scaling": _scaling,
    "front_end": _front_end,
}

if __name__ == "__main__":
    sys.exit(main())
