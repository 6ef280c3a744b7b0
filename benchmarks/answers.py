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
from collections.abc import Sequence
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
from palpate.inversion.minima import continued, driven, posterior_sd
from palpate.inversion.noise import NoiseLaw
from palpate.inversion.objective import LocalModel, Objective
from palpate.inversion.problem import InverseProblem, InversionSettings
from palpate.inversion.wall_refinement import REFINEMENTS, refined_walls
from palpate.inversion.weighting import first_law, objective_of
from palpate.mechanics.equilibrium import from_linear, from_start
from palpate.mechanics.finite_strain import FiniteStrainModel
from palpate.mechanics.first_order import expanded
from palpate.mechanics.forward import Equilibrium
from palpate.mechanics.linear_model import LinearModel, with_constraint
from palpate.mesh.constraint import Constraint

ROUNDS = 40
REACH = 0.8  # of ln E, within which an expansion is used
UNCHANGED = AGREED  # of ln E by a whole round
MIXED = 4  # rounds before the last one

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plain:
    """A plain estimate: where it ended, under which weights and on which equilibria, after so many rounds."""

    minimum: Minimum
    objective: Objective
    law: NoiseLaw
    equilibria: tuple[Equilibrium, ...] = ()
    rounds: int = 0


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
    full = _Linear(problem.models, tuple(model.constraint for model in problem.models))
    still = [np.zeros(model.n_modes) for model in problem.models]
    moduli = problem.modulus_map.moduli(theta)
    law = settings.law or first_law(problem)
    objective = objective_of(problem, _expanded(full, full.solve(moduli, still, ()), moduli, still), law)
    rest = np.concatenate([theta, *still])
    filled = driven(objective.with_fresh_correspondence(rest), theta, bounds=settings.bounds)
    objective = replace(objective, prior=learned_prior(problem, filled.evaluation, filled.unknowns))
    found = Plain(filled, objective.with_fresh_correspondence(filled.unknowns), law)
    found = _followed(problem, full, found, settings, weigh=False)
    if not problem.finite_strain:
        return _with_walls(problem, full, found, settings)
    found = replace(_followed(problem, full, found, settings), equilibria=())
    return _with_walls(problem, _FiniteStrain(problem.models, full.constraints, problem.finite_strain), found, settings)


def _with_walls(problem: InverseProblem, full: Full, start: Plain, settings: InversionSettings) -> Plain:
    """Followed to its end, and again with finer motions of the drivers' walls where these are asked for."""
    found = _followed(problem, full, start, settings)
    for _ in range(REFINEMENTS):
        finer = refined_walls(problem, full.constraints, found.minimum.evaluation.surfaces, found.law)
        if all(a is b for a, b in zip(full.constraints, finer, strict=True)):
            break
        full = replace(full, constraints=finer)
        found = _followed(problem, full, found, settings)
    return found


def _followed(
    problem: InverseProblem, full: Full, start: Plain, settings: InversionSettings, *, weigh: bool = True
) -> Plain:
    """Rounds until the log-moduli do not change: the full model where the last one led, the estimate on that.

    Not `weigh`: under the weights of the start, until they change by no more than a per cent. Where moduli are known to
    half their size only, rounds overshoot; they are mixed then.
    """
    found, places, ends, n = start, list[Array](), list[Array](), start.objective.n_parameters
    unknowns, change = start.minimum.unknowns, 1.0
    for number in range(1, ROUNDS + 1):
        theta, objective = unknowns[:n], found.objective
        moduli, amounts = objective.modulus_map.moduli(theta), objective.coefficients(unknowns)
        there = full.solve(moduli, amounts, found.equilibria)
        objective = objective.under(_expanded(full, there, moduli, amounts))
        minimum = replace(found.minimum, unknowns=unknowns, evaluation=objective(unknowns))
        lower = np.maximum(settings.bounds.lower, theta - REACH)
        near = replace(settings, bounds=Bounds(lower, np.minimum(settings.bounds.upper, theta + REACH)))
        law = found.law
        if weigh:
            end = agreed(problem, objective, minimum, near, within=max(0.3 * UNCHANGED, 0.1 * change))
            law, objective, minimum = end.law, end.objective, end.minimum
        else:
            minimum = continued(objective.with_fresh_correspondence(unknowns), minimum, near)
        change = min(float(np.abs(minimum.unknowns - unknowns)[:n].max()), 1.0)
        found = Plain(minimum, objective, law, there, start.rounds + number)
        print(f"  round {number}: {np.exp(minimum.unknowns[:n])}, changed by {change:.1e}", file=sys.stderr, flush=True)
        if change < (UNCHANGED if weigh else 1e-2):
            break
        places, ends = [*places[-MIXED:], unknowns], [*ends[-MIXED:], minimum.unknowns]
        unknowns = _mixed(np.array(places), np.array(ends), minimum.evaluation.matrix, n)
    return found


