"""Estimates of twin problems: the truth from exact surfaces, whatever the start, the optimiser or a common bias."""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from palpate.inversion import (
    Bounds,
    InversionSettings,
    Objective,
    OuterIterate,
    estimate,
    fit_driver,
    gauss_newton,
    invert,
    posterior_sd,
)
from palpate.inversion.optimise import same_minimum
from palpate.observation.noise_model import NoiseModel
from palpate.study.estimation import Observed, conclude
from palpate.uncertainty import FittedState, sandwich_covariance

SHARP = NoiseModel(np.array([1e-6]), np.array([3.0]))


@pytest.fixture(scope="module")
def found(twins, exact):
    return invert(exact, twins.settings(0.1, 2.0, 50.0), progress=twins.silent)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_the_mesh_that_made_the_data_finds_the_moduli(twins, element):
    problem = twins.exact_problem(twins.make_twin(element=element))
    inversion = invert(problem, twins.settings(0.5, 8.0), progress=twins.silent)
    assert inversion.minimum.converged
    assert np.abs(inversion.minimum.unknowns[:2] - twins.TRUTH).max() < 1e-4


def test_starts_far_apart_end_in_one_minimum(found):
    assert all(start.minimum.converged for start in found.starts)
    assert [start.candidate for start in found.starts] == [0, 0, 0]
    assert len(found.candidates) == 1


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


def test_the_optimisers_end_in_the_same_minimum(twins, twin):
    problem = twins.exact_problem(twin, noise=SHARP)
    ends = [
        invert(problem, twins.settings(0.5, method=method), progress=twins.silent).minimum
        for method in ("gauss-newton", "lbfgs")
    ]
    assert all(end.converged for end in ends)
    assert np.abs(ends[0].unknowns[:2] - ends[1].unknowns[:2]).max() < 1e-3


def test_two_images_of_one_body_are_explained_by_one_set_of_moduli(twins, twin):
    problem = twins.exact_problem(twin, twins.deformed(twin.model, seed=6))
    inversion = invert(problem, twins.settings(1.0), progress=twins.silent)
    assert len(inversion.minimum.unknowns) == 2 + 2 * twin.model.n_modes
    assert np.abs(inversion.minimum.unknowns[:2] - twins.TRUTH).max() < 1e-4


def test_a_bias_of_both_distance_maps_leaves_the_moduli_alone(twins, twin, voxels):
    plain, biased = (
        invert(problem, twins.settings(1.0), progress=twins.silent)
        for problem in (voxels, twins.voxel_problem(twin, bias=0.4))
    )
    assert np.abs(np.expm1(biased.minimum.unknowns[:2] - plain.minimum.unknowns[:2])).max() < 1e-3
    sds = [found.objective.states[0].noise["surface distance"].sd for found in (plain, biased)]
    assert sds[1] == pytest.approx(sds[0], rel=1e-3)


def test_a_bias_of_one_distance_map_does_not(twins, voxels):
    """The law above can fail: what only the later image has is a misfit."""
    state = voxels.states[0]
    targets = [replace(o.target, after=o.target.after.shifted(0.4)) for o in state.observations]
    moved = [replace(o, target=target) for o, target in zip(state.observations, targets, strict=True)]
    plain, biased = (
        invert(problem, twins.settings(1.0), progress=twins.silent)
        for problem in (voxels, replace(voxels, states=(state.with_observations(moved),)))
    )
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
    assert thetas.min() >= np.log(0.5) - 1e-12
    assert thetas.max() <= np.log(2.5) + 1e-12


def test_starts_of_their_own_for_each_tissue_are_taken(twins, twin):
    start = np.log([5.0, 0.3])
    limits = Bounds(np.full(2, -4.0), np.full(2, 5.0))
    problem = twins.exact_problem(twin, noise=SHARP)
    inversion = invert(problem, InversionSettings((start,), limits), progress=twins.silent)
    assert inversion.starts[0].minimum.history[0].theta == pytest.approx(start)


def test_the_driver_alone_is_fitted_at_given_moduli(twin, exact):
    ((displacement,),) = fit_driver(exact, twin.moduli)
    error = np.linalg.norm(displacement - twin.scene.displacement, axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(np.sum(twin.scene.displacement**2, axis=1)))


