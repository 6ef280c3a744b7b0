"""What is stated of a mixture of explanations: quantiles, draws and causes, each by a law that has a known answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from palpate.inversion import Bounds, Explanation, MarginalPosterior, Mixture, fixed_correspondence
from palpate.uncertainty import (
    NORMAL_95,
    Covariance,
    Marginal,
    ModulusInterval,
    Profile,
    marginals_of,
    modulus_interval,
    stated_mixture,
)
from palpate.unknowns import Acts, Alternative, Block, Choice

BOUNDS = (np.log(0.02), np.log(200.0))
WIDE = Bounds(np.full(2, BOUNDS[0]), np.full(2, BOUNDS[1]))
SD = 0.2
STRAIGHT = Profile(np.array([-2.0, 0.0, 2.0]) * SD + 1.0, np.array([-2.0, 0.0, 2.0]), 1.0 - 1.96 * SD, 1.0 + 1.96 * SD)
DRAWS = 200_000


def marginal(weights, theta, sd, profile=STRAIGHT):
    return Marginal(np.array(weights), np.array(theta), np.array(sd), profile, sd[0])


def ends_of(found, bounds=BOUNDS):
    return np.log(found.interval(bounds))


def test_the_quantiles_of_one_explanation_are_those_of_its_ellipse_where_its_profile_is_straight():
    found = marginal([1.0], [1.0], [SD])
    assert found.quantile(0.5, BOUNDS) == pytest.approx(1.0, abs=1e-6)
    assert ends_of(found) == pytest.approx(1.0 + NORMAL_95 * SD * np.array([-1.0, 1.0]), abs=1e-5)


def test_without_a_profile_the_law_is_normal_in_the_logarithm():
    assert ends_of(marginal([1.0], [1.0], [SD], None)) == pytest.approx(1.0 + NORMAL_95 * SD * np.array([-1.0, 1.0]))


def test_the_quantiles_of_one_explanation_are_the_ends_of_its_profile(objective, minimum):
    """Of moduli that are known to a factor of two, whose profiles lean."""
    fixed = MarginalPosterior.of(fixed_correspondence(objective, minimum.unknowns, minimum.evaluation))
    for number, variance in enumerate(np.diag(minimum.evaluation.covariance_columns(2))):
        own = modulus_interval(fixed, minimum, number, variance=variance, bounds=WIDE)
        sd = float(np.sqrt(variance))
        found = marginal([1.0], [minimum.unknowns[number]], [sd], own.profile)
        low, high = ends_of(found, (WIDE.lower[number], WIDE.upper[number]))
        assert (low, high) == pytest.approx((own.profile.low, own.profile.high), abs=0.02 * NORMAL_95 * sd)
        assert found.quantile(0.5, BOUNDS) == pytest.approx(minimum.unknowns[number], abs=1e-3 * sd)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_two_laws_far_apart_are_both_held_and_the_median_lies_at_the_likelier_one_or_between(share):
    near, far = 1.0, 3.0
    found = marginal([share, 1.0 - share], [near, far], [SD, SD])
    low, high = ends_of(found)
    assert low < near - SD
    assert high > far + SD
    middle = found.quantile(0.5, BOUNDS)
    assert low < middle < high
    assert near < middle < far if share == 0.5 else abs(middle - (near if share > 0.5 else far)) < 2.0 * SD
    expected = [stats.norm(near, SD), stats.norm(far, SD)]
    for probability, end in ((0.025, low), (0.5, middle), (0.975, high)):
        below = share * expected[0].cdf(end) + (1.0 - share) * expected[1].cdf(end)
        assert below == pytest.approx(probability, abs=1e-5)


def test_an_explanation_too_seldom_to_matter_leaves_the_interval_where_it_was():
    alone, beside = marginal([1.0], [1.0], [SD]), marginal([0.999, 0.001], [1.0, 3.0], [SD, SD])
    assert ends_of(beside) == pytest.approx(ends_of(alone), abs=0.05 * SD)


def test_an_end_beyond_the_bounds_is_open():
    found, half = marginal([1.0], [1.0], [SD]), NORMAL_95 * SD
    assert found.interval((1.0 - 0.9 * half, 3.0))[0] is None
    assert found.interval((-1.0, 1.0 + 0.9 * half))[1] is None
    assert None not in found.interval((1.0 - 1.1 * half, 1.0 + 1.1 * half))
    far = marginal([0.9, 0.1], [1.0, 3.0], [SD, SD])
    assert far.interval((-1.0, 2.5)) == (pytest.approx(np.exp(far.quantile(0.025, BOUNDS)), rel=1e-5), None)


def test_an_end_beyond_where_the_profile_could_be_followed_is_open():
    lost = replace(STRAIGHT, theta=STRAIGHT.theta[:2], root=STRAIGHT.root[:2], high=None)
    low, high = marginal([1.0], [1.0], [SD], lost).interval(BOUNDS)
    assert low == pytest.approx(np.exp(1.0 - NORMAL_95 * SD), rel=1e-4)
    assert high is None


def curved():
    """A profile of a law that leans: r = 2 sinh(x / 2 sd) on the way up, half of it on the way down."""
    x = np.linspace(-3.0, 3.0, 61) * SD
    return Profile(x, np.where(x < 0.0, 0.5, 1.0) * 2.0 * np.sinh(0.5 * x / SD), -2.0 * SD, 1.7 * SD)


def test_the_coordinate_is_the_profile_and_rises_on_beyond_its_ends():
    found = marginal([1.0], [0.0], [SD], curved())
    assert found.coordinate(found.profile.theta) == pytest.approx(SD * found.profile.root)
    beyond = found.coordinate(np.linspace(-3.0, 3.0, 400))
    assert np.all(np.diff(beyond) > 0.0)


def test_draws_have_the_quantiles_that_are_stated(rng):
    """Of three explanations, one at the profile's middle, one near, one far beyond it."""
    found = marginal([0.5, 0.3, 0.2], [0.0, 0.2, 1.5], [SD, 0.3, 0.1], curved())
    which = rng.choice(3, size=DRAWS, p=found.weights)
    drawn = found.at(which, found.sd[which] * rng.standard_normal(DRAWS))
    for probability in (0.025, 0.25, 0.5, 0.75, 0.975):
        assert np.mean(drawn < found.quantile(probability, BOUNDS)) == pytest.approx(probability, abs=0.004)