def _mixed(places: Array, ends: Array, metric: Array, n_parameters: int) -> Array:
    """Where the next round begins after rounds from `places` (k, n) to `ends` (k, n).

    The affine combination of the ends whose step, combined likewise, is the smallest in the objective's `metric` (n, n)
    (Anderson 1965, J. ACM 12, 547-560); the last end where the log-moduli would go further than 1/4 from it.
    """
    steps = ends - places
    by_step, by_end = np.diff(steps, axis=0), np.diff(ends, axis=0)
    share = np.linalg.pinv(by_step @ metric @ by_step.T, hermitian=True) @ (by_step @ metric @ steps[-1])
    back = share @ by_end
    return ends[-1] - back if np.abs(back[:n_parameters]).max(initial=0.0) < 0.25 else ends[-1]


def _expanded(full: Full, there: Sequence[Equilibrium], moduli: Array, amounts: list[Array]) -> tuple[LocalModel, ...]:
    """All states' models to first order around their equilibria."""
    triples = zip(there, full.models, amounts, strict=True)
    return tuple(expanded(e, names=model.names, moduli=moduli, coefficients=q) for e, model, q in triples)


class Full(Protocol):
    """Full models of all states under their constraints."""

    models: tuple[LinearModel, ...]
    constraints: tuple[Constraint, ...]

    def solve(self, moduli: Array, amounts: list[Array], before: tuple[Equilibrium, ...]) -> tuple[Equilibrium, ...]:
        """Equilibria at moduli (n_regions,) kPa and each state's coefficients (n_modes,), which have derivatives.

        before: those that it may begin at; none: at rest.
        """
        ...


@dataclass(frozen=True)
class _Linear:
    models: tuple[LinearModel, ...]
    constraints: tuple[Constraint, ...]

    def solve(self, moduli: Array, amounts: list[Array], before: tuple[Equilibrium, ...]) -> tuple[Equilibrium, ...]:
        del before
        three = zip(self.models, self.constraints, amounts, strict=True)
        return tuple(with_constraint(model, c).solve(moduli, q) for model, c, q in three)


@dataclass(frozen=True)
class _FiniteStrain:
    models: tuple[LinearModel, ...]
    constraints: tuple[Constraint, ...]
    finite: tuple[FiniteStrainModel, ...]

    def solve(self, moduli: Array, amounts: list[Array], before: tuple[Equilibrium, ...]) -> tuple[Equilibrium, ...]:
        models = [model.under(c) for model, c in zip(self.finite, self.constraints, strict=True)]
        if before:
            triples = zip(models, before, amounts, strict=True)
            there = [from_start(m, moduli, q, start=b.displacement, nearby=b.factorisation) for m, b, q in triples]
        else:
            linear = [with_constraint(m, c).system(moduli) for m, c in zip(self.models, self.constraints, strict=True)]
            there = [from_linear(m, system, q) for m, system, q in zip(models, linear, amounts, strict=True)]
        return tuple(equilibrium.refactorised() for equilibrium in there)


HEAD = ("| row | seed | tissue | error, % | plainly | difference, % | sd, % |", "|---|---|---|---|---|---|---|")


def _line(case: dict) -> str:
    columns = ("tissues", "ln_error", "plain_ln_error", "difference_percent", "sd")
    return "\n".join(
        f"| `{case['row']}` | {case['seed']} | {name} | {100 * a:+.3f} | {100 * b:+.3f} | {d:+.3f} | {100 * sd:.2f} |"
        for name, a, b, d, sd in zip(*(case[column] for column in columns), strict=True)
    )


if __name__ == "__main__":
    raise SystemExit(main())
