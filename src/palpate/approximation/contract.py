"""What stands in for a full model while an objective is minimised, and the plainest such: it solves everywhere."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from palpate.errors import EstimationError
from palpate.mechanics.equilibrium import from_start
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium, FiniteStrainModel
from palpate.mechanics.first_order import FirstOrderModel, expanded
from palpate.mechanics.forward import ForwardModel, Outputs, SolveCounts
from palpate.mechanics.linear_model import LinearEquilibrium, LinearModel
from palpate.mechanics.solvers.contract import Factorisation
from palpate.mesh.space import Constraint


@contextmanager
def determined() -> Iterator[None]:
    """Where images and prior leave an unknown open, its matrix has no inverse: raises `EstimationError` for it."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise EstimationError(
            f"the images do not determine the unknowns ({error}): the driver's motion vanishes in the noise ([noise]"
            " surface_sd_mm, or that of the residuals); state smaller noise, or use images with a larger motion"
        ) from error


class LocalModel(ForwardModel, Protocol):
    """A forward model of all points that can answer with what is seen of them only."""

    def outputs(self, seen: Outputs) -> ForwardModel:
        """The same model with the outputs that a linear map makes of its own."""
        ...


@dataclass(frozen=True, slots=True)
class LinearisationPoint:
    """Moduli (n_regions,) kPa and driver coefficients (n_modes,) at which a model is approximated.

    directions (n_regions + n_modes, k) of (ln E, q): those along which derivatives are made exact, None where the
    displacement alone is; metric (n_regions + n_modes, n_regions + n_modes): the Gauss-Newton matrix there;
    all_material: whether they are made so by all material modes, too, where these are known of far moduli.
    """

    moduli: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    directions: NDArray[np.float64] | None = None
    metric: NDArray[np.float64] | None = None
    all_material: bool = True

    def same_as(self, other: LinearisationPoint | None) -> bool:
        """Whether moduli and coefficients are those of another place."""
        return (
            other is not None
            and np.array_equal(self.moduli, other.moduli)
            and np.array_equal(self.coefficients, other.coefficients)
        )


@dataclass(frozen=True, slots=True)
class ModelError:
    """What an approximation misses at a place, by one right-hand side of the full model.

    relative: of the displacement, in energy, a bound or an estimate; missing (n_dof,) mm: a first estimate of the exact
    displacement less the approximate one, for what it does to what is sought.
    """

    relative: float
    missing: NDArray[np.float64]


class Approximation(Protocol):
    """A cheap model of all points near some place, and the way to make it exact elsewhere; an immutable value."""

    @property
    def model(self) -> LocalModel:
        """The cheap model."""
        ...

    @property
    def constraint(self) -> Constraint:
        """What is prescribed to the full model."""
        ...

    @property
    def factorisation(self) -> Factorisation | None:
        """A factorisation of the full model's stiffness near the last place."""
        ...

    @property
    def counts(self) -> SolveCounts:
        """What the full model has cost to make the approximation."""
        ...

    @property
    def trust_radius(self) -> float:
        """Distance in ln E from its place within which the approximation is used."""
        ...

    @property
    def derivatives_at(self) -> NDArray[np.float64] | None:
        """Moduli (n_regions,) kPa where the derivatives that decide the estimate are exact; None: nowhere yet."""
        ...

    def update(self, at: LinearisationPoint) -> Self:
        """The approximation made exact at a place: the displacement, and the derivatives along its directions.

        Raises `NotConverged` when the full model has no equilibrium there, `SolverError` when it cannot be solved.
        """
        ...

    @classmethod
    def update_all(cls, each: Sequence[Self], points: Sequence[LinearisationPoint]) -> list[Self]:
        """Those of several states made exact, each at its place: what their models share is done once.

        Raises as `update` does.
        """
        ...

    @property
    def error_counts(self) -> SolveCounts:
        """What one call of `error` costs; an approximation cannot add it to its own `counts`."""
        ...

    def error(self, at: LinearisationPoint) -> ModelError:
        """What it misses at a place."""
        ...


