"""From the linear estimate to that of a finite-strain law: Gauss-Newton on expansions around true equilibria.

The linear law is off by tens of per cent where a wall moves by half its radius, but near enough to begin. Each round
minimises the objective on an expansion to first order around the present equilibrium and solves the equilibrium where
that leads; where it does not lower the objective the step is halved. One factorisation, made near the first
equilibrium, gives all derivatives there and serves every solve. At the end the derivatives along the directions that
decide the moduli, which is all that these need to first order, are made those of the equilibrium there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from palpate.errors import NotConverged
from palpate.inversion.directions import deciding_directions
from palpate.inversion.driver_prior import learned_prior
from palpate.inversion.gauss_newton import Bounds, Minimum, Outcome
from palpate.inversion.minima import SETTLED, minimised, moved_between, words
from palpate.inversion.noise import NoiseLaw
from palpate.inversion.objective import Evaluation, Objective
from palpate.inversion.problem import InverseProblem, Inversion, InversionSettings, StandIn
from palpate.inversion.weighting import objective_of, residual_law, reweighted
from palpate.mechanics.equilibrium import from_start
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium, FiniteStrainModel
from palpate.mechanics.first_order import FirstOrderModel
from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.solvers.contract import Factorisation
from palpate.mesh.constraint import Constraint

__all__ = ["Expansion", "continued_at_finite_strain"]

ROUNDS = 12
WEIGHED = (2, 7)  # least and largest number of rounds that weigh the residuals anew
NEAR = 0.5  # posterior standard deviations: a round that moves less leaves the weights
REACH = 0.8  # of ln E, within which an expansion is trusted
HALVINGS = 3
NOISE = 0.5  # of the objective, in units of log-likelihood: the noise of re-chosen closest points
COARSE, ROUGH = 3e-2, 1e-4  # of the forces: for a first factorisation; for all rounds but the last
FEW = 24  # moduli and modes, all of whose derivatives cost less than the rounds that they spare
POLISH = 1e-5  # decrement of a round's minimum


@dataclass(frozen=True, slots=True)
class Expansion:
    """A model to first order around `equilibrium`, and what the full one has cost so far."""

    reduced: FirstOrderModel
    equilibrium: FiniteStrainEquilibrium = field(repr=False)
    counts: SolveCounts

    @property
    def factorisation(self) -> Factorisation | None:
        """That of the tangent stiffness there."""
        return self.equilibrium.factorisation

    @property
    def constraint(self) -> Constraint:
        """What is prescribed to the model."""
        return self.equilibrium.model.constraint


@dataclass(frozen=True, slots=True)
class _Place:
    """A minimum under the objective made of the expansions around the equilibria where the last round led.

    moved: by so many posterior standard deviations.
    """

    objective: Objective
    minimum: Minimum
    expansions: tuple[Expansion, ...]
    law: NoiseLaw
    moved: float = np.inf

    @property
    def settled(self) -> bool:
        """Whether the last round would have moved the log-moduli by little."""
        return self.moved < SETTLED


def continued_at_finite_strain(
    problem: InverseProblem,
    linear: Inversion,
    settings: InversionSettings,
    *,
    progress: Callable[[str], None],
) -> Inversion:
    """The estimate under the law of the problem's `finite_strain` models, from the minima of the `linear` one.

    Each distinct linear minimum that converged is continued, the best one always. Raises `NotConverged` when its
    equilibrium is not found, with the element and the share of the motion where it ended.
    """
    pairs = zip(problem.finite_strain, linear.surrogates, strict=True)
    models = tuple(model.under(surrogate.constraint).to_tolerance(ROUGH) for model, surrogate in pairs)
    chosen = linear.groups[linear.best]
    places = {chosen: _followed(problem, models, linear, linear.minimum, settings, progress)}
    for minimum, group in zip(linear.minima, linear.groups, strict=True):
        if group not in places and minimum.outcome.converged:
            places[group] = _followed(problem, models, linear, minimum, settings, progress)
    best = min(places, key=lambda g: (not places[g].minimum.outcome.converged, places[g].minimum.evaluation.value))
    minima = tuple(
        _joined(m, places[g].minimum) if g in places else m for m, g in zip(linear.minima, linear.groups, strict=True)
    )
    place = places[best]
    spent = sum((e.counts for p in places.values() for e in p.expansions), SolveCounts())
    return replace(
        linear,
        objective=place.objective,
        minima=minima,
        best=linear.groups.index(best),
        law=place.law,
        surrogates=place.expansions,
        settled=place.settled,
        evaluations=sum(len(minimum.history) for minimum in minima),
        counts=linear.counts + spent,
    )


def _joined(first: Minimum, second: Minimum) -> Minimum:
    return replace(second, history=first.history + second.history)


def _followed(
    problem: InverseProblem,
    models: tuple[FiniteStrainModel, ...],
    linear: Inversion,
    start: Minimum,
    settings: InversionSettings,
    progress: Callable[[str], None],
) -> _Place:
    """Rounds from one linear minimum until the moduli no longer move."""
    progress("finite strain: the equilibrium at the linear estimate")
    moduli, amounts = _split(linear.objective, start.unknowns)
    triples = zip(models, linear.surrogates, amounts, strict=True)
    expansions = tuple(_near_linear(model, surrogate, moduli, q) for model, surrogate, q in triples)
    first = _Place(linear.objective, replace(start, history=()), expansions, linear.law)
    place = _weighed(problem, first, settings)
    for number in range(ROUNDS):
        progress(f"finite strain, round {number + 1}: {words(problem, place.minimum)}")
        weigh = number < WEIGHED[0] or (number < WEIGHED[1] and place.moved > NEAR)
        before, place = place, _round(problem, place, settings, weigh=weigh)
        if place.settled or place.expansions is before.expansions:
            break
    expansions = _sharpened(place.objective, place.minimum.evaluation, place.expansions)
    place = replace(place, objective=_around(place, expansions), expansions=expansions)
    found = minimised(place.objective, place.minimum.unknowns, settings, tolerance=POLISH)
    # a polish that finds no better point leaves the last round's, which is an equilibrium with its own outcome
    end = _joined(place.minimum, found) if found.outcome.converged else place.minimum
    if not place.settled:
        left = place.minimum.outcome
        end = replace(end, outcome=Outcome.STEPS if left.converged else left)
    return _at_equilibria(problem, place, end)


def _at_equilibria(problem: InverseProblem, place: _Place, end: Minimum) -> _Place:
    """The place with the minimum `end`, at its exact equilibria: the rounds' own were found to what a step needs."""
    moduli, amounts = _split(place.objective, end.unknowns)
    expansions = []
    for model, before, q in zip(problem.finite_strain, place.expansions, amounts, strict=True):
        near, exact = before.equilibrium, model.under(before.constraint)
        start = before.reduced.solve(moduli, q).displacement
        expansions.append(_recentred(before, from_start(exact, moduli, q, start=start, nearby=near.factorisation)))
    objective = _around(place, tuple(expansions))
    minimum = replace(end, evaluation=objective(end.unknowns))
    return replace(place, objective=objective, minimum=minimum, expansions=tuple(expansions))


