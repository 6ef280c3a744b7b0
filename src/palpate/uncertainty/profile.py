"""The profile of a modulus: what the images say of each of its values, the other moduli at their best.

An ellipse around the minimum takes the marginal posterior of the log-moduli, M (see `inversion.laplace`), for a
parabola. It is none where an organ is so stiff, or so soft, that its modulus hardly matters any more: there the profile
is flat on one side, and its interval leans that way. Of two moduli it is a region, drawn beside the ellipse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from palpate.errors import SolverError
from palpate.inversion import (
    Bounds,
    FixedCorrespondence,
    LinearisedObjective,
    MarginalMinimum,
    MarginalPosterior,
    Minimum,
    Objective,
    Outcome,
    fixed_correspondence,
    gauss_newton,
    posterior_sd,
    with_correlations,
    with_scales,
)

TRIALS = 12  # points on a ray from the estimate
DIRECTIONS = 16  # of a joint region
JOINT_LEVEL = float(np.sqrt(special.chdtri(2, 0.05)))  # root deviance on its boundary: two degrees of freedom
NEAR = 0.05  # of the level: accuracy of an end before the line through the last two points corrects it
NEARER = 0.02  # before the line through the minimum and the only point does
FURTHEST = 2.0  # largest extrapolation, times the distance of the last point
PASSES = 10
SETTLED = 0.02  # posterior standard deviations
TOLERANCE = 1e-6  # decrement of a minimum


@dataclass(frozen=True, slots=True)
class Profile:
    """Signed root deviance r (n,) at values theta (n,) of one log-modulus, both ascending.

    r^2 = 2 (min M(theta) - min M) / s with the ratio s of its variance to that of M's minimum: what is known of
    correlated residuals and of the voxels' place counts as in the ellipse, at whose ends r = 1.96 where M is a
    parabola. low, high: ln E where |r| is the level; None where the search's bound, or what cannot be solved, is
    reached before. outermost: all unknowns (n_unknowns,) at the last place on each side that has one.
    """

    theta: NDArray[np.float64]
    root: NDArray[np.float64]
    low: float | None
    high: float | None
    outermost: tuple[NDArray[np.float64], ...] = ()


def profile(
    marginal: MarginalPosterior, minimum: Minimum, number: int, *, variance: float, bounds: Bounds, level: float
) -> Profile:
    """The profile of the log-modulus with a `number`, as far as |r| = `level` or its bound, on both sides.

    `variance` of the log-modulus by all that is known (see `sandwich_covariance`). The deviance is scaled so that its
    curvature is one over that (Chandler & Bate, Biometrika 94 (2007) 167-183, section 3, vertically).
    """
    least = marginal.minimum(minimum.unknowns, bounds)
    scale = float(least.covariance[number, number]) / variance
    held, centre = np.arange(marginal.n_parameters) == number, float(least.minimum.unknowns[number])
    points, ends, outermost = [(centre, 0.0)], list[float | None](), list[NDArray[np.float64]]()
    for sign in (-1.0, 1.0):
        ray = Ray(marginal, least, sign * held, held, bounds, scale)
        found, end = ray.to_level(level, first=level * float(np.sqrt(variance)))
        points += [(centre + sign * distance, sign * root) for distance, root, _ in found]
        outermost += [unknowns for _, _, unknowns in found[-1:]]
        ends.append(None if end is None else centre + sign * end)
    ordered = np.array(sorted(points))
    return Profile(ordered[:, 0], ordered[:, 1], ends[0], ends[1], tuple(outermost))


RayPoint = tuple[float, float, NDArray[np.float64]]
"""Distance on a ray, root deviance r there, and all unknowns (n_unknowns,) at their best."""


@dataclass(frozen=True, slots=True)
class Ray:
    """A straight line of the log-moduli from a minimum of M, along which those that are not held are at their best.

    direction (n_parameters,): change of the log-moduli for a distance of 1; held (n_parameters,): which of them the ray
    holds; scale: that of the deviance 2 (min M - least M), whose root is r.
    """

    marginal: MarginalPosterior
    least: MarginalMinimum
    direction: NDArray[np.float64]
    held: NDArray[np.bool_]
    bounds: Bounds
    scale: float

    @property
    def bound(self) -> float:
        """The distance at which the search's bounds end it."""
        theta, along = self.least.minimum.unknowns[: len(self.direction)], self.direction != 0.0
        limits = np.where(self.direction > 0.0, self.bounds.upper, self.bounds.lower)
        return float(np.min((limits - theta)[along] / self.direction[along]))

    def _slope(self) -> NDArray[np.float64]:
        """Change (n_unknowns,) of all unknowns for a distance of 1 from the minimum; those that are not held follow.

        H_ff s_f = -H_fh s_h with the Gauss-Newton matrix H; a log-modulus at a bound stays.
        """
        n, evaluation = len(self.direction), self.least.minimum.evaluation
        slope = np.pad(self.direction, (0, len(evaluation.score) - n))
        still = self.held | self.bounds.reached(self.least.minimum.unknowns[:n])
        free = np.pad(~still, (0, len(slope) - n), constant_values=True)
        pulled = evaluation.matrix @ np.where(free, 0.0, slope)
        slope[free] = -evaluation.matrix.among(free).solve(pulled[free])
        return slope

    def to_level(self, level: float, *, first: float) -> tuple[list[RayPoint], float | None]:
        """Points on the ray, from the `first` distance on, and the distance where r is the level; None at the bound.

        The root deviance is nearly straight: the next point is where a line through the minimum and the last one, or
        through the last two around the level, meets it. A place at which the model cannot be solved ends the search as
        a bound does; so does one where the other unknowns did not come to a minimum and the deviance is above the
        level, for it may be less there, and the end further off. Where not even the estimate is a minimum under what is
        held, nothing is known of any end.
        """
        bound, n = self.bound, len(self.direction)
        least, points, inside, outside = self.least.minimum.unknowns, list[RayPoint](), (0.0, 0.0), None
        distance = first
        if bound <= 0.0 or not self.least.minimum.converged:
            return [], None
        slope = self._slope()
        for _ in range(TRIALS):
            at_bound, distance = distance >= bound, min(distance, bound)
            start = least + distance * slope
            start[:n] = np.clip(start[:n], self.bounds.lower, self.bounds.upper)
            try:
                found = self.marginal.minimum(start, self.bounds.fixed(start[:n], self.held))
            except SolverError:
                return points, None
            root = float(np.sqrt(max(2.0 * self.scale * (found.least - self.least.least), 0.0)))
            if not (found.minimum.converged or root < (1.0 - NEAR) * level):
                return points, None
            points.append((distance, root, found.minimum.unknowns))
            slope = (found.minimum.unknowns - least) / distance
            if abs(root - level) < (NEAR if len(points) > 1 else NEARER) * level:
                return points, _on_line(points, level)
            if root < level:
                if at_bound:
                    return points, None
                inside = (distance, root)
            else:
                outside = (distance, root)
            if outside is None:
                distance *= min(level / max(root, 1e-3), FURTHEST)
            else:
                (near, low), (far, high) = inside, outside
                distance = near + (far - near) * float(np.clip((level - low) / (high - low), 0.1, 0.9))
        return points, distance


