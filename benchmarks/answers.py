"""Whether what is spared changes what is found: rows of accuracy.py estimated with and without all that saves time.

    python benchmarks/answers.py [--rows clean,noise,...] [--cases N] [--first-seed S] [--output FILE] [--json]

For each case two estimates from the same images. One is the product's. The plain one knows no reduced model, no frozen
factor and no derivative that is not exact: it starts at the middle start alone and repeats, until nothing changes, a
solution of the full model, a factorisation there, the derivatives by all moduli and modes, and the weights and the
estimate that agree on them. At finite strain it goes on from its own linear estimate. Simulated data.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import accuracy
import numpy as np
from numpy.typing import NDArray

from palpate.inversion.agreement import AGREED, agreed
from palpate.inversion.driver_prior import learned_prior
from palpate.inversion.gauss_newton import Bounds, Minimum
from palpate.inversion.invert import invert
from palpate.inversion.minima import change_between, continued, driven, posterior_sd
from palpate.inversion.noise import NoiseLaw
from palpate.inversion.objective import Objective
from palpate.inversion.problem import InverseProblem, InversionSettings
from palpate.inversion.wall_refinement import REFINEMENTS, refined_walls
from palpate.inversion.weighting import first_law, objective_of
from palpate.mechanics.equilibrium import from_linear, from_start
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium, FiniteStrainModel
from palpate.mechanics.first_order import expanded
from palpate.mechanics.forward import Equilibrium
from palpate.mechanics.linear_model import LinearModel, with_constraint
from palpate.mesh.constraint import Constraint

ROUNDS = 40
REACH = 0.8  # of ln E, within which an expansion is used
UNCHANGED = AGREED  # of ln E by a whole round


@dataclass(frozen=True)
class Plain:
    """A plain estimate: where it ended, under which weights, after so many rounds."""

    minimum: Minimum
    objective: Objective
    law: NoiseLaw
    rounds: int


def main() -> int:
    """Run the rows that were asked for and print by how much the two estimates differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", default=",".join(accuracy.ROWS))
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
        truths: accuracy.Truths = {}
        for name in arguments.rows.split(","):
            row = accuracy.ROWS[name]
            if arguments.edge:
                row = replace(row, edge_mm=arguments.edge)
            found.append({"row": name, "seed": seed, **_both(accuracy.posed(row, seed, 0, truths))})
            with arguments.output.open("a") as file:
                file.write(json.dumps(found[-1]) + "\n")
            print(_line(found[-1]), file=sys.stderr, flush=True)
    print(json.dumps({"answers": found}, indent=1) if arguments.json else "\n".join([*HEAD, *map(_line, found)]))
    return 0


def _both(case: accuracy.Posed) -> dict[str, object]:
    """The product's estimate and the plain one of the same inverse problem."""
    began = time.perf_counter()
    product = invert(case.problem, case.settings, progress=_silent)
    ended = time.perf_counter()
    plain = plain_estimate(case.problem, case.settings)
    n, mapping = product.objective.n_parameters, product.objective.modulus_map
    theta, other = product.minimum.unknowns[:n], plain.minimum.unknowns[:n]
    scale = case.scene.moduli_kpa[mapping.relative_to]
    truth = np.log([case.scene.moduli_kpa[name] / scale for name in mapping.tissues])
    return {
        "dofs": 3 * len(case.space.points),
        "tissues": list(mapping.tissues),
        "ln_error": (theta - truth).tolist(),
        "plain_ln_error": (other - truth).tolist(),
        "difference_percent": (100.0 * np.expm1(theta - other)).tolist(),
        "sd": posterior_sd(plain.minimum, n).tolist(),
        "law_sd_mm": [product.law.sd, plain.law.sd],
        "outcomes": [product.minimum.outcome.name, plain.minimum.outcome.name],
        "rounds": plain.rounds,
        "seconds": [ended - began, time.perf_counter() - ended],
    }


def _silent(message: str) -> None:
    del message


def plain_estimate(problem: InverseProblem, settings: InversionSettings) -> Plain:
    """The estimate from the middle start, the full model solved with all its derivatives at every place."""
    theta = np.asarray(np.median(np.stack(settings.starts), axis=0))
    moduli, still = problem.modulus_map.moduli(theta), [np.zeros(model.n_modes) for model in problem.models]
    full = _Linear(problem.models)
    pairs = zip(full.solve(moduli, still), full.names, still, strict=True)
    models = tuple(expanded(e, names=names, moduli=moduli, coefficients=q) for e, names, q in pairs)
    objective = objective_of(problem, models, settings.law or first_law(problem))
    rest = np.concatenate([theta, *still])
    filled = driven(objective.with_fresh_correspondence(rest), theta, bounds=settings.bounds)
    objective = replace(objective, prior=learned_prior(problem, filled.evaluation, filled.unknowns))
    found = Plain(filled, objective.with_fresh_correspondence(filled.unknowns), settings.law or first_law(problem), 0)
    found = _followed(problem, _Linear(problem.models), found, settings, weigh=False)
    if not problem.finite_strain:
        return _with_walls(problem, _Linear(problem.models), found, settings)
    found = _followed(problem, _Linear(problem.models), found, settings)
    return _with_walls(problem, _Equilibria(problem.finite_strain, problem.models), found, settings)


