"""Whether stated intervals hold the truth where the model is wrong, and their width over the Cramer-Rao limit.

    python benchmarks/coverage.py [--rows gauss-0.3,bumps,...] [--bodies N] [--draws N] [--first-seed S] [--edge MM]
                                  [--output FILE] [--minutes N] [--json]

Simulated data. A row is a kind of body, of errors of its drawn surfaces, and of further measurements (scenes.py). Each
body is estimated once from the exact surfaces of a finer mesh, with all unknowns of the defaults: frame, layers, patchy
tissues, Poisson's ratios, offsets. Each draw then moves the surfaces of both images. It is estimated on that estimate's
approximation of the model, which is updated on the way. Noise, weights, closest points and the priors of frame, walls
and tissues are found anew; the model's first responses and two of three starts are not computed again. The search ends
within a fifth of a standard deviation. Intervals are those of the program, without the position of voxels, because the
surfaces have none.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from accuracy import true_ratios
from cramer_rao import fisher_information
from numpy.typing import NDArray
from rows import Job, Result, collected, holds, mean, median, parser_of, printed, seeds_of, silent
from scipy import stats

from palpate.body import aligned, inverse_problem, make_body
from palpate.case import Case, Mechanics, MeshSettings, Phantom
from palpate.errors import EstimationError
from palpate.images import segment
from palpate.inversion import InverseProblem, Inversion, InversionSettings, StopRule, invert
from palpate.mesh import LagrangeSpace
from palpate.observation import NoiseModel, Observation, ObservedSurface, SurfaceDistance, surface_distance
from palpate.phantoms import Scene
from palpate.statement import as_stated, estimates_of, intervals_of
from palpate.study import inversion_settings
from palpate.uncertainty import NORMAL_95, covariance_of, gain, noise_covariance
from palpate.unknowns import Choice
from palpate_validation.truth import target_of_truth
from scenes import NOISES, POINTS, TRUTHS, measured_points, skins_of

Array = NDArray[np.float64]
BodyKey = tuple[str, bool, str, str]  # truth, whether points are measured, the estimate's law and the truth's

OUT = 2.0  # half-widths
NEARLY = StopRule(step_sd=0.2)  # the stop rule moves an estimate much less than noise does
CLEAN = NoiseModel(np.array([2.0 * 0.05**2]), np.array([3.0]))  # of the clean estimate: smaller than any row's
MOST_TELLING = "field-0.2"  # by whose clean estimate all points are followed: it sees what the others see
NO_GRID = 3  # draws of a voxel grid, in which nothing is off


@dataclass(frozen=True)
class Row:
    """What is drawn: a key of TRUTHS, of NOISES and of POINTS ("": none), the truth's law and the estimate's.

    noise: of a residual, where a Cramer-Rao limit is computed, too.
    """

    name: str
    truth: str
    noise: str
    points: str = ""
    law: str = "linear"
    truth_law: str = "linear"
    limit: NoiseModel | None = None


def _normal(sd_mm: float) -> NoiseModel:
    return NoiseModel(np.array([2.0 * sd_mm**2]), np.array([6.0]))


ROWS = {
    row.name: row
    for row in (
        Row("gauss-0.1", "pelvis", "gauss-0.1", limit=_normal(0.1)),
        Row("gauss-0.2", "pelvis", "gauss-0.2", limit=_normal(0.2)),
        Row("matern", "pelvis", "matern"),
        Row("bumps", "pelvis", "bumps"),
        Row("uneven", "pelvis", "uneven"),
        Row("resegmented", "pelvis", "resegmented"),
        Row("shrunk", "pelvis", "shrunk"),
        Row("patchy", "patchy", "gauss-0.1"),
        Row("moving", "moving", "gauss-0.1", limit=_normal(0.1)),
        Row("balls", "balls", "gauss-0.1"),
        Row("liver", "liver", "gauss-0.1"),
        Row("other-law", "small", "gauss-0.1", truth_law="neo-hookean"),
        Row("finite", "pelvis", "gauss-0.1", law="neo-hookean", truth_law="neo-hookean"),
        Row("surfaces", "moving", "gauss-0.3", limit=_normal(0.3)),
        *(Row(name, "moving", "gauss-0.3", points=name, limit=_normal(0.3)) for name in POINTS),
    )
}


@dataclass(frozen=True)
class Body:
    """What a row's draws of one body share: its problem on the approximations of the clean estimate, and the truth.

    surfaces: those that are compared; truth (n,): ln of the true ratios; clean (n,): the clean estimate's errors.
    """

    scene: Scene
    space: LagrangeSpace
    surfaces: tuple[ObservedSurface, ...]
    problem: InverseProblem
    settings: InversionSettings
    truth: Array
    clean: Array


def main() -> int:
    """Run what was asked for and print the table."""
    parser = parser_of(__doc__ or "", output="coverage.jsonl", first_seed=501, seeds=3)
    parser.add_argument("--rows", default=",".join(ROWS), help=f"of {', '.join(ROWS)}")
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--edge", type=float, default=10.0, help="edge length (mm) of the estimate's mesh")
    asked = parser.parse_args()
    results = collected(_jobs(asked), asked, ("row", "seed"), lambda r: f"{r['row']} {r['seed']}: {summary([r])}")
    names = [name for name in ROWS if any(result["row"] == name for result in results)]
    table = {name: summary([result for result in results if result["row"] == name]) for name in names}
    printed(table | {"all": summary(results)}, asked, COLUMNS)
    return 0


def _jobs(asked: argparse.Namespace) -> Iterator[Job]:
    """Body after body: rows of one seed share scenes and bodies where they can."""
    for seed in seeds_of(asked):
        shared = dict[tuple[str, str], Scene](), dict[BodyKey, Body]()
        for name in asked.rows.split(","):
            yield Job({"row": name, "seed": seed}, partial(_result, ROWS[name], seed, asked.draws, asked.edge, *shared))


def _result(
    row: Row,
    seed: int,
    draws: int,
    edge_mm: float,
    scenes: dict[tuple[str, str], Scene],
    bodies: dict[BodyKey, Body],
) -> Result:
    """A row's draws of one body; scenes and bodies are kept for the next row, the last body alone."""
    began = time.perf_counter()
    if (row.truth, row.truth_law) not in scenes:
        scenes[row.truth, row.truth_law] = TRUTHS[row.truth](seed, row.truth_law, edge_mm)
    scene, key = scenes[row.truth, row.truth_law], (row.truth, bool(row.points), row.law, row.truth_law)
    if key not in bodies:
        bodies.clear()  # its approximation is large
        bodies[key] = _body(scene, row, edge_mm)
    body, spent = bodies[key], time.perf_counter() - began
    began = time.perf_counter()
    found = [_drawn(body, row, draw) for draw in range(draws)]
    return {
        "clean_error": body.clean.tolist(),
        "body_seconds": round(spent, 1),
        "draw_seconds": round((time.perf_counter() - began) / max(draws, 1), 1),
        "draws": found,
    }


