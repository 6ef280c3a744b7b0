"""How each residual counts, and what is believed of the blocks: steps of the hyper-parameters on one function."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.inversion import (
    LinearisedObjective,
    StopRule,
    begun,
    gauss_newton,
    minimised,
    with_correlations,
    with_first_noise,
    with_hyper_parameters,
)
from palpate.inversion.hyper_parameters import fitted_noise, with_amplitudes, with_scales
from palpate.observation.noise_model import NoiseModel
from palpate.uncertainty.alternatives import undecided_covariance
from palpate.unknowns import Block
from palpate.unknowns.blocks import Acts

NOISE = NoiseModel(np.array([0.2**2]), np.array([4.0]))
CHEAP = StopRule(model_error=np.inf, derivatives=False, learn=False)


@pytest.fixture(scope="module")
def minimum(twins, twin, voxels):
    """An objective of voxels and its minimum under the first noise."""
    start = begun(twins.objective_of(voxels, twin.coefficients), twin.unknowns)
    end = minimised(start, twins.settings(1.0).bounds, CHEAP, progress=twins.silent, title="")
    assert end.minimum.converged
    return end.objective, end.minimum


def linear(objective, found):
    return LinearisedObjective(objective, found.unknowns, found.evaluation)


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

    def total(factor):
        changed = [o.with_sd(factor * sd) if i in organs else o for i, o in enumerate(objective.observations)]
        there = objective.with_observations(changed)
        return there.total(linear(there, found)(found.unknowns))

    values = [total(factor) for factor in (0.93, 1.0, 1.07)]
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


def test_hyper_parameters_leave_the_old_objective_and_lower_the_objective(minimum, twins):
    """On linear residuals, and then the unknowns under them: each lowers J."""
    objective, found = minimum
    objective = with_correlations(objective, found.evaluation)
    before = objective(found.unknowns).value
    here = linear(objective, found)(found.unknowns)
    totals = [objective.total(here)]
    now, unknowns = objective, found.unknowns
    for _ in range(3):
        now = with_hyper_parameters(now, linear(now, found)(unknowns), unknowns)
        unknowns = gauss_newton(linear(now, found), unknowns, bounds=twins.settings(1.0).bounds).unknowns
        totals.append(now.total(linear(now, found)(unknowns)))
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
    assert spoilt[0, "surface distance"].key == good[0, "surface distance"].key
    assert spoilt[1, "surface distance"].sd > 1.3 * good[1, "surface distance"].sd
    plain, other = (with_scales(objective, e).states for e in (evaluation, spoilt_evaluation))
    first, untouched = ([o.weighting.sd for o in states[0].observations] for states in (other, plain))
    assert first == pytest.approx(untouched)
    second, before = ([o.weighting.sd for o in states[1].observations] for states in (other, plain))
    assert sum(second) > 1.2 * sum(before)


def test_an_alternative_stays_until_another_one_is_more_than_as_good(minimum, twins):
    objective, found = minimum
    size = float(np.sqrt(np.mean(found.unknowns[2:] ** 2)))
    for levels, chosen in (((size, 1.05 * size), 0), ((0.02 * size, size), 1)):
        one = replace(twins.mixture(objective, levels), chosen=(0,))
        there = with_hyper_parameters(one, linear(one, found)(found.unknowns), found.unknowns)
        assert there.chosen == (chosen,)


def test_what_is_learned_last_waits_until_it_is_asked_for(minimum, twins):
    objective, found = minimum
    size = float(np.sqrt(np.mean(found.unknowns[2:] ** 2)))
    one = twins.mixture(objective, (0.02 * size, size), last=True)
    here = linear(one, found)(found.unknowns)
    assert with_hyper_parameters(one, here, found.unknowns).chosen == (None,)
    assert with_hyper_parameters(replace(one, learn_last=True), here, found.unknowns).chosen == (1,)


def test_a_field_varies_by_what_is_stated(minimum, twins):
    """From the first iteration to the last: a floor under its variance would widen what is believed on the way."""
    objective, found = minimum
    size = float(np.sqrt(np.mean(found.unknowns[2:] ** 2)))
    one = twins.mixture(objective, (size, 1.05 * size), acts=Acts.MATERIAL)
    there = with_hyper_parameters(one, linear(one, found)(found.unknowns), found.unknowns)
    assert there.chosen == (0,)
    assert there.parameters.nuisance_precision == pytest.approx(one.parameters.blocks[0].precision)


def two_causes(objective, found, *, levels, odds, rivals=(), last=(True, True), slight=False):
    """Two blocks of the driver's modes, and an evaluation that sees 2 of the sum of their first ones and a modulus."""
    n, m = objective.n_parameters, objective.parameters.n_coefficients
    unknowns = np.zeros(n + m)
    unknowns[[n, n + 1]] = 1.0
    blocks = tuple(
        Block(
            "a",
            cause,
            Acts.BOUNDARY,
            (0,),
            np.eye(size) / own[0] ** 2,
            tuple((level**2 * np.eye(size),) for level in own),
            (1.0, 1.0),
            odds=odd,
            last=waits,
            rivals=against,
            slight=slight and cause == "a",
        )
        for cause, size, own, odd, against, waits in zip(
            "ab", (1, m - 1), levels, odds, ((), rivals), last, strict=True
        )
    )
    parameters = replace(objective.parameters, blocks=blocks, nuisance_precision=np.eye(m) / levels[0][0] ** 2)
    prior = parameters.prior_matrix
    seen = unknowns + np.eye(n + m)[0]
    matrix, score = 100.0 * np.outer(seen, seen) + prior, prior @ unknowns
    matrix[:n, :n] += 100.0 * np.eye(n)
    evaluation = replace(found.evaluation, matrix=matrix, prior=prior, score=score, prior_score=score)
    return replace(objective, parameters=parameters, learn_last=True), evaluation, unknowns


