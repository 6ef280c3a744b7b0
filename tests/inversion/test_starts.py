"""The combinations of a block's unknowns that the images tell: what is left out of them moves no estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.inversion import LaterState, invert, posterior_sd
from palpate.inversion import starts as informed
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.material import material_modes
from palpate.uncertainty.alternatives import undecided_covariance
from palpate.unknowns import Acts, Block, material_blocks, parameter_map, unit_blocks


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


def test_estimates_with_what_is_seen_are_those_with_all_unknowns(twins, patchy):
    settings = twins.settings(2.0)
    seen = invert(patchy, settings, progress=twins.silent)
    blocks = tuple(replace(block, left_out=-1.0) for block in patchy.parameters.blocks)
    every = replace(patchy, parameters=replace(patchy.parameters, blocks=blocks))
    whole = invert(every, settings, progress=twins.silent)
    assert whole.objective.parameters.n_unknowns == patchy.parameters.n_unknowns
    assert seen.objective.parameters.n_unknowns < 0.7 * patchy.parameters.n_unknowns
    sd = posterior_sd(whole.minimum, 2)
    assert seen.minimum.unknowns[:2] == pytest.approx(whole.minimum.unknowns[:2], abs=0.1 * sd.min())
    assert posterior_sd(seen.minimum, 2) == pytest.approx(sd, rel=0.03)


def test_starts_round_the_middle_of_the_bounds_are_judged_from_one_minimum(twins, patchy):
    """Which they are moves no estimate, as long as they lead to the same minimum."""
    every = [twins.settings(*ratios) for ratios in ((0.2, 0.5, 3.0), (1.0, 9.0, 30.0), (2.0,))]
    found = [invert(patchy, settings, progress=twins.silent) for settings in every]
    assert all(len(each.candidates) == 1 for each in found)
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
    alternatives, most = ((covariance,),), (0.1, 1.0)
    block = Block("a", "b", Acts.BOUNDARY, (0,), np.linalg.inv(covariance), alternatives, amplitudes=most)
    basis, inverse = informed.informed_combinations(block, information)
    assert basis.shape[1] < n
    assert inverse @ basis == pytest.approx(np.eye(basis.shape[1]), abs=1e-9)
    left = np.eye(n) - basis @ inverse
    assert np.trace(information @ left @ covariance @ left.T) < block.left_out
    kept = block.combined(inverse)
    narrow = basis @ np.linalg.inv(basis.T @ information @ basis + kept.precision) @ basis.T
    whole = np.linalg.inv(information + block.precision)
    rest = left @ covariance @ left.T
    assert np.linalg.eigvalsh(narrow + rest - whole).min() > -1e-9  # what is left at its prior is no narrower


def test_a_motion_of_several_images_leaves_out_no_more_of_any_of_them(rng):
    n = 40
    covariance, informations = spread(rng, n), [size * spread(rng, n) for size in (4.0, 40.0, 10.0)]
    block = Block("a", "b", Acts.BOUNDARY, (0,), np.linalg.inv(covariance), ((covariance,),), amplitudes=(0.1, 1.0))
    basis, inverse = informed.informed_combinations(block, *informations)
    assert basis.shape[1] < n
    left = np.eye(n) - basis @ inverse
    assert all(np.trace(seen @ left @ covariance @ left.T) < block.left_out for seen in informations)


def test_images_of_one_body_have_the_same_combinations_of_a_motion_and_one_model_of_them(twins, twin):
    """The answer is that with all unknowns, which each image has for itself."""
    one, size = twins.exact_problem(twin, twins.deformed(twin.model, seed=6)), twin.model.n_modes
    own = ((4.0 * np.eye(size),),)
    parameters = one.parameters

    def problem(left_out):
        blocks = [
            Block("wall", "driver", Acts.BOUNDARY, (s,), np.eye(size), own, amplitudes=(0.5, 1.0), left_out=left_out)
            for s in range(2)
        ]
        return replace(one, parameters=replace(parameters, blocks=tuple(blocks), nuisance_precision=np.zeros((0, 0))))

    start = informed.informed_start(problem(1e3), np.zeros(2), progress=twins.silent)
    first, second = start.objective.approximations
    assert first.constraint.modes is second.constraint.modes
    assert first.constraint.n_modes < size
    assert first.full_model.coupling is second.full_model.coupling
    assert first.model.output_basis[0] is second.model.output_basis[0]
    free, fixed = (informed.informed_start(problem(amount), np.zeros(2), progress=twins.silent) for amount in (0.0, -1))
    assert free.minimum.evaluation.value == pytest.approx(fixed.minimum.evaluation.value, rel=1e-4)


def test_offsets_and_what_is_not_learned_stay_as_they_are():
    own = ((np.eye(13),),)
    for acts, alternatives in ((Acts.RESIDUALS, own), (Acts.MODULI, ()), (Acts.MATERIAL, ()), (Acts.BOUNDARY, ())):
        block = Block("a", "b", acts, (0,), np.eye(13), alternatives)
        basis, inverse = informed.informed_combinations(block, np.zeros((13, 13)))
        assert np.array_equal(basis, np.eye(13))
        assert np.array_equal(inverse, np.eye(13))


@pytest.mark.parametrize("n", [1, 3, 20])
def test_of_a_motion_that_nothing_sees_one_combination_is_kept(rng, n):
    covariance = spread(rng, n)
    block = Block("a", "b", Acts.BOUNDARY, (0,), np.linalg.inv(covariance), ((covariance,),))
    basis, inverse = informed.informed_combinations(block, np.zeros((n, n)))
    assert basis.shape == (n, 1)
    assert inverse @ basis == pytest.approx(np.eye(1))


def test_what_is_undecided_is_the_second_moment_of_the_mixture(twins, twin, voxels):
    """Against the posterior of each alternative by whole matrices, and their evidence."""
    objective = twins.objective_of(voxels, twin.coefficients)
    n, size = 2, voxels.parameters.n_coefficients
    levels, odds = (0.3, 1.5), (0.0, -0.7)
    terms = tuple((level**2 * np.eye(size),) for level in levels)
    block = Block("a", "wall", Acts.BOUNDARY, (0,), np.eye(size) / levels[0] ** 2, terms, (1.0, 1.0), odds)
    parameters = replace(objective.parameters, blocks=(block,), nuisance_precision=np.zeros((0, 0)))
    objective = replace(objective, parameters=parameters)
    unknowns = twin.unknowns
    evaluation = objective.rematched(unknowns)(unknowns)
    data = evaluation.matrix - evaluation.prior
    pull = data @ unknowns - (evaluation.score - evaluation.prior_score)
    means, spreads, evidences = [], [], []
    for level, odd in zip(levels, odds, strict=True):
        variance = level**2 * (1.0 + 1e-3 / level**2)  # no mode is forbidden, see LEAST_VARIANCE
        prior = np.zeros_like(data)
        prior[n:, n:] = np.eye(size) / variance
        means.append(np.linalg.solve(data + prior, pull)[:n])
        spreads.append(np.linalg.inv(data + prior)[:n, :n])
        logdet = np.linalg.slogdet(data + prior)[1] + size * np.log(variance)
        evidences.append(odd + 0.5 * float(pull @ np.linalg.solve(data + prior, pull)) - 0.5 * logdet)
    weight = 1.0 / (1.0 + np.exp(evidences[0] - evidences[1]))
    prior = np.zeros_like(data)
    prior[n:, n:] = np.eye(size) / levels[0] ** 2
    chosen, own = np.linalg.solve(data + prior, pull)[:n], np.linalg.inv(data + prior)[:n, :n]
    moved = means[1] - chosen
    part = weight * (spreads[1] - own + np.outer(moved, moved))
    (found,) = undecided_covariance(objective, evaluation, unknowns).values()
    sizes, axes = np.linalg.eigh(part)
    assert found == pytest.approx((axes * np.maximum(sizes, 0.0)) @ axes.T, rel=1e-3, abs=1e-12)