def _body(scene: Scene, row: Row, edge_mm: float) -> Body:
    """One whole estimate from what the truth shows without errors."""
    case = Case("coverage", phantom=Phantom("pelvis"), mesh=MeshSettings(edge_mm), mechanics=Mechanics(row.law, "auto"))
    before, after = (segment(image, scene.tissues) for image in (scene.before, scene.after))
    meshed = make_body(aligned(before, (after,), method="none"), case, progress=silent)
    problem = inverse_problem(meshed, case, progress=silent)
    seen = problem.states[0].observations
    surfaces = tuple(o.target.surface for o in seen if isinstance(o, SurfaceDistance))
    exact = [surface_distance(target_of_truth(scene.space, scene.displacement, surface)) for surface in surfaces]
    exact = [o.with_noise(o.first_noise((o,))) for o in (replace(o, stated_noise=CLEAN) for o in exact)]
    points = [measured_points(scene, meshed.space, POINTS[MOST_TELLING], None)] if row.points else []
    state = problem.states[0].with_observations([*exact, *points])
    settings = inversion_settings(case, problem.parameters)
    linear = invert(InverseProblem((state,), problem.parameters).linear(), settings, progress=silent, rule=NEARLY)
    theta, n = linear.minimum.unknowns[: problem.parameters.n_parameters], problem.parameters.n_parameters
    known = linear.objective.states[0]
    if state.finite_strain is not None:
        finite = state.finite_strain.with_conditions(known.model.conditions)
        known = replace(known, finite_strain=replace(finite, material=known.model.material))
    parameters = replace(linear.objective.parameters, priors=())  # to be learned anew
    truth = np.log(true_ratios(linear.objective, scene))
    return Body(
        scene,
        meshed.space,
        surfaces,
        InverseProblem((known,), parameters),
        replace(settings, starts=(theta[:n],)),
        truth,
        theta[:n] - truth,
    )


def _drawn(body: Body, row: Row, draw: int) -> Result:
    """What one draw leads to; an estimate that fails says so, and counts as not converged."""
    rng = np.random.default_rng([body.scene.seed, draw, *row.name.encode()])
    state = body.problem.states[0].with_observations(_observations(body, row, rng))
    assert state.approximation is not None
    problem = replace(body.problem, states=(state.with_approximation(state.approximation),))
    try:
        inversion = invert(problem, body.settings, progress=silent, rule=NEARLY)
    except EstimationError as error:
        return {"converged": False, "failure": str(error), "moduli": []}
    converged = inversion.minimum.converged
    noise = {o.kind: (o.noise_model.sd, o.noise_model.correlation_area) for o in inversion.objective.observations}
    return {"converged": converged, "noise": noise, "moduli": _moduli(inversion, body, row) if converged else []}


