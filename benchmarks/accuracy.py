"""How near the estimates come to the truth: same mesh, other mesh, voxels, noise, a tumour, a small filling.

    python benchmarks/accuracy.py [--rows clean,noise,...] [--cases N] [--first-seed S] [--output FILE] [--json]

Every row draws random pelves (shape, position, orientation to the voxel grid, moduli 1.5 to 6 times the surroundings,
Poisson's ratios 0.40 to 0.45) by seed. The truth is made on a finer mesh than the one that inverts it. Each case is
appended to FILE (JSON lines) as soon as it is done, and a case that is there is not computed again. Simulated data.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.images.segmentation import segment
from palpate.images.tissue import Role
from palpate.inversion.conclude import Observed, conclude
from palpate.inversion.continuation import Expansion, continued_at_finite_strain
from palpate.inversion.cramer_rao import cramer_rao
from palpate.inversion.grid_position import FittedState, voxel_errors
from palpate.inversion.invert import invert
from palpate.inversion.modulus_map import modulus_map
from palpate.inversion.noise import NoiseLaw, fit_noise_law
from palpate.inversion.problem import InverseProblem, Inversion, InversionSettings
from palpate.inversion.surrogate import first_surrogate
from palpate.inversion.weighting import objective_of
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.equilibrium import from_linear
from palpate.mechanics.first_order import expanded
from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.linear_model import linear_model
from palpate.mesh.space import LagrangeSpace, lagrange_space
from palpate.mesh.surface import triangle_normals
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.observation.observed_surface import observed_surface
from palpate.observation.prescribed_motion import prescribed_motion
from palpate.phantoms.exact_targets import exact_target
from palpate.phantoms.pelvis import PelvisOptions, pelvis, pelvis_anatomy, pelvis_grid
from palpate.phantoms.scene import Noise, Scene, reimaged, rescaled
from palpate.study.body import Body, aligned, inverse_problem, make_body
from palpate.study.case import Case, Mechanics, MeshSettings, Phantom
from palpate.study.run import fitted_states, inversion_settings

NOISE = Noise(surface_sd_mm=0.3, correlation_length_mm=6.0)


@dataclass(frozen=True)
class Row:
    """One row of the table: how scenes are drawn, and what is shown to the estimate."""

    cases: int
    filling_mm: float | None = None  # None: 6 to 8 mm at random
    spacing_mm: tuple[float, float, float] = (1.0, 1.0, 1.0)
    noise: Noise | None = None
    tumour: bool = False
    data: str = "voxels"
    edge_mm: float = 4.0
    truth_edge_mm: float = 2.7
    draws: int = 1  # of the noise, for each pelvis
    law: str = "linear"  # of the truth and of the estimate
    poisson_ratio: float | None = None  # None: 0.40 to 0.45 at random


ROWS = {
    "same-mesh": Row(2, data="same mesh", truth_edge_mm=4.0),
    "other-mesh": Row(4, data="surfaces"),
    "clean": Row(8),
    "clean-3mm": Row(4, filling_mm=3.0),
    "noise": Row(8, spacing_mm=(1.0, 1.0, 2.5), noise=NOISE, edge_mm=6.0, draws=3),
    "tumour": Row(3, tumour=True),
    "nu-0.49": Row(4, poisson_ratio=0.49),
    "finite-clean": Row(6, law="neo-hookean", edge_mm=5.0, truth_edge_mm=3.4),
    "finite-clean-3mm": Row(3, law="neo-hookean", edge_mm=5.0, truth_edge_mm=3.4, filling_mm=3.0),
    "finite-noise": Row(
        6, law="neo-hookean", edge_mm=6.0, truth_edge_mm=3.4, spacing_mm=(1.0, 1.0, 2.5), noise=NOISE, draws=2
    ),
}
GRIDS = 6  # that the voxels' part of the Cramer-Rao limit's noise is measured on: one alone moves the limit threefold
FAR_OFF = np.log([3.0, 1.0 / 3.0, 3.0])  # from the linear estimate: another start of the continuation


def main() -> int:
    """Run the rows that were asked for and print their summaries."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", default=",".join(ROWS))
    parser.add_argument("--cases", type=int, help="cases a row instead of the row's own number")
    parser.add_argument("--first-seed", type=int, default=101)
    parser.add_argument("--share", default="0/1", help="k/n: every n-th seed from the k-th, to run n at once")
    parser.add_argument("--output", type=Path, default=Path("accuracy.jsonl"))
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    done = _read(arguments.output)
    summaries = {}
    names = arguments.rows.split(",")
    share = tuple(int(part) for part in arguments.share.split("/"))
    for seed in range(arguments.first_seed, arguments.first_seed + (arguments.cases or max_cases(names))):
        if (seed - arguments.first_seed) % share[1] != share[0]:
            continue
        truths: Truths = {}
        for name in names:
            if seed - arguments.first_seed >= (arguments.cases or ROWS[name].cases):
                continue
            for draw in range(ROWS[name].draws):
                key = (name, seed, draw)
                if key not in done:
                    done[key] = _case(key, ROWS[name], truths)
                    with arguments.output.open("a") as file:
                        file.write(json.dumps(done[key]) + "\n")
                _say(_line(done[key]))
    for name in names:
        cases = [result for key, result in sorted(done.items()) if key[0] == name]
        summaries[name] = _summary(cases)
        _say(f"{name}: {json.dumps(summaries[name])}")
    print(json.dumps({"rows": summaries}, indent=1) if arguments.json else _table(summaries))
    return 0