@pytest.mark.parametrize("likelier", [0, 1])
def test_of_two_causes_of_one_sight_the_likelier_is_taken_in_whichever_order_they_stand(minimum, likelier):
    odds = [(0.0, 0.0 if k == likelier else -1.0) for k in (0, 1)]
    objective, evaluation, unknowns = two_causes(*minimum, levels=[(0.1, 1.0)] * 2, odds=odds)
    chosen = with_amplitudes(replace(objective, chosen=(0, 0)), evaluation, unknowns).chosen
    assert chosen == tuple(int(k == likelier) for k in (0, 1))


@pytest.mark.parametrize(("odd", "expected"), [(0.0, 0), (3.0, 1)])
def test_what_a_rival_explains_as_well_is_the_rivals_where_none_has_a_choice_yet(minimum, odd, expected):
    """A block leaves its first alternative for the next where it explains more; it would else, choosing first."""
    odds, levels = [(0.0, odd, -9.0), (0.0, 0.0, 0.0)], [(0.1, 1.0, 2.0), (0.1, 1.0, 2.0)]
    for rivals, found in (((), 1), (("a",), expected)):
        posed = two_causes(*minimum, levels=levels, odds=odds, rivals=rivals, last=(False, True), slight=True)
        assert with_amplitudes(*posed).chosen[0] == found


def test_what_no_rival_is_taken_for_is_the_blocks_own(minimum):
    """An alternative further than the slight one is judged by itself."""
    levels = [(0.1, 0.2, 2.0), (0.1, 1.0, 2.0)]
    odds = [(0.0,) * 3] * 2
    posed = two_causes(*minimum, levels=levels, odds=odds, rivals=("a",), last=(False, True), slight=True)
    assert with_amplitudes(*posed).chosen == (2, 0)


def test_the_last_alternative_is_none_where_a_rival_has_left_its_first(minimum):
    odds = [(0.0, 0.0), (0.0, 0.0, 0.0)]
    for rivals, frame, before, expected in (((), 1, 0, 2), (("a",), 0, 0, 2), (("a",), 1, 0, 1), (("a",), 1, 2, 1)):
        undecided = list[float]()
        for last in (2.0, 3.0):
            levels = [(0.09, 0.1), (0.1, 0.2, last)]
            objective, evaluation, unknowns = two_causes(*minimum, levels=levels, odds=odds, rivals=rivals)
            objective = replace(objective, chosen=(frame, before))
            assert with_amplitudes(objective, evaluation, unknowns).chosen == (frame, expected)
            after = undecided_covariance(replace(objective, chosen=(frame, 1)), evaluation, unknowns)
            undecided.append(after["b"][0, 0])
        assert (undecided[0] == undecided[1]) == (expected == 1)
