"""Whether intervals hold: random pelves, noise on exact surfaces of another mesh, the same outer loop and intervals.

    python benchmarks/coverage.py [--settings gauss-0.3-6,...] [--pelves N] [--draws N] [--laws linear,neo-hookean]
                                  [--first-seed S] [--edge MM] [--output FILE] [--plot FILE.svg] [--json]

For each pelvis one whole estimate from the clean surfaces of a finer mesh. Then each draw moves both images' surfaces
along their normals by a random field of its own, and the product's outer loop goes from the clean estimate, on its
approximation of the model, which is updated where the draw leads, to its end: what is spared are starts, factorisation
and first derivatives. Whole estimates of the same draws differ by 0.05 standard deviations at the most (13 of them
looked at). Intervals are the product's; surfaces have no voxels, whose place is no part of them. A line of JSON a
pelvis and setting, as soon as it is done; another run with the same file adds to it. Truths are known: simulated data.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from accuracy import true_ratios
from accuracy_rows import ROWS, posed
from cramer_rao import cramer_rao
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from palpate.errors import EstimationError
from palpate.inversion import (
    InversionSettings,
    LaterState,
    OuterIterate,
    StopRule,
    invert,
    reweighted,
    run_outer_loop,
)
from palpate.mesh import vertex_normals
from palpate.observation import NoiseModel, SurfaceDistance, observed_surface, surface_distance
from palpate.phantoms import Scene, smooth_field, target_of_truth
from palpate.uncertainty import fixed_correspondence, mesh_covariance, modulus_interval, sandwich_covariance

Array = NDArray[np.float64]
Shift = Callable[[Array, Array, np.random.Generator, bool], Array]  # of places and normals, in the later image or not

LEVELS = (0.50, 0.68, 0.80, 0.90, 0.95, 0.99)
FAR = 3.0  # half-widths
SLICE_MM = 2.5
FEATURES = 400  # waves of a random field, which are drawn anew for each


@dataclass(frozen=True)
class Setting:
    """A kind of segmentation error: how far (n,) mm surfaces at places (n, 3) move along their normals (n, 3)."""

    name: str
    shift: Shift
    noise: NoiseModel | None = None  # of a residual, where it is normal


def gauss(sd_mm: float, correlation_mm: float) -> Setting:
    """Both images' surfaces moved by fields of their own."""

    def shift(places: Array, normals: Array, rng: np.random.Generator, later: bool) -> Array:
        del later
        field = smooth_field(rng, sd_mm=sd_mm, correlation_mm=correlation_mm, features=FEATURES)
        return np.asarray(np.einsum("ni,ni->n", field.at(places), normals))

    noise = NoiseModel(np.array([2.0 * sd_mm**2]), np.array([correlation_mm]))
    return Setting(f"gauss-{sd_mm}-{correlation_mm:g}", shift, noise)


def _one_sided(places: Array, normals: Array, rng: np.random.Generator, later: bool) -> Array:
    """Over-segmentation: outwards only, by 0.3 mm times the absolute value of a normal field."""
    del later
    field = smooth_field(rng, sd_mm=0.3, correlation_mm=6.0, features=FEATURES)
    return np.asarray(np.abs(np.einsum("ni,ni->n", field.at(places), normals)))


def _missing_slice(places: Array, normals: Array, rng: np.random.Generator, later: bool) -> Array:
    """The later image's uppermost slice of 2.5 mm is missing, beside a normal field of 0.2 mm."""
    moved = gauss(0.2, 6.0).shift(places, normals, rng, later)
    if not later:
        return moved
    top = places[:, 2].max() - SLICE_MM
    return np.asarray(moved - np.maximum(places[:, 2] - top, 0.0) * np.maximum(normals[:, 2], 0.0))


def _shrunk(places: Array, normals: Array, rng: np.random.Generator, later: bool) -> Array:
    """Every organ of the later image is smaller by 0.2 mm all around, beside a normal field of 0.2 mm."""
    return np.asarray(gauss(0.2, 6.0).shift(places, normals, rng, later) - (0.2 if later else 0.0))