def block(choice, state, cause):
    one = np.eye(1)
    return Block(cause, cause, Acts.MATERIAL, (state,), (Alternative(one), Alternative(4.0 * one)), choice)


BLOCKS = (
    block(Choice.PATCHINESS, 0, "heterogeneity"),
    block(Choice.LAYERS, 0, "layer"),
    block(Choice.FRAME, 0, "frame"),
    block(Choice.HELD, 0, "offset"),
)
POSTERIOR = np.array([[0.04, 0.01], [0.01, 0.02]])


def explained(*told):
    """The mixture of explanations by their chosen alternatives, weights and log-moduli, of one covariance."""
    every = tuple(
        Explanation(dict(enumerate(chosen)), (), ((),), weight, np.array(theta), POSTERIOR, None)
        for chosen, weight, theta in told
    )
    return Mixture(every)


def causes(*, grown=1.0, held=0.003):
    """A covariance by its causes, its sandwich so many times the posterior's, a part of it by a block that is held."""
    noise, layer, offset = 0.6 * grown * POSTERIOR, 0.4 * grown * POSTERIOR, held * np.eye(2)
    mesh = np.diag([0.001, 0.002])
    given = {"causes": {"layer": layer, "offset": offset}, "held": {"offset": offset}}
    return Covariance(noise, layer + offset, 0.002 * np.eye(2), mesh, POSTERIOR, **given)


ALONE = ((0, 0, 0), 1.0, (1.0, 0.5))


def test_one_explanation_has_the_covariance_of_all_that_is_known():
    own = causes()
    found = stated_mixture(explained(ALONE), own, BLOCKS)
    assert found.covariance.total == pytest.approx(own.total)
    assert found.covariances[0] == pytest.approx(own.total)
    for number in range(2):
        assert found.covariance.shares(number) == pytest.approx(own.shares(number))


@pytest.mark.parametrize(("grown", "counts"), [(0.5, 1.0), (1.0, 1.0), (1.7, 1.7), (4.0, 1.5**2)])
def test_residuals_that_are_alike_widen_every_explanation_and_only_so_far(grown, counts):
    apart = (((0, 0, 0), 0.6, (1.0, 0.5)), ((0, 0, 1), 0.4, (1.3, 0.5)))
    found = stated_mixture(explained(*apart), causes(grown=grown), BLOCKS)
    further = 0.003 + 0.002 + np.array([0.001, 0.002])
    for covariance in found.covariances:
        assert np.diag(covariance) == pytest.approx(counts * np.diag(POSTERIOR) + further)