def test_every_step_is_reported(twins, twin):
    lines = []
    invert(twins.exact_problem(twin, noise=SHARP), twins.settings(1.0), progress=lines.append)
    assert any("gland" in line for line in lines)
    assert any("start 1 of 1" in line for line in lines)


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
def imaged(twins, twin, voxels):
    """An objective of voxels and its minimum near the truth."""
    objective = twins.objective_of(voxels, twin.coefficients).rematched(twin.unknowns)
    return objective, gauss_newton(objective, twin.unknowns, bounds=twins.settings(1.0).bounds)


def believing(objective, factor):
    """The objective with noise of `factor` times the size."""
    noise = objective.states[0].noise["surface distance"]
    larger = replace(noise, variances=factor**2 * noise.variances)
    return objective.with_observations([o.with_noise(larger) for o in objective.observations])


def worse(objective, minimum, by):
    """A minimum elsewhere, where another objective has one: gland and sac held apart from where they fit."""
    theta = minimum.unknowns[:2] + by
    held = Bounds(theta - 1e-3, theta + 1e-3)
    return gauss_newton(objective, np.concatenate([theta, minimum.unknowns[2:]]), bounds=held)


def concluded(twins, *iterates, settings=None):
    starts = tuple(estimate.StartRun(np.zeros(2), it.minimum, i) for i, it in enumerate(iterates))
    return estimate._concluded(iterates, starts, iterates[0].minimum.evaluation, settings or twins.settings(1.0), 0)


@pytest.mark.parametrize("order", [1, -1])
def test_the_worse_fit_does_not_win_because_its_noise_is_believed_to_be_larger(twins, imaged, order, monkeypatch):
    """Its own value is the smaller one; under one noise model it is the larger one, whichever was sought first."""
    objective, minimum = imaged
    rough = believing(objective, 3.0)
    elsewhere = worse(rough, minimum, 0.7)
    assert elsewhere.evaluation.misfit_mm2 > 1.2 * minimum.evaluation.misfit_mm2
    assert elsewhere.evaluation.value < minimum.evaluation.value
    hold(monkeypatch)
    good, bad = OuterIterate(objective, minimum), OuterIterate(rough, elsewhere)
    found = concluded(twins, *(good, bad)[::order])
    assert found.minimum.unknowns == pytest.approx(minimum.unknowns)
    assert found.candidates[found.best].value < found.candidates[1 - found.best].value


def test_no_kind_of_observation_decides_alone_under_which_noise_minima_are_compared(twins, with_points, monkeypatch):
    """One per cent in the largest standard deviation of all is less than a factor of three in another kind's."""
    _, problem = with_points
    objective = twins.objective_of(problem)
    sds = [{"surface distance": 0.1, "point motion": 1.0}, {"surface distance": 0.3, "point motion": 0.99}]
    noises = [{kind: NoiseModel(np.array([sd**2]), np.array([3.0])) for kind, sd in of.items()} for of in sds]
    iterates = []
    for noise in noises:
        believed = objective.with_observations([o.with_noise(noise[o.kind]) for o in objective.observations])
        iterates.append(OuterIterate(believed, gauss_newton(believed, np.zeros(14), bounds=twins.settings(1.0).bounds)))
    compared = []

    def under(objective, start, settings, **_):
        compared.append({kind: noise.sd for kind, noise in objective.states[0].noise.items()})
        return gauss_newton(objective, start, bounds=settings.bounds, max_steps=1)

    monkeypatch.setattr(estimate, "minimised", under)
    estimate._values(iterates, twins.settings(1.0))
    assert compared == [pytest.approx(sds[0])] * 2


@pytest.mark.parametrize("ratios", [(1.0,), (0.3, 2.0, 8.0)])
def test_every_evaluation_of_the_objective_is_counted(twins, twin, ratios, monkeypatch):
    calls = count()
    evaluated = Objective.__call__

    def counted(objective, unknowns):
        next(calls)
        return evaluated(objective, unknowns)

    monkeypatch.setattr(Objective, "__call__", counted)
    found = invert(twins.voxel_problem(twin), twins.settings(*ratios), progress=twins.silent)
    assert found.evaluations == next(calls)


