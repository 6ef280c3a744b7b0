"""The driver's motion when the moduli are known: its wall brought to the later image, the organs following."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.errors import NotConverged
from palpate.inversion.driver_prior import learned_prior
from palpate.inversion.gauss_newton import Bounds
from palpate.inversion.minima import driven
from palpate.inversion.objective import LocalModel
from palpate.inversion.problem import InverseProblem
from palpate.inversion.surrogate import first_surrogate
from palpate.inversion.weighting import SEGMENTATION_LAW, objective_of
from palpate.mechanics.equilibrium import from_linear
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium, FiniteStrainModel
from palpate.mechanics.first_order import expanded

__all__ = ["fit_driver"]

Motions = tuple[NDArray[np.float64], ...]


def fit_driver(
    problem: InverseProblem, moduli: NDArray[np.float64], *, shares: Sequence[float] = (1.0,)
) -> tuple[Motions, ...]:
    """Displacements (n_points, 3) mm of each later image at moduli (n_regions,) kPa and at shares of its motion.

    Under the problem's finite-strain law, where it has one, every share is in equilibrium. Raises `NotConverged` when
    the driver's wall cannot be brought to the images, or a path ends early.
    """
    surrogates = tuple(first_surrogate(model, moduli) for model in problem.models)
    held = replace(problem, modulus_map=replace(problem.modulus_map, base=moduli))
    linear = tuple(surrogate.reduced for surrogate in surrogates)
    amounts = _fitted(held, linear, np.zeros(sum(model.n_modes for model in linear)))
    if not problem.finite_strain:
        pairs = zip(linear, amounts, strict=True)
        return tuple(_scaled(model.solve(moduli, q).displacement, shares) for model, q in pairs)
    triples = zip(problem.finite_strain, surrogates, amounts, strict=True)
    first = [from_linear(model, surrogate.system, q) for model, surrogate, q in triples]
    models = tuple(expanded(e, names=e.model.names, moduli=e.moduli, coefficients=e.coefficients) for e in first)
    amounts = _fitted(held, models, np.concatenate(amounts))
    return tuple(_followed(equilibrium, q, shares) for equilibrium, q in zip(first, amounts, strict=True))


def _scaled(displacement: NDArray[np.float64], shares: Sequence[float]) -> Motions:
    return tuple(share * displacement for share in shares)


def _fitted(
    held: InverseProblem, models: tuple[LocalModel, ...], coefficients: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Mode coefficients of each state that bring the walls to the images, from given ones, all in one row."""
    n = len(held.modulus_map.tissues)
    bounds = Bounds(np.full(n, -1.0), np.full(n, 1.0))
    objective = objective_of(held, models, SEGMENTATION_LAW)
    unknowns = np.concatenate([np.zeros(n), coefficients])
    objective = objective.with_fresh_correspondence(unknowns)
    first = driven(objective, unknowns[:n], bounds=bounds, coefficients=coefficients)
    objective = replace(objective, prior=learned_prior(held, first.evaluation, first.unknowns))
    objective = objective.with_fresh_correspondence(first.unknowns)
    found = driven(objective, unknowns[:n], bounds=bounds, coefficients=first.unknowns[n:])
    if not found.outcome.converged:
        raise NotConverged(f"the driver's wall could not be fitted to the later image: {found.outcome.value}")
    return objective.coefficients(found.unknowns)


def _followed(near: FiniteStrainEquilibrium, coefficients: NDArray[np.float64], shares: Sequence[float]) -> Motions:
    """Equilibria at shares of the coefficients and of the offset, each from the one before it."""
    states: list[NDArray[np.float64]] = []
    for share in shares:
        model = _at_share(near.model, share)
        start = states[-1] if states else share * near.displacement
        states.append(model.solve(near.moduli, share * coefficients, start=start).displacement)
    return tuple(states)


def _at_share(model: FiniteStrainModel, share: float) -> FiniteStrainModel:
    return model.under(replace(model.constraint, offset=share * model.constraint.offset))