def _observations(body: Body, row: Row, rng: np.random.Generator) -> list[Observation]:
    """Those of one draw: the surfaces of both images moved along their normals, and points that err."""
    tissues, drawn = [surface.tissue for surface in body.surfaces], []
    for later in (False, True):
        skins = skins_of(body.scene, tissues, later=later)
        errors = NOISES[row.noise](skins, rng, later)
        drawn.append([error[:, None] * skin.normals for error, skin in zip(errors, skins, strict=True)])
    space, displacement = body.scene.space, body.scene.displacement
    found: list[Observation] = [
        surface_distance(target_of_truth(space, displacement, surface, warps=(before.__add__, after.__add__)))
        for surface, before, after in zip(body.surfaces, *drawn, strict=True)
    ]
    if row.points:
        found.append(measured_points(body.scene, body.space, POINTS[row.points], rng))
    return found


def _moduli(inversion: Inversion, body: Body, row: Row) -> list[Result]:
    """By tissue: the error of ln E, its standard deviation, the ends of its intervals less the truth, the verdict."""
    objective, minimum = inversion.objective, inversion.minimum
    errors = [[np.zeros(len(line.weights)) for line in minimum.evaluation.linearisations]] * NO_GRID
    bonded = covariance_of(objective, minimum.evaluation, errors)
    posterior = as_stated(inversion, bonded, body.settings.bounds)
    covariance, known = posterior.mixture.covariance, intervals_of(inversion, body.settings, posterior)
    estimates = estimates_of(inversion, known, covariance, truth={})
    limits = _limits(inversion, row)
    of_noise = None if row.limit is None else _by_true_noise(inversion, row.limit)
    scale, found = objective.parameters.scale_kpa, []
    for i, (estimate, of) in enumerate(zip(estimates, known, strict=True)):
        given = estimate.interval95_given_model
        found.append(
            {
                "tissue": estimate.tissue,
                "error": float(of.theta - body.truth[i]),
                "sd": float(np.sqrt(covariance.total[i, i])),
                "sd_true_noise": None
                if of_noise is None
                else float(np.sqrt(covariance.total[i, i] - covariance.noise[i, i] + of_noise[i, i])),
                "shares": {name: round(share, 4) for name, share in covariance.shares(i).items()},
                "verdict": estimate.verdict,
                "interval": _ends(of.interval, body.truth[i]),
                "own": _ends(of.own.ends, body.truth[i]),
                "given_model": _ends(given, body.truth[i] + np.log(scale)) if given else None,
                **{name: limit[i] for name, limit in limits.items()},
            }
        )
    return found


def _ends(interval: tuple[float | None, float | None], truth: float) -> list[float | None]:
    """The ends of an interval in ln E, less the truth."""
    return [None if end is None else float(np.log(end) - truth) for end in interval]


def _by_true_noise(inversion: Inversion, noise: NoiseModel) -> Array:
    """Covariance (n, n) of the log-moduli that errors as they were drawn make through the estimate's own weights."""
    evaluation, n = inversion.minimum.evaluation, inversion.objective.n_parameters
    seen = [(line.state, line.observation) for line in evaluation.linearisations]
    models = {(s, o.kind): noise if isinstance(o, SurfaceDistance) else o.first_noise((o,)) for s, o in seen}
    pairs = list(zip(evaluation.linearisations, gain(evaluation, n), strict=True))
    return noise_covariance(inversion.objective, pairs, models)


def _limits(inversion: Inversion, row: Row) -> dict[str, list[float]]:
    """The Cramer-Rao limits of the standard deviations: with the draw's priors, layers held; these free; the widest.

    The widest priors are those that mixtures have for frames, offsets and patchy tissues that are not what is usual:
    which of them holds is left undecided, and counts in an interval.
    """
    if row.limit is None:
        return {}
    evaluation, parameters = inversion.minimum.evaluation, inversion.objective.parameters
    known, found = fisher_information(evaluation, row.limit, cell_mm=float(row.limit.lengths[0])), {}
    held = (Choice.HELD,)  # is unknown to a limit as well
    wide = {
        "limit": held,
        "limit_layers": (*held, Choice.LAYERS),
        "limit_widest": (*held, Choice.PATCHINESS, Choice.FRAME, Choice.DRAWING),
    }
    for name, choices in wide.items():
        prior = evaluation.prior.dense
        for i, block in enumerate(parameters.blocks):
            own = np.ix_(parameters.columns(i), parameters.columns(i))
            if block.choice in choices:
                prior[own] = np.linalg.inv(block.widest)
            elif block.choice is Choice.LAYERS:
                prior[own] = np.linalg.inv(block.alternatives[0].covariance)
        variances = np.diag(np.linalg.inv(known + prior))
        found[name] = np.sqrt(variances[: parameters.n_parameters]).tolist()
    return found


