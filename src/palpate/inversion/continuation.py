"""From the linear estimate to that of a finite-strain law: Gauss-Newton on expansions around true equilibria.

The linear law is off by tens of per cent where a wall moves by half its radius, but near enough to begin. Each round
minimises the objective on an expansion to first order around the present equilibrium and solves the equilibrium where
that leads; where it does not lower the objective the step is halved. One factorisation, made near the first
equilibrium, gives all derivatives there and serves every solve. Near the estimate the derivatives along the directions
that decide the moduli, which is all that these need to first order, are made those of the equilibrium there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from palpate.errors import NotConverged
from palpate.inversion.agreement import AGREED, agreed, left_since
from palpate.inversion.directions import deciding_directions
from palpate.inversion.gauss_newton import Bounds, Minimum, Outcome
from palpate.inversion.minima import SETTLED, change_between, moved_between, posterior_sd, words
from palpate.inversion.noise import NoiseLaw
from palpate.inversion.objective import Evaluation, Objective
from palpate.inversion.problem import InverseProblem, Inversion, InversionSettings, StandIn
from palpate.inversion.wall_refinement import REFINEMENTS, refined_walls
from palpate.mechanics.equilibrium import from_start
from palpate.mechanics.finite_strain import FiniteStrainEquilibrium, FiniteStrainModel
from palpate.mechanics.first_order import FirstOrderModel
from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.solvers.contract import Factorisation
from palpate.mesh.constraint import Constraint

__all__ = ["Expansion", "continued_at_finite_strain"]

ROUNDS = 16
NEAR = 0.5  # posterior standard deviations: a round that moves less ends where derivatives are worth making exact
FORCING = 0.1  # of a round's change: to which the next one's weights and estimate agree
RESOLVED = 1e-5  # of ln E: what exact surfaces tell
REACH = 0.8  # of ln E, within which an expansion is trusted
HALVINGS = 3
NOISE = 0.5  # of the objective, in units of log-likelihood: the noise of re-chosen closest points
COARSE, ROUGH = 3e-2, 1e-4  # of the forces: for a first factorisation; for all rounds but the last
FEW = 24  # moduli and modes, all of whose derivatives cost less than the rounds that they spare


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
    """Where the last round led: a point under the objective made of the expansions around the equilibria there.

    change: of ln E by that round, at the most, or by the last pass of its weights and estimate where that is more;
    moved: the same in posterior standard deviations; sharp (n_parameters,): ln E where the expansions' derivatives were
    made exact, None while they have not been; final: whether another round, if it changes ln E by as much less than
    this one as this one did than the one before, changes it by no more than `AGREED` and `SETTLED` standard
    deviations.
    """

    objective: Objective
    minimum: Minimum
    expansions: tuple[Expansion, ...]
    law: NoiseLaw
    change: float = np.inf
    moved: float = np.inf
    sharp: NDArray[np.float64] | None = None
    final: bool = False

    @property
    def theta(self) -> NDArray[np.float64]:
        """The log-moduli (n_parameters,) there."""
        return self.minimum.unknowns[: self.objective.n_parameters]

    @property
    def settled(self) -> bool:
        """Whether another round would move the log-moduli by little."""
        return self.change < AGREED or self.moved < SETTLED

    def under(self, expansions: tuple[Expansion, ...], minimum: Minimum) -> _Place:
        """The place with the objective on other expansions, at the unknowns of `minimum`."""
        objective = self.objective.under([expansion.reduced for expansion in expansions])
        there = replace(minimum, evaluation=objective(minimum.unknowns))
        return replace(self, objective=objective, minimum=there, expansions=expansions)

    def weighed(self, law: NoiseLaw, objective: Objective) -> _Place:
        """The place under other weights."""
        there = replace(self.minimum, evaluation=objective(self.minimum.unknowns))
        return replace(self, objective=objective, minimum=there, law=law)


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
    models = tuple(model.to_tolerance(ROUGH) for model in problem.finite_strain)
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
    objective = linear.objective.under([e.reduced for e in expansions]).with_fresh_correspondence(start.unknowns)
    first = replace(start, evaluation=objective(start.unknowns), history=())
    place, refinements = _Place(objective, first, expansions, linear.law), 0
    for number in range(ROUNDS):
        progress(f"finite strain, round {number + 1}: {words(problem, place.minimum)}")
        before, place = place, _round(problem, place, settings)
        if place.final:
            done = refinements == REFINEMENTS or number == ROUNDS - 1
            finer = place if done else _with_finer_walls(problem, place)
            if finer is place:
                break
            place, refinements = finer, refinements + 1
        elif place.minimum.unknowns is before.minimum.unknowns:
            break
    return _at_equilibria(problem, place)


def _with_finer_walls(problem: InverseProblem, place: _Place) -> _Place:
    """The place with finer motions of the drivers' walls, where their surfaces ask for it, else the same."""
    constraints = tuple(expansion.constraint for expansion in place.expansions)
    finer = refined_walls(problem, constraints, place.minimum.evaluation.surfaces, place.law)
    if all(a is b for a, b in zip(constraints, finer, strict=True)):
        return place
    expansions = tuple(_constrained(*pair) for pair in zip(place.expansions, finer, strict=True))
    return replace(place, moved=np.inf, sharp=None, final=False).under(expansions, place.minimum)


