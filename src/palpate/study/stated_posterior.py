"""The posterior on which all that is stated of an inversion rests, its models exact as far as intervals go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.contract import updated
from palpate.errors import SolverError
from palpate.inversion import Bounds, Inversion, Minimum, Objective, Posterior, cheapest_posterior
from palpate.parallel import mapped
from palpate.uncertainty import NORMAL_95, Covariance, StatedMixture, modulus_interval, stated_mixture

ROUNDS = 3  # largest number of times that models are made exact where profiles end
STAYS = 0.1  # of the half-width: largest change of an end with which the rounds stop


@dataclass(frozen=True, slots=True)
class StatedPosterior:
    """The posterior of the likeliest explanation, frozen, its minimum, and the mixture over all of them."""

    frozen: Posterior
    minimum: Minimum
    mixture: StatedMixture

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance (n, n) of the parameters under the likeliest explanation, by all that is known."""
        return np.asarray(self.mixture.covariances[0])


def as_stated(inversion: Inversion, own: Covariance, bounds: Bounds) -> StatedPosterior:
    """What is stated; own: the covariance of the likeliest explanation by all causes (see `covariance_of`)."""
    objective, minimum = inversion.objective, inversion.minimum
    mixture = stated_mixture(inversion.mixture, own, objective.parameters.blocks)
    frozen = cheapest_posterior(objective, minimum.unknowns, minimum.evaluation)
    return exact_at_ends(StatedPosterior(frozen, inversion.mixture.minimum, mixture), objective, bounds)


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
            there = [least.evaluation]
            asked.append(objective.linearisation_points(least.unknowns, there, all_material=False))
        try:
            for points in asked:
                models = updated(models, points)
        except SolverError:
            break
        bent = objective.bent_as(models)
        exact = cheapest_posterior(bent, least.unknowns, bent(least.unknowns))
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
