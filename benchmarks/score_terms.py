"""Two terms that the score of an estimate leaves out: changing material responses, and the slope of ln det H.

    python benchmarks/score_terms.py CASE.toml [CASE.toml ...] [--set KEY=VALUE ...] [--json]

For cases with one later image, under the linear law. It prints the step that each term would add to each log-modulus,
in posterior standard deviations sd:

- responses: the displacement is u(E, q) + U(E, q) c with responses U to the material modes c, and the reduced model
  holds U while E and q move. With the change dx of U c along h = H^-1 e_i and the residuals' derivatives S by the
  displacement the step is -dx^T S^T W r, which the score lacks.
- determinant: the mode of the moduli alone, the other unknowns n integrated over by Laplace's approximation, lies
  -(H^-1)_tt d(1/2 ln det H_nn)/dt from the mode of all unknowns together. Its two parts are the changes of the
  responses to the boundary modes, those of the reduced model, and to the material modes, those of the full model.

Where a truth.json with "moduli_kpa" lies beside a case, as in the scenes of mismatch.py, the errors of ln E are printed
as they are, with the steps by the material modes' responses, and with all three.

Derivatives are central differences over 0.2 of sd and of ln E.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.approximation import ReducedBasis
from palpate.inversion import Inversion, Linearisation, Minimum, Objective, invert
from palpate.study import inverse_problem, inversion_settings, make_body, read_case, read_states

STEP = 0.2
TERMS = ("responses", "determinant_boundary", "determinant_material")


def main() -> int:
    """Estimate every case and print the steps that its score leaves out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="+", type=Path, metavar="CASE.toml")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of the case; repeatable")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    found = []
    for path in arguments.cases:
        inversion, truth = estimated(path, arguments.set), path.parent / "truth.json"
        true = json.loads(truth.read_text())["moduli_kpa"] if truth.exists() else {}
        found.append({"case": path.parent.name, **measured(inversion), "ln_errors": errors(inversion, true)})
        if not arguments.json:
            words = [f"{term} {', '.join(f'{x:.2f}' for x in found[-1][term])}" for term in TERMS]
            print(f"{found[-1]['case']}: in sd, by {'; by '.join(words)}", flush=True)
    rows = summary(found)
    if arguments.json:
        print(json.dumps({"cases": found, "summary": rows}, indent=1))
    else:
        for name, row in rows.items():
            print(f"{name}: {row['number']} errors of ln E, RMS {row['rms']:.3f}, mean {row['mean']:.3f}")
    return 0


def estimated(path: Path, overrides: list[str]) -> Inversion:
    """The inversion of a case under the linear law."""
    case = read_case(path, ["mechanics.law='linear'", *overrides])
    body = make_body(read_states(case), case, progress=lambda _: None)
    problem = inverse_problem(body, case, progress=lambda _: None)
    return invert(problem, inversion_settings(case, problem.parameters), progress=lambda _: None)


def measured(inversion: Inversion) -> dict[str, Any]:
    """Steps of the log-moduli, in sd, that the score leaves out, and these sd of ln E."""
    of, n = _Estimate.of(inversion), inversion.objective.n_parameters
    covariance = of.minimum.evaluation.covariance_columns(n)
    sd = np.sqrt(np.diag(covariance[:n]))
    lacking = -np.array([of.pull_lacking(covariance[:, i] / sd[i]) for i in range(n)])
    here = of.tangent(of.minimum.unknowns)
    slopes = np.array([of.determinant_slopes(i, here) for i in range(n)])
    steps = [lacking, *(-covariance[:n] @ slopes / sd[:, None]).T]
    return {**{term: step.tolist() for term, step in zip(TERMS, steps, strict=True)}, "sd": sd.tolist()}


def errors(inversion: Inversion, truth: dict[str, float]) -> list[float | None]:
    """Ln of each estimated modulus over its truth, kPa, None without one."""
    parameters = inversion.objective.parameters
    known = dict(
        zip(inversion.objective.states[0].model.names, parameters.moduli(inversion.minimum.unknowns), strict=True)
    )
    return [math.log(known[name] / truth[name]) if name in truth else None for name in parameters.names]


