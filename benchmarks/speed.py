"""Speed: an estimate in forward solves, gradients beside those of other programs, the cost by mesh size.

    python benchmarks/speed.py [--parts solver,linear,nonlinear,gradient,...] [--quick] [--json]

The body is a simulated pelvis with prostate and bladder to estimate, seen through voxels, with 90 modes of the rectum's
wall. Compared programs run in turns. A program that is not installed gives null; `make benchmark-setup` installs
them. Simulated data.
"""

from __future__ import annotations

import argparse
import functools
import json
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import speed_direct as direct
import speed_peers as peers
from memory import peak_mb
from numpy.typing import NDArray
from scipy import sparse
from speed_default import default_case, mapped_organ, measured_field, other_signals
from speed_maps import beside_a_peer
from speed_stages import shares_of_stages

from multifrontal import analyse
from palpate.approximation import ReducedBasis, reduced_basis
from palpate.body import aligned, inverse_problem, make_body
from palpate.case import Case, Discrepancy, Domain, Mechanics, MeshSettings, Phantom
from palpate.images import segment
from palpate.inversion import (
    InverseProblem,
    Inversion,
    InversionSettings,
    Objective,
    invert,
)
from palpate.mechanics import expected_of_size, linear_model, outer_constraint, weighted_sum
from palpate.mesh import lagrange_space, tetrahedralise
from palpate.observation import SEGMENTATION_NOISE, prescribed_motion
from palpate.parallel import blas_on_one_thread
from palpate.phantoms import PelvisOptions, Scene, pelvis, pelvis_anatomy
from palpate.study import inversion_settings
from palpate.uncertainty import sandwich_covariance

PARTS = "solver,linear,nonlinear,gradient,scaling,front_end,default,signals,field,map"
IN_A_ROW = 20  # gradients, as an optimiser asks for them
STARTS = (0.5, 1.0, 2.0, 4.0, 8.0)  # moduli to the surroundings'
SCALING_EDGES = (9.0, 6.0, 4.0, 2.7, 1.85, 1.65)  # mm: 30 k to 1 M unknowns


@dataclass(frozen=True)
class Sizes:
    """Edge lengths (mm) at the organs, repetitions."""

    solver: float = 4.5  # 122 k unknowns, 111 k of them free
    linear: float = 4.5  # 130 k unknowns
    nonlinear: float = 4.5
    gradient: float = 8.5  # 28 k unknowns
    scaling: tuple[float, ...] = SCALING_EDGES
    repeats: int = 3
    starts_of_peers: int = 1
    map: tuple[float, int] = (8.0, 200)  # and modes: 10 k unknowns


QUICK = Sizes(10.0, 9.0, 9.0, 10.0, (12.0, 9.0), 1, 5_000, map=(12.0, 30))


def main() -> int:
    """Run the parts that were asked for and print one JSON document."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", default=PARTS)
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
    result: Result = {"machine": platform.processor() or platform.machine(), "solver": _solver(130_000)}
    for part in arguments.parts.split(","):
        say(f"{part} ...")
        result |= PART[part](sizes, arguments.seed, say)
        say(json.dumps(result))
    print(json.dumps(result, indent=1))
    return 0


Say = Callable[[str], None]
Result = dict[str, Any]  # of JSON


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


def _silent(message: str) -> None:
    del message


def _solver(unknowns: int) -> str:
    return expected_of_size(unknowns, 120)[0]


@dataclass(frozen=True)
class Posed:
    """An inverse problem of one later state, five starts, and the true moduli (n_regions,) kPa."""

    problem: InverseProblem
    settings: InversionSettings
    moduli: NDArray[np.float64]

    @property
    def n_dofs(self) -> int:
        """Unknowns of the displacement."""
        return 3 * len(self.problem.states[0].model.space.points)


def problem_of(edge_mm: float, seed: int, law: str = "linear", *, held: bool = False) -> Posed:
    """What a simulated pelvis poses at an edge length; held: with moduli and the wall's motion alone as unknowns."""
    scene = _scene(seed, law)
    mechanics = Mechanics(law, "P2" if law == "linear" else "auto")
    case = Case(f"speed-{seed}", phantom=Phantom("pelvis", seed), mesh=MeshSettings(edge_mm), mechanics=mechanics)
    if held:
        nothing = Discrepancy(heterogeneity_sd=0.0, poisson_sd=0.0, surface_offset_mm=0.0, layer_sd=0.0)
        case = replace(case, domain=Domain(outer_boundary="fixed"), discrepancy=nothing)
    before, after = (segment(image, scene.tissues) for image in (scene.before, scene.after))
    body = make_body(aligned(before, (after,), method="none"), case, progress=_silent)
    problem = inverse_problem(body, case, progress=_silent)
    n = problem.parameters.n_parameters
    starts = tuple(np.full(n, np.log(start)) for start in STARTS)
    settings = replace(inversion_settings(case, problem.parameters), starts=starts)
    return Posed(problem, settings, np.array([scene.moduli_kpa[name] for name in problem.states[0].model.names]))


