"""How each residual counts: by the noise of its kind, robustly, and again when the residuals have told more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.inversion import gauss_newton, reweighted, with_first_noise
from palpate.inversion.optimise import Minimum
from palpate.inversion.reweighting import _beyond_modes, fitted_noise, with_found_noise
from palpate.observation.noise_model import NoiseModel

NOISE = NoiseModel(np.array([0.2**2]), np.array([4.0]))


@pytest.fixture(scope="module")
def minimum(twins, twin, voxels):
    """An objective of voxels and the minimum near the truth."""
    objective = twins.objective_of(voxels, twin.coefficients).rematched(twin.unknowns)
    return objective, gauss_newton(objective, twin.unknowns, bounds=twins.settings(1.0).bounds)


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
    lines = found.evaluation.lines
    telling = [line.residuals for line in lines if not line.observation.of_driver]
    assert 0 < len(telling) < len(lines)
    alone = lines[0].observation.fitted_noise(telling)
    together = lines[0].observation.fitted_noise([line.residuals for line in lines])
    noise = fitted_noise(found.evaluation)[0, "surface distance"]
    assert noise.sd == alone.sd
    assert noise.sd != together.sd


def test_under_the_noise_that_is_found_all_residuals_count_by_their_area(minimum):
    objective, found = minimum
    under = with_found_noise(objective, found)
    noise = fitted_noise(found.evaluation)[0, "surface distance"]
    assert noise.sd != objective.observations[0].noise_model.sd
    assert all(o.noise_model.key == noise.key for o in under.observations)
    ratios = [o.weighting.precision / o.target.area.sum() for o in under.observations]
    assert ratios == pytest.approx([1.0 / (noise.correlation_area * noise.sd**2)] * 3)
    assert all(np.isinf(o.weighting.loss.cutoff) for o in under.observations)


def test_reweighting_gives_a_new_objective_and_leaves_the_old_one(minimum, twin):
    objective, found = minimum
    before = objective.value(twin.unknowns)
    again = reweighted(objective, found).rematched(found.unknowns)
    assert objective.value(twin.unknowns) == before
    assert again.value(twin.unknowns) != before
    assert again.states[0].noise["surface distance"].sd == fitted_noise(found.evaluation)[0, "surface distance"].sd
    assert all(np.isfinite(o.weighting.loss.cutoff) for o in again.observations)


def test_reweighting_again_at_the_same_place_changes_little(minimum):
    """The weights are a function of the residuals: those of the same residuals are the same."""
    objective, found = minimum
    once, twice = reweighted(objective, found), reweighted(reweighted(objective, found), found)
    assert [o.weighting for o in twice.observations] == [o.weighting for o in once.observations]


def test_a_driver_counts_no_less_for_what_its_modes_can_follow_and_do_not(minimum):
    """Else it would follow its wall still less, and a prior that is learned from it would hold it there."""
    objective, found = minimum
    away = found.unknowns.copy()
    away[objective.n_parameters : objective.n_parameters + 3] += 0.2  # the wall as a whole, off its image
    there = replace(found, unknowns=away, evaluation=objective(away))
    noise = fitted_noise(found.evaluation)[0, "surface distance"]
    (near,), (far,) = ([x for x in m.evaluation.lines if x.observation.of_driver] for m in (found, there))

    def share(line, beyond):
        seen = line.observation.with_noise(noise)
        return seen.reweighted(line.residuals, beyond).weighting.precision / seen.weighting.precision

    beyond = [_beyond_modes(line, objective.n_parameters) for line in (near, far)]
    assert share(far, None) < 0.3 * share(near, None)
    assert share(far, beyond[1]) == pytest.approx(share(near, beyond[0]), rel=0.05)


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
        for line in evaluation.lines
    ]
    good, spoilt = (fitted_noise(e) for e in (evaluation, replace(evaluation, lines=tuple(lines))))
    assert spoilt[0, "surface distance"].key == good[0, "surface distance"].key
    assert spoilt[1, "surface distance"].sd > 1.3 * good[1, "surface distance"].sd
    minimum = Minimum(np.zeros(problem.parameters.n_unknowns), replace(evaluation, lines=tuple(lines)), None, ())
    again = reweighted(objective, minimum)
    first, second = ([o.weighting.precision for o in state.observations] for state in again.states)
    untouched = reweighted(objective, replace(minimum, evaluation=evaluation)).states
    assert first == pytest.approx([o.weighting.precision for o in untouched[0].observations])
    assert sum(second) < 0.7 * sum(o.weighting.precision for o in untouched[1].observations)
