"""The errors of estimates against the truth: same mesh, other mesh, voxels, noise, a tumour, a small filling.

    python benchmarks/accuracy.py [--rows clean,noise,...] [--cases N] [--first-seed S] [--edges 4,6,8] [--meshes N]
                                  [--defaults] [--output FILE] [--json]

Every row draws random pelves (shape, position, orientation to the voxel grid, moduli 1.5 to 6 times the surroundings,
Poisson's ratios 0.40 to 0.45) by seed. The truth is made on a finer mesh than the one that inverts it. Simulated data.

--edges estimates rows of voxels on meshes of several edge lengths, and --meshes on several of each, which differ by a
few per cent. The table is then one of edge lengths: their error of ln E, and the distance from the estimate of the
first edge length as a share of the 95 % interval (without the position of the voxels). Of several meshes it also tells
how far a body's estimates lie from their mean at the first edge length, beside the stated `discretisation_sd`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from cramer_rao import cramer_rao, model_to_image
from numpy.typing import NDArray
from rows import Job, Result, collected, holds, mean, median, parser_of, printed, rms, seeds_of, silent

from palpate.approximation import LinearisationPoint, exact_approximation
from palpate.body import Body, aligned, edge_length_of, inverse_problem, make_body
from palpate.case import Case, Discrepancy, Domain, Mechanics, MeshSettings, Phantom
from palpate.images import Role, segment
from palpate.inversion import InverseProblem, Inversion, InversionSettings, LaterState, Objective, invert
from palpate.mechanics import ACCURACY, NewtonSettings, finite_strain_model, linear_model, outer_constraint
from palpate.mesh import LagrangeSpace, lagrange_space, tetrahedralise, triangle_normals
from palpate.observation import NoiseModel, fit_noise_model, observed_surface, prescribed_motion, surface_distance
from palpate.phantoms import Noise, PelvisOptions, Scene, pelvis, pelvis_anatomy, pelvis_grid, reimaged
from palpate.statement import Observed, conclude
from palpate.study import fitted_states, inversion_settings
from palpate.uncertainty import (
    NORMAL_95,
    FittedState,
    discretisation_sd,
    grid_position_shifts,
    imaging_errors,
    sandwich_covariance,
)
from palpate.unknowns import parameter_map, wall_blocks
from palpate_validation.truth import exact_target, rescaled
from scenes import drawn_filling

Array = NDArray[np.float64]

KEYS = ("row", "seed", "draw", "edge_mm", "mesh")
NOTHING_LEFT_OUT = Discrepancy(heterogeneity_sd=0.0, poisson_sd=0.0, surface_offset_mm=0.0)
NOISE = Noise(surface_sd_mm=0.3, correlation_length_mm=6.0)
GRIDS = 6  # that the voxels' part of the Cramer-Rao limit's noise is measured on: one alone moves the limit threefold
DRIVER_ERRORS = ("driver_normal_rms_mm", "driver_tangential_rms_mm")
OTHER_MESH = 0.03  # by which share of its edge length a further mesh of the same edge length differs


@dataclass(frozen=True)
class Row:
    """One row of the table: how scenes are drawn, and what is shown to the estimate."""

    cases: int
    filling_mm: float | None = None  # None: 6 to 8 mm at random
    spacing_mm: tuple[float, float, float] = (1.0, 1.0, 1.0)
    noise: Noise | None = None
    tumour: bool = False
    data: str = "voxels"
    edge_mm: float | None = None  # None: the program's own choice
    truth_edge_mm: float = 3.4
    draws: int = 1  # of the noise, for each pelvis
    law: str = "linear"  # of the truth and of the estimate
    poisson_ratio: float | None = None  # None: 0.40 to 0.45 at random
    held: bool = True  # the frame, and all else that the model leaves out; False: the program's defaults


ROWS = {
    "same-mesh": Row(2, data="same mesh", truth_edge_mm=5.0),
    "other-mesh": Row(4, data="surfaces", edge_mm=4.0, truth_edge_mm=2.7),  # what exact surfaces show
    "clean": Row(8),
    "clean-3mm": Row(4, filling_mm=3.0),
    "noise": Row(8, spacing_mm=(1.0, 1.0, 2.5), noise=NOISE, draws=3),
    "tumour": Row(3, tumour=True),
    "nu-0.49": Row(4, poisson_ratio=0.49),
    "finite-clean": Row(6, law="neo-hookean"),
    "finite-clean-3mm": Row(3, law="neo-hookean", filling_mm=3.0),
    "finite-noise": Row(6, law="neo-hookean", spacing_mm=(1.0, 1.0, 2.5), noise=NOISE, draws=2),
}


Truths = dict[tuple[object, ...], tuple[Scene, float]]


def truth_of(row: Row, seed: int, draw: int, truths: Truths) -> tuple[Scene, PelvisOptions]:
    """The scene of a row; rows of one seed share the truth where they can, but not the images.

    A linear truth is linear in the filling; a finite-strain one is made anew.
    """
    filling = drawn_filling(seed)
    if row.law != "linear" and row.filling_mm is not None:
        filling = row.filling_mm
    options = PelvisOptions(
        seed=seed,
        filling_mm=filling,
        tumour=row.tumour,
        law=row.law,
        poisson_ratio=row.poisson_ratio,
        truth_edge_mm=row.truth_edge_mm,
    )
    key = (row.tumour, row.law, row.poisson_ratio, row.truth_edge_mm, filling)
    if key not in truths:
        truths.clear()  # a truth is large
        truths[key] = pelvis(options), filling
    scene, made = truths[key]
    if row.filling_mm is not None and row.law == "linear":
        scene = rescaled(scene, row.filling_mm / made)
        filling = row.filling_mm
    options = replace(options, filling_mm=filling, spacing_mm=row.spacing_mm, noise=row.noise)
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
        domain=Domain(outer_boundary="fixed") if row.held else Domain(),
        discrepancy=NOTHING_LEFT_OUT if row.held else Discrepancy(),
    )
    bodies: tuple[Body, ...] = ()
    if row.data == "voxels":
        problem, body = from_voxels(scene, case)
        space, bodies = body.space, (body,)
    else:
        space, problem = _from_surfaces(scene, case, options, row)
    return Posed(scene, options.filling_mm, space, problem, inversion_settings(case, problem.parameters), bodies)


def from_voxels(scene: Scene, case: Case) -> tuple[InverseProblem, Body]:
    """Everything from the label images: the inverse problem, and the body that it is made of."""
    before, after = (segment(image, scene.tissues) for image in (scene.before, scene.after))
    body = make_body(aligned(before, (after,), method="none"), case, progress=silent)
    return inverse_problem(body, case, progress=silent), body


def _from_surfaces(scene: Scene, case: Case, options: PelvisOptions, row: Row) -> tuple[LagrangeSpace, InverseProblem]:
    """The truth's surfaces as targets; on the same mesh also a wall motion that the modes can make."""
    same_mesh = row.data == "same mesh"
    if same_mesh:
        space = lagrange_space(scene.mesh, "P2")
    else:
        before, after = (segment(image, scene.tissues) for image in (scene.before, scene.after))
        edges = edge_length_of(case, before, (after,))
        anatomy = pelvis_anatomy(options)
        mesh = tetrahedralise(anatomy, edge_length_mm=edges.mm, longer_mm=edges.longer_mm)
        space = lagrange_space(mesh, "P2")
    driver = case.driver
    motion = prescribed_motion(
        space, {}, n_modes=driver.modes, kernel_mm=driver.kernel_mm, prior_mm=driver.prior_mm, fine=True
    )
    constraint = outer_constraint(
        space, outer="fixed", modes=motion.modes, offset=motion.offset, prescribed=motion.prescribed
    )
    model = linear_model(space, constraint)
    if same_mesh:
        rows = np.repeat(motion.prescribed, 3)
        q = np.asarray(np.linalg.lstsq(motion.modes[rows], scene.displacement.ravel()[rows])[0], dtype=np.float64)
        moduli = np.array([scene.moduli_kpa[name] for name in model.names])
        scene = replace(scene, displacement=model.solve(moduli, q).displacement)
    observed = [i for i, t in enumerate(scene.tissues) if t.role in (Role.ESTIMATE, Role.DRIVER)]
    seen = tuple(surface_distance(exact_target(scene, observed_surface(space, i))) for i in observed)
    mapping = parameter_map(scene.tissues, model.regions, [b for wall in motion.walls for b in wall_blocks(wall, 0)])
    law = case.mechanics.material_law
    finite = finite_strain_model(space, constraint, law, settings=NewtonSettings(ACCURACY)) if law.finite else None
    return space, InverseProblem((LaterState(model, seen, finite),), mapping)