def _around(place: _Place, expansions: tuple[Expansion, ...]) -> Objective:
    """The place's objective on other expansions."""
    states = (
        replace(state, model=expansion.reduced.at(np.concatenate([t.surface.dofs for t in state.targets])))
        for state, expansion in zip(place.objective.states, expansions, strict=True)
    )
    return replace(place.objective, states=tuple(states))


def _near_linear(
    model: FiniteStrainModel, linear: StandIn, moduli: NDArray[np.float64], amounts: NDArray[np.float64]
) -> Expansion:
    """The equilibrium near the linear estimate, with a factorisation of its own and all derivatives by that.

    It is the only one: it serves all solves that follow, which stay near.
    """
    there = linear.reduced.solve(moduli, amounts)
    coarse = model.to_tolerance(COARSE)
    near = from_start(coarse, moduli, amounts, start=there.displacement, nearby=linear.factorisation).refactorised()
    found = from_start(model, moduli, amounts, start=near.displacement, nearby=near.factorisation)
    derivatives = FirstOrderModel(model.names, moduli, amounts, found.values, near.tangent())
    return Expansion(derivatives, found, near.counts + near.tangent_counts + found.counts)


def _weighed(problem: InverseProblem, place: _Place, settings: InversionSettings) -> _Place:
    """The place with the residuals at its own equilibria weighed by their law, and the drivers' prior learned there."""
    at, models = place.minimum, tuple(expansion.reduced for expansion in place.expansions)
    prior = place.objective.prior
    first = objective_of(problem, models, place.law, prior).with_fresh_correspondence(at.unknowns)
    here = first(at.unknowns)
    law = settings.law or residual_law(problem, here)
    learned = learned_prior(problem, here, at.unknowns)
    objective = reweighted(objective_of(problem, models, law, learned), replace(at, evaluation=here), law)
    return replace(place, objective=objective, minimum=replace(at, evaluation=objective(at.unknowns)), law=law)