SETTINGS = {
    setting.name: setting
    for setting in (
        *(gauss(sd, 6.0) for sd in (0.1, 0.2, 0.3, 0.5)),
        gauss(0.3, 3.0),
        gauss(0.3, 12.0),
        Setting("one-sided", _one_sided),
        Setting("missing-slice", _missing_slice),
        Setting("shrunk", _shrunk),
    )
}


@dataclass(frozen=True)
class Body:
    """A pelvis, the estimate from its clean surfaces, the truth (n,): ln of the true ratios."""

    scene: Scene
    clean: OuterIterate
    settings: InversionSettings
    truth: Array


def main() -> int:
    """Run what was asked for and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--settings", default=",".join(SETTINGS))
    parser.add_argument("--laws", default="linear", help="with commas")
    parser.add_argument("--pelves", type=int, default=10)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=501)
    parser.add_argument("--edge", type=float, default=8.0, help="edge length (mm) of the estimate's mesh")
    parser.add_argument("--output", type=Path, default=Path("coverage.jsonl"))
    parser.add_argument("--plot", type=Path, help="SVG of the share of intervals that hold, by what they state")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    asked = parser.parse_args()
    rows = [json.loads(line) for line in asked.output.read_text().splitlines()] if asked.output.exists() else []
    done = {(row["law"], row["seed"], row["setting"]) for row in rows}
    for law in asked.laws.split(","):
        for seed in range(asked.first_seed, asked.first_seed + asked.pelves):
            open_ = [name for name in asked.settings.split(",") if (law, seed, name) not in done]
            if not open_:
                continue
            body = _body(law, seed, asked.edge)
            for name in open_:
                found = [_drawn(body, SETTINGS[name], seed, draw) for draw in range(asked.draws)]
                limit = _limit(body, SETTINGS[name].noise)
                rows.append({"law": law, "seed": seed, "setting": name, "limit": limit, "draws": found})
                with asked.output.open("a") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
                print(f"{law} {seed} {name}: {_line(rows[-1:])}", file=sys.stderr, flush=True)
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {(row["law"], row["setting"]): [] for row in rows}
    for row in rows:
        groups[row["law"], row["setting"]].append(row)
    if asked.plot:
        _plot(groups, asked.plot)
    table = {f"{law} {name}": _summary(of) for (law, name), of in groups.items()}
    print(json.dumps(table, indent=1) if asked.json else "\n".join(f"{name}: {_line(of)}" for name, of in _by(groups)))
    return 0


def _by(groups: dict[tuple[str, str], list[dict[str, Any]]]) -> list[tuple[str, list[dict[str, Any]]]]:
    return [(f"{law:12} {name:14}", rows) for (law, name), rows in groups.items()]


def _body(law: str, seed: int, edge_mm: float) -> Body:
    row = replace(ROWS["other-mesh"], law=law, edge_mm=edge_mm, truth_edge_mm=0.68 * edge_mm)
    case = posed(row, seed, 0, {})
    problem = case.problem.linear() if law == "linear" else case.problem
    found = invert(problem, case.settings, progress=lambda _: None)
    clean, truth = found.candidates[found.best].iterate, np.log(true_ratios(found.objective, case.scene))
    return Body(case.scene, clean, case.settings, truth)


def _limit(body: Body, noise: NoiseModel | None) -> list[float] | None:
    """The Cramer-Rao limit of the standard deviations under normal noise, by the derivatives at the clean estimate."""
    if noise is None:
        return None
    limit = cramer_rao(body.clean.minimum.evaluation, noise, len(body.truth), cell_mm=float(noise.lengths[0]))
    return [float(sd) for sd in np.sqrt(np.diag(limit))]


def _drawn(body: Body, setting: Setting, seed: int, draw: int) -> dict[str, Any]:
    """What one draw leads to; an estimate that fails says so, and counts as not converged."""
    rng = np.random.default_rng([seed, draw, *setting.name.encode()])
    (state,), unknowns = body.clean.objective.states, body.clean.minimum.unknowns
    objective = body.clean.objective.with_observations(_observations(body.scene, state, setting, rng))
    try:
        objective = objective.rematched(unknowns)
        first = replace(body.clean.minimum, evaluation=objective(unknowns))
        objective = reweighted(objective, first)
        start = OuterIterate(objective, replace(first, evaluation=objective(unknowns)))
        found = run_outer_loop(start, body.settings, StopRule(), progress=lambda _: None, title="")
    except EstimationError as error:
        return {"converged": False, "failure": str(error), "organs": []}
    return {"converged": found.minimum.converged, "organs": _organs(found, body)}


def _observations(scene: Scene, state: LaterState, setting: Setting, rng: np.random.Generator) -> list[SurfaceDistance]:
    """Those of a later state, with the surfaces of both images moved; one field an image, across all organs."""
    surfaces = [o.target.surface for o in state.observations if isinstance(o, SurfaceDistance)]
    truths = [observed_surface(scene.space, surface.tissue) for surface in surfaces]
    ends, drawn = np.cumsum([len(truth.rest) for truth in truths])[:-1], []
    for later in (False, True):
        places = [truth.rest + (scene.displacement[truth.points] if later else 0.0) for truth in truths]
        normals = [vertex_normals(p, truth.triangles) for p, truth in zip(places, truths, strict=True)]
        errors = setting.shift(np.concatenate(places), np.concatenate(normals), rng, later)
        drawn.append(np.split(errors[:, None] * np.concatenate(normals), ends))
    return [
        surface_distance(
            target_of_truth(scene.space, scene.displacement, surface, warps=(before.__add__, after.__add__))
        )
        for surface, before, after in zip(surfaces, *drawn, strict=True)
    ]


def _organs(found: OuterIterate, body: Body) -> list[dict[str, Any]]:
    """Errors of ln E, standard deviations, interval ends and the root deviance at the truth, by organ."""
    objective, minimum = found.objective, found.minimum
    covariance = sandwich_covariance(objective, minimum.evaluation) + mesh_covariance(objective)
    fixed = fixed_correspondence(objective, minimum.unknowns, minimum.evaluation)
    organs = []
    for i, truth in enumerate(body.truth):
        variance = float(covariance[i, i])
        interval = modulus_interval(fixed, minimum, i, variance=variance, bounds=body.settings.bounds)
        low, high = (None if end is None else float(np.log(end) - truth) for end in interval.ends)
        organs.append(
            {
                "error": float(minimum.unknowns[i] - truth),
                "sd": float(np.sqrt(variance)),
                "low": low,
                "high": high,
                "kind": interval.kind,
                "root": _root(interval.profile.theta, interval.profile.root, float(truth)),
            }
        )
    return organs


def _root(theta: Array, root: Array, truth: float) -> float:
    """Signed root deviance at the truth, between the points of a profile and on their chords beyond them."""
    if theta[0] <= truth <= theta[-1] or len(theta) < 2:
        return float(np.interp(truth, theta, root))
    (a, b), (c, d) = (theta[:2], root[:2]) if truth < theta[0] else (theta[-2:], root[-2:])
    return float(c + (truth - a) * (d - c) / (b - a))


def _summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Coverage of the 95 % intervals, calibration, and widths beside the spread of the estimates."""
    organs = [organ for row in rows for draw in row["draws"] if draw["converged"] for organ in draw["organs"]]
    lows = np.array([-np.inf if o["low"] is None else o["low"] for o in organs])
    highs = np.array([np.inf if o["high"] is None else o["high"] for o in organs])
    held, roots = (lows <= 0.0) & (highs >= 0.0), np.abs([o["root"] for o in organs])
    bodies = [[draw for draw in row["draws"] if draw["converged"]] for row in rows]
    spread = [
        np.std([draw["organs"][i]["error"] for draw in draws], ddof=1)
        / np.median([draw["organs"][i]["sd"] for draw in draws])
        for draws in bodies
        for i in range(len(draws[0]["organs"]))
    ]
    widths = [
        np.median([_width(draw["organs"][i]) for draw in draws])
        / np.std([draw["organs"][i]["error"] for draw in draws], ddof=1)
        for draws in bodies
        for i in range(len(draws[0]["organs"]))
    ]
    interval = stats.binomtest(int(held.sum()), len(held)).proportion_ci()
    half = np.array([1.96 * o["sd"] for o in organs])
    over_limit = [
        organ["sd"] / limit
        for row in rows
        for draw in row["draws"]
        for organ, limit in zip(draw["organs"], row["limit"] or [], strict=False)
    ]
    return {
        "intervals": len(organs),
        "not_converged": sum(not draw["converged"] for row in rows for draw in row["draws"]),
        "coverage95": float(held.mean()),
        "coverage95_interval": [float(interval.low), float(interval.high)],
        "calibration": {str(level): float(np.mean(roots <= stats.norm.ppf(0.5 + level / 2))) for level in LEVELS},
        "sd_over_spread": float(1.0 / np.median(spread)),
        "width_over_spread": width if np.isfinite(width := float(np.median(widths))) else None,
        "sd_over_cramer_rao": float(np.median(over_limit)) if over_limit else None,
        "mean_error_over_sd": float(np.mean([o["error"] / o["sd"] for o in organs])),
        "beyond_three_half_widths": int(np.sum(np.abs([o["error"] for o in organs]) > FAR * half)),
        "profile_share": float(np.mean([o["kind"] == "profile" for o in organs])),
        "median_error_percent": float(100.0 * np.median(np.abs(np.expm1([o["error"] for o in organs])))),
    }


