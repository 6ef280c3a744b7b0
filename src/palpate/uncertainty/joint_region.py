"""The joint 95 % region of two moduli: where the profile likelihood of both ends, beside the ellipse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from palpate.inversion import Bounds, LeastSquares, Minimum, gauss_newton
from palpate.uncertainty.profile import Ray

DIRECTIONS = 16
LEVEL = float(np.sqrt(special.chdtri(2, 0.05)))  # root deviance on the boundary: chi-squared of two degrees of freedom


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
    fixed: LeastSquares,
    minimum: Minimum,
    numbers: tuple[int, int],
    *,
    covariance: NDArray[np.float64],
    bounds: Bounds,
) -> JointRegion:
    """The region of two log-moduli around a minimum, in directions that are equally spaced on the ellipse.

    covariance (2, 2) of both by all that is known, V. Along a direction d the deviance is scaled by
    d^T V^-1 d / d^T G^-1 d, G the covariance of the Gauss-Newton matrix, so that it ends where the ellipse does when
    the objective is a parabola (Chandler & Bate, Biometrika 94 (2007) 167-183, section 3, vertically). Where a bound is
    met before, the boundary lies there.
    """
    least, pair = gauss_newton(fixed, minimum.unknowns, bounds=bounds, tolerance=1e-6), list(numbers)
    own = least.evaluation.covariance_columns(fixed.n_parameters)[np.ix_(pair, pair)]
    held = np.isin(np.arange(fixed.n_parameters), pair)
    centre, edge, cut = least.unknowns[pair], list[NDArray[np.float64]](), False
    angles = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ np.linalg.cholesky(covariance).T  # V^-1 norm 1
    for along in directions:
        direction = np.zeros(fixed.n_parameters)
        direction[pair] = along
        ray = Ray(fixed, least, direction, held, bounds, 1.0 / float(along @ np.linalg.solve(own, along)))
        points, end = ray.to_level(LEVEL, first=LEVEL)
        reached = end if end is not None else max((distance for distance, _ in points), default=0.0)
        cut = cut or end is None
        edge.append(centre + reached * along)
    return JointRegion(numbers, np.array(edge), centre + LEVEL * directions, cut)
