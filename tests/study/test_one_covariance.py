"""Everything that is stated of the moduli rests on the same mixture: layers that may be there are in all of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.images.tissue import Role
from palpate.inversion import invert
from palpate.observation.noise_model import NoiseModel
from palpate.statement.conclusion import Observed, conclude
from palpate.uncertainty import FittedState
from palpate.uncertainty.intervals import NORMAL_95
from palpate.uncertainty.profile import JOINT_LEVEL
from palpate.unknowns import layer_blocks
from palpate.unknowns.blocks import LAYER_ODDS

NOISE = NoiseModel(np.array([0.1**2]), np.array([3.0]))
SD = 0.25  # of ln E of the known tissue, which as a whole is the layer: no image tells anything of it


@pytest.fixture(scope="module")
def bodies(twins):
    return [twins.make_twin(seed=seed) for seed in (5, 8)]


@pytest.fixture(scope="module")
def observed(bodies):
    states = [
        FittedState(b.model.space, b.scene.displacement, b.scene.before.grid, b.scene.before.grid) for b in bodies
    ]
    images = [(b.scene.after.labels - 1).astype(np.int16) for b in bodies]
    return Observed(tuple(states), tuple(images))


def concluded(twins, bodies, observed, *, layers, samples):
    """Two later states, with the known tissue a layer that may differ, or without one."""
    settings, problem = twins.settings(2.0), twins.exact_problem(*bodies, noise=NOISE)
    if layers:
        tissues, regions = bodies[0].scene.tissues, bodies[0].model.regions
        known = tuple(i for i, number in enumerate(regions) if tissues[number].role is Role.KNOWN)
        own = layer_blocks((("gland", known, 1.0),), (0, 1), sd=SD, thickness_mm=1.0)
        blocks = (*problem.parameters.blocks, *own)
        mapping = replace(problem.parameters, blocks=blocks, priors=())
        problem = replace(problem, parameters=mapping)
    inversion = invert(problem, settings, progress=twins.silent)
    return conclude(inversion, settings, observed, truth={}, seed=1, samples=samples)


@pytest.fixture(scope="module")
def without(twins, bodies, observed):
    return concluded(twins, bodies, observed, layers=False, samples=0)


@pytest.fixture(scope="module")
def found(twins, bodies, observed):
    return concluded(twins, bodies, observed, layers=True, samples=500)


def half_widths(intervals):
    """Of intervals, in ln E, (n,)."""
    return 0.5 * np.log([high / low for low, high in intervals])


def test_what_may_be_is_in_the_covariance_with_its_probability(found, without):
    """All moduli scaled together move nothing: ln E of all organs varies by as much as that of a layer, if it does.

    No image tells anything of that: its probability is the one that was believed.
    """
    layered = sum(of.probability for of in found.explanations if "layers" in of.scenario)
    assert layered == pytest.approx(1.0 / (1.0 + np.exp(-LAYER_ODDS)), rel=0.02)
    varied = layered * SD**2
    added = found.covariance.total - without.covariance.total
    assert added == pytest.approx(np.full((2, 2), varied), rel=0.05)
    for i, estimate in enumerate(found.estimates):
        assert estimate.variance_shares["layer"] == pytest.approx(varied / found.covariance.total[i, i], rel=0.05)
        assert sum(estimate.variance_shares.values()) == pytest.approx(1.0, abs=1e-3)
    assert found.correlation[0, 1] > without.correlation[0, 1] + 0.1


def test_the_intervals_are_those_of_the_covariance(found):
    sd = np.sqrt(np.diag(found.covariance.total))
    assert half_widths([e.interval95 for e in found.estimates]) == pytest.approx(NORMAL_95 * sd, rel=0.1)


def test_a_region_reaches_along_each_axis_as_far_as_the_interval_beside_it(found):
    """At its own level, which is that of two moduli."""
    (region,) = found.regions
    own = half_widths([e.interval95 for e in found.estimates]) / NORMAL_95
    for edge in (region.boundary, region.ellipse):
        ends = zip(np.min(edge, axis=0), np.max(edge, axis=0), strict=True)
        assert half_widths(ends) / JOINT_LEVEL == pytest.approx(own, rel=0.1)


def test_samples_have_the_interval_of_the_estimate(found):
    drawn = half_widths(found.samples.interval95)
    assert drawn == pytest.approx(half_widths([e.interval95 for e in found.estimates]), rel=0.1)
    correlation = np.corrcoef(np.log(found.samples.moduli).T)[0, 1]
    assert correlation == pytest.approx(found.correlation[0, 1], abs=0.1)


def test_each_later_image_alone_and_the_mean_of_all_have_what_the_likeliest_explanation_has(found, without):
    pairs = zip(
        (found.image_pairs.mean_interval95, *(of.interval95 for of in found.image_pairs.alone)),
        (without.image_pairs.mean_interval95, *(of.interval95 for of in without.image_pairs.alone)),
        strict=True,
    )
    assert "bonded" in found.explanations[0].scenario
    for ours, others in pairs:
        assert half_widths(ours.values()) == pytest.approx(half_widths(others.values()), rel=0.01)
    assert found.image_pairs.heterogeneity_p == pytest.approx(without.image_pairs.heterogeneity_p, rel=0.1)
