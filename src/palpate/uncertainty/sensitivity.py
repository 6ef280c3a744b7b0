"""How an estimate moves when what it rests on is changed, without another solution of the model.

Residuals change to first order in the assumption, r + e, by the surfaces or by the displacement; then weights and
estimate are brought into agreement with them, the closest points held (see `refitted`), on the approximation of the
model, which bends: an organ that is drawn too large can run away to the bounds, which no gradient at the estimate
foretells. The drivers' prior and their modes are changed under the estimate's own weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.expansion import Expansion
from palpate.inversion import (
    Bounds,
    Evaluation,
    FixedCorrespondence,
    Linearisation,
    Minimum,
    Objective,
    fixed_correspondence,
    gauss_newton,
)
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium, finite_strain_model
from palpate.mechanics.hyperelastic import elements_of
from palpate.mechanics.laws.contract import Law
from palpate.mechanics.linear_model import LinearEquilibrium, LinearSystem, of_same_body, poisson_tangents
from palpate.mechanics.newton import NewtonSettings
from palpate.observation.contract import Imaged, OfMaterial, seen_by
from palpate.uncertainty.profile import PASSES, refitted

TOLERANCE = 1e-6  # decrement of a minimum
STEPS = 120  # at the most, for a modulus that moves far
COARSE = NewtonSettings(tolerance=2e-3, step_tolerance=1e-2)  # of the forces, under another law
DERIVATIVES = 1e-4  # relative residual of those by Poisson's ratios
DROPPED = 1e10  # precision of a coefficient that is held at 0; a free one has 1

Errors = tuple[NDArray[np.float64], ...]  # changes (n,) mm of each observation's residuals
Equilibria = Sequence[LinearEquilibrium | FiniteStrainEquilibrium]  # of each later state


@dataclass(frozen=True, slots=True)
class Shift:
    """Change theta (n_parameters,) of the log-moduli; at_bound (n_parameters,): which of them end at a bound.

    converged: whether there is a minimum.
    """

    theta: NDArray[np.float64]
    at_bound: NDArray[np.bool_]
    converged: bool


@dataclass(frozen=True, slots=True)
class FastPath:
    """The objective with closest points and weights held, its minimum near the estimate, and the search's bounds."""

    fixed: FixedCorrespondence
    least: Minimum
    bounds: Bounds

    def under(self, errors: Errors, *, passes: int = PASSES) -> Shift:
        """Where the estimate goes when the residuals of each observation change by e (n,) mm, noise, weights and all.

        passes: see `refitted`, which also tells what is raised.
        """
        there = _moved(self.least.evaluation.linearisations, errors)
        moved = replace(self.least, evaluation=replace(self.least.evaluation, linearisations=there))
        return self._shift(refitted(self.fixed.objective, moved, self.bounds, max_steps=STEPS, passes=passes)[0])

    def shift(self, errors: Errors = (), *, width: float = 1.0, dropped: NDArray[np.bool_] | None = None) -> Shift:
        """Where it goes under its own weights: with other residuals, another prior of the drivers, fewer modes.

        errors: e (n,) mm of each observation, none for none; width: of the prior, times its own; dropped
        (n_coefficients,): coefficients that are held at 0. Raises `SolverError`, `EstimationError` where an unknown is
        left open.
        """
        fixed, start, n = self.fixed, self.least.unknowns.copy(), self.fixed.n_parameters
        parameters = fixed.objective.parameters
        priors = list(parameters.priors)
        for i, block in enumerate(parameters.blocks):
            covariance = (width if block.cause == "driver" else 1.0) ** 2 * priors[i].covariance
            if dropped is not None:
                held = DROPPED * np.diag(dropped[parameters.columns(i) - n])
                covariance = np.asarray(np.linalg.inv(np.linalg.inv(covariance) + held))
            priors[i] = replace(priors[i], covariance=covariance)
        if dropped is not None:
            start[n:] = np.where(dropped, 0.0, start[n:])
        objective = replace(fixed.objective, parameters=replace(parameters, priors=tuple(priors)))
        linearisations, there = fixed.linearisations, self.least.evaluation.linearisations
        if errors:
            linearisations, there = _moved(linearisations, errors), _moved(there, errors)
        changed = replace(fixed, objective=objective, linearisations=linearisations)
        begin = changed.assembled(start, there) if dropped is None else None
        return self._shift(
            gauss_newton(changed, start, bounds=self.bounds, tolerance=TOLERANCE, max_steps=STEPS, begin=begin)
        )

    def _shift(self, found: Minimum) -> Shift:
        theta, least = (of.unknowns[: self.fixed.n_parameters] for of in (found, self.least))
        return Shift(theta - least, self.bounds.reached(theta), found.converged)


def _moved(linearisations: Sequence[Linearisation], errors: Errors) -> tuple[Linearisation, ...]:
    """Linearisations with their residuals changed."""
    return tuple(term.with_errors(error) for term, error in zip(linearisations, errors, strict=True))


def fast_path(objective: Objective, minimum: Minimum, bounds: Bounds) -> FastPath:
    """That of an estimate; raises as `gauss_newton` does."""
    fixed = fixed_correspondence(objective, minimum.unknowns, minimum.evaluation)
    return FastPath(fixed, gauss_newton(fixed, minimum.unknowns, bounds=bounds, tolerance=TOLERANCE), bounds)