def updated(approximations: Sequence[Approximation], points: Sequence[LinearisationPoint]) -> list[Approximation]:
    """The approximation of each state made exact at its place; raises as `Approximation.update` does."""
    return list(type(approximations[0]).update_all(approximations, points)) if approximations else []


@dataclass(frozen=True, slots=True)
class ExactApproximation:
    """The full model, solved anew at every place with all its derivatives; implements `Approximation`.

    Nothing is spared: what the other ones find is held against it.
    """

    linear: LinearModel
    finite_strain: FiniteStrainModel | None
    model: FirstOrderModel
    place: LinearisationPoint
    equilibrium: LinearEquilibrium | FiniteStrainEquilibrium = field(repr=False)
    counts: SolveCounts

    @property
    def constraint(self) -> Constraint:
        """What is prescribed to the model."""
        return self.linear.constraint

    @property
    def factorisation(self) -> Factorisation | None:
        """That of the finite-strain equilibrium, if it is one."""
        return self.equilibrium.factorisation if isinstance(self.equilibrium, FiniteStrainEquilibrium) else None

    @property
    def trust_radius(self) -> float:
        """As far as an expansion to first order is trusted."""
        return 0.8

    @property
    def derivatives_at(self) -> NDArray[np.float64]:
        """Moduli (n_regions,) kPa where the model was last solved: there all derivatives are exact."""
        return self.place.moduli

    def update(self, at: LinearisationPoint) -> ExactApproximation:
        """The model solved at a place, and expanded there; raises as `Approximation.update` does."""
        if at.same_as(self.place):
            return self
        return exact_approximation(self.linear, self.finite_strain, at, nearby=self)

    @classmethod
    def update_all(
        cls, each: Sequence[ExactApproximation], points: Sequence[LinearisationPoint]
    ) -> list[ExactApproximation]:
        """Those of several states, one after the other."""
        return [one.update(at) for one, at in zip(each, points, strict=True)]

    @property
    def error_counts(self) -> SolveCounts:
        """One right-hand side with the factorisation that is there."""
        return SolveCounts(forward=1)

    def error(self, at: LinearisationPoint) -> ModelError:
        """A bound under the linear law (see `LinearSystem.error_bound`), else an estimate (see `error_estimate`)."""
        displacement = self.model.solve(at.moduli, at.coefficients).values
        if at.same_as(self.place):
            return ModelError(0.0, np.zeros_like(displacement))
        there = self.equilibrium
        if isinstance(there, FiniteStrainEquilibrium):
            return ModelError(*there.error_estimate(at.moduli, at.coefficients, displacement))
        boundary = np.arange(len(at.coefficients)) < self.constraint.n_modes  # of the linear law's homogeneous part
        displacement = self.model.solve(at.moduli, np.where(boundary, at.coefficients, 0.0)).values
        return ModelError(*there.system.error_bound(at.moduli, displacement))


def exact_approximation(
    linear: LinearModel,
    finite_strain: FiniteStrainModel | None,
    at: LinearisationPoint,
    *,
    nearby: ExactApproximation | None = None,
) -> ExactApproximation:
    """Solve the model at a place, from an equilibrium `nearby` where there is one; raises as `update` does."""
    before = None if nearby is None else nearby.equilibrium
    there: LinearEquilibrium | FiniteStrainEquilibrium
    if finite_strain is None:
        there = linear.solve(at.moduli, at.coefficients)
    else:
        near = before.factorisation if isinstance(before, FiniteStrainEquilibrium) else None
        start = before or linear.solve(at.moduli, at.coefficients)
        found = from_start(finite_strain, at.moduli, at.coefficients, start=start.displacement, nearby=near)
        there = found.refactorised()
    model = expanded(there, names=linear.names, moduli=at.moduli, coefficients=at.coefficients)
    spent = SolveCounts() if nearby is None else nearby.counts
    return ExactApproximation(linear, finite_strain, model, at, there, spent + there.counts + there.tangent_counts)
