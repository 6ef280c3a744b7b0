"""Estimates of twin problems: the truth from exact surfaces, whatever the start, the optimiser or a common bias."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.inversion import Bounds, InversionSettings, fit_driver, invert
from palpate.observation.noise_model import NoiseModel

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
    sds = [found.objective.noise["surface distance"].sd for found in (plain, biased)]
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
