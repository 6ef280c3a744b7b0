"""The combinations of a block's unknowns that the images tell: what is left out of them moves no estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.approximation import reduced_basis
from palpate.inversion import LaterState, invert
from palpate.inversion.starts import LEFT_OUT, informed_combinations, informed_start
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.material import material_modes
from palpate.unknowns import Acts, Alternative, Block, Choice, material_blocks, parameter_map, unit_blocks
from palpate.unknowns.blocks import only


def spread(rng, n):
    """A covariance (n, n) whose sizes span three orders of magnitude."""
    axes = np.linalg.qr(rng.standard_normal((n, n)))[0]
    return (axes * np.geomspace(1e-3, 1.0, n)) @ axes.T


@pytest.fixture(scope="module")
def patchy(twins, twin):
    """The voxel problem of a twin with modes of ln E in all tissues."""
    space = twin.model.space
    modes = material_modes(space.mesh, (0, 1, 3), length_mm=9.0)
    model = linear_model(space, twin.model.constraint, material=modes)
    blocks = material_blocks(modes, space.mesh, (0,), heterogeneity_sd=0.3, poisson_sd=0.0)
    problem = twins.voxel_problem(twin)
    parameters = parameter_map(twin.scene.tissues, model.regions, [*unit_blocks(model.constraint.n_modes), *blocks])
    return replace(problem, states=(LaterState(model, problem.states[0].observations),), parameters=parameters)


def with_every_unknown(twins, problem):
    """The estimate with all unknowns of the blocks, on a reduced basis of their full responses."""
    begin = np.concatenate([twins.settings(2.0).centre, np.zeros(problem.parameters.n_coefficients)])
    (state,) = problem.states
    moduli = problem.parameters.moduli(begin)
    values = state.model.solve(moduli, begin[2:]).values
    responses = state.model.system(moduli).material_responses(values)
    basis = reduced_basis(state.model, moduli).with_material(responses, moduli, values)
    states = (state.with_approximation(basis),)
    return invert(replace(problem, states=states), twins.settings(2.0), progress=twins.silent)


def test_estimates_with_what_is_seen_are_those_with_all_unknowns(twins, patchy):
    settings = twins.settings(2.0)
    seen = invert(patchy, settings, progress=twins.silent)
    whole = with_every_unknown(twins, patchy)
    assert whole.objective.parameters.n_unknowns == patchy.parameters.n_unknowns
    assert seen.objective.parameters.n_unknowns < 0.7 * patchy.parameters.n_unknowns
    sds = [np.sqrt(np.diag(found.mixture.covariance)) for found in (seen, whole)]
    assert seen.mixture.mean == pytest.approx(whole.mixture.mean, abs=0.1 * sds[1].min())
    assert sds[0] == pytest.approx(sds[1], rel=0.03)


def test_starts_round_the_middle_of_the_bounds_are_judged_from_one_minimum(twins, patchy):
    """Which they are moves no estimate, as long as they lead to the same minimum."""
    every = [twins.settings(*ratios) for ratios in ((0.2, 0.5, 3.0), (1.0, 9.0, 30.0), (2.0,))]
    found = [invert(patchy, settings, progress=twins.silent) for settings in every]
    assert all(run.candidate == 0 for each in found for run in each.starts)
    assert all(each.minimum.unknowns == pytest.approx(found[0].minimum.unknowns, abs=1e-7) for each in found)
    assert [len(each.starts) for each in found] == [3, 3, 1]


@pytest.mark.parametrize(("ratios", "place"), [((0.5, 8.0), 2.0), ((3.0, 8.0), 3.0), ((0.1, 0.4), 0.4)])
def test_an_estimate_begins_no_further_than_its_starts_lie(twins, ratios, place):
    """Bounds say where nothing is sought, not where an estimate may be."""
    assert twins.settings(*ratios).centre == pytest.approx(np.log(place))


def test_what_is_left_out_could_explain_less_than_it_may(rng):
    """The posterior's covariance of what is kept is that of all unknowns, but for the share that is stated."""
    n = 40
    covariance, information = spread(rng, n), 40.0 * spread(rng, n)
    alternatives = Alternative(0.01 * covariance, name="still"), Alternative(covariance, name="moves")
    block = Block("a", "b", Acts.BOUNDARY, (0,), alternatives, Choice.FRAME)
    basis, inverse = informed_combinations(block, information)
    assert basis.shape[1] < n
    assert inverse @ basis == pytest.approx(np.eye(basis.shape[1]), abs=1e-9)
    left = np.eye(n) - basis @ inverse
    assert np.trace(information @ left @ covariance @ left.T) < LEFT_OUT
    kept = block.combined(inverse)
    narrow = basis @ np.linalg.inv(basis.T @ information @ basis + np.linalg.inv(kept.widest)) @ basis.T
    whole = np.linalg.inv(information + np.linalg.inv(covariance))
    rest = left @ covariance @ left.T
    assert np.linalg.eigvalsh(narrow + rest - whole).min() > -1e-9  # what is left at its prior is no narrower