@functools.lru_cache(maxsize=1)
def _scene(seed: int, law: str) -> Scene:
    return pelvis(PelvisOptions(seed=seed, truth_edge_mm=4.0, law=law))


def timed(work: Callable[[], object]) -> float:
    """Seconds that `work` took."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def alternating(repeats: int, works: Mapping[str, Callable[[], object]]) -> dict[str, float]:
    """Median seconds of each work, taken in turns."""
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeats):
        for name, work in works.items():
            seconds[name].append(timed(work))
    return {name: float(np.median(values)) for name, values in seconds.items()}


def _estimate(problem: InverseProblem, settings: InversionSettings) -> Inversion:
    """From an assembled problem to moduli with linearised intervals."""
    inversion = invert(problem, settings, progress=_silent)
    sandwich_covariance(inversion.objective, inversion.minimum.evaluation)
    return inversion


def _linear(sizes: Sizes, seed: int, say: Say) -> Result:
    posed = problem_of(sizes.linear, seed)
    model, moduli = posed.problem.states[0].model, posed.moduli
    coefficients = np.random.default_rng(seed).standard_normal(model.n_modes)
    say(f"{posed.n_dofs} unknowns")
    model.solve(moduli, coefficients)  # the solver's library is loaded
    inversions: list[Inversion] = []
    seconds = alternating(
        sizes.repeats,
        {
            "forward_solve_s": lambda: model.solve(moduli, coefficients),
            "estimate_s": lambda: inversions.append(_estimate(posed.problem, posed.settings)),
        },
    )
    inversion = inversions[-1]
    basis = inversion.objective.states[0].approximation
    assert isinstance(basis, ReducedBasis)
    for n in (2, 3):  # the solver keeps its plans for two patterns
        analyse(sparse.csr_matrix(sparse.eye_array(n)))
    matrix = weighted_sum(moduli, model.free_stiffness)
    analysis = seconds["analysis_s"] = timed(lambda: analyse(matrix))
    return {
        "dofs": posed.n_dofs,
        **seconds,
        "estimate_over_forward": seconds["estimate_s"] / seconds["forward_solve_s"],
        "of_a_new_pattern": (seconds["estimate_s"] + analysis) / (seconds["forward_solve_s"] + analysis),
        "outcome": inversion.minimum.outcome.name,
        "ratios": np.exp(inversion.minimum.unknowns[: inversion.objective.n_parameters]).tolist(),
        "basis": basis.model.n_basis,
        "evaluations": inversion.evaluations,
        "factorisations": inversion.counts.factorisations,
        "peak_mb": peak_mb(),
    }


def _nonlinear(sizes: Sizes, seed: int, say: Say) -> Result:
    posed = problem_of(sizes.nonlinear, seed, "neo-hookean")
    say(f"{posed.n_dofs} unknowns")
    still = np.zeros(posed.problem.states[0].model.n_modes)
    posed.problem.states[0].model.solve(posed.moduli, still)  # the solver's library is loaded
    inversions: list[Inversion] = []
    seconds = {"estimate_s": timed(lambda: inversions.append(_estimate(posed.problem, posed.settings)))}
    objective, unknowns = inversions[0].objective, inversions[0].minimum.unknowns
    model, coefficients = objective.states[0].finite_strain, objective.parameters.coefficients(unknowns)[0]
    assert model is not None
    seconds |= alternating(sizes.repeats, {"forward_solve_s": lambda: model.solve(posed.moduli, coefficients)})
    found = {
        "dofs": posed.n_dofs,
        "law": "neo-hookean",
        **seconds,
        "estimate_over_forward": seconds["estimate_s"] / seconds["forward_solve_s"],
        "outcome": inversions[0].minimum.outcome.name,
        "factorisations": inversions[0].counts.factorisations,
    }
    return {"nonlinear": found}


def _gradient(sizes: Sizes, seed: int, say: Say) -> Result:
    posed = problem_of(sizes.gradient, seed, held=True)
    problem, model, mapping = posed.problem, posed.problem.states[0].model, posed.problem.parameters
    say(f"{posed.n_dofs} unknowns")
    middle = mapping.moduli(np.median(np.stack(posed.settings.starts), axis=0))
    coefficients = 0.3 * np.random.default_rng(seed).standard_normal(model.n_modes)
    began = time.perf_counter()
    basis = reduced_basis(model, middle).with_modulus_series(coefficients, mapping.selection)
    offline_s = time.perf_counter() - began
    theta = np.log(posed.moduli[mapping.selection.argmax(axis=0)] / mapping.scale_kpa)
    unknowns = np.concatenate([theta, coefficients])
    objective = Objective(problem.states, mapping).with_approximations([basis])
    objective = objective.with_observations([o.with_noise(SEGMENTATION_NOISE) for o in objective.observations])
    objective = objective.rematched(unknowns)
    frozen = peers.frozen_misfit(objective, unknowns)
    ours = peers.reduced(objective, frozen, unknowns)
    say(f"reduced: gradient off by {peers.disagreement(ours(), frozen, problem, unknowns):.1e}")
    others = {
        "torch_fem_gradient_s": peers.torch_fem(problem, frozen, unknowns),
        "scikit_fem_gradient_s": peers.scikit_fem(problem, frozen, unknowns),
    }
    there = {name: gradient for name, gradient in others.items() if gradient is not None}
    for name, gradient in there.items():
        say(f"{name}: gradient off by {peers.disagreement(gradient(), frozen, problem, unknowns):.1e}")
    objective(unknowns)

    def in_a_row(gradient: Callable[[], object]) -> Callable[[], None]:
        """Several of ours, as an estimate computes them."""

        @blas_on_one_thread()
        def work() -> None:
            for _ in range(IN_A_ROW):
                gradient()

        return work

    works: dict[str, Callable[[], object]] = {
        "gradient_s": in_a_row(ours),
        "evaluation_s": in_a_row(lambda: objective(unknowns)),
    }
    seconds = alternating(sizes.repeats, works | there)
    for name in works:
        seconds[name] /= IN_A_ROW
    say(json.dumps(seconds))
    few = replace(posed.settings, starts=posed.settings.starts[: sizes.starts_of_peers])
    both = alternating(
        1,
        {
            "finite_difference_lm_s": lambda: peers.finite_difference_lm(problem, few),
            "estimate_of_the_same_s": lambda: _estimate(problem, few),
        },
    )
    torch = seconds.get("torch_fem_gradient_s")
    return {
        "gradient_dofs": posed.n_dofs,
        "offline_s": offline_s,
        **dict.fromkeys(others),
        **seconds,
        "gradient_ratio": None if torch is None else seconds["gradient_s"] / torch,
        "evaluation_ratio": None if torch is None else seconds["evaluation_s"] / torch,
        **both,
        "finite_difference_lm_starts": sizes.starts_of_peers,
    }


def _scaling(sizes: Sizes, seed: int, say: Say) -> Result:
    """Each size in a process of its own, so that its peak memory is its own."""
    rows = []
    for edge in sizes.scaling:
        command = [sys.executable, str(Path(__file__)), "--one-size", str(edge), "--seed", str(seed)]
        rows.append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
        say(json.dumps(rows[-1]))
    unknowns, seconds = np.log([[row["dofs"], row["seconds"]] for row in rows]).T
    exponent = float(np.polyfit(unknowns, seconds, 1)[0]) if len(rows) > 1 else None
    return {"scaling": rows, "scaling_exponent": exponent}


def _default(sizes: Sizes, seed: int, say: Say) -> Result:
    """A whole estimate at default settings, from label images on disk to the report."""
    del say
    return {"default": default_case(seed, quick=sizes == QUICK)}


def _signals(sizes: Sizes, seed: int, say: Say) -> Result:
    """The same, with cases whose images contain more or less information."""
    del say
    return {"signals": other_signals(seed, quick=sizes == QUICK)}


def _field(sizes: Sizes, seed: int, say: Say) -> Result:
    """The same with a measured displacement field in addition to surfaces."""
    del say
    return {"field": measured_field(seed, quick=sizes == QUICK)}


def _map(sizes: Sizes, seed: int, say: Say) -> Result:
    """The cost of a map of the prostate's stiffness, and a small map by Palpate and by torch-fem."""
    peer = beside_a_peer(*sizes.map, seed, say)
    return {"map": mapped_organ(seed, quick=sizes == QUICK), "map_beside_torch_fem": peer}


