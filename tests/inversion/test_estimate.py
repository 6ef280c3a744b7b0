"""Estimates of twin problems: the truth from exact surfaces, whatever the start, the optimiser or a common bias."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.approximation import LinearisationPoint, exact_approximation
from palpate.inversion import (
    REPORTED,
    Bounds,
    InversionSettings,
    StopRule,
    begun,
    fit_coefficients,
    invert,
    posterior_sd,
    searched,
)
from palpate.observation.noise_model import NoiseModel
from palpate.statement.conclusion import Observed, conclude
from palpate.uncertainty import FittedState, sandwich_covariance

SHARP = NoiseModel(np.array([1e-6]), np.array([3.0]))


@pytest.fixture(scope="module")
def found(twins, exact):
    return invert(exact, twins.settings(0.1, 2.0, 50.0), progress=twins.silent)


def test_the_mesh_that_made_the_data_finds_the_moduli(twins, found):
    """By linear elements and by quadratic ones."""
    quadratic = twins.exact_problem(twins.make_twin(element="P2"))
    for inversion in (found, invert(quadratic, twins.settings(8.0), progress=twins.silent)):
        assert inversion.minimum.converged
        assert np.abs(inversion.minimum.unknowns[:2] - twins.TRUTH).max() < 1e-4


def test_starts_far_apart_end_in_one_minimum(found):
    assert all(start.minimum.converged for start in found.starts)
    assert [start.candidate for start in found.starts] == [0, 0, 0]
    assert len(found.mixture.explanations) == 1


@pytest.mark.parametrize("seed", range(3))
def test_every_start_finds_a_minimum_whatever_the_noise(twins, twin, seed):
    """Under less noise than the images have it would seek one between the places where closest points jump."""
    problem = twins.noisy_problem(twin, sd_mm=0.4, seed=seed)
    inversion = invert(problem, twins.settings(0.5, 2.0, 8.0), progress=twins.silent)
    assert inversion.minimum.converged
    assert all(start.minimum.converged for start in inversion.starts)
    assert max(len(start.minimum.history) for start in inversion.starts) <= 10


def test_the_drivers_motion_is_found_with_the_moduli(found, twin):
    assert found.minimum.unknowns[2:] == pytest.approx(twin.coefficients, abs=5e-3)


def test_two_images_of_one_body_are_explained_by_one_set_of_moduli(twins, twin):
    problem = twins.exact_problem(twin, twins.deformed(twin.model, seed=6))
    inversion = invert(problem, twins.settings(1.0), progress=twins.silent)
    assert len(inversion.minimum.unknowns) == 2 + 2 * twin.model.n_modes
    assert np.abs(inversion.minimum.unknowns[:2] - twins.TRUTH).max() < 1e-4


@pytest.fixture(scope="module")
def plain(twins, voxels):
    return invert(voxels, twins.settings(1.0), progress=twins.silent)


def test_a_bias_of_both_distance_maps_leaves_the_moduli_alone(twins, twin, plain):
    biased = invert(twins.voxel_problem(twin, bias=0.4), twins.settings(1.0), progress=twins.silent)
    assert np.abs(np.expm1(biased.minimum.unknowns[:2] - plain.minimum.unknowns[:2])).max() < 1e-3
    sds = [found.objective.states[0].noise["surface distance"].sd for found in (plain, biased)]
    assert sds[1] == pytest.approx(sds[0], rel=1e-3)


def test_a_bias_of_one_distance_map_does_not(twins, voxels, plain):
    """The law above can fail: what only the later image has is a misfit."""
    state = voxels.states[0]
    targets = [replace(o.target, after=o.target.after.shifted(0.4)) for o in state.observations]
    moved = [replace(o, target=target) for o, target in zip(state.observations, targets, strict=True)]
    problem = replace(voxels, states=(state.with_observations(moved),))
    biased = invert(problem, twins.settings(1.0), progress=twins.silent)
    assert np.abs(biased.minimum.unknowns[:2] - plain.minimum.unknowns[:2]).max() > 1e-2


def test_without_a_known_modulus_ratios_are_found(twins):
    problem = twins.exact_problem(twins.make_twin(rest_kpa=None))
    inversion = invert(problem, twins.settings(0.5, 2.0), progress=twins.silent)
    assert problem.parameters.tissues == ("sac", "rest")
    assert inversion.minimum.unknowns[:2] == pytest.approx(np.log([2.0 / 3.0, 1.0 / 3.0]), abs=1e-4)


def test_bounds_are_respected(twins, exact):
    inversion = invert(exact, twins.settings(1.0, limits=(0.5, 2.5)), progress=twins.silent)
    assert inversion.minimum.unknowns[0] == pytest.approx(np.log(2.5))
    minima = [inversion.minimum, *(start.minimum for start in inversion.starts)]
    thetas = np.stack([iterate.theta for minimum in minima for iterate in minimum.history])
    assert inversion.minimum.converged
    assert thetas.min() >= np.log(0.5) - 1e-12
    assert thetas.max() <= np.log(2.5) + 1e-12


@pytest.fixture(scope="module")
def from_one_place(twins, twin):
    """An estimate from a start of its own for each tissue, that start, and what was said meanwhile."""
    start, said = np.log([5.0, 0.3]), list[str]()
    limits = Bounds(np.full(2, -4.0), np.full(2, 5.0))
    problem = twins.exact_problem(twin, noise=SHARP)
    return invert(problem, InversionSettings((start,), limits), progress=said.append), start, said


def test_starts_of_their_own_for_each_tissue_are_taken(from_one_place):
    inversion, start, _ = from_one_place
    assert inversion.starts[0].minimum.history[0].theta == pytest.approx(start)


def test_every_step_is_reported(from_one_place):
    for words in ("gland", "1 starts", "iteration 1"):
        assert any(words in line for line in from_one_place[2])


STATED = NoiseModel(np.array([0.03**2]), np.array([3.0]))


@pytest.fixture(scope="module")
def with_points(twins, twin, point_motion):
    """A problem of surfaces with and without the motion of three points within the organs, all with a stated noise."""
    problem = twins.exact_problem(twin, noise=STATED)
    points, state = twin.model.space.points, problem.states[0]
    middles = [shape.centre for shape in twins.BALLS[:2]] + [np.array([10.0, -10.0, 5.0])]
    numbers = [int(np.argmin(np.linalg.norm(points - middle, axis=1))) for middle in middles]
    seen = [point_motion.point_motion(n, points[n], twin.scene.displacement[n], sd_mm=0.05) for n in numbers]
    more = replace(state, observations=(*state.observations, *seen))
    return problem, replace(problem, states=(more,))


@pytest.fixture(scope="module")
def with_and_without(twins, with_points):
    return [invert(problem, twins.settings(0.5, 8.0), progress=twins.silent) for problem in with_points]


def test_a_second_kind_of_observation_is_estimated_from_together_with_the_surfaces(twins, with_and_without):
    """The estimate stays at the truth, and what more has been seen leaves less open."""
    surfaces, together = with_and_without
    assert together.minimum.converged
    assert np.all(np.abs(together.minimum.unknowns[:2] - twins.TRUTH) < 0.05 * posterior_sd(together.minimum, 2))
    assert set(together.objective.states[0].noise) == {"surface distance", "point motion"}
    sds = [posterior_sd(found.minimum, 2) for found in (surfaces, together)]
    assert np.all(sds[1] < 0.999 * sds[0])
    spreads = [np.sqrt(np.diag(sandwich_covariance(f.objective, f.minimum.evaluation))) for f in (surfaces, together)]
    assert np.all(spreads[1] <= spreads[0])


def test_a_second_kind_of_observation_is_stated_with_its_fit(twins, twin, with_and_without):
    grid, space = twin.scene.before.grid, twin.model.space
    images = ((twin.scene.after.labels - 1).astype(np.int16),)
    observed = Observed((FittedState(space, twin.scene.displacement, grid, grid),), images)
    result = conclude(with_and_without[1], twins.settings(0.5, 8.0), observed, truth={}, seed=1)
    assert [fit.tissue for fit in result.fits[0]] == ["gland", "sac", "tube", "landmark", "landmark", "landmark"]
    assert all(fit.end.rms_mm < 0.1 * fit.start.rms_mm for fit in result.fits[0])


@pytest.fixture(scope="module")
def of_voxels(twins, voxels):
    return invert(voxels, twins.settings(0.5, 2.0, 8.0), progress=twins.silent)


def test_the_way_to_the_estimate_does_not_show(twins, voxels, of_voxels):
    """The noise ends alike, too, and with it the posterior's width."""
    for ratio in (1.0, 3.0, 20.0):
        other = invert(voxels, twins.settings(ratio), progress=twins.silent)
        sd = np.sqrt(np.diag(of_voxels.mixture.covariance))
        assert other.minimum.converged
        assert np.all(np.abs(other.mixture.mean - of_voxels.mixture.mean) < 0.1 * sd)
        assert np.sqrt(np.diag(other.mixture.covariance)) == pytest.approx(sd, rel=5e-3)
        scales = [[o.weighting.sd for o in f.objective.observations] for f in (of_voxels, other)]
        assert scales[0] == pytest.approx(scales[1], rel=5e-3)