def test_a_motion_of_several_images_leaves_out_no_more_of_any_of_them(rng):
    n = 40
    covariance, informations = spread(rng, n), [size * spread(rng, n) for size in (4.0, 40.0, 10.0)]
    block = Block("a", "b", Acts.BOUNDARY, (0,), only(covariance), Choice.FRAME)
    basis, inverse = informed_combinations(block, *informations)
    assert basis.shape[1] < n
    left = np.eye(n) - basis @ inverse
    assert all(np.trace(seen @ left @ covariance @ left.T) < LEFT_OUT for seen in informations)


def test_images_of_one_body_have_the_same_combinations_of_a_motion_and_one_model_of_them(twins, twin):
    """The answer is that with all unknowns, which each image has for itself."""
    one, size = twins.exact_problem(twin, twins.deformed(twin.model, seed=6)), twin.model.n_modes
    parameters = one.parameters

    def problem(choice, variance):
        blocks = [Block("wall", "driver", Acts.BOUNDARY, (s,), only(variance * np.eye(size)), choice) for s in range(2)]
        return replace(one, parameters=replace(parameters, blocks=tuple(blocks), priors=()))

    start = informed_start(problem(Choice.FRAME, 1e-4), np.zeros(2), progress=twins.silent)
    first, second = start.objective.approximations
    assert first.constraint.modes is second.constraint.modes
    assert first.constraint.n_modes < size
    assert first.full_model.coupling is second.full_model.coupling
    assert first.model.output_basis[0] is second.model.output_basis[0]
    free, fixed = (
        informed_start(problem(choice, 4.0), np.zeros(2), progress=twins.silent)
        for choice in (Choice.FRAME, Choice.NONE)
    )
    assert free.minimum.evaluation.value == pytest.approx(fixed.minimum.evaluation.value, rel=1e-4)


def test_offsets_and_what_has_one_prior_stay_as_they_are():
    two = Alternative(0.01 * np.eye(13), name="narrow"), Alternative(np.eye(13), name="wide")
    for acts, alternatives, choice in (
        (Acts.RESIDUALS, two, Choice.DRAWING),
        (Acts.RESIDUALS, only(np.eye(13)), Choice.HELD),
        (Acts.MODULI, two, Choice.LAYERS),
        (Acts.MATERIAL, only(np.eye(13)), Choice.NONE),
        (Acts.BOUNDARY, only(np.eye(13)), Choice.NONE),
    ):
        block = Block("a", "b", acts, (0,), alternatives, choice)
        basis, inverse = informed_combinations(block, np.zeros((13, 13)))
        assert np.array_equal(basis, np.eye(13))
        assert np.array_equal(inverse, np.eye(13))


@pytest.mark.parametrize("n", [1, 3, 20])
def test_of_a_motion_that_nothing_sees_one_combination_is_kept(rng, n):
    covariance = spread(rng, n)
    block = Block("a", "b", Acts.BOUNDARY, (0,), only(covariance), terms=(covariance,))
    basis, inverse = informed_combinations(block, np.zeros((n, n)))
    assert basis.shape == (n, 1)
    assert inverse @ basis == pytest.approx(np.eye(1))