def _round(problem: InverseProblem, place: _Place, settings: InversionSettings, *, weigh: bool) -> _Place:
    """The minimum on the present expansions, or a part of the way to it, with the equilibria there.

    `weigh`: the residuals there give new weights. Where no part of the way lowers the objective the place stays, its
    minimum `STALLED` when the whole way is within the estimate's own noise and `STUCK` when not.
    """
    now = place.minimum
    near = replace(settings, bounds=_near(settings.bounds, now.unknowns[: place.objective.n_parameters]))
    found = minimised(place.objective, now.unknowns, near)
    moved = moved_between(now, found, place.objective.n_parameters)
    lower = _lower(place, found.unknowns - now.unknowns)
    if lower is None:
        outcome = Outcome.STALLED if moved < SETTLED else Outcome.STUCK
        return replace(place, minimum=replace(now, outcome=outcome), moved=moved)
    unknowns, equilibria = lower
    pairs = zip(equilibria, place.expansions, strict=True)
    expansions = tuple(_recentred(before, equilibrium) for equilibrium, before in pairs)
    if all(e.reduced.n_regions + e.reduced.n_modes <= FEW for e in expansions):
        expansions = _sharpened(place.objective, found.evaluation, expansions)
    there = replace(found, unknowns=unknowns, history=(*now.history, *found.history))
    objective = _around(place, expansions)
    arrived = _Place(objective, replace(there, evaluation=objective(unknowns)), expansions, place.law, moved)
    return _weighed(problem, arrived, settings) if weigh else arrived


def _lower(
    place: _Place, step: NDArray[np.float64]
) -> tuple[NDArray[np.float64], tuple[FiniteStrainEquilibrium, ...]] | None:
    """The first of step, step / 2, step / 4 ... that lowers the objective, with the equilibria there; None: none does.

    Raises `NotConverged` when the last of them has no equilibrium.
    """
    now = place.minimum
    for halving in range(HALVINGS + 1):
        unknowns = now.unknowns + 0.5**halving * step
        moduli, amounts = _split(place.objective, unknowns)
        equilibria = tuple(_solved(e, moduli, q) for e, q in zip(place.expansions, amounts, strict=True))
        if all(e.converged for e in equilibria) and _lowers(place, equilibria, unknowns):
            return unknowns, equilibria
    for equilibrium in equilibria:
        if not equilibrium.converged:
            raise NotConverged(f"no equilibrium near the estimate: {equilibrium.reason}")
    return None


def _solved(expansion: Expansion, moduli: NDArray[np.float64], amounts: NDArray[np.float64]) -> FiniteStrainEquilibrium:
    """The equilibrium at other moduli and coefficients, from where the expansion says that it is."""
    before = expansion.equilibrium
    start = expansion.reduced.solve(moduli, amounts).displacement
    found = before.model.attempt(moduli, amounts, start=start, nearby=before.factorisation)
    return found if found.converged else before.model.attempt(moduli, amounts, start=before.displacement)