def max_cases(names: list[str]) -> int:
    """Largest number of cases of the rows."""
    return max(ROWS[name].cases for name in names)


Truths = dict[tuple[object, ...], tuple[Scene, float]]


def truth_of(row: Row, seed: int, draw: int, truths: Truths) -> tuple[Scene, PelvisOptions]:
    """The scene of a row; rows of one seed share the truth where they can, but not the images.

    A linear truth is linear in the filling; a finite-strain one is made anew.
    """
    filling = float(np.random.default_rng([seed, 7]).uniform(6.0, 8.0))
    if row.law != "linear" and row.filling_mm is not None:
        filling = row.filling_mm
    given = {"tumour": row.tumour, "law": row.law, "poisson_ratio": row.poisson_ratio}
    given["truth_edge_mm"] = row.truth_edge_mm
    key = (*given.values(), filling)
    if key not in truths:
        truths.clear()  # a truth is large
        truths[key] = pelvis(PelvisOptions(seed=seed, filling_mm=filling, **given)), filling
    scene, made = truths[key]
    if row.filling_mm is not None and row.law == "linear":
        scene = rescaled(scene, row.filling_mm / made)
        filling = row.filling_mm
    options = PelvisOptions(seed=seed, filling_mm=filling, spacing_mm=row.spacing_mm, noise=row.noise, **given)
    return reimaged(replace(scene, seed=seed + 1000 * draw), pelvis_grid(options), noise=row.noise), options


@dataclass(frozen=True)
class Posed:
    """One case of a row: the scene, what is asked of it, and the body it was made of where images are seen."""

    scene: Scene
    filling_mm: float
    space: LagrangeSpace
    problem: InverseProblem
    settings: InversionSettings
    bodies: tuple[Body, ...]


def posed(row: Row, seed: int, draw: int, truths: Truths) -> Posed:
    """The scene of a row, and the inverse problem that its images or surfaces pose."""
    scene, options = truth_of(row, seed, draw, truths)
    case = Case(
        f"seed-{seed}",
        phantom=Phantom("pelvis", seed),
        mesh=MeshSettings(row.edge_mm),
        mechanics=Mechanics(row.law, "P2" if row.law == "linear" and row.poisson_ratio is None else "auto"),
    )
    if row.data == "voxels":
        space, problem, bodies = from_voxels(scene, case)
    else:
        space, problem, bodies = _from_surfaces(scene, case, options, same_mesh=row.data == "same mesh")
    return Posed(scene, options.filling_mm, space, problem, inversion_settings(case, problem.modulus_map), bodies)