def main() -> int:
    """Run the rows that were asked for and print their summaries."""
    parser = parser_of(__doc__ or "", output="accuracy.jsonl", first_seed=101, seeds=None, name="--cases")
    parser.add_argument("--rows", default=",".join(ROWS))
    parser.add_argument("--defaults", action="store_true", help="the program's defaults: nothing is held")
    parser.add_argument("--edges", help="edge lengths (mm) instead of the row's own")
    parser.add_argument("--meshes", type=int, default=1, help="of each edge length")
    asked = parser.parse_args()
    names = asked.rows.split(",")
    found = [line for line in collected(_jobs(names, asked), asked, KEYS, _line) if line["row"] in names]
    if asked.edges:
        summaries, columns = edges_of([line for line in found if "edge_mm" in line]), EDGE_COLUMNS
    else:
        by_row = {name: [line for line in found if line["row"] == name and "edge_mm" not in line] for name in names}
        summaries, columns = {name: summary_of(lines) for name, lines in by_row.items() if lines}, COLUMNS
    printed(summaries, asked, columns)
    return 0


def _jobs(names: Sequence[str], asked: argparse.Namespace) -> Iterator[Job]:
    """Body after body, for rows of one body share its truth."""
    wanted = asked.seeds
    asked.seeds = wanted or max(ROWS[name].cases for name in names)
    for seed in seeds_of(asked):
        truths: Truths = {}
        for name in names:
            row = replace(ROWS[name], held=not asked.defaults)
            if seed - asked.first_seed >= (wanted or row.cases):
                continue
            if asked.edges:
                for edge in map(float, asked.edges.split(",")):
                    for mesh in range(asked.meshes):
                        key = {"row": name, "seed": seed, "edge_mm": edge, "mesh": mesh}
                        yield Job(key, partial(_meshed, row, edge, mesh, seed, truths))
                continue
            for draw in range(row.draws):
                yield Job({"row": name, "seed": seed, "draw": draw}, partial(_case, row, seed, draw, truths))