def _sharpened(
    objective: Objective, evaluation: Evaluation, expansions: tuple[Expansion, ...]
) -> tuple[Expansion, ...]:
    """The expansions with the derivatives exact, at their equilibria, along the directions that decide the moduli."""
    metrics = _metrics(objective, evaluation)
    triples = zip(expansions, _directions(objective, evaluation), metrics, strict=True)
    return tuple(_sharpened_along(*of) for of in triples)


def _sharpened_along(expansion: Expansion, directions: NDArray[np.float64], metric: NDArray[np.float64]) -> Expansion:
    """The expansion with the derivatives along `directions` D (n_regions + n_modes, k) exact at its equilibrium.

    T + (C - T D) (D^T H D)^+ D^T H with the exact C and H the `metric` (n_regions + n_modes, n_regions + n_modes): of
    all T' with T' D = C the one that changes least. The other columns stay as they were where T was made.
    """
    model, place = expansion.reduced, expansion.equilibrium
    before = model.derivatives @ directions
    change = place.tangent_along(directions, before) - before
    share = np.linalg.pinv(directions.T @ metric @ directions, hermitian=True) @ (directions.T @ metric)
    sharper = replace(model, derivatives=model.derivatives + change @ share)
    return replace(expansion, reduced=sharper, counts=expansion.counts + SolveCounts(tangent=directions.shape[1]))


def _directions(objective: Objective, evaluation: Evaluation) -> list[NDArray[np.float64]]:
    """Those that decide the moduli, (n_regions + n_modes, k) of each state; all where a state has few unknowns."""
    deciding = deciding_directions(objective, evaluation)
    return [np.eye(len(d)) if len(d) <= FEW else d for d in deciding]


def _metrics(objective: Objective, evaluation: Evaluation) -> list[NDArray[np.float64]]:
    """The Gauss-Newton matrix as one of each state's (ln E, q), (n_regions + n_modes, n_regions + n_modes)."""
    n, start, found = objective.n_parameters, objective.n_parameters, []
    for state in objective.states:
        end = start + state.model.n_modes
        own = np.concatenate([np.arange(n), np.arange(start, end)])
        place = np.concatenate([objective.modulus_map.columns, state.model.n_regions + np.arange(end - start)])
        metric = np.zeros((state.model.n_regions + end - start,) * 2)
        metric[np.ix_(place, place)] = evaluation.matrix[np.ix_(own, own)]
        found.append(metric)
        start = end
    return found


def _recentred(expansion: Expansion, equilibrium: FiniteStrainEquilibrium) -> Expansion:
    """The expansion around an equilibrium so near that its derivatives still hold there: a third of the price."""
    moduli, amounts = equilibrium.moduli, equilibrium.coefficients
    model = replace(expansion.reduced, moduli=moduli, coefficients=amounts, values=equilibrium.values)
    return Expansion(model, equilibrium, expansion.counts + equilibrium.counts)


def _lowers(place: _Place, equilibria: tuple[FiniteStrainEquilibrium, ...], unknowns: NDArray[np.float64]) -> bool:
    """Whether the objective at the true displacements, not the expansions', is lower than at the place.

    By its value, or by the work of its score along the way (the trapezoidal rule, 1/2 (s_0 + s_1) . step): the value
    has the noise of closest points that slide over voxels, the score has not.
    """
    pairs = zip(place.expansions, equilibria, strict=True)
    there, now = _around(place, tuple(_recentred(before, found) for before, found in pairs))(unknowns), place.minimum
    work = 0.5 * (there.score + now.evaluation.score) @ (unknowns - now.unknowns)
    return bool(there.value < now.evaluation.value + NOISE or work < 0.0)


def _split(
    objective: Objective, unknowns: NDArray[np.float64]
) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
    """Moduli (n_regions,) kPa and each state's coefficients (n_modes,)."""
    return objective.modulus_map.moduli(unknowns[: objective.n_parameters]), objective.coefficients(unknowns)


def _near(bounds: Bounds, theta: NDArray[np.float64]) -> Bounds:
    """The bounds, no further from theta (n_parameters,) than an expansion is trusted."""
    return Bounds(np.maximum(bounds.lower, theta - REACH), np.minimum(bounds.upper, theta + REACH))