def _width(organ: Mapping[str, Any]) -> float:
    """Width of a 95 % interval of ln E, in standard deviations' worth: over 2 x 1.96; infinite where an end is open."""
    return np.inf if organ["low"] is None or organ["high"] is None else (organ["high"] - organ["low"]) / 3.92


def _plot(groups: Mapping[tuple[str, str], Sequence[dict[str, Any]]], path: Path) -> None:
    """Calibration: nominal against found, a line a setting, beside the scatter of as many intervals that hold."""
    figure = Figure(figsize=(8.0, 5.5), layout="constrained")
    axes = figure.add_subplot()
    levels = np.linspace(LEVELS[0], LEVELS[-1], 60)
    n = min(sum(len(draw["organs"]) for row in rows for draw in row["draws"]) for rows in groups.values())
    low, high = (stats.binom.ppf(q, n, levels) / n for q in (0.025, 0.975))
    axes.fill_between(100 * levels, 100 * low, 100 * high, color="0.9", label=f"95 % of {n} true intervals")
    axes.plot(100 * levels, 100 * levels, color="0.5", linewidth=1)
    for (law, name), rows in groups.items():
        found = list(_summary(rows)["calibration"].values())
        style = "-" if law == "linear" else "--"
        axes.plot(
            100 * np.array(LEVELS), 100 * np.array(found), style, marker="o", markersize=3, label=f"{law}, {name}"
        )
    axes.set(xlabel="stated, %", ylabel="found, %")
    figure.legend(fontsize="small", loc="outside right upper")
    figure.savefig(path, metadata={"Date": None})


def _line(rows: Sequence[dict[str, Any]]) -> str:
    of = _summary(rows)
    low, high = of["coverage95_interval"]
    calibration = " ".join(f"{float(level):.0%}:{found:.0%}" for level, found in of["calibration"].items())
    limit = "" if of["sd_over_cramer_rao"] is None else f"; sd / limit {of['sd_over_cramer_rao']:.2f}"
    width = "open" if of["width_over_spread"] is None else f"{of['width_over_spread']:.2f}"
    return (
        f"{of['coverage95']:.1%} [{low:.1%}, {high:.1%}] of {of['intervals']} held; {calibration}; sd / spread"
        f" {of['sd_over_spread']:.2f}, width / spread {width}{limit}; beyond 3 half-widths"
        f" {of['beyond_three_half_widths']}; profiles {of['profile_share']:.0%}; median error"
        f" {of['median_error_percent']:.1f} %; not converged {of['not_converged']}"
    )


if __name__ == "__main__":
    raise SystemExit(main())