def summary(found: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Number, RMS and mean of the errors of ln E, as they are and with the steps of some terms; none without truths."""
    named = {"as estimated": (), "with the material modes' terms": (TERMS[0], TERMS[2]), "with all terms": TERMS}
    rows = {}
    for name, terms in named.items():
        moved = [
            error + sd * sum(step)
            for case in found
            for error, sd, *step in zip(case["ln_errors"], case["sd"], *(case[term] for term in terms), strict=True)
            if error is not None
        ]
        if moved:
            rows[name] = {
                "number": len(moved),
                "rms": float(np.sqrt(np.mean(np.square(moved)))),
                "mean": float(np.mean(moved)),
            }
    return rows


@dataclass(frozen=True)
class _Estimate:
    """A minimum of an objective of one state, with its reduced basis."""

    objective: Objective
    minimum: Minimum
    basis: ReducedBasis

    @classmethod
    def of(cls, inversion: Inversion) -> _Estimate:
        """The best minimum of an inversion; raises `SystemExit` for one of several states."""
        (*others, basis) = inversion.objective.approximations
        if others or not isinstance(basis, ReducedBasis):
            raise SystemExit(
                f"score_terms.py measures one later image, and this case has {len(others) + 1}: name one in [images]"
            )
        return cls(inversion.objective, inversion.minimum, basis)

    def pull_lacking(self, direction: NDArray[np.float64]) -> float:
        """dx^T S^T W r along a direction (n_unknowns,)."""
        parameters, unknowns = self.objective.parameters, self.minimum.unknowns
        along, first = parameters.chain(0, unknowns) @ direction[parameters.unknowns_of(0)], len(parameters.base)
        boundary = self.basis.constraint.n_modes
        moduli, q = parameters.moduli(unknowns), parameters.coefficients(unknowns)[0]

        def following(share: float) -> NDArray[np.float64]:
            """U c (n_dof,) mm a share of the direction away, at the coefficients c that are here."""
            here = moduli * np.exp(share * along[:first])
            there = q[:boundary] + share * along[first : first + boundary]
            system = self.basis.full_model.system(here)
            homogeneous = system.solve(np.concatenate([there, 0.0 * q[boundary:]])).values
            return np.asarray(system.material_responses(homogeneous, q[boundary:, None])[:, 0])

        change, pull = (following(STEP) - following(-STEP)) / (2.0 * STEP), 0.0
        for term, seen in self._seen(change):
            moved = np.asarray(term.residuals.jacobian @ seen)
            pull += float(moved @ (term.precision * term.weights * term.residuals.values))
        return pull

    def determinant_slopes(self, i: int, here: NDArray[np.float64]) -> tuple[float, float]:
        """Derivatives of 1/2 ln det H_nn by the i-th log-modulus, by responses to boundary and to material modes.

        here (n_dof, n_regions + n_modes) mm: the tangent at the minimum, of which either part is held.
        """
        step = np.where(np.arange(len(self.minimum.unknowns)) == i, STEP, 0.0)
        ends = [self.minimum.unknowns + sign * step for sign in (1.0, -1.0)]
        there = [self.tangent(end) for end in ends]
        first, found = len(self.objective.parameters.base) + self.basis.constraint.n_modes, []
        for changes in (slice(0, first), slice(first, None)):
            values = []
            for end, moved in zip(ends, there, strict=True):
                tangent = here.copy()
                tangent[:, changes] = moved[:, changes]
                values.append(self._log_determinant(end, tangent))
            found.append(0.5 * (values[0] - values[1]) / (2.0 * STEP))
        return found[0], found[1]

    def tangent(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives (n_dof, n_regions + n_modes) mm by ln E and coefficients at unknowns (n_unknowns,)."""
        parameters, boundary = self.objective.parameters, self.basis.constraint.n_modes
        moduli, q = parameters.moduli(unknowns), parameters.coefficients(unknowns)[0]
        homogeneous = np.where(np.arange(len(q)) < boundary, q, 0.0)
        system, tangent = self.basis.full_model.system(moduli), self.basis.model.solve(moduli, homogeneous).tangent()
        tangent[:, len(parameters.base) + boundary :] = system.material_responses(system.solve(homogeneous).values)
        return tangent

    def _log_determinant(self, unknowns: NDArray[np.float64], tangent: NDArray[np.float64]) -> float:
        """Ln det of H's part of the unknowns beside the moduli, of a tangent (n_dof, n_regions + n_modes) mm."""
        evaluation, n = self.minimum.evaluation, self.objective.n_parameters
        matrix = evaluation.prior.copy()
        for term, seen in self._seen(tangent):
            jacobian = term.jacobian.under(self.objective.parameters.by_unknowns(seen, unknowns))
            matrix[np.ix_(term.columns, term.columns)] += jacobian.gram(term.precision * term.weights)
        return float(np.linalg.slogdet(matrix[n:, n:])[1])

    def _seen(self, displacements: NDArray[np.float64]) -> list[tuple[Linearisation, NDArray[np.float64]]]:
        """Each linearisation with what it sees of displacements (n_dof,) or (n_dof, k) mm."""
        (state,) = self.objective.states
        seen, rows = state.seen(displacements), state.slices
        return [(term, seen[own]) for term, own in zip(self.minimum.evaluation.linearisations, rows, strict=True)]


if __name__ == "__main__":
    sys.exit(main())