def _case(row: Row, seed: int, draw: int, truths: Truths) -> Result:
    """Make one scene, estimate it, and compare the estimate with the truth."""
    began = time.perf_counter()
    case = posed(row, seed, draw, truths)
    scene, problem, settings = case.scene, case.problem, case.settings
    ready = time.perf_counter()
    inversion = invert(problem, settings, progress=silent)
    result: Result = {
        "filling_mm": case.filling_mm,
        "dofs": 3 * len(case.space.points),
        "truth_dofs": 3 * len(scene.space.points),
        "scene_seconds": ready - began,
        "estimate_seconds": time.perf_counter() - ready,
        "outcome": inversion.minimum.outcome.name,
        "starts": [start.candidate for start in inversion.starts],
    }
    result |= _errors(inversion, scene)
    if row.law != "linear":
        result["linear_ln_error"] = _errors(invert(problem.linear(), settings, progress=silent), scene)["ln_error"]
    if case.bodies:
        result |= _uncertainty(inversion, problem, case.bodies[0], scene, settings, row)
        result |= _driver_error(inversion, case.space, scene)
    return result


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
    squares = normal**2, np.maximum(total - normal**2, 0.0)
    return {name: float(np.sqrt(np.average(of, weights=area))) for name, of in zip(DRIVER_ERRORS, squares, strict=True)}


