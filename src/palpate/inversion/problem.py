"""What is asked and what is answered: the inverse problem, its settings, and the minima that were found."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.inversion.gauss_newton import Bounds, Minimum
from palpate.inversion.modulus_map import ModulusMap
from palpate.inversion.noise import NoiseLaw
from palpate.inversion.objective import Evaluation, LocalModel, Objective
from palpate.mechanics.finite_strain import FiniteStrainModel
from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.linear_model import LinearModel
from palpate.mechanics.solvers.contract import Factorisation
from palpate.mesh.constraint import Constraint
from palpate.observation.target import SurfaceTarget
from palpate.observation.wall_modes import Wall

__all__ = ["InverseProblem", "Inversion", "InversionSettings", "StandIn"]


class StandIn(Protocol):
    """What stands in for a full model while the objective is minimised."""

    @property
    def reduced(self) -> LocalModel:
        """The cheap model."""
        ...

    @property
    def constraint(self) -> Constraint:
        """What is prescribed to the full model."""
        ...

    @property
    def factorisation(self) -> Factorisation | None:
        """A factorisation of the full model's stiffness near the estimate."""
        ...

    @property
    def counts(self) -> SolveCounts:
        """What the full model has cost so far."""
        ...


@dataclass(frozen=True, slots=True)
class InverseProblem:
    """One model and the surfaces of one later image, for each later image; unknown moduli by `modulus_map`.

    `estimated`: the tissues whose moduli are sought; the other surfaces are drivers'. `finite_strain`: the same bodies
    under the law that the estimate is continued to; empty where the linear one is the case's. `fine_kernel_mm`:
    correlation length of what a wall does beyond its modes (see `refined_walls`). `walls`: the drivers' walls of each
    model, whose prior is learned from the images (see `learned_prior`); empty: the modes' own prior holds.
    """

    models: tuple[LinearModel, ...]
    targets: tuple[tuple[SurfaceTarget, ...], ...]
    modulus_map: ModulusMap
    estimated: frozenset[str]
    finite_strain: tuple[FiniteStrainModel, ...] = ()
    fine_kernel_mm: float = 8.0
    walls: tuple[tuple[Wall, ...], ...] = ()

    @property
    def drivers(self) -> frozenset[str]:
        """Names of the observed tissues whose motion is prescribed."""
        return frozenset(t.surface.name for targets in self.targets for t in targets) - self.estimated


@dataclass(frozen=True, slots=True)
class InversionSettings:
    """Starts theta (n_parameters,) each, their bounds, the optimiser's name; `law` None: from the residuals."""

    starts: tuple[NDArray[np.float64], ...]
    bounds: Bounds
    method: str = "gauss-newton"
    law: NoiseLaw | None = None


@dataclass(frozen=True, slots=True)
class Inversion:
    """All starts' minima under the final objective, the best one's number; the law of the residuals.

    rest: the evaluation at no motion; `settled` is False when weights and estimate still changed each other at the end.
    """

    objective: Objective
    minima: tuple[Minimum, ...]
    groups: tuple[int, ...]
    best: int
    law: NoiseLaw
    surrogates: tuple[StandIn, ...]
    rest: Evaluation
    settled: bool = True
    evaluations: int = 0
    counts: SolveCounts = field(default_factory=SolveCounts)

    @property
    def minimum(self) -> Minimum:
        """The minimum with the smallest objective."""
        return self.minima[self.best]