def summary(results: Sequence[Result]) -> Result:
    """Of the bodies of one row: how many intervals hold, of how many, and how wide they are."""
    draws = [draw for result in results for draw in result["draws"]]
    moduli = [modulus for draw in draws for modulus in draw["moduli"]]
    stated = [modulus for modulus in moduli if modulus["verdict"] != "not identified"]
    held = sum(holds(modulus["interval"]) for modulus in stated)
    given = [holds(modulus["given_model"]) for modulus in stated if modulus["given_model"] is not None]
    bounds = stats.binomtest(held, len(stated)).proportion_ci() if stated else None
    verdicts = [modulus["verdict"] for modulus in moduli]
    out = [modulus for modulus in stated if _half_widths(modulus) > OUT]

    def over(name: str, of: str) -> float | None:
        """Median of the ratio of two entries, of the moduli that have both."""
        return median([modulus[name] / modulus[of] for modulus in moduli if of in modulus])

    return {
        "bodies": len(results),
        "draws": len(draws),
        "not_converged": sum(not draw["converged"] for draw in draws),
        "moduli": len(moduli),
        "stated": len(stated),
        "held": held,
        "given_model": sum(given),
        "holds": held / len(stated) if stated else None,
        "holds_interval": [float(bounds.low), float(bounds.high)] if bounds else None,
        "holds_given_model": mean(given),
        "holds_without_layers": mean([holds(modulus["own"]) for modulus in moduli]),
        "holds_all": mean([holds(modulus["interval"]) for modulus in moduli]),
        "verdicts": {name: verdicts.count(name) for name in sorted(set(verdicts))},
        "out": len(out),
        "out_identified": sum(modulus["verdict"] == "identified" for modulus in out),
        "median_error": median([abs(m["error"]) for m in moduli]),
        "mean_error_over_sd": mean([m["error"] / m["sd"] for m in moduli]),
        "sd": median([m["sd"] for m in moduli]),
        "sd_over_spread": median(_over_spread(results)),
        "true_noise_over_limit": over("sd_true_noise", "limit"),
        "sd_over_limit": over("sd", "limit"),
        "sd_over_widest": over("sd", "limit_widest"),
        "width_over_limit": median([_width(m) / m["limit_layers"] for m in moduli if "limit_layers" in m]),
        "draw_seconds": mean([result["draw_seconds"] for result in results]),
        "body_seconds": mean([result["body_seconds"] for result in results]),
    }


def _half_widths(modulus: Result) -> float:
    """Distance of the truth from the estimate in half-widths of its interval."""
    low, high = modulus["interval"]
    return 0.0 if low is None or high is None else float(abs(modulus["error"]) / (0.5 * (high - low)))


def _width(modulus: Result) -> float:
    """Width of the interval in standard deviations' worth; infinite where an end is open."""
    low, high = modulus["interval"]
    return np.inf if low is None or high is None else float((high - low) / (2.0 * NORMAL_95))


def _over_spread(results: Sequence[Result]) -> list[float]:
    """By body and tissue, the median standard deviation over the spread of the draws' estimates."""
    found = []
    for result in results:
        every = [draw["moduli"] for draw in result["draws"] if draw["moduli"]]
        for of_tissue in zip(*every, strict=True) if len(every) > 1 else ():
            spread = np.std([modulus["error"] for modulus in of_tissue], ddof=1)
            found.append(float(np.median([modulus["sd"] for modulus in of_tissue]) / spread))
    return found


COLUMNS = {
    "bodies, moduli": lambda row: f"{row['bodies']}, {row['moduli']}",
    "stated": lambda row: str(row["stated"]),
    "of these hold": lambda row: (
        f"{row['holds']:.0%} ({row['holds_interval'][0]:.0%} to {row['holds_interval'][1]:.0%})"
    ),
    "given the model": lambda row: f"{row['holds_given_model']:.0%}",
    "of all moduli, without layers": lambda row: f"{row['holds_all']:.0%}, {row['holds_without_layers']:.0%}",
    "verdicts": lambda row: ", ".join(f"{n} {verdict}" for verdict, n in row["verdicts"].items()),
    "out (identified)": lambda row: f"{row['out']} ({row['out_identified']})",
    "error": lambda row: f"{row['median_error']:.2f}",
    "sd over spread": lambda row: f"{row['sd_over_spread']:.2f}",
    "over limit": lambda row: f"{row['sd_over_limit']:.2f}",
    "width over limit": lambda row: f"{row['width_over_limit']:.2f}",
    "seconds": lambda row: f"{row['body_seconds']:.0f}, {row['draw_seconds']:.0f}",
}

if __name__ == "__main__":
    raise SystemExit(main())
