"""Whether shortcuts change the estimate: rows of accuracy.py estimated with and without all that saves time.

    python benchmarks/answers.py [--rows clean,noise,...] [--cases N] [--first-seed S] [--output FILE] [--json]

Each case is estimated twice from the same images, by the same outer loop. One estimate is Palpate's. The plain one has
no reduced model, no reused factor, no approximate derivative and no further starts: the full model is solved,
factorised and differentiated by all moduli and modes at every place. Its stop rule is a fifth of Palpate's. At finite
strain it continues from its own linear estimate. Simulated data.

Two answers agree where they differ by at most 0.1 %, or 0.05 posterior standard deviations where that is more. Else the
exit code is 1, and the plain loop begins again at Palpate's answer. It stays there where the shortcuts are not the
cause.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from accuracy import Array, Result, true_ratios
from accuracy_rows import ROWS, Posed, Truths, posed

from palpate.approximation import LinearisationPoint, exact_approximation
from palpate.inversion import (
    InverseProblem,
    Inversion,
    InversionSettings,
    Objective,
    Searched,
    StopRule,
    begun,
    fit_coefficients,
    invert,
    posterior_sd,
    searched,
    with_first_noise,
)

RULE = StopRule(step_sd=0.01, iterations=40)
SAME_PERCENT, SAME_SD = 0.1, 0.05


def main() -> int:
    """Run the rows that were asked for and print by how much the two estimates differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", default=",".join(ROWS))
    parser.add_argument("--cases", type=int, default=1, help="cases a row")
    parser.add_argument("--first-seed", type=int, default=101)
    parser.add_argument("--edge", type=float, help="edge length (mm) instead of the row's own")
    parser.add_argument(
        "--output", type=Path, default=Path("answers.jsonl"), help="a line a case, as soon as it is done"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    found = []
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.cases):
        truths: Truths = {}
        for name in arguments.rows.split(","):
            row = ROWS[name]
            if arguments.edge:
                row = replace(row, edge_mm=arguments.edge)
            found.append({"row": name, "seed": seed, **_both(posed(row, seed, 0, truths))})
            with arguments.output.open("a") as file:
                file.write(json.dumps(found[-1]) + "\n")
            _say(_line(found[-1]))
    print(json.dumps({"answers": found}, indent=1) if arguments.json else "\n".join([*HEAD, *map(_line, found)]))
    return 0 if all(all(case["same"]) for case in found) else 1


def _both(case: Posed) -> Result:
    """The product's estimate and the plain one of the same inverse problem."""
    began = time.perf_counter()
    product = invert(case.problem, case.settings, progress=lambda line: _say(f"  product: {line}"))
    ended = time.perf_counter()
    plain = plain_estimate(case.problem, case.settings, progress=lambda line: _say(f"  plain: {line}"))
    n, truth = product.objective.n_parameters, np.log(true_ratios(product.objective, case.scene))
    theta, other, sd = product.minimum.unknowns[:n], plain.minimum.unknowns[:n], posterior_sd(plain.minimum, n)
    percent = 100.0 * np.expm1(theta - other)
    same = np.abs(percent) < np.maximum(SAME_PERCENT, 100.0 * SAME_SD * sd)
    moved = None if same.all() else (_plainly_on(case, product).minimum.unknowns[:n] - theta) / sd
    return {
        "dofs": 3 * len(case.space.points),
        "tissues": list(product.objective.parameters.tissues),
        "ln_error": (theta - truth).tolist(),
        "plain_ln_error": (other - truth).tolist(),
        "difference_percent": percent.tolist(),
        "difference_sd": ((theta - other) / sd).tolist(),
        "same": same.tolist(),
        "plainly_on_sd": None if moved is None else moved.tolist(),
        "sd": sd.tolist(),
        "law_sd_mm": [
            objective.states[0].noise["surface distance"].sd for objective in (product.objective, plain.objective)
        ],
        "outcomes": [product.minimum.outcome.name, plain.minimum.outcome.name],
        "seconds": [ended - began, time.perf_counter() - ended],
    }


def plain_estimate(
    problem: InverseProblem, settings: InversionSettings, *, progress: Callable[[str], None]
) -> Searched:
    """The estimate from where the program begins, the full model solved with all its derivatives at every place."""
    still = np.concatenate([settings.centre, np.zeros(problem.parameters.n_coefficients)])
    bounds = settings.bounds
    objective = with_first_noise(_exact(Objective(problem.states, problem.parameters), still)).rematched(still)
    filled = fit_coefficients(objective, still)
    start = begun(_exact(objective, filled.unknowns), filled.unknowns)  # at rest no modulus shows
    found = searched(start, bounds, RULE, progress=progress, title="linear law")
    if not problem.finite_strain:
        return found
    unknowns = found.minimum.unknowns
    start = begun(_exact(found.objective, unknowns, finite_strain=True), unknowns)
    return searched(start, bounds, RULE, progress=progress, title="finite strain")


def _plainly_on(case: Posed, product: Inversion) -> Searched:
    """Where the plain loop leads from the product's answer."""
    unknowns = product.minimum.unknowns
    objective = _exact(product.objective, unknowns, finite_strain=case.problem.finite_strain)
    start = begun(objective, unknowns)
    bounds = case.settings.bounds
    return searched(start, bounds, RULE, progress=lambda line: _say(f"  {line}"), title="plainly on")


def _exact(objective: Objective, unknowns: Array, *, finite_strain: bool = False) -> Objective:
    """The objective on full models that are solved at unknowns (n_unknowns,), linear ones or the states' others."""
    moduli, coefficients = objective.parameters.moduli(unknowns), objective.parameters.coefficients(unknowns)
    models = [(state.model, state.finite_strain if finite_strain else None) for state in objective.states]
    return objective.with_approximations(
        [exact_approximation(*m, LinearisationPoint(moduli, q)) for m, q in zip(models, coefficients, strict=True)]
    )


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


COLUMNS = ("row", "seed", "tissue", "error, %", "plainly, %", "difference, %", "in sd", "sd, %", "same", "moves on, sd")
HEAD = (f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS))


def _line(case: Result) -> str:
    keys = ("tissues", "ln_error", "plain_ln_error", "difference_percent", "difference_sd", "sd", "same")
    on = ["-" if moved is None else f"{moved:+.3f}" for moved in case["plainly_on_sd"] or [None] * len(case["tissues"])]
    return "\n".join(
        f"| `{case['row']}` | {case['seed']} | {name} | {100 * a:+.3f} | {100 * b:+.3f} | {d:+.3f} | {of_sd:+.3f}"
        f" | {100 * sd:.2f} | {'yes' if same else 'no'} | {moved} |"
        for name, a, b, d, of_sd, sd, same, moved in zip(*(case[key] for key in keys), on, strict=True)
    )


if __name__ == "__main__":
    raise SystemExit(main())