def _case(key: tuple[str, int, int], row: Row, truths: Truths) -> dict[str, object]:
    """Make one scene, estimate it, and hold the estimate beside the truth."""
    name, seed, draw = key
    began = time.perf_counter()
    case = posed(row, seed, draw, truths)
    scene, space, problem, settings = case.scene, case.space, case.problem, case.settings
    posed_seconds = time.perf_counter() - began
    estimated = time.perf_counter()
    inversion = invert(problem, settings, progress=_silent)
    seconds = time.perf_counter() - estimated
    result = {
        "row": name,
        "seed": seed,
        "draw": draw,
        "filling_mm": case.filling_mm,
        "dofs": 3 * len(space.points),
        "truth_dofs": 3 * len(scene.space.points),
        "scene_seconds": posed_seconds,
        "estimate_seconds": seconds,
        "outcome": inversion.minimum.outcome.name,
        "starts": [int(group) for group in inversion.groups],
    }
    result |= _errors(inversion, scene)
    if row.law != "linear":
        linear = invert(replace(problem, finite_strain=()), settings, progress=_silent)
        result["linear_ln_error"] = _errors(linear, scene)["ln_error"]
        if seed % 5 == 1 and draw == 0 and row.noise is None:
            result["far_off_ln_error"] = _errors(_from_far_off(problem, linear, settings), scene)["ln_error"]
    if case.bodies:
        result |= _uncertainty(inversion, problem, case.bodies[0], scene, settings, row)
        result |= _driver_error(inversion, space, scene)
    return result


def _silent(message: str) -> None:
    del message


def _from_far_off(problem: InverseProblem, linear: Inversion, settings: InversionSettings) -> Inversion:
    """The continuation from moduli that are three times too high and too low instead of the linear estimate's."""
    n = linear.objective.n_parameters
    unknowns = linear.minimum.unknowns.copy()
    unknowns[:n] += FAR_OFF[:n]
    moved = replace(linear, minima=(replace(linear.minimum, unknowns=unknowns),), groups=(0,), best=0)
    return continued_at_finite_strain(problem, moved, settings, progress=_silent)


def from_voxels(scene: Scene, case: Case) -> tuple[LagrangeSpace, InverseProblem, tuple[object, ...]]:
    """Everything from the label images: the displacements' space, the inverse problem, the body it is made of."""
    before, after = (segment(image, scene.tissues) for image in (scene.before, scene.after))
    states = aligned(before, (after,), method="none")
    body = make_body(states, case, progress=lambda _: None)
    return body.space, inverse_problem(body, case, progress=lambda _: None), (body,)


def _from_surfaces(
    scene: Scene, case: Case, options: PelvisOptions, *, same_mesh: bool
) -> tuple[LagrangeSpace, InverseProblem, tuple[object, ...]]:
    """The truth's surfaces as targets; on the same mesh also a wall motion that the modes can make."""
    if same_mesh:
        space = lagrange_space(scene.mesh, "P2")
    else:
        space = lagrange_space(tetrahedralise(pelvis_anatomy(options), edge_length_mm=case.mesh.edge_length_mm), "P2")
    driver = case.driver
    motion = prescribed_motion(space, {}, n_modes=driver.modes, kernel_mm=driver.kernel_mm, prior_mm=driver.prior_mm)
    constraint = outer_constraint(
        space, outer="fixed", modes=motion.modes, offset=motion.offset, prescribed=motion.prescribed
    )
    model = linear_model(space, constraint)
    if same_mesh:
        rows = np.repeat(motion.prescribed, 3)
        q = np.linalg.lstsq(motion.modes[rows], scene.displacement.ravel()[rows], rcond=None)[0]
        moduli = np.array([t.youngs_modulus_kpa for t in scene.tissues if t.meshed])
        scene = replace(scene, displacement=model.solve(moduli, q).displacement)
    observed = [i for i, t in enumerate(scene.tissues) if t.role in (Role.ESTIMATE, Role.DRIVER)]
    targets = tuple(exact_target(scene, observed_surface(space, i)) for i in observed)
    estimated = frozenset(t.name for t in scene.tissues if t.role is Role.ESTIMATE)
    mapping = modulus_map(scene.tissues, model.regions)
    return space, InverseProblem((model,), (targets,), mapping, estimated, walls=(motion.walls,)), ()


def _errors(inversion: Inversion, scene: Scene) -> dict[str, object]:
    mapping = inversion.objective.modulus_map
    theta = inversion.minimum.unknowns[: len(mapping.tissues)]
    truth = np.array([scene.moduli_kpa[name] / scene.moduli_kpa[mapping.relative_to] for name in mapping.tissues])
    return {
        "tissues": list(mapping.tissues),
        "truth_ratio": truth.tolist(),
        "ratio": np.exp(theta).tolist(),
        "ln_error": (theta - np.log(truth)).tolist(),
        "law": {"sd_mm": inversion.law.sd, "correlation_area_mm2": inversion.law.correlation_area},
    }


