"""Estimates of twin problems: the truth from exact surfaces, whatever the start, the optimiser or a common bias."""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from palpate.inversion import (
    Bounds,
    Candidate,
    InversionSettings,
    Objective,
    Outcome,
    StartRun,
    begun,
    concluded,
    invert,
    minimised,
    posterior_sd,
)
from palpate.inversion import starts as of_starts
from palpate.inversion.trust_region import NEAR
from palpate.observation.noise_model import NoiseModel
from palpate.study.estimation import Observed, conclude
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
    for words in ("gland", "1 starts", "objective"):
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
def iterate(twins, twin, voxels):
    """The end of a loop near the truth, on a reduced basis."""
    start = begun(twins.objective_of(voxels, twin.coefficients), twin.unknowns)
    end = minimised(start, twins.settings(1.0).bounds, NEAR, progress=twins.silent, title="")
    assert end.minimum.converged
    return end


@pytest.fixture(scope="module")
def worse(twins, twin, iterate):
    """A minimum elsewhere: that of coarser images of a body twice as stiff, whose noise is larger."""
    other = twins.deformed(twin.model, voxel_mm=2.0, truth=twins.TRUTH + 0.7)
    start = begun(twins.objective_of(twins.voxel_problem(other), other.coefficients), other.unknowns)
    end = minimised(start, twins.settings(1.0).bounds, NEAR, progress=twins.silent, title="")
    assert end.minimum.converged
    assert end.objective.observations[0].weighting.sd > iterate.objective.observations[0].weighting.sd
    return end


def together(twins, *iterates):
    starts = tuple(StartRun(np.zeros(2), it.minimum, i) for i, it in enumerate(iterates))
    bounds = twins.settings(1.0).bounds
    ends = [Candidate(iterate, iterate.objective.total(iterate.minimum.evaluation)) for iterate in iterates]
    return concluded(ends, starts, iterates[0].minimum.evaluation, bounds)


@pytest.mark.parametrize("order", [1, -1])
def test_the_worse_fit_does_not_win_because_its_noise_is_larger(twins, iterate, worse, order):
    """What a larger noise takes off its misfit it pays for by ln Z, whichever was sought first."""
    found = together(twins, *(iterate, worse)[::order])
    assert found.minimum.unknowns == pytest.approx(iterate.minimum.unknowns)
    assert found.candidates[found.best].value < found.candidates[1 - found.best].value


def test_minima_are_compared_with_the_same_numbers_of_residuals(twins, iterate, worse):
    """More of them make every value another one: by those of the other minimum it is the same as without."""
    noise = NoiseModel(np.array([0.2**2]), np.array([1.0]))
    seen = [o.with_correlation(noise) for o in iterate.objective.observations]
    other = replace(iterate, objective=iterate.objective.with_observations(seen))
    fewest, some, most = (it.objective.n_independent for it in (worse, iterate, other))
    assert 1.2 * fewest < some < most / 1.2
    values = [[c.value for c in together(twins, one, worse).candidates] for one in (iterate, other)]
    assert values[1] == pytest.approx(values[0], abs=0.02)
    assert values[0][1] > values[0][0] + 2.0


@pytest.mark.parametrize("ratios", [(1.0,), (0.3, 2.0, 8.0)])
def test_every_evaluation_of_the_objective_is_counted(twins, voxels, ratios, monkeypatch):
    calls = count()
    evaluated = Objective.__call__

    def counted(objective, unknowns):
        next(calls)
        return evaluated(objective, unknowns)

    monkeypatch.setattr(Objective, "__call__", counted)
    found = invert(voxels, twins.settings(*ratios), progress=twins.silent)
    assert found.evaluations == next(calls)
    assert found.evaluations <= 25


def test_iterates_that_met_are_one_candidate_of_which_the_one_sought_first_stands(twins, iterate):
    minimum = iterate.minimum
    near = replace(minimum, unknowns=minimum.unknowns + np.append([0.01, -0.01], np.zeros(len(minimum.unknowns) - 2)))
    found = together(twins, iterate, replace(iterate, minimum=near))
    assert len(found.candidates) == 1
    assert [start.candidate for start in found.starts] == [0, 0]
    assert found.minimum is minimum


def test_minima_further_apart_than_their_own_uncertainty_are_candidates_of_their_own(twins, iterate, worse):
    found = together(twins, iterate, worse)
    assert len(found.candidates) == 2
    assert [start.candidate for start in found.starts] == [0, 1]


def test_a_minimum_that_did_not_converge_is_not_the_best_one_while_another_did(twins, iterate, worse):
    failed = replace(iterate, minimum=replace(iterate.minimum, outcome=Outcome.STUCK))
    found = together(twins, failed, worse)
    assert found.best == 1
    assert found.minimum.converged


def test_every_start_tells_what_it_did_itself_and_the_shared_steps_stand_once(twins, voxels):
    found = invert(voxels, twins.settings(0.5, 8.0), progress=twins.silent)
    first, second = (start.minimum.history for start in found.starts)
    for start, history in zip(found.starts, (first, second), strict=True):
        assert np.array_equal(history[0].theta, start.theta)
        assert np.array_equal(history[-1].theta, start.minimum.unknowns[:2])
        assert start.minimum.evaluation.misfit_mm2 > 0.0
    assert not {tuple(i.theta) for i in first} & {tuple(i.theta) for i in second}
    shared = {tuple(iterate.theta) for iterate in found.minimum.history[1:]}
    assert len(shared) > 1
    assert not shared & {tuple(iterate.theta) for history in (first, second) for iterate in history}


def test_starts_that_lead_elsewhere_are_followed_the_best_first_and_others_say_that_they_were_not(
    twins, voxels, monkeypatch
):
    """Four minima of the cheapest model, told to lie apart: the first one's, two that are followed, one that is not."""
    screened = of_starts.cheapest_minima

    def apart(*of):
        here, *_ = screened(*of)
        ways = [np.append([w, w], np.zeros(len(here.unknowns) - 2)) for w in (0.0, 1.5, -1.5, 3.0)]
        values = [replace(here.evaluation, value=here.evaluation.value + k) for k in (0.0, 2.0, 1.0, 3.0)]
        return [replace(here, unknowns=here.unknowns + w, evaluation=v) for w, v in zip(ways, values, strict=True)]

    followed, follow = [], of_starts.minimised

    def noted(start, *of, **named):
        followed.append((named["title"], start.minimum.unknowns[:2]))
        return follow(start, *of, **named)

    monkeypatch.setattr(of_starts, "cheapest_minima", apart)
    monkeypatch.setattr(of_starts, "minimised", noted)
    found = invert(voxels, twins.settings(0.5, 1.0, 2.0, 4.0), progress=twins.silent)
    assert [title for title, _ in followed if title.startswith("start")] == ["start 3", "start 2"]
    assert [start.candidate for start in found.starts] == [0, 0, 0, None]
    assert len(found.candidates) == 1
