"""The posteriors on which all that is stated of an inversion rests, their models exact as far as intervals go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.contract import updated
from palpate.errors import SolverError
from palpate.inversion import Bounds, FrozenPosterior, Inversion, Minimum, Objective, frozen_posterior
from palpate.parallel import mapped
from palpate.uncertainty import NORMAL_95, Covariance, modulus_interval, sandwich_covariance

ROUNDS = 3  # largest number of times that models are made exact where profiles end
STAYS = 0.1  # of the half-width: largest change of an end with which the rounds stop


@dataclass(frozen=True, slots=True)
class StatedPosterior:
    """One that is stated: frozen, its minimum, and the covariance (n, n) of its parameters by all that is known."""

    frozen: FrozenPosterior
    minimum: Minimum
    covariance: NDArray[np.float64]


def stated_posteriors(
    inversion: Inversion, bonded: Covariance, bounds: Bounds
) -> tuple[Covariance, tuple[StatedPosterior, ...]]:
    """The covariance by all causes, and the posteriors, the widest last.

    The first is that of the estimate, with its own covariance (`bonded`, where blocks are held that may be free); the
    other, where such blocks were released, is about the minimum with them free, and has what they add.
    """
    objective, minimum = inversion.objective, inversion.minimum
    fixed = frozen_posterior(objective, minimum.unknowns, minimum.evaluation)
    first = StatedPosterior(fixed, minimum, bonded.total)
    if (released := inversion.released) is None:
        return bonded, (exact_at_ends(first, objective, bounds),)
    sandwich = sandwich_covariance(released.objective, released.minimum.evaluation)
    covariance = bonded.with_released(objective, minimum.evaluation, sandwich)
    free = frozen_posterior(released.objective, released.minimum.unknowns, released.minimum.evaluation)
    second = StatedPosterior(free, released.minimum, covariance.total)
    return covariance, (first, exact_at_ends(second, released.objective, bounds))


def exact_at_ends(posterior: StatedPosterior, objective: Objective, bounds: Bounds) -> StatedPosterior:
    """A posterior whose reduced models are exact where its profiles end, far from where the estimate asked for it.

    The displacement is added to the basis at the outermost place of every profile, and once more where that moves by a
    tenth of the half-width. Of an expansion, exact at one place alone, it is the linear law's basis, as which it bends,
    and which lacks the derivatives that decide there: they are taken from it. The posterior stays as it is without one,
    or where its full model cannot be solved there. objective: that of the posterior, with its models.
    """
    models, least = objective.bends_as, posterior.minimum
    if not least.converged or any(np.isfinite(model.trust_radius) for model in models):
        return posterior
    half = NORMAL_95 * np.sqrt(np.diag(posterior.covariance))
    known: Mapping[tuple[int, bool], NDArray[np.float64]] = {}
    for _ in range(ROUNDS):
        found = _outermost(posterior, objective.n_parameters, bounds)
        moved = {
            (k, above): x
            for (k, above), x in found.items()
            if (k, above) not in known or abs(x - known[k, above])[k] > STAYS * half[k]
        }
        if not moved:
            break
        asked = [objective.linearisation_points(x) for x in moved.values()]
        if not known and any(state.bending for state in objective.states):
            asked.append(objective.linearisation_points(least.unknowns, least.evaluation, all_material=False))
        try:
            for points in asked:
                models = updated(models, points)
        except SolverError:
            break
        exact = frozen_posterior(objective.bent_as(models), least.unknowns)
        posterior, known = replace(posterior, frozen=exact), {**known, **moved}
    return posterior


def _outermost(
    posterior: StatedPosterior, n_parameters: int, bounds: Bounds
) -> dict[tuple[int, bool], NDArray[np.float64]]:
    """All unknowns (n_unknowns,) at the outermost places of each log-modulus' profile, by its number and side."""
    variances, least = np.diag(posterior.covariance), posterior.minimum

    def places(k: int) -> tuple[NDArray[np.float64], ...]:
        """Those of one of them."""
        of = modulus_interval(posterior.frozen, least, k, variance=float(variances[k]), bounds=bounds)
        return of.profile.outermost

    each = enumerate(mapped(places, range(n_parameters)))
    return {(k, bool(x[k] > least.unknowns[k])): x for k, of in each for x in of}