def _uncertainty(
    inversion: Inversion, problem: InverseProblem, body: Body, scene: Scene, settings: InversionSettings, row: Row
) -> dict[str, object]:
    """Interval, spread of an exact model over grid positions, and the Cramer-Rao limit of this scene's noise."""
    images = tuple(image.index for image in body.states.after)
    observed = Observed(body.space, fitted_states(inversion, body), images)
    estimation = conclude(inversion, settings, observed, truth=scene.moduli_kpa, seed=scene.seed)
    found = {
        "interval95": [e.ratio_interval95 for e in estimation.estimates],
        "verdict": [e.verdict for e in estimation.estimates],
        "sd": np.sqrt(np.diag(estimation.covariance)).tolist(),
        "grid_sd": np.sqrt(np.diag(estimation.grid_covariance)).tolist(),
    }
    if row.noise is not None:
        found["cramer_rao_sd"] = _cramer_rao_sd(at_truth(inversion, problem, scene), body, scene, row.noise)
    return found


def _cramer_rao_sd(inversion: Inversion, body: Body, scene: Scene, noise: Noise) -> list[float]:
    """Of the log-moduli at an inversion's minimum; what is known before is the prior that the case states."""
    rng = np.random.default_rng([scene.seed, 11])
    law = true_law(inversion, body.space, fitted_states(inversion, body), noise, rng)
    stated = replace(inversion.objective, prior=None).prior_precision()
    evaluation = replace(inversion.minimum.evaluation, prior=stated)
    n, cell = inversion.objective.n_parameters, noise.correlation_length_mm
    return np.sqrt(np.diag(cramer_rao(evaluation, law, n, cell_mm=cell))).tolist()


def at_truth(inversion: Inversion, problem: InverseProblem, scene: Scene) -> Inversion:
    """The same with the truth for its minimum: the true moduli, and the wall's motion that comes nearest to it.

    A limit taken at the estimate would depend on the noise that moved it.
    """
    model, mapping = problem.models[0], problem.modulus_map
    surface = next(t.surface for t in problem.targets[0] if t.surface.name in problem.drivers)
    motion = scene.motions[surface.name].at(surface.rest).ravel() - model.constraint.offset[surface.dofs]
    coefficients = np.linalg.lstsq(model.constraint.modes[surface.dofs], motion, rcond=None)[0]
    truth = [np.log(scene.moduli_kpa[name] / scene.moduli_kpa[mapping.relative_to]) for name in mapping.tissues]
    unknowns = np.concatenate([truth, coefficients])
    surrogate = first_surrogate(model, mapping.moduli(np.array(truth)))
    if problem.finite_strain:
        there = from_linear(problem.finite_strain[0], surrogate.system, coefficients).refactorised()
        local = expanded(there, names=there.model.names, moduli=there.moduli, coefficients=coefficients)
        surrogate = Expansion(local, there, SolveCounts())
    objective = objective_of(problem, (surrogate.reduced,), inversion.law).with_fresh_correspondence(unknowns)
    minimum = replace(inversion.minimum, unknowns=unknowns, evaluation=objective(unknowns))
    return replace(inversion, objective=objective, minima=(minimum,), groups=(0,), best=0, surrogates=(surrogate,))


def true_law(
    inversion: Inversion,
    space: LagrangeSpace,
    fitted: tuple[FittedState, ...],
    noise: Noise,
    rng: np.random.Generator,
) -> NoiseLaw:
    """The noise that was put into both images, and that of the voxels on the model, over several places of the grid."""
    errors = [error for _ in range(GRIDS) for error in voxel_errors(inversion, space, fitted, rng=rng)]
    lines = GRIDS * inversion.minimum.evaluation.surfaces
    sizes = [len(error) for error in errors]
    voxels = fit_noise_law(
        errors,
        [line.residuals.places[:n] for line, n in zip(lines, sizes, strict=True)],
        [line.residuals.normals[:n] for line, n in zip(lines, sizes, strict=True)],
    )
    smooth = 2.0 * noise.surface_sd_mm**2
    return NoiseLaw(np.append(voxels.variances, smooth), np.append(voxels.lengths, noise.correlation_length_mm))