def _constrained(expansion: Expansion, constraint: Constraint) -> Expansion:
    """The expansion around the equilibrium that another offset of what is prescribed leads to."""
    before = expansion.equilibrium
    model, start = before.model.under(constraint), before.displacement
    found = from_start(model, before.moduli, before.coefficients, start=start, nearby=before.factorisation)
    return _recentred(expansion, found)


def _at_equilibria(problem: InverseProblem, place: _Place) -> _Place:
    """The place at its exact equilibria, for the rounds' own were found to what a step needs, with its outcome."""
    minimum = place.minimum
    if not place.settled and minimum.outcome.converged:
        minimum = replace(minimum, outcome=Outcome.STEPS)
    moduli, amounts = _split(place.objective, minimum.unknowns)
    expansions = []
    for model, before, q in zip(problem.finite_strain, place.expansions, amounts, strict=True):
        near, exact = before.equilibrium, model.under(before.constraint)
        found = from_start(exact, moduli, q, start=near.displacement, nearby=near.factorisation)
        expansions.append(_recentred(before, found))
    return place.under(tuple(expansions), minimum)


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


def _round(problem: InverseProblem, place: _Place, settings: InversionSettings) -> _Place:
    """Weights and estimate on the present expansions, the equilibria there, or on a part of the way to it.

    They are sought together to a tenth of what the last round changed, at the first to what one pass gives. Where no
    part of the way lowers the objective the place stays, its minimum `STALLED` when the whole way is within the
    estimate's own noise and `STUCK` when not.
    """
    now, n, before = place.minimum, place.objective.n_parameters, place.change
    reach = replace(settings, bounds=_near(settings.bounds, place.theta))
    within = max(AGREED, FORCING * place.change)
    end = agreed(problem, place.objective, now, reach, within=within)
    place, found = place.weighed(end.law, end.objective), end.minimum
    change = float(change_between(now, found, n).max(initial=end.change))
    moved = max(moved_between(now, found, n), end.moved)
    lower = _lower(place, found.unknowns - now.unknowns)
    if lower is None:
        outcome = Outcome.STALLED if moved < SETTLED else Outcome.STUCK
        return replace(place, minimum=replace(now, outcome=outcome), change=change, moved=moved)
    unknowns, equilibria = lower
    expansions = tuple(_recentred(*pair) for pair in zip(place.expansions, equilibria, strict=True))
    there = replace(found, unknowns=unknowns)
    wanted = np.clip(SETTLED * posterior_sd(found, n).min(initial=np.inf), RESOLVED, AGREED)
    agree = end.change < AGREED and left_since(place.sharp, there, n) < AGREED
    arrived = replace(place, change=change, moved=moved, final=agree and _next(change, before) < wanted)
    few = all(e.reduced.n_regions + e.reduced.n_modes <= FEW for e in expansions)
    if not arrived.final and (moved < NEAR or few):
        expansions = _sharpened(place.objective, found.evaluation, expansions)
        arrived = replace(arrived, sharp=unknowns[:n])
    return arrived.under(expansions, there)


def _next(change: float, before: float) -> float:
    """By how much another round would change ln E, if that shrinks as it did from `before` to `change`."""
    return change * min(change / before, 1.0) if 0.0 < before < np.inf else change


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
    there = place.objective.under([_recentred(before, found).reduced for before, found in pairs])(unknowns)
    now = place.minimum
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
