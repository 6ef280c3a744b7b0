"""How an estimate moves when what it rests on is changed, without another solution of the model.

Residuals change to first order in the assumption, r + e, by the surfaces or by the displacement; then weights and
estimate are brought into agreement with them, the closest points held (see `refitted`), on the approximation of the
model, which bends: an organ that is drawn too large can run away to the bounds, which no gradient at the estimate
foretells. The drivers' prior and their modes are changed under the estimate's own weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.expansion import Expansion
from palpate.inversion import (
    Bounds,
    Evaluation,
    FrozenPosterior,
    Minimum,
    Objective,
    Outcome,
    Posterior,
    cheapest_posterior,
    gauss_newton,
    newton_step,
    pulls_of,
)
from palpate.mechanics.chord import chord_equilibria
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium, FiniteStrainModel, finite_strain_model
from palpate.mechanics.hyperelastic import elements_of
from palpate.mechanics.laws.contract import Law
from palpate.mechanics.linear_model import LinearEquilibrium, LinearModel, LinearSystem, poisson_tangents
from palpate.mechanics.newton import NewtonSettings
from palpate.mechanics.solvers.conjugate_gradients import conjugate_gradients
from palpate.mechanics.solvers.contract import Factorisation
from palpate.observation.contract import Imaged, OfMaterial, seen_by
from palpate.uncertainty.profile import PASSES, refitted

TOLERANCE = 1e-6  # decrement of a minimum
STEPS = 120  # at the most, for a modulus that moves far
ACCELERATED, DEPENDENT = 12, 1e-8  # steps near the estimate, at the most; relative size of dependent ones, squared
SHORT = 1e-4  # decrement before the last step, after which a hundredth of it is left at the most
FAR = 0.75  # of ln E: a step that is sought with a trust region
SIDE_BY_SIDE, CHORDS = 1e-2, 12  # of the forces, where images of one body go there together, and their iterations
COARSE = NewtonSettings(tolerance=2e-2, step_tolerance=2e-2)  # of the forces, under another law
DERIVATIVES = 1e-4  # relative residual of those by Poisson's ratios
ITERATIONS = 120  # with a factorisation of other moduli
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
    """An objective with closest points and weights held as at a `minimum`, its `least` near there, and the bounds."""

    objective: Objective
    minimum: Minimum
    posterior: Posterior
    least: Minimum
    bounds: Bounds

    def shifted_by(self, errors: Errors, *, passes: int = PASSES) -> Shift:
        """Where the estimate goes when the residuals of each observation change by e (n,) mm, noise, weights and all.

        passes: see `refitted`, which also tells what is raised.
        """
        moved = replace(self.minimum, evaluation=_moved(self.minimum.evaluation, errors))
        return self._shift(refitted(self.objective, moved, self.bounds, max_steps=STEPS, passes=passes)[0])

    def pulled(self, changes: Sequence[Errors]) -> list[Callable[[float], Posterior]]:
        """Of several changes the posterior by its amount, whose residuals change by that many times e (n,) mm."""
        at, evaluation, held = self.minimum.unknowns, self.minimum.evaluation, self.posterior
        if isinstance(held, FrozenPosterior):
            return [partial(held.pulled, pulls) for pulls in pulls_of(self.objective, at, evaluation, changes)]

        def moved(errors: Errors, amount: float) -> Posterior:
            """The posterior under one change, made anew."""
            changed = tuple(amount * error for error in errors)
            return cheapest_posterior(self.objective, at, _moved(evaluation, changed))

        return [partial(moved, errors) for errors in changes]

    def shift(
        self, posterior: Posterior | None = None, *, width: float = 1.0, dropped: NDArray[np.bool_] | None = None
    ) -> Shift:
        """Where it goes under its own weights: with other residuals, another prior of the drivers, fewer modes.

        posterior: one that is `pulled`; width: of the prior, times its own; dropped (n_coefficients,): coefficients
        that are held at 0. Raises `SolverError`, `EstimationError` where an unknown is left open.
        """
        start, n, changed = self.least.unknowns.copy(), self.objective.n_parameters, posterior or self.posterior
        parameters = self.objective.parameters
        if width != 1.0 or dropped is not None:
            priors = list(parameters.priors)
            for i, block in enumerate(parameters.blocks):
                covariance = (width if block.moves_driver else 1.0) ** 2 * priors[i].covariance
                if dropped is not None:
                    held = DROPPED * np.diag(dropped[parameters.columns(i) - n])
                    covariance = np.asarray(np.linalg.inv(np.linalg.inv(covariance) + held))
                priors[i] = replace(priors[i], covariance=covariance)
            if dropped is not None:
                start[n:] = np.where(dropped, 0.0, start[n:])
            changed = changed.with_prior(replace(parameters, priors=tuple(priors)))
        near = _accelerated(changed, start, self.bounds)
        if near.converged:
            return self._shift(near)
        found = gauss_newton(
            changed,
            near.unknowns,
            bounds=self.bounds,
            tolerance=TOLERANCE,
            max_steps=STEPS,
            begin=near.evaluation,
        )
        return self._shift(found)

    def _shift(self, found: Minimum) -> Shift:
        theta, least = (of.unknowns[: self.objective.n_parameters] for of in (found, self.least))
        return Shift(theta - least, self.bounds.reached(theta), found.converged)


def _accelerated(posterior: Posterior, start: NDArray[np.float64], bounds: Bounds) -> Minimum:
    """Where Newton's steps from unknowns (n,) lead as long as they lead down inside of the bounds.

    It is a minimum where the last step is so short that nothing need be evaluated after it.

    Anderson's acceleration in the Gauss-Newton matrix' norm (Walker & Ni, SIAM J. Numer. Anal. 49 (2011) 1715): the
    matrix lacks how models bend, and steps alone come nearer by the same share each time.
    """
    n, every = posterior.n_parameters, np.ones(len(start), dtype=bool)
    unknowns, now, before = start, posterior(start), list[tuple[NDArray[np.float64], NDArray[np.float64]]]()
    for _ in range(ACCELERATED):
        if not np.isfinite(now.value) or not bounds.free(unknowns, now.score).all():
            break
        step = newton_step(now, every, n)
        before, ahead = [*before[-n:], (unknowns, step)], step
        if len(before) > 1:
            places, steps = (np.diff(np.stack(each, axis=1), axis=1) for each in zip(*before, strict=True))
            along = steps.T @ np.stack([now.matrix @ column for column in (*steps.T, step)], axis=1)
            ahead = step - (places + steps) @ np.linalg.lstsq(along[:, :-1], along[:, -1], rcond=DEPENDENT)[0]
        theta = (unknowns + ahead)[:n]
        if np.abs(ahead[:n]).max(initial=0.0) > FAR or np.any((theta <= bounds.lower) | (theta >= bounds.upper)):
            break
        if -0.5 * float(now.score @ step) < SHORT:
            return Minimum(unknowns + ahead, now, Outcome.CONVERGED, ())
        there = posterior(unknowns + ahead)
        if not there.value < now.value:
            break
        unknowns, now = unknowns + ahead, there
    return Minimum(unknowns, now, Outcome.STEPS, ())


def _moved(evaluation: Evaluation, errors: Errors) -> Evaluation:
    """An evaluation with its residuals changed; of value and score nothing is said."""
    pairs = zip(evaluation.linearisations, errors, strict=True)
    return replace(evaluation, linearisations=tuple(term.with_errors(error) for term, error in pairs))


def fast_path(
    objective: Objective, minimum: Minimum, bounds: Bounds, known: tuple[Posterior, Minimum] | None = None
) -> FastPath:
    """That of an estimate; raises as `gauss_newton` does.

    known: the posterior with closest points and weights held, and its minimum, where these are there.
    """
    posterior, begin = known or (cheapest_posterior(objective, minimum.unknowns, minimum.evaluation), minimum)
    least = gauss_newton(posterior, begin.unknowns, bounds=bounds, tolerance=TOLERANCE)
    return FastPath(objective, minimum, posterior, least, bounds)


@dataclass(frozen=True, slots=True)
class _Nearby:
    """The stiffness of a model at moduli (n_regions,) kPa, by iterations with a factorisation of others'."""

    model: LinearModel
    moduli: NDArray[np.float64]
    inner: Factorisation

    def solve(self, rhs: NDArray[np.float64], *, tolerance: float = DERIVATIVES) -> NDArray[np.float64]:
        """Solution (n, m) for rhs (n, m) to a relative residual of `tolerance`, or of `DERIVATIVES` if that is less."""
        product, accuracy = partial(self.model.free_forces, self.moduli), max(tolerance, DERIVATIVES)
        return conjugate_gradients(product, rhs, self.nearly, tolerance=accuracy, max_iterations=ITERATIONS)[0]

    def nearly(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the factorisation alone makes of rhs (n, m)."""
        return self.inner.nearly(rhs)


def exact_equilibria(objective: Objective, unknowns: NDArray[np.float64]) -> Equilibria:
    """The equilibrium of each later state at unknowns (n_unknowns,), where its approximation is exact.

    Derivatives are taken with the factorisation that is there; raises `SolverError`.
    """
    found = list[LinearEquilibrium | FiniteStrainEquilibrium]()
    points = objective.linearisation_points(unknowns)
    for state, of, place in zip(objective.states, objective.approximations, points, strict=True):
        if isinstance(of, Expansion):
            found.append(of.equilibrium)
        elif of.factorisation is None:
            found.append(state.model.solve(place.moduli, place.coefficients))
        else:
            near = _Nearby(state.model, place.moduli, of.factorisation)
            values = of.model.solve(place.moduli, place.coefficients).values
            found.append(LinearEquilibrium(LinearSystem(state.model, place.moduli, near), place.coefficients, values))
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
    tangents, linear = dict[int, NDArray[np.float64]](), dict[int, LinearEquilibrium]()
    for s, there in enumerate(equilibria):
        if isinstance(there, FiniteStrainEquilibrium):
            tangents[s] = there.poisson_tangents(tolerance=DERIVATIVES)
        else:
            linear[s] = there
    while linear:  # later images of one body together
        first = next(iter(linear.values())).system
        alike = [s for s, there in linear.items() if first.model.same_stiffness(there.system.model)]
        values = np.stack([linear.pop(s).values for s in alike], axis=1)
        tangents |= zip(alike, poisson_tangents(first, values, dilatation), strict=True)
    found = []
    for term, moved in zip(
        evaluation.linearisations,
        _of_displacements(evaluation, [tangents[s] for s in range(len(equilibria))]),
        strict=True,
    ):
        seen, there = term.observation, equilibria[term.state]
        if not isinstance(seen, OfMaterial):
            found.append(moved)
            continue
        system = there if isinstance(there, FiniteStrainEquilibrium) else there.system
        here = seen.with_material(system.moduli, there.coefficients[system.model.constraint.n_modes :])
        found.append(moved + here.by_poisson(seen_by(seen, there.values)))
    return tuple(found)


def law_errors(
    evaluation: Evaluation,
    equilibria: Equilibria,
    law: Law,
    dilatation: Dilatation,
) -> Errors:
    """Changes (n,) mm of each observation's residuals when the bodies follow another law at the same moduli.

    From each equilibrium to that of the other law with the factorisation that is there: images of one body side by side
    (see `chord_equilibria`), by Newton's method where that does not lead there. Raises `NotConverged` where there is no
    such equilibrium.
    """
    changes, linear = dict[int, NDArray[np.float64]](), dict[int, LinearEquilibrium]()
    for s, there in enumerate(equilibria):
        if isinstance(there, FiniteStrainEquilibrium):
            exact = there if there.factorisation else there.refactorised()
            other = replace(exact.model, elements=elements_of(exact.model.space, law, dilatation))
            changes[s] = _newton_change(other, exact, exact.moduli, exact.factorisation)
        else:
            linear[s] = there
    while linear:
        first = next(iter(linear.values())).system
        alike = [
            s
            for s, there in linear.items()
            if first.model.same_stiffness(there.system.model) and np.array_equal(first.moduli, there.system.moduli)
        ]
        made = finite_strain_model(first.model.space, first.model.constraint, law, dilatation=dilatation)
        of_states = [linear.pop(s) for s in alike]
        others = [
            replace(made.with_conditions(of.system.model.conditions), material=of.system.model.material)
            for of in of_states
        ]
        found = chord_equilibria(
            [
                other.balance(first.moduli, of.coefficients[other.constraint.n_modes :])
                for other, of in zip(others, of_states, strict=True)
            ],
            [of.values for of in of_states],
            first.factorisation,
            tolerance=SIDE_BY_SIDE,
            iterations=CHORDS,
        )
        for s, other, of, values in zip(alike, others, of_states, found, strict=True):
            if values is None:
                changes[s] = _newton_change(other, of, first.moduli, first.factorisation)
            else:
                changes[s] = values - of.values
    return _of_displacements(evaluation, [changes[s] for s in range(len(equilibria))])


def _newton_change(
    other: FiniteStrainModel,
    there: LinearEquilibrium | FiniteStrainEquilibrium,
    moduli: NDArray[np.float64],
    nearby: Factorisation | None,
) -> NDArray[np.float64]:
    """Change (n_dof,) mm from an equilibrium to that of another model; raises `NotConverged`."""
    coarse = replace(other, settings=COARSE)
    found = coarse.solve(moduli, there.coefficients, start=there.displacement, nearby=nearby)
    return np.asarray(found.values - there.values)


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