def _driver_error(inversion: Inversion, space: LagrangeSpace, scene: Scene) -> dict[str, object]:
    """RMS error (mm) of the estimated wall motion, normal and tangential parts, area-weighted."""
    objective, unknowns = inversion.objective, inversion.minimum.unknowns
    moduli = objective.modulus_map.moduli(unknowns[: objective.n_parameters])
    motion = inversion.surrogates[0].reduced.solve(moduli, objective.coefficients(unknowns)[0]).displacement
    index = next(i for i, t in enumerate(scene.tissues) if t.role is Role.DRIVER)
    surface = observed_surface(space, index)
    error = motion[surface.points] - scene.motions[scene.tissues[index].name].at(surface.rest)
    faces = triangle_normals(surface.rest, surface.triangles)
    area = np.linalg.norm(faces, axis=1)
    at_faces = error[surface.triangles].mean(axis=1)
    normal = np.einsum("fa,fa->f", at_faces, faces / area[:, None])
    total = np.sum(at_faces**2, axis=1)
    return {
        "driver_normal_rms_mm": float(np.sqrt(np.average(normal**2, weights=area))),
        "driver_tangential_rms_mm": float(np.sqrt(np.average(np.maximum(total - normal**2, 0.0), weights=area))),
    }


def _summary(results: list[dict]) -> dict[str, object]:
    errors = np.concatenate([r["ln_error"] for r in results])
    found: dict[str, object] = {
        "cases": len(results),
        "moduli": len(errors),
        "rms_ln_error": _rms(errors),
        "worst_ln_error": float(np.abs(errors).max()),
        "mean_ln_error": float(errors.mean()),
        "all_converged": all(r["outcome"] in ("CONVERGED", "STALLED") for r in results),
        "estimate_seconds": float(np.mean([r["estimate_seconds"] for r in results])),
        "dofs": int(np.mean([r["dofs"] for r in results])),
    }
    if "linear_ln_error" in results[0]:
        off = np.concatenate([r["linear_ln_error"] for r in results])
        found |= {"linear_rms_ln_error": _rms(off), "linear_worst_ln_error": float(np.abs(off).max())}
    if "sd" in results[0]:
        truth = np.concatenate([r["truth_ratio"] for r in results])
        ends = [end for r in results for end in r["interval95"]]
        inside = [(low or 0.0) <= t <= (high or np.inf) for (low, high), t in zip(ends, truth, strict=True)]
        found |= {
            "grid_spread_rms": _rms(np.concatenate([r["grid_sd"] for r in results])),
            "inside_95": float(np.mean(inside)),
            "driver_normal_rms_mm": float(np.mean([r["driver_normal_rms_mm"] for r in results])),
            "driver_tangential_rms_mm": float(np.mean([r["driver_tangential_rms_mm"] for r in results])),
        }
    if "cramer_rao_sd" in results[0]:
        limit = np.concatenate([r["cramer_rao_sd"] for r in results])
        sd = np.concatenate([r["sd"] for r in results])
        found |= {"cramer_rao_rms": _rms(limit), "median_width_over_cramer_rao": float(np.median(sd / limit))}
    return found


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _line(result: dict) -> str:
    errors = ", ".join(
        f"{name} {100 * error:+.2f} %" for name, error in zip(result["tissues"], result["ln_error"], strict=True)
    )
    seconds = f"scene {result['scene_seconds']:.0f} s, estimate {result['estimate_seconds']:.0f} s"
    return f"{result['row']} {result['seed']}: {errors} ({result['outcome']}, {result['dofs']} dof; {seconds})"


def _table(summaries: dict[str, dict]) -> str:
    """The rows as they stand in the docs."""
    lines = [
        "| row | cases, moduli | RMS ln-error | worst | mean | grid spread | Cramer-Rao | inside 95 % | linear law |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in summaries.items():
        keys = ("rms_ln_error", "worst_ln_error", "mean_ln_error", "grid_spread_rms", "cramer_rao_rms")
        digits = 5 if row["worst_ln_error"] < 0.005 else 3
        cells = [f"`{name}`", f"{row['cases']}, {row['moduli']}"]
        cells += [f"{row[key]:.{digits}f}" if key in row else "-" for key in keys]
        cells.append(f"{100 * row['inside_95']:.0f} %" if "inside_95" in row else "-")
        cells.append(f"{row['linear_rms_ln_error']:.2f}" if "linear_rms_ln_error" in row else "-")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _read(path: Path) -> dict[tuple[str, int, int], dict]:
    lines = path.read_text().splitlines() if path.exists() else []
    results = [json.loads(line) for line in lines]
    return {(result["row"], result["seed"], result.get("draw", 0)): result for result in results}


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
