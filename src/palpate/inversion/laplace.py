"""Laplace's approximation of what is left of a posterior when all that acts on no modulus is integrated out.

Let t be the log-moduli and what else acts on moduli, y all other unknowns. Given t the residuals are linear in y, and
the integral over y is exact: of J(t, y) it leaves M(t) = min_y J + 1/2 ln det H_yy. Where soft organs leave the others
more room, its minimum is not that of J (Cox & Reid, J. R. Stat. Soc. B 49 (1987) 1). M has few coordinates: it is seen
at a place, and on either side of it along the axes in which the Gauss-Newton matrix of J is a unit matrix, as in
integrated nested Laplace approximations (Rue, Martino & Chopin, J. R. Stat. Soc. B 71 (2009) 319, section 6.1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.errors import SolverError
from palpate.inversion.frozen_posterior import Posterior
from palpate.inversion.objective import Evaluation
from palpate.inversion.optimise import Bounds, LeastSquares, Minimum, Outcome
from palpate.parallel import mapped
from palpate.unknowns.parameters import ParameterMap, Volume

ASIDE, FURTHEST = 1.0, 0.4  # from a place to either side: standard deviations of J, and ln E at most
LEAST = 0.25  # curvature of M over that of J by the Gauss-Newton matrix: of less, that of J counts
RISE = 0.1  # of M: a place where it is larger by more is too far
PLACES = 16  # at most, from one to the next of which a minimum is sought
NEAR = 0.1  # a step of fewer standard deviations from a place leads to the minimum
AT_ONCE = 0.8  # of ln E: a longer step is cut
RIDGE = 1e-12  # of correlations, which prevents a singular matrix


@dataclass(frozen=True, slots=True)
class MarginalMinimum:
    """The minimum of M, with all other unknowns at their best there.

    least: M; covariance (n_parameters, n_parameters): of theta, infinite where it moves nothing, or where bounds hold
    it; value: M + 1/2 ln det of its second derivatives; volume: how 1/2 ln det H_yy changes with t there.
    """

    minimum: Minimum
    least: float
    covariance: NDArray[np.float64]
    value: float
    volume: Volume


@dataclass(frozen=True, slots=True)
class MarginalPosterior:
    """M of an objective J; on_moduli (n,): numbers of the unknowns beside theta that act on moduli."""

    objective: LeastSquares
    on_moduli: NDArray[np.int64]

    @classmethod
    def of(cls, posterior: Posterior) -> MarginalPosterior:
        """That of a posterior, under its own prior."""
        parameters = replace(posterior.parameters, volume=None)
        return cls(posterior.with_prior(parameters), parameters.free_on_moduli)

    @property
    def n_parameters(self) -> int:
        """Number of log-moduli among the unknowns."""
        return self.objective.n_parameters

    def minimum(self, unknowns: NDArray[np.float64], bounds: Bounds, places: int = PLACES) -> MarginalMinimum:
        """The minimum of M, sought from unknowns (n_unknowns,) within bounds; raises as `seen_at_minimum`."""
        return self.seen_at_minimum(unknowns, bounds, places)[0]

    def seen_at_minimum(
        self, unknowns: NDArray[np.float64], bounds: Bounds, places: int = PLACES
    ) -> tuple[MarginalMinimum, Nearby]:
        """The minimum of M, and what is known around it.

        A step leads from each of some places to the minimum of the parabola there, half as far where M is larger.
        Raises `SolverError` where the model cannot be solved.
        """
        at, last = unknowns.copy(), None
        at[: self.n_parameters] = np.clip(at[: self.n_parameters], bounds.lower, bounds.upper)
        for left in reversed(range(places)):
            nearby = Nearby.of(self, at, bounds)
            parabola = nearby.parabola()
            if last is not None and parabola.value > last.value + RISE and left:
                at = 0.5 * (at + last.best)
                continue
            target, away = (parabola if last is None else parabola.bent(last)).minimum(bounds)
            if away < NEAR:
                break
            at, last = target, parabola
        outcome = Outcome.CONVERGED if away < NEAR else Outcome.STEPS
        if outcome.converged and len(nearby.moved) > 1:
            nearby = nearby.with_pairs(self)
            parabola = nearby.parabola()
            target, _ = parabola.minimum(bounds)
        return nearby.at_minimum(self, target, parabola, outcome), nearby


@dataclass(frozen=True, slots=True)
class Nearby:
    """M seen at a place and on either side of it along axes of t.

    moved (n,): numbers of t among the unknowns; others (n_unknowns,): which are integrated out, none of the log-moduli;
    axes U (n, n): columns with U^T S U = 1, S the Schur complement of the Gauss-Newton matrix, of what is known best
    first, which moves what is known less; steps (n,): how far along each; open (n,): those so long that bounds cut
    them; places (1 + 2 n, n_unknowns) with their evaluations: the centre, those before, and those behind, and, where it
    is seen with pairs, those to both sides along every two axes.
    """

    moved: NDArray[np.int64]
    others: NDArray[np.bool_]
    axes: NDArray[np.float64]
    steps: NDArray[np.float64]
    open: NDArray[np.bool_]
    places: NDArray[np.float64]
    evaluations: tuple[Evaluation, ...]

    @classmethod
    def of(cls, marginal: MarginalPosterior, unknowns: NDArray[np.float64], bounds: Bounds) -> Nearby:
        """It around unknowns (n_unknowns,), with the axes under its own prior."""
        n, centre = marginal.n_parameters, marginal.objective(unknowns)
        seen = np.flatnonzero((centre.matrix.diagonal[:n] > 0.0) & (bounds.upper > bounds.lower))
        moved = np.concatenate([seen, marginal.on_moduli])
        axes = _root(_covariance(centre, moved))
        longest = np.abs(axes[: len(seen)])
        room = bounds.room[seen, None] / np.sqrt(12.0)
        steps = np.minimum(ASIDE, FURTHEST / np.maximum(longest.max(axis=0, initial=0.0), FURTHEST))
        places = np.repeat(unknowns[None], 1 + 2 * len(moved), axis=0)
        aside = (axes * steps).T
        places[1:, moved] += np.concatenate([aside, -aside])
        evaluations = (centre, *mapped(marginal.objective, places[1:]))
        others = np.arange(len(unknowns)) >= n
        others[moved] = False
        return cls(moved, others, axes, steps, np.any(longest > room, axis=0), places, evaluations)

    def with_pairs(self, marginal: MarginalPosterior) -> Nearby:
        """The same with what it is along every two axes together."""
        n, (one, other) = len(self.moved), np.triu_indices(len(self.moved), 1)
        first, second = (
            np.concatenate([one, n + one, one, n + one]),
            np.concatenate([other, n + other, n + other, other]),
        )
        along = self.places[1 + first] + self.places[1 + second] - self.places[0]
        evaluations = (*self.evaluations, *mapped(marginal.objective, along))
        return replace(self, places=np.concatenate([self.places, along]), evaluations=evaluations)

    def with_prior(self, parameters: ParameterMap) -> Nearby:
        """The same under another prior of the unknowns."""
        pairs = zip(self.places, self.evaluations, strict=True)
        return replace(self, evaluations=tuple(seen.with_prior(parameters, place) for place, seen in pairs))

    def parabola(self) -> Parabola:
        """M around the place."""
        n, twice = len(self.moved), 2.0 * self.steps
        pairs = zip(self.places, self.evaluations, strict=True)
        every = [_Followed.of(seen, place, self.others) for place, seen in pairs]
        least, room = np.array([of.least for of in every]), np.array([of.room for of in every])

        def slopes(of: NDArray[np.float64]) -> NDArray[np.float64]:
            """By differences of both sides."""
            return np.asarray((of[1 : n + 1] - of[n + 1 : 2 * n + 1]) / twice)

        def curvatures(of: NDArray[np.float64]) -> NDArray[np.float64]:
            """By those of both sides and the centre."""
            return np.asarray((of[1 : n + 1] + of[n + 1 : 2 * n + 1] - 2.0 * of[0]) / self.steps**2)

        told = ~self.open  # on a plain any slope of the room would lead to a bound
        slope, bend = slopes(least) + told * slopes(room), curvatures(least) + told * curvatures(room)
        inverse = np.linalg.inv(self.axes)
        gauss_newton = np.linalg.inv(inverse @ _covariance(self.evaluations[0], self.moved) @ inverse.T)
        own = np.diag(gauss_newton)
        longer = np.sqrt(np.where(told & (bend > LEAST * own), bend, own) / own)
        best = np.stack([of.best for of in every])
        follow = (best[1 : n + 1] - best[n + 1 : 2 * n + 1]).T / twice
        bend = longer[:, None] * gauss_newton * longer
        if len(least) > 2 * n + 1:
            whole, (one, other) = least + np.where(told.all(), room, 0.0), np.triu_indices(n, 1)
            alike, unlike = whole[2 * n + 1 :].reshape(2, 2, -1).sum(axis=1)
            seen = np.diag(np.diag(bend))
            seen[one, other] = seen[other, one] = 0.25 * (alike - unlike) / (self.steps[one] * self.steps[other])
            bend = seen if np.linalg.eigvalsh(seen / np.sqrt(np.outer(*(np.diag(bend),) * 2)))[0] > LEAST else bend
        return Parabola(self.moved, self.axes, least[0] + room[0], slope, bend, told * slopes(room), best[0], follow)

    def at_minimum(
        self, marginal: MarginalPosterior, unknowns: NDArray[np.float64], parabola: Parabola, outcome: Outcome
    ) -> MarginalMinimum:
        """What is stated of M at its minimum, unknowns (n_unknowns,)."""
        n, numbers, there = marginal.n_parameters, marginal.on_moduli, marginal.objective(unknowns)
        seen, room = len(self.moved) - len(numbers), np.linalg.solve(self.axes.T, parabola.room)
        slope, covariance = np.zeros(n), np.diag(np.full(n, np.inf))
        slope[self.moved[:seen]] = room[:seen]
        volume = Volume(np.append(slope, room[seen:]), np.append(unknowns[:n], unknowns[numbers]), numbers)
        found = _Followed.of(there, unknowns, self.others)
        of_t = self.axes @ np.linalg.solve(parabola.bend, self.axes.T)
        covariance[np.ix_(self.moved[:seen], self.moved[:seen])] = of_t[:seen, :seen]
        least = found.least + found.room
        minimum = Minimum(found.best, there, outcome, (), len(self.evaluations) + 1)
        value = least - 0.5 * float(np.linalg.slogdet(of_t)[1])
        return MarginalMinimum(minimum, least, covariance, value, volume)


@dataclass(frozen=True, slots=True)
class Parabola:
    """M(U xi) = value + slope . xi + 1/2 xi . B xi along the axes U of t, B `bend`; the others `best` + `follow` xi.

    B (n, n) has second differences of M, or of these its diagonal and the correlations of the Gauss-Newton matrix.
    room (n,): the part of the slope that is of 1/2 ln det H_yy; best (n_unknowns,), follow (n_unknowns, n).
    """

    moved: NDArray[np.int64]
    axes: NDArray[np.float64]
    value: float
    slope: NDArray[np.float64]
    bend: NDArray[np.float64]
    room: NDArray[np.float64]
    best: NDArray[np.float64]
    follow: NDArray[np.float64]

    def bent(self, last: Parabola) -> Parabola:
        """The same with the curvature that the slope here and at the last place tell of the way between them.

        By one update of Broyden, Fletcher, Goldfarb and Shanno (Nocedal & Wright 2006, section 6.1): in a valley that
        winds the correlations of the Gauss-Newton matrix are not those of M.
        """
        step = np.linalg.solve(self.axes, self.best[self.moved] - last.best[self.moved])
        change = self.slope - self.axes.T @ np.linalg.solve(last.axes.T, last.slope)
        told, before = float(change @ step), self.bend @ step
        if told <= LEAST * float(step @ before):
            return self
        bend = self.bend - np.outer(before, before) / float(step @ before) + np.outer(change, change) / told
        return replace(self, bend=bend)

    def minimum(self, bounds: Bounds) -> tuple[NDArray[np.float64], float]:
        """All unknowns (n_unknowns,) at its minimum within bounds, and the longest step along an axis to it.

        A log-modulus that a bound stops stays there, and the others follow.
        """
        n, count = len(bounds.lower), len(self.moved)
        theta = self.moved[self.moved < n]
        low, high = np.full(count, -np.inf), np.full(count, np.inf)
        low[: len(theta)] = np.maximum(bounds.lower[theta] - self.best[theta], -AT_ONCE)
        high[: len(theta)] = np.minimum(bounds.upper[theta] - self.best[theta], AT_ONCE)
        inverse = np.linalg.inv(self.axes)
        away, free = np.linalg.solve(self.bend, -self.slope), np.ones(count, dtype=bool)
        step = self.axes @ away
        while np.any(beyond := free & ((step < low) | (step > high))):
            step[beyond], free = np.clip(step, low, high)[beyond], free & ~beyond
            stiff, pull = inverse.T @ self.bend @ inverse, inverse.T @ self.slope
            rest = -pull - stiff[:, ~free] @ step[~free]
            step[free] = np.linalg.solve(stiff[np.ix_(free, free)], rest[free])
        away = inverse @ step
        at = self.best + self.follow @ away
        at[self.moved] = self.best[self.moved] + step
        at[theta] = np.clip(at[theta], bounds.lower[theta], bounds.upper[theta])
        return at, float(np.abs(away).max(initial=0.0))


@dataclass(frozen=True, slots=True)
class _Followed:
    """J with some unknowns at their best, all unknowns (n_unknowns,) there, and 1/2 ln det H_yy of these."""

    least: float
    best: NDArray[np.float64]
    room: float

    @classmethod
    def of(cls, there: Evaluation, unknowns: NDArray[np.float64], others: NDArray[np.bool_]) -> _Followed:
        """That of an evaluation at unknowns (n_unknowns,) whose `others` (n_unknowns,) follow: J is a parabola."""
        matrix, score, best = there.matrix.among(others).grounded(), there.score[others], unknowns.copy()
        eliminated = matrix.eliminated()
        halves, right = eliminated.right(-score)
        step = eliminated.followed(halves, np.asarray(np.linalg.solve(eliminated.left, right)))
        best[others] += step
        return cls(there.value + 0.5 * float(score @ step), best, 0.5 * eliminated.log_determinant())


def _covariance(there: Evaluation, numbers: NDArray[np.int64]) -> NDArray[np.float64]:
    """Of unknowns with these numbers (n,), all others at their best: (n, n), by the Gauss-Newton matrix.

    Raises `SolverError` where that is so near to singular that rounding leaves negative variances.
    """
    unit = np.zeros((there.matrix.size, len(numbers)))
    unit[numbers, np.arange(len(numbers))] = 1.0
    found = np.asarray(there.matrix.grounded().solve(unit)[numbers])
    if not (np.diag(found) > 0.0).all():
        raise SolverError("the Gauss-Newton matrix is singular to rounding; the motion there is none of a body")
    return found


def _root(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """U (n, n) with U U^T a covariance (n, n), triangular once the smallest variances stand first."""
    sd, found = np.sqrt(np.diag(covariance)), np.zeros(covariance.shape)
    order = np.argsort(sd, kind="stable")
    scaled = (covariance / np.outer(sd, sd))[np.ix_(order, order)]
    found[order] = sd[order, None] * np.linalg.cholesky(0.5 * (scaled + scaled.T) + RIDGE * np.eye(len(sd)))
    return found
