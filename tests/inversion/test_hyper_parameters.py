"""How each residual counts, and how far walls move: what is learned once, on linear residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

from palpate.inversion import LinearisedObjective, begun, gauss_newton, with_correlations, with_first_noise, with_scales
from palpate.inversion.hyper_parameters import evident_variances, fitted_noise, worse_driver
from palpate.observation.noise_model import NoiseModel
from palpate.unknowns.blocks import AMPLITUDES

NOISE = NoiseModel(np.array([0.2**2]), np.array([4.0]))


@pytest.fixture(scope="module")
def minimum(twins, twin, voxels):
    """An objective of voxels and its minimum under the first noise."""
    objective, unknowns = twins.objective_of(voxels, twin.coefficients), twin.unknowns
    for _ in range(6):
        start = begun(objective, unknowns)
        found = gauss_newton(linear(start.objective, start.minimum), unknowns, bounds=twins.settings(1.0).bounds)
        objective, unknowns = start.objective, found.unknowns
    assert np.abs(unknowns - start.minimum.unknowns)[:2].max() < 1e-3
    return start.objective, start.minimum


def linear(objective, found):
    return LinearisedObjective(objective, found.unknowns, found.evaluation)


def total(objective, evaluation):
    """J with what depends on the scales alone: ln Z of all residuals, 1/2 ln det H, and what is believed of drivers."""
    sds = [o.weighting.sd for o in objective.observations if not o.of_driver]
    drivers = sum(worse_driver(o.weighting.sd, sds[0]) for o in objective.observations if o.of_driver)
    normalisers = sum(o.weighting.log_normaliser for o in objective.observations)
    return evaluation.value + normalisers + 0.5 * float(evaluation.matrix.log_determinant()) + drivers


def test_all_surfaces_begin_with_one_noise_model_and_count_by_their_area(twins, voxels):
    objective = twins.objective_of(voxels)
    ratios = [o.weighting.precision / o.target.area.sum() for o in objective.observations]
    assert len(ratios) == 3
    assert ratios == pytest.approx([ratios[0]] * 3)
    assert {id(o.noise_model) for o in objective.observations} == {id(objective.states[0].noise["surface distance"])}


def test_the_first_noise_does_not_depend_on_what_was_weighted_before(minimum):
    objective, _ = minimum
    coarse = objective.with_observations([o.with_noise(NOISE) for o in objective.observations])
    first = with_first_noise(coarse)
    assert first.states[0].noise["surface distance"].sd == objective.states[0].noise["surface distance"].sd
    assert first.states[0].noise["surface distance"].sd != NOISE.sd


def test_a_drivers_residuals_do_not_tell_the_noise(minimum):
    _, found = minimum
    lines = found.evaluation.linearisations
    telling = [line.residuals for line in lines if not line.observation.of_driver]
    assert 0 < len(telling) < len(lines)
    alone = lines[0].observation.fitted_noise(telling)
    together = lines[0].observation.fitted_noise([line.residuals for line in lines])
    noise = fitted_noise(found.evaluation)[0, "surface distance"]
    assert noise.sd == alone.sd
    assert noise.sd != together.sd


def test_another_correlation_is_another_number_of_residuals_and_no_other_scale(minimum):
    objective, found = minimum
    there = with_correlations(objective, found.evaluation)
    area = fitted_noise(found.evaluation)[0, "surface distance"].correlation_area
    for before, after in zip(objective.observations, there.observations, strict=True):
        assert after.weighting.sd == pytest.approx(before.weighting.sd)
        assert after.weighting.count == pytest.approx(after.target.area.sum() / area)


def test_the_scale_is_where_the_objective_is_least(minimum):
    """Minimised over the unknowns as well: value, ln Z and 1/2 ln det H together, on linear residuals."""
    objective, found = minimum
    for _ in range(20):
        objective = with_scales(objective, linear(objective, found)(found.unknowns))
    organs = [i for i, o in enumerate(objective.observations) if not o.of_driver]
    sd = objective.observations[organs[0]].weighting.sd

    def of(factor):
        changed = [o.with_sd(factor * sd) if i in organs else o for i, o in enumerate(objective.observations)]
        there = objective.with_observations(changed)
        return total(there, linear(there, found)(found.unknowns))

    values = [of(factor) for factor in (0.93, 1.0, 1.07)]
    assert values[1] < min(values[0], values[2])


def test_a_driver_counts_no_more_than_what_is_believed_of_its_kind(minimum):
    objective, found = minimum
    there = with_scales(objective, found.evaluation)
    organs = [o.weighting.sd for o in there.observations if not o.of_driver]
    (driver,) = (o.weighting.sd for o in there.observations if o.of_driver)
    assert organs == pytest.approx([organs[0]] * 2)
    assert driver >= min(organs) * (1.0 - 1e-12)


def test_stated_noise_that_explains_the_residuals_stays(twins, twin):
    stated = NoiseModel(np.array([0.5**2]), np.array([3.0]))
    start = begun(twins.objective_of(twins.voxel_problem(twin, noise=stated)), twin.unknowns)
    there = with_scales(start.objective, start.minimum.evaluation)
    assert [o.weighting.sd for o in there.observations if not o.of_driver] == pytest.approx([0.5] * 2)


def test_scales_leave_the_old_objective_and_lower_what_they_are_chosen_by(minimum, twins):
    """On linear residuals, and then the unknowns under them: each lowers J with what depends on the scales."""
    objective, found = minimum
    objective = with_correlations(objective, found.evaluation)
    before = objective(found.unknowns).value
    totals = [total(objective, linear(objective, found)(found.unknowns))]
    now, unknowns = objective, found.unknowns
    for _ in range(3):
        now = with_scales(now, linear(now, found)(unknowns))
        unknowns = gauss_newton(linear(now, found), unknowns, bounds=twins.settings(1.0).bounds).unknowns
        totals.append(total(now, linear(now, found)(unknowns)))
    assert np.all(np.diff(totals) < 1e-3)  # weights of outliers are those of the step before
    assert totals[1] < totals[0]
    assert objective(found.unknowns).value == before


def test_a_later_image_that_was_drawn_badly_leaves_the_others_their_noise(twins):
    """Two later images, one with an organ 3 mm beside its place: the other counts as it does alone."""
    problem = twins.exact_problem(*(twins.make_twin(seed=seed) for seed in (5, 8)), noise=None)
    objective = with_first_noise(twins.objective_of(problem)).rematched(np.zeros(problem.parameters.n_unknowns))
    evaluation = objective(np.zeros(problem.parameters.n_unknowns))
    lines = [
        replace(
            line, residuals=replace(line.residuals, values=line.residuals.values + 3.0 * line.residuals.normals[:, 0])
        )
        if line.state == 1
        else line
        for line in evaluation.linearisations
    ]
    spoilt_evaluation = replace(evaluation, linearisations=tuple(lines))
    good, spoilt = (fitted_noise(e) for e in (evaluation, spoilt_evaluation))
    for of in ("variances", "lengths"):
        assert np.array_equal(*(getattr(noise[0, "surface distance"], of) for noise in (spoilt, good)))
    assert spoilt[1, "surface distance"].sd > 1.3 * good[1, "surface distance"].sd
    plain, other = (with_scales(objective, e).states for e in (evaluation, spoilt_evaluation))
    first, untouched = ([o.weighting.sd for o in states[0].observations] for states in (other, plain))
    assert first == pytest.approx(untouched)
    second, before = ([o.weighting.sd for o in states[1].observations] for states in (other, plain))
    assert sum(second) > 1.2 * sum(before)


@pytest.fixture(params=range(8))
def learned(request):
    """Terms of a prior, what data of it say as R (m, n) and t (m,), and the log-evidence of variances (n_terms,)."""
    rng = np.random.default_rng(request.param)
    n, m, n_terms = (int(k) for k in rng.integers((3, 4, 1), (9, 20, 4)))
    roots = [rng.standard_normal((n, int(rng.integers(1, n + 1)))) for _ in range(n_terms)]
    terms = [root @ root.T / n + 1e-3 * np.eye(n) for root in roots]
    seen, variances = 2.0 * rng.standard_normal((m, n)), rng.choice([1e-9, 0.01, 0.3, 1.5], n_terms)
    drawn = np.linalg.cholesky(np.tensordot(variances, terms, axes=1)) @ rng.standard_normal(n)
    target = seen @ drawn + rng.standard_normal(m)

    def log_evidence(of):
        whole = np.eye(m) + seen @ np.tensordot(of, terms, axes=1) @ seen.T
        return -0.5 * float(target @ np.linalg.solve(whole, target) + np.linalg.slogdet(whole)[1])

    return terms, seen, target, log_evidence


def test_no_other_variances_have_more_evidence(learned):
    """Against a general optimiser from several places, between the same bounds."""
    terms, seen, target, log_evidence = learned
    found = evident_variances(terms, seen.T @ seen, seen.T @ target)
    bounds = [tuple(np.log(np.square(AMPLITUDES)))] * len(terms)
    other = max(
        -optimize.minimize(lambda x: -log_evidence(np.exp(x)), np.full(len(terms), begin), bounds=bounds).fun
        for begin in np.log([1e-3, 0.1, 1.0, 3.0])
    )
    assert log_evidence(found) > other - 1e-3


def test_every_sweep_raises_the_evidence(learned):
    terms, seen, target, log_evidence = learned
    found = [evident_variances(terms, seen.T @ seen, seen.T @ target, sweeps=k) for k in range(12)]
    assert np.all(np.diff([log_evidence(of) for of in found]) > -1e-9)


@pytest.mark.parametrize("size", [0.0, 1e-20])
def test_a_term_that_moves_nothing_seen_keeps_what_it_begins_with(rng, size):
    terms = [np.diag([1.0, 1.0, 0.0]), np.diag([0.0, 0.0, 1.0])]
    seen = rng.normal(size=(30, 3)) * [1.0, 1.0, size]
    found = evident_variances(terms, seen.T @ seen, seen.T @ (seen @ [0.3, -0.4, 0.0] + 0.01 * rng.normal(size=30)))
    assert found[1] == 1.0
    assert found[0] < 0.5
