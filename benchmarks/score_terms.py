"""What the score of an estimate leaves out: how what follows the material changes, and the slope of ln det H.

    python benchmarks/score_terms.py CASE.toml [CASE.toml ...] [--set KEY=VALUE ...] [--json]

Of cases of one later image, under the linear law. The steps of each log-modulus that either would add to the estimate,
in its posterior standard deviations sd:

- responses: the displacement is u(E, q) + U(E, q) c with responses U to the material modes c, and the reduced model
  holds U while E and q move. With the change dx of U c along h = H^-1 e_i and the residuals' derivatives S by the
  displacement the step is -dx^T S^T W r, which the score lacks.
- determinant: the mode of the moduli alone, the other unknowns n integrated over by Laplace's approximation, lies
  -(H^-1)_tt d(1/2 ln det H_nn)/dt from the mode of all unknowns together. The boundary modes' responses are those of
  the reduced model, those of the material modes the full model's.

Derivatives are central differences over 0.2 of sd and of ln E.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.approximation import ReducedBasis
from palpate.inversion import Inversion, Linearisation, Minimum, Objective, invert
from palpate.study import inverse_problem, inversion_settings, make_body, read_case, read_states

STEP = 0.2


def main() -> int:
    """Estimate every case and print the steps that its score leaves out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="+", type=Path, metavar="CASE.toml")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of the case; repeatable")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    found = []
    for path in arguments.cases:
        found.append({"case": path.parent.name, **measured(estimated(path, arguments.set))})
        if not arguments.json:
            words = [
                f"{name} {', '.join(f'{x:.2f}' for x in found[-1][name])}" for name in ("responses", "determinant")
            ]
            print(f"{found[-1]['case']}: in sd, by {'; by '.join(words)}", flush=True)
    if arguments.json:
        print(json.dumps(found, indent=1))
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
    lacking = [of.pull_lacking(covariance[:, i] / sd[i]) for i in range(n)]
    slopes = [of.determinant_slope(i) for i in range(n)]
    by_determinant = -covariance[:n] @ slopes / sd
    return {"responses": (-np.array(lacking)).tolist(), "determinant": by_determinant.tolist(), "sd": sd.tolist()}


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

    def determinant_slope(self, i: int) -> float:
        """Derivative of 1/2 ln det H_nn by the i-th log-modulus."""
        step = np.where(np.arange(len(self.minimum.unknowns)) == i, STEP, 0.0)
        ends = [self._log_determinant(self.minimum.unknowns + sign * step) for sign in (1.0, -1.0)]
        return 0.5 * (ends[0] - ends[1]) / (2.0 * STEP)

    def _log_determinant(self, unknowns: NDArray[np.float64]) -> float:
        """Ln det of the unknowns' part of H beside the moduli, by the responses at unknowns (n_unknowns,)."""
        parameters, evaluation, n = self.objective.parameters, self.minimum.evaluation, self.objective.n_parameters
        moduli, q = parameters.moduli(unknowns), parameters.coefficients(unknowns)[0]
        first = len(parameters.base) + self.basis.constraint.n_modes
        homogeneous = np.where(np.arange(len(q)) < self.basis.constraint.n_modes, q, 0.0)
        system, tangent = self.basis.full_model.system(moduli), self.basis.model.solve(moduli, homogeneous).tangent()
        tangent[:, first:] = system.material_responses(system.solve(homogeneous).values)
        matrix = evaluation.prior.copy()
        for term, seen in self._seen(tangent):
            jacobian = term.jacobian.under(parameters.by_unknowns(seen, unknowns))
            matrix[np.ix_(term.columns, term.columns)] += jacobian.gram(term.precision * term.weights)
        return float(np.linalg.slogdet(matrix[n:, n:])[1])

    def _seen(self, displacements: NDArray[np.float64]) -> list[tuple[Linearisation, NDArray[np.float64]]]:
        """Each linearisation with what it sees of displacements (n_dof,) or (n_dof, k) mm."""
        (state,) = self.objective.states
        seen, rows = state.seen(displacements), state.slices
        return [(term, seen[own]) for term, own in zip(self.minimum.evaluation.linearisations, rows, strict=True)]


if __name__ == "__main__":
    sys.exit(main())
