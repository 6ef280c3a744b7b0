"""The errors of estimates against the truth: same mesh, other mesh, voxels, noise, a tumour, a small filling.

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
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from accuracy_rows import ROWS, Row, Truths, posed
from cramer_rao import cramer_rao, model_to_image
from numpy.typing import NDArray

from palpate.approximation import LinearisationPoint, exact_approximation
from palpate.body import Body
from palpate.images import Role
from palpate.inversion import (
    REPORTED,
    InverseProblem,
    Inversion,
    InversionSettings,
    Objective,
    Searched,
    at_finite_strain,
    invert,
    searched,
)
from palpate.mesh import LagrangeSpace, triangle_normals
from palpate.observation import NoiseModel, fit_noise_model, observed_surface
from palpate.phantoms import Noise, Scene
from palpate.statement import Observed, conclude
from palpate.study import fitted_states
from palpate.uncertainty import FittedState, grid_position_shifts, imaging_errors

Array = NDArray[np.float64]
Result = dict[str, Any]  # a line of JSON

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
    parser.add_argument("--defaults", action="store_true", help="the program's defaults: nothing is held")
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
                    done[key] = _case(key, replace(ROWS[name], held=not arguments.defaults), truths)
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


def _case(key: tuple[str, int, int], row: Row, truths: Truths) -> Result:
    """Make one scene, estimate it, and compare the estimate with the truth."""
    name, seed, draw = key
    began = time.perf_counter()
    case = posed(row, seed, draw, truths)
    scene, space, problem, settings = case.scene, case.space, case.problem, case.settings
    posed_seconds = time.perf_counter() - began
    estimated = time.perf_counter()
    inversion = invert(problem, settings, progress=_silent)
    seconds = time.perf_counter() - estimated
    result: Result = {
        "row": name,
        "seed": seed,
        "draw": draw,
        "filling_mm": case.filling_mm,
        "dofs": 3 * len(space.points),
        "truth_dofs": 3 * len(scene.space.points),
        "scene_seconds": posed_seconds,
        "estimate_seconds": seconds,
        "outcome": inversion.minimum.outcome.name,
        "starts": [start.candidate for start in inversion.starts],
    }
    result |= _errors(inversion, scene)
    if row.law != "linear":
        linear = invert(problem.linear(), settings, progress=_silent)
        result["linear_ln_error"] = _errors(linear, scene)["ln_error"]
        if seed % 5 == 1 and draw == 0 and row.noise is None:
            result["far_off_ln_error"] = _errors(_from_far_off(inversion, linear, settings), scene)["ln_error"]
    if case.bodies:
        result |= _uncertainty(inversion, problem, case.bodies[0], scene, settings, row)
        result |= _driver_error(inversion, space, scene)
    return result


def _silent(message: str) -> None:
    del message


def _from_far_off(finite: Inversion, linear: Inversion, settings: InversionSettings) -> Inversion:
    """The continuation of a `finite` estimate from moduli three times too high and too low, not the linear one's."""
    n, unknowns = linear.objective.n_parameters, linear.minimum.unknowns.copy()
    unknowns[:n] += FAR_OFF[:n]
    pairs = zip(linear.objective.states, finite.objective.states, strict=True)
    states = tuple(replace(state, finite_strain=given.finite_strain) for state, given in pairs)
    near = Searched(replace(linear.objective, states=states), replace(linear.minimum, unknowns=unknowns))
    near = at_finite_strain(near, progress=_silent)
    end = searched(near, settings.bounds, REPORTED, progress=_silent, title="far off")
    return Inversion(end.objective, end.minimum, end.posterior, (), linear.rest, end.minimum.evaluations, end.counts)


