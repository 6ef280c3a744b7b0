"""What is stated rests on posteriors whose models are exact as far as intervals go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.approximation import exact_approximation, reduced_basis
from palpate.inversion import Outcome, frozen_posterior, invert
from palpate.observation.noise_model import NoiseModel
from palpate.statement.stated_posterior import StatedPosterior, exact_at_ends, profiled
from palpate.uncertainty import NORMAL_95, Covariance, StatedMixture, modulus_interval

NOISE = NoiseModel(np.array([0.3**2]), np.array([3.0]))


@pytest.fixture(scope="module")
def bounds(twins):
    return twins.settings(2.0).bounds


@pytest.fixture(scope="module")
def inversion(twins, twin):
    return invert(twins.exact_problem(twin, noise=NOISE), twins.settings(2.0), progress=twins.silent)


@pytest.fixture(scope="module")
def poor(inversion, twin):
    """The objective on a basis of responses at the estimate and at stiffer moduli, of no displacement elsewhere."""
    theta, mapping = inversion.minimum.unknowns, inversion.objective.parameters
    basis, stiffer = reduced_basis(twin.model, mapping.moduli(theta)), theta + np.append([1.0, 1.0], 0.0 * theta[2:])
    responses = twin.model.system(mapping.moduli(stiffer)).responses()[:, :-1]
    free = np.asarray(twin.model.constraint.free.T @ responses)
    return inversion.objective.with_approximations([replace(basis, projection=basis.projection.extended(free))])


def posterior_of(objective, minimum):
    covariance = np.linalg.inv(minimum.evaluation.matrix.dense)[:2, :2]
    zero = np.zeros_like(covariance)
    alone = np.ones(1), minimum.unknowns[None, :2], covariance[None]
    mixture = StatedMixture(*alone, Covariance(covariance, zero, zero, zero, covariance))
    return StatedPosterior(frozen_posterior(objective, minimum.unknowns), minimum, mixture)


def profiles(posterior, bounds):
    variances = np.diag(posterior.covariance)[:2]
    found = [
        modulus_interval(posterior.marginal, posterior.minimum, k, variance=float(variance), bounds=bounds)
        for k, variance in enumerate(variances)
    ]
    return [of.profile for of in found]


def ends(posterior, bounds):
    return np.array([[of.low, of.high] for of in profiles(posterior, bounds)], dtype=np.float64)


@pytest.fixture(scope="module")
def expansion(inversion, twin):
    """The linear law to first order around the estimate."""
    return exact_approximation(
        twin.model, None, inversion.objective.linearisation_points(inversion.minimum.unknowns)[0]
    )


@pytest.fixture(scope="module", params=["itself", "bending an expansion"])
def on_poor(request, poor, expansion):
    """The objective on the poor basis, or on an expansion that bends as that does: of one law they are the same."""
    if request.param == "itself":
        return poor
    (state,) = poor.with_approximations([expansion]).states
    return replace(poor, states=(replace(state, bending=poor.approximations[0]),))


def test_profiles_end_where_those_of_the_full_model_do(inversion, poor, on_poor, bounds):
    """A tenth of the half-width off at the most; one of a basis that was not asked there is further off."""
    before = posterior_of(on_poor, inversion.minimum)
    found, full = exact_at_ends(profiled(before, bounds), on_poor, bounds), poor
    for of in profiles(found, bounds):
        for place in of.outermost:
            at, (model,) = full.linearisation_points(place)[0], full.approximations
            full = full.with_approximations([model.with_responses(at.moduli, at.coefficients)])
    half = NORMAL_95 * np.sqrt(np.diag(found.covariance)[:2])[:, None]
    truth = ends(posterior_of(full, inversion.minimum), bounds)
    off = [np.abs(ends(of, bounds) - truth) / half for of in (before, found)]
    assert on_poor is not poor or np.nanmax(off[0]) > 0.1
    assert off[1].max() < 0.1


def test_an_expansion_that_bends_as_no_basis_does_stays(inversion, poor, expansion, bounds):
    before = posterior_of(poor, inversion.minimum)
    assert exact_at_ends(before, poor.with_approximations([expansion]), bounds) is before


def test_nothing_is_asked_where_no_minimum_was_found(inversion, poor, bounds):
    lost = replace(inversion.minimum, outcome=Outcome.STEPS)
    before = replace(posterior_of(poor, inversion.minimum), minimum=lost)
    assert exact_at_ends(before, poor, bounds) is before