def _one_size(edge_mm: float, seed: int) -> Result:
    """Assembly, one forward solve and two modulus sensitivities with multigrid."""
    options = PelvisOptions(seed=seed)
    space = lagrange_space(tetrahedralise(pelvis_anatomy(options), edge_length_mm=edge_mm), "P2")
    motion = prescribed_motion(space, {}, n_modes=3, kernel_mm=20.0, prior_mm=5.0)
    constraint = outer_constraint(
        space, outer="fixed", modes=motion.modes, offset=motion.offset, prescribed=motion.prescribed
    )
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


def _front_end(sizes: Sizes, seed: int, say: Say) -> Result:
    """Where the time of a whole case goes, from label images in memory to intervals; under a profiler."""
    case = Case(f"speed-{seed}", phantom=Phantom("pelvis", seed), mesh=MeshSettings(sizes.nonlinear))
    found = shares_of_stages(_scene(seed, "neo-hookean"), case)
    say(f"{found['total_s']:.0f} s for {found['dofs']} unknowns")
    return {"front_end": found}


def _solvers(sizes: Sizes, seed: int, say: Say) -> Result:
    return direct.beside_each_other(sizes.solver, seed, repeats=sizes.repeats, say=say)


PART = {
    "solver": _solvers,
    "linear": _linear,
    "nonlinear": _nonlinear,
    "gradient": _gradient,
    "scaling": _scaling,
    "front_end": _front_end,
    "default": _default,
    "signals": _signals,
    "field": _field,
    "map": _map,
}

if __name__ == "__main__":
    sys.exit(main())