def test_it_ends_where_the_objective_is_least(of_voxels):
    """Of one explanation: the score vanishes along every log-modulus, all other unknowns at their best."""
    there = of_voxels.objective(of_voxels.minimum.unknowns)
    shift = np.linalg.solve(there.matrix.dense, there.score)
    assert np.all(np.abs(shift[:2]) < 0.1 * posterior_sd(of_voxels.minimum, 2))


def test_its_posterior_is_that_of_the_matrix_there(of_voxels):
    assert len(of_voxels.mixture.explanations) == 1
    sd = np.sqrt(np.diag(of_voxels.mixture.covariance))
    assert sd == pytest.approx(posterior_sd(of_voxels.minimum, 2), rel=0.02)
    assert np.all(np.abs(of_voxels.mixture.mean - of_voxels.minimum.unknowns[:2]) < 0.05 * sd)


def test_the_full_model_finds_the_same_where_the_reduced_one_stands(twins, twin, of_voxels):
    """All derivatives of the full model exact at every place."""
    found = of_voxels
    moduli = found.objective.parameters.moduli(found.minimum.unknowns)
    place = LinearisationPoint(moduli, found.minimum.unknowns[2:])
    start = begun(
        found.objective.with_approximations([exact_approximation(twin.model, None, place)]), found.minimum.unknowns
    )
    end = searched(start, twins.settings(1.0).bounds, REPORTED, progress=twins.silent, title="")
    assert end.minimum.converged
    assert np.all(np.abs(end.posterior.mean - found.mixture.mean) < 0.1 * posterior_sd(found.minimum, 2))