def exact_equilibria(objective: Objective, unknowns: NDArray[np.float64]) -> Equilibria:
    """The equilibrium of each later state at unknowns (n_unknowns,), with its factorisation; raises `SolverError`.

    States of one body share a factorisation under the linear law.
    """
    found, systems = list[LinearEquilibrium | FiniteStrainEquilibrium](), list[LinearSystem]()
    points = objective.linearisation_points(unknowns)
    for state, of, place in zip(objective.states, objective.approximations, points, strict=True):
        if isinstance(of, Expansion):
            found.append(of.equilibrium)
            continue
        shared = of_same_body(state.model, place.moduli, systems)
        systems.append(shared or state.model.system(place.moduli))
        found.append(systems[-1].solve(place.coefficients))
    return tuple(found)


def poisson_errors(
    evaluation: Evaluation,
    equilibria: Equilibria,
    dilatation: Dilatation,
) -> Errors:
    """Derivatives (n, n_regions) mm of each observation's residuals by the Poisson's ratios of the regions.

    At the equilibria of the later states, held moduli and coefficients; dilatation: that of the element. In the
    residuals' unit of what depends on the material directly, as a force does.
    """
    tangents = [
        there.poisson_tangents(tolerance=DERIVATIVES)
        if isinstance(there, FiniteStrainEquilibrium)
        else poisson_tangents(there, dilatation)
        for there in equilibria
    ]
    found = []
    for term, moved in zip(evaluation.linearisations, _of_displacements(evaluation, tangents), strict=True):
        seen, there = term.observation, equilibria[term.state]
        if not isinstance(seen, OfMaterial):
            found.append(moved)
            continue
        system = there if isinstance(there, FiniteStrainEquilibrium) else there.system
        here = seen.under(system.moduli, there.coefficients[system.model.constraint.n_modes :])
        found.append(moved + here.by_poisson(seen_by(seen, there.values)))
    return tuple(found)


def law_errors(
    evaluation: Evaluation,
    equilibria: Equilibria,
    law: Law,
    dilatation: Dilatation,
) -> Errors:
    """Changes (n,) mm of each observation's residuals when the bodies follow another law at the same moduli.

    Newton's method leads from each equilibrium to that of the other law, with the factorisation that is there. Raises
    `NotConverged` where there is none.
    """
    changes = []
    for there in equilibria:
        if isinstance(there, FiniteStrainEquilibrium):
            exact = there if there.factorisation else there.refactorised()
            other = replace(exact.model, elements=elements_of(exact.model.space, law, dilatation))
            moduli, factorisation = exact.moduli, exact.factorisation
        else:
            model, moduli, factorisation = there.system.model, there.system.moduli, there.system.factorisation
            other = finite_strain_model(
                model.space,
                model.constraint,
                law,
                dilatation=dilatation,
                loads=model.conditions.loads,
                material=model.material,
            )
        coarse = replace(other, settings=COARSE)
        found = coarse.solve(moduli, there.coefficients, start=there.displacement, nearby=factorisation)
        changes.append(np.asarray(found.values - there.values))
    return _of_displacements(evaluation, changes)


def _of_displacements(evaluation: Evaluation, changes: Sequence[NDArray[np.float64]]) -> Errors:
    """Changes of each observation's residuals, mm, by changes (n_dof, ...) mm of the states' displacements."""
    return tuple(
        np.asarray(term.residuals.jacobian @ seen_by(term.observation, changes[term.state]))
        for term in evaluation.linearisations
    )


def modulus_errors(objective: Objective, unknowns: NDArray[np.float64], evaluation: Evaluation) -> Errors:
    """Derivatives (n, n_regions) mm of each observation's residuals by ln E of the regions, known ones among them."""
    found, linearisations = [], iter(evaluation.linearisations)
    for state, place in zip(objective.states, objective.linearisation_points(unknowns), strict=True):
        assert state.observed is not None, "an objective is made of states with approximations"
        tangent = state.observed.solve(place.moduli, place.coefficients).tangent()[:, : len(place.moduli)]
        for rows in state.slices:
            residuals = next(linearisations).residuals
            by_moduli = np.asarray(residuals.jacobian @ tangent[rows])
            held = 0.0 if residuals.direct is None else residuals.direct[:, : len(place.moduli)]
            found.append(by_moduli + held)
    return tuple(found)


def surface_errors(evaluation: Evaluation, tissue: str) -> Errors:
    """Derivatives (n,), dimensionless, of each observation's residuals by how far `tissue` reaches in all later images.

    By its growth along its normals, which takes from its neighbours (see `Imaged.growth_error`). To first order
    the same growth in the first image, the mesh held, has the opposite effect: residuals are differences.
    """
    found = []
    for term in evaluation.linearisations:
        seen, peers = term.observation, [o.observation for o in evaluation.linearisations if o.state == term.state]
        if isinstance(seen, Imaged):
            found.append(seen.growth_error(term.residuals, tissue, peers))
        else:
            found.append(np.zeros_like(term.residuals.values))
    return tuple(found)
