"""How much each residual counts: by the law of the residuals, robustly, and only where surfaces face each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.inversion.driver_prior import learned_prior
from palpate.inversion.gauss_newton import Minimum
from palpate.inversion.noise import NoiseLaw, fit_noise_law
from palpate.inversion.objective import Evaluation, Linearisation, LocalModel, Objective, State, Weighting
from palpate.inversion.problem import InverseProblem
from palpate.inversion.tukey import Tukey
from palpate.observation.misfit import Correspondence
from palpate.observation.target import SurfaceTarget

__all__ = [
    "EXACT_LAW",
    "SEGMENTATION_LAW",
    "first_law",
    "objective_of",
    "residual_law",
    "reweighted",
    "robust_loss",
    "weighed_anew",
]

TUKEY = 4.685  # cutoff in standard deviations, 95 % efficient for normal errors (Huber 1981)
MAD = 1.4826  # standard deviations of a normal law in one median absolute deviation
LEAST_CUTOFF = 5e-3  # mm
EXACT_LAW = NoiseLaw(np.array([0.03**2]), np.array([3.0]))  # of surfaces that no image has rounded
SEGMENTATION_LAW = NoiseLaw(np.array([0.3**2]), np.array([3.0]))  # of segmentations of which nothing is known


def first_law(problem: InverseProblem) -> NoiseLaw:
    """Law of the residuals until they tell: the rounding of both images' voxels; without any, `EXACT_LAW`.

    Voxels of edge h round a surface by a variance of h^2 / 12 a voxel, which a Gaussian of width sigma spreads:
    h^4 / (48 pi sigma^2) for each image, with the correlation length sqrt(2) sigma. The residuals that are left put too
    small a law right; too large a one leaves motion of the drivers in the residuals, which then passes for noise.
    """
    maps = [image for targets in problem.targets for t in targets for image in t.voxels or ()]
    if not maps:
        return EXACT_LAW
    variances = [m.grid.voxel_volume ** (4.0 / 3.0) / (48.0 * np.pi * m.smoothing_mm**2) for m in maps]
    width = float(np.mean([m.smoothing_mm for m in maps]))
    return NoiseLaw(np.array([2.0 * float(np.mean(variances))]), np.array([np.sqrt(2.0) * width]))


def objective_of(
    problem: InverseProblem,
    models: tuple[LocalModel, ...],
    law: NoiseLaw,
    prior: NDArray[np.float64] | None = None,
) -> Objective:
    """The objective of the models, one for each later image; all residuals count, by their `law`.

    prior (n_coefficients, n_coefficients): precision of all the drivers' coefficients; None: the modes' own.
    """
    states = tuple(State(model, targets) for model, targets in zip(models, problem.targets, strict=True))
    return Objective(states, problem.modulus_map, _all_by_the_law(states, law), prior).under(models)


def weighed_anew(
    problem: InverseProblem, objective: Objective, minimum: Minimum, law: NoiseLaw | None = None
) -> tuple[NoiseLaw, Objective]:
    """What the residuals at a minimum of `objective` say: their law (None: fitted), the drivers' prior, their weights.

    The next minimum is sought under the objective that is returned; an estimate has settled when that is the same.
    """
    law = law or residual_law(problem, minimum.evaluation)
    prior = learned_prior(problem, minimum.evaluation, minimum.unknowns)
    by_law = replace(objective, weighting=_all_by_the_law(objective.states, law), prior=prior)
    return law, reweighted(by_law, minimum, law)


def _all_by_the_law(states: tuple[State, ...], law: NoiseLaw) -> tuple[tuple[Weighting, ...], ...]:
    """All residuals of each state's surfaces count, by their law."""
    noise = law.sd**2 * law.correlation_area
    return tuple(
        tuple(Weighting(_precision(t, law), Tukey(), _all_of(t), noise) for t in state.targets) for state in states
    )


def _all_of(target: SurfaceTarget) -> Correspondence:
    """Every image point, until the model is near enough to choose."""
    n = len(target.image_points)
    return Correspondence(np.ones(n, dtype=bool), np.zeros(n), np.zeros(len(target.surface.rest)))


def _precision(target: SurfaceTarget, law: NoiseLaw) -> float:
    """Weight (mm^-2) of a surface's mean square: its independent residuals, by their variance."""
    return max(float(target.area.sum()) / law.correlation_area, 1.0) / law.sd**2


def reweighted(objective: Objective, minimum: Minimum, law: NoiseLaw) -> Objective:
    """Robust losses from the residuals at a minimum, and image points chosen anew there.

    A surface that fits worse than the law of the residuals (a driver whose modes cannot follow its wall) counts by its
    own mean square, so that its misfit is not forced into the other unknowns.
    """
    lines = iter(minimum.evaluation.surfaces)
    weighting = tuple(
        tuple(_weighting_of(next(lines), weighting, law) for weighting in weightings)
        for weightings in objective.weighting
    )
    return replace(objective, weighting=weighting).with_fresh_correspondence(minimum.unknowns)


def _weighting_of(line: Linearisation, weighting: Weighting, law: NoiseLaw) -> Weighting:
    values = line.residuals.values
    loss = robust_loss(values, line.target)
    inside = ~loss.rejects(values)
    mean_square = float(np.average(values[inside] ** 2, weights=line.residuals.weights[inside]))
    share = min(1.0, law.sd**2 / max(mean_square, 1e-12))
    return replace(weighting, loss=loss, precision=weighting.precision * share)


def robust_loss(values: NDArray[np.float64], target: SurfaceTarget) -> Tukey:
    """Tukey's biweight for residuals (n,) mm of one surface: its cutoff is 4.685 of their standard deviations.

    Up to the edge of a voxel (half of each image's; root mean square of the three edges) all count fully: so far can
    rounding move a surface that runs along the grids, and terraces that flip as a whole are no outliers. They are rare
    and large and carry the motion of a surface that else seems to stand still: if they counted less than what is quiet,
    every motion would be found too small.
    """
    spread = MAD * float(np.median(np.abs(values)))
    return Tukey(max(TUKEY * spread, LEAST_CUTOFF), _rounding(target))


def _rounding(target: SurfaceTarget) -> float:
    """How far (mm) the rounding of both images' voxels can set a surface off."""
    return float(sum(0.5 * np.sqrt(np.mean(image.grid.spacing**2)) for image in target.voxels or ()))


def residual_law(problem: InverseProblem, evaluation: Evaluation) -> NoiseLaw:
    """Law of the residuals of the `estimate` tissues; the driver's own are flattened by its many unknowns."""
    seen = [s.residuals for s in evaluation.surfaces if s.target.surface.name in problem.estimated]
    return fit_noise_law([r.values for r in seen], [r.places for r in seen], [r.normals for r in seen])
