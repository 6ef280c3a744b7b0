"""What images that are not at hand any more say of unknowns: a normal likelihood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate.unknowns.arrowhead import Arrowhead


@dataclass(frozen=True, slots=True)
class Likelihood:
    """exp(-1/2 w^T A w + b^T w - c) of unknowns w (m,): matrix A (m, m), pull b (m,) and constant c, dimensionless."""

    matrix: NDArray[np.float64]
    pull: NDArray[np.float64]
    constant: float

    def at(self, w: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Minus its logarithm at w (m,), and the derivatives (m,)."""
        moved = self.matrix @ w
        return float(w @ (0.5 * moved - self.pull)) + self.constant, moved - self.pull

    def by(self, rows: NDArray[np.float64]) -> Likelihood:
        """That of other unknowns x (k,), of which w = rows x, rows (m, k)."""
        return Likelihood(rows.T @ self.matrix @ rows, rows.T @ self.pull, self.constant)

    def log_evidence(self, precision: NDArray[np.float64], mean: NDArray[np.float64]) -> float:
        """Ln of its mean under the prior N(mean (m,), P^-1), precision P (m, m); a factor of the flat ones is left out.

        1/2 (d^T (A + P)^-1 d - ln det(A + P) + ln det P - mean^T P mean) - c with d = b + P mean.
        """
        whole, pull = Arrowhead.of(self.matrix + precision).grounded(), self.pull + precision @ mean
        told = Arrowhead.of(precision).grounded()
        determinants = told.log_determinant() - whole.log_determinant()
        return 0.5 * float(pull @ whole.solve(pull) - mean @ precision @ mean + determinants) - self.constant

    def of_combinations(self, rows: NDArray[np.float64], covariance: NDArray[np.float64]) -> Likelihood:
        """That of combinations z = rows w (k,), rows (k, m), with what these leave open of w integrated out.

        w ~ N(0, C), covariance C (m, m). Given z it is G z + F u, G = C R^T (R C R^T)^-1, F F^T = C - G R C and u of
        independent standard normal laws, so the matrix is G^T (A - A F M^-1 F^T A) G with M = 1 + F^T A F.
        """
        mixed = covariance @ rows.T
        given = linalg.solve(rows @ mixed, mixed.T, assume_a="pos").T
        open_ = linalg.cholesky(covariance, lower=True)
        open_ = open_ - given @ (rows @ open_)
        across, target = open_.T @ self.matrix @ given, open_.T @ self.pull
        factor = linalg.cholesky(np.eye(len(target)) + open_.T @ self.matrix @ open_, lower=True)
        taken, told = (linalg.solve_triangular(factor, side, lower=True) for side in (across, target))
        return Likelihood(
            given.T @ self.matrix @ given - taken.T @ taken,
            given.T @ self.pull - taken.T @ told,
            self.constant + float(np.log(np.diag(factor)).sum() - 0.5 * told @ told),
        )