def test_every_start_tells_what_it_did_itself_and_the_shared_steps_stand_once(of_voxels):
    histories = [start.minimum.history for start in of_voxels.starts]
    for start, history in zip(of_voxels.starts, histories, strict=True):
        assert np.array_equal(history[0].theta, start.theta)
        assert np.array_equal(history[-1].theta, start.minimum.unknowns[:2])
        assert start.minimum.evaluation.misfit_mm2 > 0.0
    shared = {tuple(iterate.theta) for iterate in of_voxels.minimum.history}
    assert len(shared) == len(of_voxels.minimum.history) > 1
    assert not shared & {tuple(iterate.theta) for history in histories for iterate in history}


def test_what_it_cost_is_counted(twins, voxels, of_voxels):
    """Starts are judged on the frozen posterior, which costs no evaluation of the objective."""
    one = invert(voxels, twins.settings(2.0), progress=twins.silent)
    assert 4 <= of_voxels.evaluations <= 25
    assert of_voxels.evaluations - len(of_voxels.minimum.history) == one.evaluations - len(one.minimum.history)
    assert of_voxels.counts.factorisations >= 1


def test_log_moduli_that_are_held_stay(twins, twin, voxels):
    objective = twins.objective_of(voxels, twin.coefficients)
    unknowns = np.append([0.3, 0.1], np.zeros(len(twin.coefficients)))
    fitted = fit_coefficients(objective, unknowns)
    assert fitted.converged
    assert np.array_equal(fitted.unknowns[:2], unknowns[:2])
    assert objective.rematched(fitted.unknowns)(fitted.unknowns).value < 0.2 * objective(unknowns).value


def test_a_search_leaves_the_objective_with_which_it_begins_as_it_was(twins, twin, voxels):
    objective = twins.objective_of(voxels, twin.coefficients)
    before = objective.rematched(twin.unknowns)(twin.unknowns).value
    once = StopRule(iterations=1)
    searched(begun(objective, twin.unknowns), twins.settings(1.0).bounds, once, progress=twins.silent, title="")
    assert objective.rematched(twin.unknowns)(twin.unknowns).value == before