def test_what_was_spent_on_other_minima_is_counted(twins, voxels, monkeypatch):
    """The second start's minimum is followed on its own, on approximations that the first one's loop has made."""
    ends, follow, groups, whole = [], estimate.run_outer_loop, iter([[0, 1]]), estimate._groups

    def followed(*of, **named):
        ends.append(follow(*of, **named))
        return ends[-1]

    monkeypatch.setattr(estimate, "run_outer_loop", followed)
    monkeypatch.setattr(estimate, "_groups", lambda *of: next(groups, None) or whole(*of))
    monkeypatch.setattr(estimate, "as_good", lambda *_: False)
    found = invert(voxels, twins.settings(0.5, 8.0), progress=twins.silent)
    first, second = ends
    assert sum(vars_of(second.counts)) > sum(vars_of(first.counts)) - sum(vars_of(first.checks))
    assert found.counts == second.counts + first.checks
    assert first.checks.forward > 0
    history = found.minimum.history
    assert history in (first.minimum.history, second.minimum.history)


@pytest.mark.parametrize(("share", "sought"), [(0.9, 0), (1.1, 1)])
def test_minima_within_the_noise_that_was_found_are_not_sought_again(twins, voxels, monkeypatch, share, sought):
    """The first noise model is of voxels alone: under a third of what is found they are further apart than it lets."""
    settings, from_starts, another = twins.settings(0.5), estimate._from_starts, estimate._another
    found, calls = invert(voxels, settings, progress=twins.silent), []
    way = np.append(share * posterior_sd(found.minimum, 2), np.zeros(len(found.minimum.unknowns) - 2))

    def two(*of):
        first, _ = from_starts(*of)
        first = replace(first, evaluation=replace(first.evaluation, matrix=9.0 * first.evaluation.matrix))
        away = replace(first, unknowns=first.unknowns + way, evaluation=replace(first.evaluation, value=np.inf))
        assert not same_minimum(away.unknowns, first, 2)
        return [first, away]

    monkeypatch.setattr(estimate, "_from_starts", two)
    monkeypatch.setattr(estimate, "_another", lambda *of: calls.append(1) or another(*of))
    again = invert(voxels, replace(settings, starts=settings.starts * 2), progress=twins.silent)
    assert len(calls) == sought
    assert [start.candidate for start in again.starts] == [0, 0]


def vars_of(counts):
    return [getattr(counts, name) for name in ("forward", "adjoint", "tangent", "factorisations")]


def hold(monkeypatch):
    """Minima stay where they are when they are compared: the objective has no second one there."""

    def here(objective, start, settings, **_):
        return gauss_newton(objective, start, bounds=settings.bounds, held=True)

    monkeypatch.setattr(estimate, "minimised", here)


def test_iterates_that_met_are_one_candidate_of_which_the_one_sought_first_stands(twins, imaged):
    objective, minimum = imaged
    near = replace(minimum, unknowns=minimum.unknowns + np.append([0.01, -0.01], np.zeros(len(minimum.unknowns) - 2)))
    found = concluded(twins, OuterIterate(objective, minimum), OuterIterate(objective, near))
    assert len(found.candidates) == 1
    assert [start.candidate for start in found.starts] == [0, 0]
    assert found.minimum is minimum


def test_minima_further_apart_than_their_own_uncertainty_are_candidates_of_their_own(twins, imaged):
    objective, minimum = imaged
    far = worse(objective, minimum, 0.7)
    found = concluded(twins, OuterIterate(objective, minimum), OuterIterate(objective, far))
    assert len(found.candidates) == 2
    assert [start.candidate for start in found.starts] == [0, 1]


def test_a_minimum_that_did_not_converge_is_not_the_best_one_while_another_did(twins, imaged, monkeypatch):
    objective, minimum = imaged
    hold(monkeypatch)
    far = worse(objective, minimum, 0.7)
    failed = OuterIterate(objective, replace(minimum, outcome=estimate.Outcome.STUCK))
    found = concluded(twins, failed, OuterIterate(objective, far))
    assert found.best == 1
    assert found.minimum.converged


def test_every_start_keeps_its_own_steps_and_verdict_and_the_shared_ones_stand_once(twins, twin):
    """Starts of one minimum share what was done after it: no step of one is told as another's."""
    problem = twins.voxel_problem(twin)
    found = invert(problem, twins.settings(0.5, 8.0), progress=twins.silent)
    first, second = (start.minimum.history for start in found.starts)
    for start, history in zip(found.starts, (first, second), strict=True):
        assert np.array_equal(history[0].theta, start.theta)
        assert np.array_equal(history[-1].theta, start.minimum.unknowns[:2])
    assert not {tuple(i.theta) for i in first} & {tuple(i.theta) for i in second}
    shared = {tuple(iterate.theta) for iterate in found.minimum.history[1:]}
    assert len(shared) > 1
    assert not shared & {tuple(iterate.theta) for history in (first, second) for iterate in history}