def _errors(inversion: Inversion, scene: Scene) -> Result:
    mapping, noise = inversion.objective.parameters, inversion.objective.states[0].noise["surface distance"]
    theta = inversion.minimum.unknowns[: mapping.n_parameters]
    truth = true_ratios(inversion.objective, scene)
    return {
        "tissues": list(mapping.tissues),
        "truth_ratio": truth.tolist(),
        "ratio": np.exp(theta).tolist(),
        "ln_error": (theta - np.log(truth)).tolist(),
        "law": {"sd_mm": noise.sd, "correlation_area_mm2": noise.correlation_area},
    }


def true_ratios(objective: Objective, scene: Scene) -> NDArray[np.float64]:
    """True moduli (n_parameters,) of what is estimated, to that of the tissue that holds the scale."""
    mapping = objective.parameters
    return np.array([scene.moduli_kpa[name] / scene.moduli_kpa[mapping.relative_to] for name in mapping.tissues])


def _uncertainty(
    inversion: Inversion, problem: InverseProblem, body: Body, scene: Scene, settings: InversionSettings, row: Row
) -> Result:
    """Interval, spread of an exact model over grid positions, and the Cramer-Rao limit of this scene's noise."""
    images = tuple(image.index for image in body.states.after)
    observed = Observed(fitted_states(inversion, body), images)
    estimation = conclude(inversion, settings, observed, truth=scene.moduli_kpa, seed=scene.seed)
    at, rng = inversion.minimum.evaluation, np.random.default_rng(scene.seed)
    moved = grid_position_shifts(inversion.objective, at, observed.states, rng=rng)
    found: Result = {
        "interval95": [e.ratio_interval95 for e in estimation.estimates],
        "verdict": [e.verdict for e in estimation.estimates],
        "sd": np.sqrt(np.diag(estimation.covariance.total)).tolist(),
        "grid_sd": np.sqrt(np.mean(moved**2, axis=0)).tolist(),
    }
    if row.noise is not None:
        found["cramer_rao_sd"] = _cramer_rao_sd(at_truth(inversion, problem, scene), body, scene, row.noise)
    return found


def _cramer_rao_sd(inversion: Inversion, body: Body, scene: Scene, noise: Noise) -> list[float]:
    """Of the log-moduli at an inversion's minimum."""
    rng = np.random.default_rng([scene.seed, 11])
    model = true_noise(inversion, fitted_states(inversion, body), noise, rng)
    n, cell = inversion.objective.n_parameters, noise.correlation_length_mm
    limit = cramer_rao(inversion.minimum.evaluation, model, n, cell_mm=cell)
    return [float(sd) for sd in np.sqrt(np.diag(limit))]


def at_truth(inversion: Inversion, problem: InverseProblem, scene: Scene) -> Inversion:
    """The same with the truth for its minimum: the true moduli, and the wall's motion that comes nearest to it.

    A limit taken at the estimate would depend on the noise that moved it. All residuals count, by the inversion's noise
    model; what is known before is the prior that the case states.
    """
    state, mapping, noise = problem.states[0], problem.parameters, inversion.objective.states[0].noise
    wall = next(observation for observation in state.observations if observation.of_driver)
    rest, modes = state.model.space.points.ravel()[wall.dofs].reshape(-1, 3), state.model.constraint.modes[wall.dofs]
    motion = scene.motions[wall.name].at(rest).ravel() - state.model.constraint.offset[wall.dofs]
    coefficients = np.asarray(np.linalg.lstsq(modes, motion)[0], dtype=np.float64)
    unknowns = np.zeros(mapping.n_unknowns)  # what the model leaves out is not there
    unknowns[: mapping.n_parameters] = np.log(true_ratios(inversion.objective, scene))
    columns = mapping.coefficients(np.arange(mapping.n_unknowns, dtype=np.float64))[0].astype(int)
    unknowns[columns[: len(coefficients)]] = coefficients
    place = LinearisationPoint(mapping.moduli(unknowns), mapping.coefficients(unknowns)[0])
    exact = exact_approximation(state.model, state.finite_strain, place)
    objective = Objective(problem.states, mapping).with_approximations([exact])
    objective = objective.with_observations([o.with_noise(noise[o.kind]) for o in objective.observations])
    objective = objective.rematched(unknowns)
    minimum = replace(inversion.minimum, unknowns=unknowns, evaluation=objective(unknowns))
    return replace(inversion, objective=objective, minimum=minimum)


