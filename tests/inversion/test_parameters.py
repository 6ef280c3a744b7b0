"""From unknowns to moduli and motion: a known tissue holds the scale, else only ratios exist; ties and priors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import ConfigurationError
from palpate.images.tissue import Role, Tissue
from palpate.inversion import Bounds, gauss_newton, invert
from palpate.inversion.optimise import posterior_sd
from palpate.observation.noise_model import NoiseModel
from palpate.unknowns import Alternative, layer_blocks, parameter_map, unit_blocks
from palpate.unknowns.blocks import in_series, in_series_slopes

GLAND, SAC = Tissue("gland", Role.ESTIMATE), Tissue("sac", Role.ESTIMATE)
NODE = Tissue("node", Role.ESTIMATE)
TUBE = Tissue("tube", Role.DRIVER)
FAT = Tissue("fat", Role.KNOWN, youngs_modulus_kpa=10.0)
MUSCLE = Tissue("muscle", Role.KNOWN, youngs_modulus_kpa=40.0)


def test_moduli_are_ratios_times_the_first_known_modulus():
    mapping = parameter_map((GLAND, TUBE, MUSCLE, SAC, FAT), (0, 2, 3, 4), unit_blocks(7))
    assert mapping.tissues == ("gland", "sac")
    assert (mapping.relative_to, mapping.scale_kpa, mapping.absolute) == ("muscle", 40.0, True)
    assert mapping.moduli(np.log([3.0, 0.5])) == pytest.approx([120.0, 40.0, 20.0, 10.0])


def test_without_a_known_modulus_the_first_estimate_is_the_scale():
    mapping = parameter_map((TUBE, GLAND, SAC), (1, 2), unit_blocks(7))
    assert not mapping.absolute
    assert (mapping.relative_to, mapping.tissues, mapping.scale_kpa) == ("gland", ("sac",), 1.0)
    assert mapping.moduli(np.log([4.0])) == pytest.approx([1.0, 4.0])


def mapping_of(*n_modes, tied=()):
    """Gland, fat, sac and muscle as regions."""
    return parameter_map((GLAND, FAT, SAC, MUSCLE), (0, 1, 2, 3), unit_blocks(*n_modes), tied=tied)


TIED = [(), (("gland", "sac"),)]


@pytest.mark.parametrize("tied", TIED)
def test_derivatives_by_the_unknowns_are_those_by_region_through_the_map(rng, tied):
    """by_unknowns is the chain rule d (ln E, q) / dx, whose matrix finite differences give."""
    mapping = mapping_of(2, 3, tied=tied)
    own = mapping.unknowns_of(1)
    tangent, chain = rng.normal(size=(6, 4 + 3)), chain_of(mapping, 1, rng.normal(size=mapping.n_unknowns))
    assert mapping.by_unknowns(tangent, np.zeros(mapping.n_unknowns)) == pytest.approx(
        tangent @ chain[:, own], rel=1e-8, abs=1e-9
    )
    assert not np.delete(chain, own, axis=1).any()


@pytest.mark.parametrize("tied", TIED)
@pytest.mark.parametrize("state", [0, 1])
def test_the_chain_of_a_state_is_that_of_its_own_unknowns(rng, tied, state):
    mapping = mapping_of(2, 3, tied=tied)
    unknowns, own = rng.normal(size=mapping.n_unknowns), mapping.unknowns_of(state)
    assert mapping.chain(state, unknowns) == pytest.approx(chain_of(mapping, state, unknowns)[:, own], abs=1e-8)


def test_an_unknown_of_a_region_is_added_to_its_modulus_in_every_state(rng):
    """It enters moduli and their derivatives as theta does, between theta and the coefficients."""
    blocks = (*unit_blocks(2, 3), *layer_blocks((("gland", (1, 3), 2.0),), (0, 1), sd=1.5, thickness_mm=3.0))
    mapping = parameter_map((GLAND, FAT, SAC, MUSCLE), (0, 1, 2, 3), blocks)
    unknowns = rng.normal(size=mapping.n_unknowns)
    changed = unknowns + 0.7 * np.eye(mapping.n_unknowns)[-1]
    assert mapping.moduli(changed) / mapping.moduli(unknowns) == pytest.approx(np.exp([0.0, 0.7, 0.0, 0.7]))
    for state in (0, 1):
        own, chain = mapping.unknowns_of(state), chain_of(mapping, state, unknowns)
        assert mapping.chain(state, unknowns) == pytest.approx(chain[:, own], abs=1e-8)
        assert not np.delete(chain, own, axis=1).any()


@pytest.mark.parametrize("softer", [0.05, 1.0, 20.0])
def test_a_layer_thinner_than_its_elements_is_in_series_with_their_rest(rng, softer):
    """Compliances add: a third of a region that is a twentieth as stiff makes it 7.3 times as soft as a whole."""
    blocks = (*unit_blocks(2, 3), *layer_blocks((("gland", (1,), 9.0),), (0, 1), sd=1.5, thickness_mm=3.0))
    mapping = parameter_map((GLAND, FAT, SAC, MUSCLE), (0, 1, 2, 3), blocks)
    plain = np.append(rng.normal(size=mapping.n_unknowns - 1), 0.0)
    layered = np.append(plain[:-1], np.log(softer))
    ratio = mapping.moduli(layered) / mapping.moduli(plain)
    assert ratio == pytest.approx([1.0, 1.0 / (2.0 / 3.0 + 1.0 / (3.0 * softer)), 1.0, 1.0])
    own, chain = mapping.unknowns_of(0), chain_of(mapping, 0, layered)
    assert mapping.chain(0, layered) == pytest.approx(chain[:, own], abs=1e-7)


def test_no_layer_stiffens_a_third_of_a_region_for_ever():
    """Its slope is that of differences."""
    x, shares, step = np.array([-3.0, -0.4, 0.0, 2.0]), np.array([0.3, 1.0, 0.6, 0.3]), 1e-6
    slopes = (in_series(x + step, shares) - in_series(x - step, shares)) / (2.0 * step)
    assert in_series_slopes(x, shares) == pytest.approx(slopes, rel=1e-8)
    most = -np.log(1.0 - 0.3)
    assert in_series(np.array([40.0]), np.array([0.3])) == pytest.approx(most)


def chain_of(mapping, state, unknowns):
    """d (ln E, q) / d x of one state, (n_regions + n_modes, n_unknowns), by differences."""

    def seen(x):
        return np.concatenate([np.log(mapping.moduli(x)), mapping.coefficients(x)[state]])

    steps = 1e-4 * np.eye(mapping.n_unknowns)
    return np.stack([(seen(unknowns + step) - seen(unknowns - step)) / 2e-4 for step in steps], axis=1).round(9)


def test_every_state_has_the_moduli_and_coefficients_of_its_own():
    mapping = mapping_of(2, 3)
    assert mapping.n_unknowns == 2 + 5
    assert [mapping.unknowns_of(s).tolist() for s in (0, 1)] == [[0, 1, 2, 3], [0, 1, 4, 5, 6]]
    assert [q.tolist() for q in mapping.coefficients(np.arange(7.0))] == [[2.0, 3.0], [4.0, 5.0, 6.0]]


def test_the_base_is_not_written_into():
    mapping = parameter_map((GLAND, FAT), (0, 1), unit_blocks(7))
    mapping.moduli(np.ones(1))
    assert np.array_equal(mapping.base, [10.0, 10.0])


@pytest.mark.parametrize("tissues", [(FAT, TUBE), (GLAND, TUBE)])
def test_a_case_without_a_ratio_is_refused(tissues):
    with pytest.raises(ConfigurationError, match="only"):
        parameter_map(tissues, (0,), unit_blocks(7))


def test_tied_tissues_share_one_parameter_with_both_names():
    mapping = parameter_map((GLAND, SAC, FAT, NODE), (0, 1, 2, 3), unit_blocks(7), tied=(("gland", "node"),))
    assert mapping.tissues == ("gland and node", "sac")
    assert mapping.moduli(np.log([3.0, 0.5])) == pytest.approx([30.0, 5.0, 10.0, 30.0])


def test_tied_tissues_may_hold_the_scale():
    mapping = parameter_map((GLAND, SAC, NODE), (0, 1, 2), unit_blocks(7), tied=(("gland", "sac"),))
    assert (mapping.relative_to, mapping.tissues) == ("gland and sac", ("node",))
    assert mapping.moduli(np.log([4.0])) == pytest.approx([1.0, 1.0, 4.0])


@pytest.mark.parametrize("name", ["fat", "glnad"])
def test_only_tissues_to_be_estimated_are_tied(name):
    with pytest.raises(ConfigurationError, match=name):
        mapping_of(3, tied=(("gland", name),))


def test_an_estimate_of_tied_tissues_finds_the_modulus_that_they_share(twins):
    twin = twins.make_twin(truth=np.log([2.5, 2.5]))
    problem = twins.exact_problem(twin, tied=(("gland", "sac"),))
    inversion = invert(problem, twins.settings(0.5, 8.0, n=1), progress=twins.silent)
    assert inversion.minimum.converged
    assert inversion.minimum.unknowns[0] == pytest.approx(np.log(2.5), abs=1e-4)


def test_the_gradient_by_a_tied_modulus_is_the_sum_of_those_by_its_tissues(twins, twin):
    free, tied = (twins.objective_of(twins.exact_problem(twin, tied=groups)) for groups in ((), (("gland", "sac"),)))
    q = 0.5 * twin.coefficients
    apart, together = free(np.append([0.3, 0.3], q)), tied(np.append([0.3], q))
    assert together.value == pytest.approx(apart.value, rel=1e-8)
    assert together.score[0] == pytest.approx(apart.score[:2].sum(), rel=1e-4)
    assert together.matrix.dense[0, 0] == pytest.approx(apart.matrix.dense[:2, :2].sum(), rel=1e-4)


@pytest.fixture(scope="module")
def objective(twins, twin):
    return twins.objective_of(twins.exact_problem(twin), twin.coefficients).rematched(twin.unknowns)


def believed(objective, mean, sd):
    return replace(objective, parameters=objective.parameters.with_prior(mean, sd))


def test_a_prior_pulls_the_estimate_to_its_mean_the_more_the_stronger_it_is(twins, twin, objective):
    mean, bounds = twins.TRUTH + np.array([0.4, -0.3]), twins.settings(1.0).bounds
    sd = posterior_sd(gauss_newton(objective, twin.unknowns, bounds=bounds), 2)
    away = []
    for factor in (100.0, 1.0, 0.01):
        found = gauss_newton(believed(objective, mean, factor * sd), twin.unknowns, bounds=bounds)
        away.append(np.abs(found.unknowns[:2] - mean))
    assert away[0] == pytest.approx(np.abs(twins.TRUTH - mean), rel=0.02)
    assert np.all(away[1] < 0.9 * away[0])
    assert np.all(away[2] < 1e-3)


def test_a_flat_prior_changes_nothing(twin, objective):
    plain, flat = (of(twin.unknowns + 0.1) for of in (objective, believed(objective, np.ones(2), np.full(2, np.inf))))
    assert flat.value == plain.value
    assert np.array_equal(flat.matrix.dense, plain.matrix.dense)
    assert np.array_equal(flat.score, plain.score)


def test_a_prior_may_be_of_one_tissue_alone(objective):
    parameters = objective.parameters.with_prior(np.array([0.5, 7.0]), np.array([0.2, np.inf]))
    assert parameters.prior_precision == pytest.approx(np.diag([25.0, 0.0]))
    assert parameters.prior_centre[:2].tolist() == [0.5, 0.0]


@pytest.mark.parametrize("sd", [0.0, -0.1, np.nan, -np.inf])
def test_a_prior_without_a_spread_is_refused(sd):
    with pytest.raises(ConfigurationError, match=r"'sac'.*positive"):
        mapping_of(3).with_prior(np.zeros(2), np.array([0.2, sd]))


@pytest.mark.parametrize("mean", [np.nan, np.inf])
def test_the_mean_of_a_prior_must_be_a_number_where_it_counts(mean):
    with pytest.raises(ConfigurationError, match="'gland'"):
        mapping_of(3).with_prior(np.array([mean, 0.0]), np.array([0.2, 0.2]))
    flat = mapping_of(3).with_prior(np.array([mean, 0.0]), np.array([np.inf, 0.2]))
    assert flat.prior_mean.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("sizes", [(2,), (4,), (3, 1)])
def test_a_drivers_prior_of_another_size_is_refused_and_not_replaced(sizes):
    with pytest.raises(ConfigurationError, match=r"priors.*the blocks have \[3\]"):
        replace(mapping_of(3), priors=tuple(Alternative(np.eye(n)) for n in sizes))


def test_a_prior_of_another_number_of_moduli_is_refused():
    with pytest.raises(ConfigurationError, match="prior_mean"):
        mapping_of(3).with_prior(np.zeros(3), np.ones(3))


def test_where_images_tell_nothing_the_posterior_is_the_prior(twin, objective):
    """All residuals count so little that the moduli's spread is what was believed before."""
    sd, mean = np.array([0.3, 0.8]), np.array([0.2, -0.1])
    vague = believed(objective, mean, sd)
    blind = vague.with_observations(
        [o.with_noise(NoiseModel(np.array([1e8]), np.array([3.0]))) for o in vague.observations]
    )
    found = gauss_newton(blind, twin.unknowns, bounds=Bounds(np.full(2, -4.0), np.full(2, 4.0)), tolerance=1e-9)
    assert posterior_sd(found, 2) == pytest.approx(sd, rel=1e-4)
    assert found.unknowns[:2] == pytest.approx(mean, abs=1e-3)
