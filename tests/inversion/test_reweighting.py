"""How each residual counts: by the noise of its kind, robustly, and again when the residuals have told more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.inversion import gauss_newton, reweighted, with_first_noise
from palpate.inversion.reweighting import _beyond_modes, fitted_noise
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
    assert {id(o.noise_model) for o in objective.observations} == {id(objective.noise["surface distance"])}


def test_the_first_noise_does_not_depend_on_what_was_weighted_before(minimum):
    objective, _ = minimum
    coarse = objective.with_observations([o.with_noise(NOISE) for o in objective.observations])
    first = with_first_noise(coarse)
    assert first.noise["surface distance"].sd == objective.noise["surface distance"].sd
    assert first.noise["surface distance"].sd != NOISE.sd


def test_a_drivers_residuals_do_not_tell_the_noise(minimum):
    _, found = minimum
    lines = found.evaluation.lines
    telling = [line.residuals for line in lines if not line.observation.of_driver]
    assert 0 < len(telling) < len(lines)
    alone = lines[0].observation.fitted_noise(telling)
    together = lines[0].observation.fitted_noise([line.residuals for line in lines])
    noise = fitted_noise(found.evaluation)["surface distance"]
    assert noise.sd == alone.sd
    assert noise.sd != together.sd


def test_reweighting_gives_a_new_objective_and_leaves_the_old_one(minimum, twin):
    objective, found = minimum
    before = objective.value(twin.unknowns)
    again = reweighted(objective, found).rematched(found.unknowns)
    assert objective.value(twin.unknowns) == before
    assert again.value(twin.unknowns) != before
    assert again.noise["surface distance"].sd == fitted_noise(found.evaluation)["surface distance"].sd
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
    noise = fitted_noise(found.evaluation)["surface distance"]
    (near,), (far,) = ([x for x in m.evaluation.lines if x.observation.of_driver] for m in (found, there))

    def share(line, beyond):
        seen = line.observation.with_noise(noise)
        return seen.reweighted(line.residuals, beyond).weighting.precision / seen.weighting.precision

    beyond = [_beyond_modes(line, objective.n_parameters) for line in (near, far)]
    assert share(far, None) < 0.3 * share(near, None)
    assert share(far, beyond[1]) == pytest.approx(share(near, beyond[0]), rel=0.05)