def _with_walls(problem: InverseProblem, full: Full, start: Plain, settings: InversionSettings) -> Plain:
    """Followed to its end, and again with finer motions of the drivers' walls where these are asked for."""
    found = _followed(problem, full, start, settings)
    for _ in range(REFINEMENTS):
        finer = refined_walls(problem, full.constraints, found.minimum.evaluation.surfaces, found.law)
        if all(a is b for a, b in zip(full.constraints, finer, strict=True)):
            break
        full.constraints = finer
        found = _followed(problem, full, found, settings)
    return found


def _followed(
    problem: InverseProblem, full: Full, start: Plain, settings: InversionSettings, *, weigh: bool = True
) -> Plain:
    """Rounds until the log-moduli do not change: the full model where the last one led, the estimate on that.

    Not `weigh`: under the weights of the start, until they change by no more than a per cent.
    """
    objective, minimum, change = start.objective, start.minimum, 1.0
    n = objective.n_parameters
    for number in range(1, ROUNDS + 1):
        theta = minimum.unknowns[:n]
        moduli, amounts = objective.modulus_map.moduli(theta), objective.coefficients(minimum.unknowns)
        there = full.solve(moduli, amounts)
        pairs = zip(there, full.names, amounts, strict=True)
        objective = objective.under([expanded(e, names=names, moduli=moduli, coefficients=q) for e, names, q in pairs])
        minimum = replace(minimum, evaluation=objective(minimum.unknowns))
        lower, upper = (
            np.maximum(settings.bounds.lower, theta - REACH),
            np.minimum(settings.bounds.upper, theta + REACH),
        )
        near = replace(settings, bounds=Bounds(lower, upper))
        law, before = start.law, minimum
        if weigh:
            end = agreed(problem, objective, minimum, near, within=max(0.3 * UNCHANGED, 0.1 * change))
            law, objective, minimum = end.law, end.objective, end.minimum
        else:
            minimum = continued(objective.with_fresh_correspondence(minimum.unknowns), minimum, near)
        change = min(float(change_between(before, minimum, n).max()), 1.0)
        print(f"  round {number}: {np.exp(minimum.unknowns[:n])}, changed by {change:.1e}", file=sys.stderr, flush=True)
        if change < (UNCHANGED if weigh else 1e-2):
            break
    return Plain(minimum, objective, law, start.rounds + number)


class Full(Protocol):
    """Full models of all states, solved where they are asked to; `constraints` may be exchanged for others."""

    constraints: tuple[Constraint, ...]
    names: tuple[tuple[str, ...], ...]

    def solve(self, moduli: NDArray[np.float64], amounts: list[NDArray[np.float64]]) -> list[Equilibrium]:
        """Equilibria at moduli (n_regions,) kPa and each state's coefficients (n_modes,), which have derivatives."""
        ...


class _Linear:
    def __init__(self, models: tuple[LinearModel, ...]) -> None:
        self._models, self.names = models, tuple(model.names for model in models)
        self.constraints = tuple(model.constraint for model in models)

    def solve(self, moduli: NDArray[np.float64], amounts: list[NDArray[np.float64]]) -> list[Equilibrium]:
        three = zip(self._models, self.constraints, amounts, strict=True)
        return [with_constraint(model, c).solve(moduli, q) for model, c, q in three]


class _Equilibria:
    """Each equilibrium is sought from the one before, the first from the linear law's."""

    def __init__(self, models: tuple[FiniteStrainModel, ...], linear: tuple[LinearModel, ...]) -> None:
        self._models, self._linear, self.names = models, linear, tuple(model.names for model in models)
        self.constraints = tuple(model.constraint for model in models)
        self._before: list[FiniteStrainEquilibrium] = []

    def solve(self, moduli: NDArray[np.float64], amounts: list[NDArray[np.float64]]) -> list[Equilibrium]:
        models = [model.under(c) for model, c in zip(self._models, self.constraints, strict=True)]
        if self._before:
            three = zip(models, self._before, amounts, strict=True)
            there = [from_start(m, moduli, q, start=b.displacement, nearby=b.factorisation) for m, b, q in three]
        else:
            three = zip(models, self._linear, amounts, strict=True)
            there = [from_linear(m, linear.system(moduli), q) for m, linear, q in three]
        self._before = [equilibrium.refactorised() for equilibrium in there]
        return list(self._before)


HEAD = ("| row | seed | tissue | error, % | plainly | difference, % | sd, % |", "|---|---|---|---|---|---|---|")


def _line(case: dict) -> str:
    columns = ("tissues", "ln_error", "plain_ln_error", "difference_percent", "sd")
    return "\n".join(
        f"| `{case['row']}` | {case['seed']} | {name} | {100 * a:+.3f} | {100 * b:+.3f} | {d:+.3f} | {100 * sd:.2f} |"
        for name, a, b, d, sd in zip(*(case[column] for column in columns), strict=True)
    )


if __name__ == "__main__":
    raise SystemExit(main())