def _on_line(points: Sequence[RayPoint], level: float) -> float:
    """Where a line through the last two points, or the minimum and the only one, meets the level of the root."""
    (near, low, _), (far, high, _) = points[-2:] if len(points) > 1 else ((0.0, 0.0, None), points[0])
    rise = (high - low) / (far - near)
    return far + (level - high) / (rise if rise > 0.1 * high / far else high / far)


def refitted(
    objective: Objective, minimum: Minimum, bounds: Bounds, *, max_steps: int = 40, passes: int = PASSES
) -> tuple[Minimum, FixedCorrespondence]:
    """The estimate that the residuals in a `minimum`'s evaluation lead to, and what it is the minimum of.

    Noise and unknowns in turn, until no log-modulus moves by 0.02 of its standard deviation, `passes` times at the
    most: where it still does, the minimum has the outcome `STEPS`. No model is solved. Raises `EstimationError` where
    the residuals leave an unknown open, `SolverError` where the approximation has no answer.
    """
    n, now = objective.n_parameters, minimum
    for _ in range(passes):
        objective = with_scales(with_correlations(objective, now.evaluation), now.evaluation)
        weighed = LinearisedObjective(objective, now.unknowns, now.evaluation)(now.unknowns)
        fixed = fixed_correspondence(objective, now.unknowns, weighed)
        before, now = now, gauss_newton(fixed, now.unknowns, bounds=bounds, tolerance=TOLERANCE, max_steps=max_steps)
        if np.all(np.abs(now.unknowns - before.unknowns)[:n] < SETTLED * posterior_sd(now, n)):
            return now, fixed
    return (replace(now, outcome=Outcome.STEPS) if now.converged else now), fixed


@dataclass(frozen=True, slots=True)
class JointRegion:
    """Boundaries (n_directions, 2) of ln E of the two log-moduli with these `numbers`, once around the estimate.

    boundary: by the profile likelihood; ellipse: of the covariance, in the same directions; open: whether the bounds of
    the search, or a place that cannot be solved, cut the former.
    """

    numbers: tuple[int, int]
    boundary: NDArray[np.float64]
    ellipse: NDArray[np.float64]
    open: bool


def joint_region(
    marginal: MarginalPosterior,
    minimum: Minimum,
    numbers: tuple[int, int],
    *,
    covariance: NDArray[np.float64],
    bounds: Bounds,
) -> JointRegion:
    """The region of two log-moduli around a minimum, in directions that are equally spaced on the ellipse.

    covariance (2, 2) of both by all that is known, V. Along a direction d the deviance is scaled by
    d^T V^-1 d / d^T G^-1 d, G the covariance of M's minimum, so that it ends where the ellipse does when
    the objective is a parabola (Chandler & Bate, Biometrika 94 (2007) 167-183, section 3, vertically). Where a bound is
    met before, the boundary lies there.
    """
    least, pair = marginal.minimum(minimum.unknowns, bounds), list(numbers)
    own, n = least.covariance[np.ix_(pair, pair)], marginal.n_parameters
    held = np.isin(np.arange(n), pair)
    centre, edge, cut, first = least.minimum.unknowns[pair], list[NDArray[np.float64]](), False, JOINT_LEVEL
    angles = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ np.linalg.cholesky(covariance).T  # V^-1 norm 1
    for along in directions:
        direction = np.zeros(n)
        direction[pair] = along
        ray = Ray(marginal, least, direction, held, bounds, 1.0 / float(along @ np.linalg.solve(own, along)))
        points, end = ray.to_level(JOINT_LEVEL, first=first)  # the boundary is smooth: from where the last one lay
        first = end or JOINT_LEVEL
        reached = end if end is not None else max((distance for distance, *_ in points), default=0.0)
        cut = cut or end is None
        edge.append(centre + reached * along)
    return JointRegion(numbers, np.array(edge), centre + JOINT_LEVEL * directions, cut)