def _meshed(row: Row, edge_mm: float, mesh: int, seed: int, truths: Truths) -> Result:
    """Error, standard deviation of the noise and that of the mesh, of ln E of every organ."""
    away = OTHER_MESH * ((mesh + 1) // 2) * (-1) ** mesh
    case = posed(replace(row, edge_mm=edge_mm * (1.0 + away)), seed, 0, truths)
    inversion = invert(case.problem, case.settings, progress=silent)
    objective, minimum = inversion.objective, inversion.minimum
    sd = np.sqrt(np.diag(sandwich_covariance(objective, minimum.evaluation)))
    organs = [[case.space.mesh.tissue_index(tissue)] for tissue in objective.parameters.tissues]
    return {
        "unknowns": 3 * len(case.space.points),
        "converged": minimum.converged,
        "error": _errors(inversion, case.scene)["ln_error"],
        "sd": sd.tolist(),
        "mesh_sd": [discretisation_sd(case.space, organ) for organ in organs],
    }


def summary_of(results: Sequence[Result]) -> Result:
    """Of the cases of one row."""
    errors = [error for r in results for error in r["ln_error"]]
    ends = [end for r in results for end in r.get("interval95", [])]
    truths = [truth for r in results for truth in r["truth_ratio"]]
    stated = [(end, truth) for end, truth in zip(ends, truths, strict=bool(ends)) if end is not None]
    found: Result = {
        "cases": len(results),
        "moduli": len(errors),
        "rms_ln_error": rms(errors),
        "worst_ln_error": float(np.abs(errors).max()),
        "mean_ln_error": mean(errors),
        "all_converged": all(r["outcome"] == "CONVERGED" for r in results),
        "estimate_seconds": mean([r["estimate_seconds"] for r in results]),
        "dofs": int(np.mean([r["dofs"] for r in results])),
        "stated": len(stated),
        "held": sum(holds(end, truth) for end, truth in stated),
    }
    if "linear_ln_error" in results[0]:
        off = [error for r in results for error in r["linear_ln_error"]]
        found |= {"linear_rms_ln_error": rms(off), "linear_worst_ln_error": float(np.abs(off).max())}
    if ends:
        found["grid_spread_rms"] = rms([sd for r in results for sd in r["grid_sd"]])
        found["inside_95"] = found["held"] / len(stated) if stated else None
        found |= {name: mean([r[name] for r in results]) for name in DRIVER_ERRORS}
    if limit := [sd for r in results for sd in r.get("cramer_rao_sd", [])]:
        sds = [sd for r in results for sd in r["sd"]]
        found["cramer_rao_rms"] = rms(limit)
        found["median_width_over_cramer_rao"] = median([sd / of for sd, of in zip(sds, limit, strict=True)])
    return found


def edges_of(lines: Sequence[Result]) -> dict[str, Result]:
    """By edge length: error, how far estimates lie from those of the first, and the stated part of the mesh in that."""
    edges = list(dict.fromkeys(line["edge_mm"] for line in lines))
    bodies, found = dict.fromkeys((line["seed"], line["edge_mm"]) for line in lines), {}
    of_body = {key: [line for line in lines if (line["seed"], line["edge_mm"]) == key] for key in bodies}
    of_first = {seed: own for (seed, edge), own in of_body.items() if edge == edges[0]}
    first = {seed: np.mean([r["error"] for r in own], axis=0) for seed, own in of_first.items()}
    for edge in edges:
        own = [line for line in lines if line["edge_mm"] == edge]
        off = [np.abs(r["error"] - first[r["seed"]]) / (2.0 * NORMAL_95 * np.array(r["sd"])) for r in own]
        row: Result = {
            "edge_mm": edge,
            "unknowns": round(float(np.mean([r["unknowns"] for r in own]))),
            "rms_ln_error": rms([error for r in own for error in r["error"]]),
            "share_of_interval": float(np.median(off)),
            "largest_share": float(np.max(off)),
        }
        if edge != edges[0]:
            ratios = []
            for seed, mean_error in first.items():
                apart = [np.square(r["error"] - mean_error) for r in of_body[seed, edge]]
                ratios.append(rms([sd for r in of_body[seed, edge] for sd in r["mesh_sd"]]) / np.sqrt(np.mean(apart)))
            row |= {"bodies": len(ratios), "within_a_factor_2": sum(0.5 <= ratio <= 2.0 for ratio in ratios)}
            row["stated_over_found"] = median(ratios)
        found[f"{edge:g} mm"] = row
    return found


COLUMNS = {
    "cases, moduli": lambda row: f"{row['cases']}, {row['moduli']}",
    "RMS ln-error": lambda row: f"{row['rms_ln_error']:.{5 if row['worst_ln_error'] < 0.005 else 3}f}",
    "worst": lambda row: f"{row['worst_ln_error']:.3f}",
    "mean": lambda row: f"{row['mean_ln_error']:.3f}",
    "grid spread": lambda row: f"{row['grid_spread_rms']:.3f}",
    "Cramer-Rao": lambda row: f"{row['cramer_rao_rms']:.3f}",
    "inside 95 %": lambda row: f"{row['inside_95']:.0%}",
    "linear law": lambda row: f"{row['linear_rms_ln_error']:.2f}",
}
EDGE_COLUMNS = {
    "unknowns": lambda row: str(row["unknowns"]),
    "RMS ln-error": lambda row: f"{row['rms_ln_error']:.3f}",
    "off the first, of the interval": lambda row: f"{row['share_of_interval']:.0%}",
    "most": lambda row: f"{row['largest_share']:.0%}",
    "stated within a factor 2": lambda row: f"{row['within_a_factor_2']} of {row['bodies']}",
    "stated / found": lambda row: f"{row['stated_over_found']:.2f}",
}


def _line(result: Result) -> str:
    if "edge_mm" in result:
        return f"{result['row']} {result['seed']}, {result['edge_mm']:g} mm: {np.round(result['error'], 4).tolist()}"
    named = zip(result["tissues"], result["ln_error"], strict=True)
    errors = ", ".join(f"{name} {100 * error:+.2f} %" for name, error in named)
    seconds = f"scene {result['scene_seconds']:.0f} s, estimate {result['estimate_seconds']:.0f} s"
    return f"{result['row']} {result['seed']}: {errors} ({result['outcome']}, {result['dofs']} dof; {seconds})"


if __name__ == "__main__":
    raise SystemExit(main())
