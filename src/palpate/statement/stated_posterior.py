"""The posterior on which all that is stated of an inversion rests, its models exact as far as intervals go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.contract import Approximation, LinearisationPoint, updated
from palpate.errors import SolverError
from palpate.inversion import (
    Bounds,
    Inversion,
    MarginalPosterior,
    Minimum,
    Objective,
    Posterior,
    cheapest_posterior,
)
from palpate.parallel import mapped
from palpate.uncertainty import (
    NORMAL_95,
    Covariance,
    ModulusInterval,
    StatedMixture,
    modulus_interval,
    stated_mixture,
)

ROUNDS = 3  # largest number of times that models are made exact where profiles end
MISSED = 1e-2  # of the displacement, in energy: error up to which a model is exact; it moves ends by a few hundredths
STAYS = 0.1  # of the half-width: largest change of an end with which the rounds stop


@dataclass(frozen=True, slots=True)
class StatedPosterior:
    """The posterior of the likeliest explanation, frozen, its minimum, and the mixture over all of them.

    intervals: of each parameter, by that explanation alone; none where nothing converged. objective: what was frozen.
    """

    frozen: Posterior
    minimum: Minimum
    mixture: StatedMixture
    intervals: tuple[ModulusInterval, ...] = ()
    objective: Objective | None = None

    @property
    def marginal(self) -> MarginalPosterior:
        """That of what acts on moduli."""
        return MarginalPosterior.of(self.frozen)

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance (n, n) of the parameters under the likeliest explanation, by all that is known."""
        return np.asarray(self.mixture.covariances[0])


def as_stated(inversion: Inversion, own: Covariance, bounds: Bounds) -> StatedPosterior:
    """What is stated; own: the covariance of the likeliest explanation by all causes (see `covariance_of`)."""
    objective, minimum = inversion.objective, inversion.minimum
    mixture = stated_mixture(inversion.mixture, own, objective.parameters.blocks)
    frozen = cheapest_posterior(objective, minimum.unknowns, minimum.evaluation)
    least = MarginalPosterior.of(frozen).minimum(inversion.mixture.minimum.unknowns, bounds).minimum
    posterior = StatedPosterior(frozen, least, mixture, objective=objective)
    return exact_at_ends(profiled(posterior, bounds), objective, bounds) if minimum.converged else posterior


def profiled(posterior: StatedPosterior, bounds: Bounds) -> StatedPosterior:
    """The same with the intervals that its profiles tell."""
    variances, of = enumerate(np.diag(posterior.covariance).tolist()), (posterior.marginal, posterior.minimum)
    found = mapped(lambda one: modulus_interval(*of, one[0], variance=one[1], bounds=bounds), variances)
    return replace(posterior, intervals=tuple(found))


def exact_at_ends(posterior: StatedPosterior, objective: Objective, bounds: Bounds) -> StatedPosterior:
    """A posterior whose reduced models are exact where its profiles end, far from where the estimate asked for it.

    The displacement at the outermost place of a profile is added to the bases of a body whose first one misses more
    than a hundredth of it, and once more where that place moves by a tenth of the half-width. Of an expansion, exact at
    one place alone, it is the linear law's basis, as which it bends, and which lacks the derivatives that decide there:
    they are taken from it. The posterior stays as it is without a basis, or where its full model cannot be solved
    there. objective: that of the posterior, with its models.
    """
    models, least = objective.bends_as, posterior.minimum
    if not least.converged or any(np.isfinite(model.trust_radius) for model in models):
        return posterior
    half = NORMAL_95 * np.sqrt(np.diag(posterior.covariance))
    known: Mapping[tuple[int, bool], NDArray[np.float64]] = {}
    for _ in range(ROUNDS):
        found = {
            (k, bool(x[k] > least.unknowns[k])): x
            for k, of in enumerate(posterior.intervals)
            for x in of.profile.outermost
        }
        moved = {
            (k, above): x
            for (k, above), x in found.items()
            if (k, above) not in known or abs(x - known[k, above])[k] > STAYS * half[k]
        }
        before, asked = models, [objective.linearisation_points(x) for x in moved.values()]
        try:
            for points in asked:
                models = _exact_enough(objective, models, points)
            if not known and any(state.bending for state in objective.states):
                there = objective.linearisation_points(least.unknowns, [least.evaluation], all_material=False)
                models = updated(models, there)
        except SolverError:
            break
        if all(one is other for one, other in zip(models, before, strict=True)):
            break
        bent = objective.bent_as(models)
        exact = cheapest_posterior(bent, least.unknowns, bent(least.unknowns))
        posterior, known = profiled(replace(posterior, frozen=exact, objective=bent), bounds), {**known, **moved}
    return posterior


def _exact_enough(
    objective: Objective, models: Sequence[Approximation], points: Sequence[LinearisationPoint]
) -> list[Approximation]:
    """The models of all states, those made exact whose body's first one misses more than `MISSED` at its place.

    Raises `SolverError`.
    """
    references = [state.reference for state in objective.states]
    first = {r: references.index(r) for r in references}
    missed = {r: models[i].error(points[i]).relative for r, i in first.items()}
    far = [i for i, r in enumerate(references) if missed[r] > MISSED]
    sharper = dict(zip(far, updated([models[i] for i in far], [points[i] for i in far]), strict=True))
    return [sharper.get(i, model) for i, model in enumerate(models)]