def true_noise(
    inversion: Inversion, fitted: tuple[FittedState, ...], noise: Noise, rng: np.random.Generator
) -> NoiseModel:
    """The noise that was put into both images, and that of the voxels on the model, over several places of the grid."""
    objective, evaluation = inversion.objective, inversion.minimum.evaluation
    errors = [error for _ in range(GRIDS) for error in imaging_errors(objective, evaluation, fitted, rng=rng)]
    lines = GRIDS * evaluation.linearisations
    rows = [model_to_image(line) for line in lines]
    voxels = fit_noise_model(
        [0.5 * error[of] for error, of in zip(errors, rows, strict=True)],  # one direction represents both
        [line.residuals.places[of] for line, of in zip(lines, rows, strict=True)],
        [line.residuals.normals[of] for line, of in zip(lines, rows, strict=True)],
    )
    smooth = 2.0 * noise.surface_sd_mm**2
    return NoiseModel(np.append(voxels.variances, smooth), np.append(voxels.lengths, noise.correlation_length_mm))


def _driver_error(inversion: Inversion, space: LagrangeSpace, scene: Scene) -> Result:
    """RMS error (mm) of the estimated wall motion, normal and tangential parts, area-weighted."""
    mapping, unknowns = inversion.objective.parameters, inversion.minimum.unknowns
    moduli, coefficients = mapping.moduli(unknowns), mapping.coefficients(unknowns)
    motion = inversion.objective.states[0].displacement(moduli, coefficients[0])
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


def _summary(results: Sequence[Result]) -> Result:
    errors = np.concatenate([r["ln_error"] for r in results])
    found: Result = {
        "cases": len(results),
        "moduli": len(errors),
        "rms_ln_error": _rms(errors),
        "worst_ln_error": float(np.abs(errors).max()),
        "mean_ln_error": float(errors.mean()),
        "all_converged": all(r["outcome"] == "CONVERGED" for r in results),
        "estimate_seconds": float(np.mean([r["estimate_seconds"] for r in results])),
        "dofs": int(np.mean([r["dofs"] for r in results])),
    }
    if "linear_ln_error" in results[0]:
        off = np.concatenate([r["linear_ln_error"] for r in results])
        found |= {"linear_rms_ln_error": _rms(off), "linear_worst_ln_error": float(np.abs(off).max())}
    if "sd" in results[0]:
        truth = np.concatenate([r["truth_ratio"] for r in results])
        ends = [end for r in results for end in r["interval95"]]
        stated = [
            (of, t) for of, t in zip(ends, truth, strict=True) if of is not None
        ]  # none of what is not identified
        inside = [low <= t <= high for (low, high), t in stated]
        found |= {
            "grid_spread_rms": _rms(np.concatenate([r["grid_sd"] for r in results])),
            "inside_95": float(np.mean(inside)) if inside else float("nan"),
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


def _line(result: Result) -> str:
    errors = ", ".join(
        f"{name} {100 * error:+.2f} %" for name, error in zip(result["tissues"], result["ln_error"], strict=True)
    )
    seconds = f"scene {result['scene_seconds']:.0f} s, estimate {result['estimate_seconds']:.0f} s"
    return f"{result['row']} {result['seed']}: {errors} ({result['outcome']}, {result['dofs']} dof; {seconds})"


def _table(summaries: dict[str, Result]) -> str:
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


def _read(path: Path) -> dict[tuple[str, int, int], Result]:
    lines = path.read_text().splitlines() if path.exists() else []
    results = [json.loads(line) for line in lines]
    return {(result["row"], result["seed"], result.get("draw", 0)): result for result in results}


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