def test_the_variance_of_the_whole_is_that_of_its_draws(rng):
    told = (((0, 0, 0), 0.5, (1.0, 0.5)), ((1, 0, 0), 0.3, (1.4, 0.3)), ((1, 1, 1), 0.2, (0.7, 0.6)))
    found = stated_mixture(explained(*told), causes(grown=1.3), BLOCKS)
    which, away = found.draws(DRAWS, rng)
    theta = found.theta[which] + away
    assert np.cov(theta.T) == pytest.approx(found.covariance.total, rel=0.02, abs=2e-4)
    assert theta.mean(axis=0) == pytest.approx(found.weights @ found.theta, abs=5e-3)


@pytest.mark.parametrize(
    ("other", "cause"),
    [((1, 0, 0), "heterogeneity"), ((0, 1, 0), "layer"), ((0, 0, 1), "frame"), ((0, 0, 0), "minima")],
)
def test_what_explanations_disagree_about_is_the_share_of_what_distinguishes_them(other, cause):
    apart = explained(((0, 0, 0), 0.5, (1.0, 0.5)), (other, 0.5, (2.0, 0.5)))
    found, own = stated_mixture(apart, causes(), BLOCKS).covariance, causes()
    between = 0.25
    assert found.total[0, 0] == pytest.approx(own.total[0, 0] + between)
    assert found.total[1, 1] == pytest.approx(own.total[1, 1])
    shares, before = found.shares(0), own.shares(0)
    assert sum(shares.values()) == pytest.approx(1.0)
    grown = shares[cause] * found.total[0, 0] - before.get(cause, 0.0) * own.total[0, 0]
    assert grown == pytest.approx(between)
    for name in {*before, *shares} - {cause}:
        part = before.get(name, 0.0) * own.total[0, 0]
        assert shares[name] * found.total[0, 0] == pytest.approx(part, abs=1e-12), name


def test_a_scenario_under_which_less_is_known_is_told_by_it():
    """Layers, with a probability of 0.3, under which the variance of the first log-modulus is 0.1 larger."""
    (bonded,) = explained(ALONE).explanations
    wide = replace(bonded, chosen={0: 0, 1: 1, 2: 0}, weight=0.3, covariance=POSTERIOR + np.diag([0.1, 0.0]))
    found, own = stated_mixture(Mixture((replace(bonded, weight=0.7), wide)), causes(), BLOCKS), causes()
    assert found.covariance.total == pytest.approx(own.total + np.diag([0.03, 0.0]))
    whole = found.covariance.total[0, 0]
    assert found.covariance.shares(0)["layer"] * whole == pytest.approx(own.shares(0)["layer"] * own.total[0, 0] + 0.03)
    assert found.covariance.shares(1) == pytest.approx(own.shares(1))


def test_shares_add_to_1_where_several_causes_disagree():
    told = (
        ((0, 0, 0), 0.4, (1.0, 0.5)),
        ((1, 0, 0), 0.3, (1.4, 0.3)),
        ((1, 1, 1), 0.2, (0.7, 0.6)),
        ((1, 1, 1), 0.1, (1.8, 0.1)),
    )
    found = stated_mixture(explained(*told), causes(grown=1.3), BLOCKS).covariance
    for number in range(2):
        shares = found.shares(number)
        assert sum(shares.values()) == pytest.approx(1.0)
        assert min(shares.values()) >= 0.0
        assert {"heterogeneity", "layer", "frame", "minima"} <= set(shares)
    assert np.linalg.eigvalsh(found.total).min() > 0.0


def test_each_parameter_has_its_own_marginal():
    found = stated_mixture(explained(ALONE), causes(), BLOCKS)
    for kind, known in (("linearised", False), ("profile", True)):
        own = [ModulusInterval((None, None), kind, STRAIGHT)] * 2
        for i, of in enumerate(marginals_of(found, own)):
            assert of.theta == pytest.approx([ALONE[2][i]])
            assert of.sd == pytest.approx([np.sqrt(found.covariance.total[i, i])])
            assert of.spread == of.sd[0]
            assert (of.profile is STRAIGHT) is known
