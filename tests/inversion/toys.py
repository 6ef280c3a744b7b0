"""Objectives whose minimum is known by hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate.errors import SolverError
from palpate.inversion.objective import Evaluation
from palpate.unknowns import Arrowhead


@dataclass(frozen=True)
class Quadratic:
    """1/2 (x - centre)^T curvature (x - centre) with `n_parameters` log-moduli.

    `pull` spoils the score's sign; `height` makes the value alone flatter than its score and matrix say.
    """

    curvature: np.ndarray
    centre: np.ndarray
    n_parameters: int = 2
    pull: float = 1.0
    height: float = 1.0

    def value(self, unknowns):
        away = unknowns - self.centre
        return self.height * float(0.5 * away @ self.curvature @ away)

    def __call__(self, unknowns):
        slope = self.curvature @ (unknowns - self.centre)
        value = self.value(unknowns)
        matrix = Arrowhead.of(self.curvature)
        return Evaluation(value, value, self.pull * slope, matrix, (), Arrowhead.zeros(matrix.places), 0.0 * slope)


@dataclass(frozen=True)
class Folding:
    """Another objective, where the last unknown is no larger than `most`: beyond nothing can be solved."""

    of: Quadratic | Saturating
    most: float

    @property
    def n_parameters(self):
        return self.of.n_parameters

    def __call__(self, unknowns):
        if unknowns[-1] > self.most:
            raise SolverError("the motion turns elements inside out")
        return self.of(unknowns)


@dataclass(frozen=True)
class Saturating:
    """Residuals E - E_true of log-moduli with E = exp(theta): flat to the left, steep to the right; `noise` stays."""

    truth: np.ndarray
    noise: float = 0.0

    @property
    def n_parameters(self):
        return len(self.truth)

    def value(self, unknowns):
        return self.noise + float(0.5 * np.sum((np.exp(unknowns) - np.exp(self.truth)) ** 2))

    def __call__(self, unknowns):
        slope = np.exp(unknowns)
        score = slope * (slope - np.exp(self.truth))
        matrix = Arrowhead.of(np.diag(slope**2))
        value = self.value(unknowns)
        return Evaluation(value, value, score, matrix, (), Arrowhead.zeros(matrix.places), 0.0 * score)


def coupled(rng, n=5, centre=None):
    root = rng.standard_normal((n, n))
    return Quadratic(root @ root.T + 0.5 * np.eye(n), rng.standard_normal(n) * 0.3 if centre is None else centre)
