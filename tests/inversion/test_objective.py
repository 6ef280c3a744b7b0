"""The score is the slope of the objective, and its Gauss-Newton system that of weighted residuals and the prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.approximation import reduced_basis
from palpate.images.tissue import Role
from palpate.inversion import Objective
from palpate.inversion.objective import LinearisedObjective, deciding_directions
from palpate.observation.contract import Weighting
from palpate.observation.robust_loss import PowerLaw
from palpate.unknowns import layer_blocks

PRIOR_SD = np.array([0.5, 2.0])
PRIOR_MEAN = np.array([0.3, -0.4])


def basis_of(model, moduli, parameters):
    """A reduced model exact at `moduli`, with series of the moduli along one motion of the driver."""
    return reduced_basis(model, moduli).with_modulus_series(np.ones(model.n_modes), parameters.selection)


def objective_of(problem, *, loss=None, precision=30.0) -> Objective:
    """All image points count; the maps' smoothing draws nothing in."""
    parameters = problem.parameters
    moduli = parameters.moduli(np.zeros(2))
    bases = [basis_of(state.model, moduli, parameters) for state in problem.states]
    objective = Objective(problem.states, parameters).with_approximations(bases)
    weighting = Weighting(precision, loss or PowerLaw())
    return objective.with_observations([replace(o, weighting=weighting) for o in objective.observations])


def one_image(twins, twin):
    return objective_of(twins.voxel_problem(twin))


def robust(twins, twin):
    return objective_of(twins.voxel_problem(twin), loss=PowerLaw(0.5))


def two_images(twins, twin):
    return objective_of(twins.voxel_problem(twin, twins.deformed(twin.model, seed=6)))


def with_prior(twins, twin):
    objective = one_image(twins, twin)
    return replace(objective, parameters=objective.parameters.with_prior(PRIOR_MEAN, PRIOR_SD))


FACTORIES = {"one image": one_image, "robust": robust, "two images": two_images, "with a prior": with_prior}


@pytest.fixture(scope="module", params=sorted(FACTORIES))
def objective(request, twins, twin):
    return FACTORIES[request.param](twins, twin)


def place(objective, seed):
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(size=2), 0.5 * rng.standard_normal(objective.parameters.n_unknowns - 2)])


def whole(line, unknowns):
    """The derivative (n, n_unknowns) of a surface's residuals by all unknowns."""
    jacobian = np.zeros((line.jacobian.shape[0], len(unknowns)))
    jacobian[:, line.columns] = line.jacobian.dense
    return jacobian


@pytest.mark.parametrize("loss", [PowerLaw(), PowerLaw(0.1)], ids=["squares", "robust"])
def test_the_score_is_that_of_central_differences(twins, twin, point_motion, loss):
    """By points, whose Jacobian is exact; that of surfaces leaves out what slides over voxels."""
    problem = twins.exact_problem(twin, twins.deformed(twin.model, seed=6))
    points, motion = twin.model.space.points, twin.scene.displacement
    seen = tuple(point_motion.point_motion(int(n), points[n], motion[n], sd_mm=0.1) for n in range(0, len(points), 23))
    states = tuple(replace(state, observations=seen) for state in problem.states)
    objective = objective_of(replace(problem, states=states), loss=loss)
    objective = replace(objective, parameters=objective.parameters.with_prior(PRIOR_MEAN, PRIOR_SD))
    unknowns, h = place(objective, 1), 1e-6
    steps = h * np.eye(len(unknowns))
    differences = [(objective(unknowns + s).value - objective(unknowns - s).value) / (2.0 * h) for s in steps]
    now = objective(unknowns)
    score = now.score
    assert any(np.any(line.weights < line.residuals.weights) for line in now.linearisations) == np.isfinite(loss.cutoff)
    assert np.linalg.norm(score - differences) < 1e-6 * np.linalg.norm(score)
    assert np.abs(score[:2]).min() > 1e-4 * np.linalg.norm(score)


def test_matrix_and_score_are_those_of_weighted_residuals_and_the_prior(objective):
    unknowns, parameters = place(objective, 4), objective.parameters
    now = objective(unknowns)
    stated = np.any(parameters.prior_precision != 0.0)
    mean, precision = (PRIOR_MEAN, PRIOR_SD**-2.0) if stated else (np.zeros(2), np.zeros(2))
    prior = np.diag(np.append(precision, np.ones(len(unknowns) - 2)))
    roots = [np.sqrt(line.precision * line.weights) for line in now.linearisations]
    rows = np.concatenate([r[:, None] * whole(s, unknowns) for r, s in zip(roots, now.linearisations, strict=True)])
    values = np.concatenate([r * s.residuals.values for r, s in zip(roots, now.linearisations, strict=True)])
    pull = prior @ (unknowns - np.append(mean, np.zeros(len(unknowns) - 2)))
    assert now.prior.dense == pytest.approx(prior)
    assert now.prior_score == pytest.approx(pull)
    assert now.matrix.dense == pytest.approx(rows.T @ rows + prior, rel=1e-10, abs=1e-8)
    assert now.score == pytest.approx(rows.T @ values + pull, rel=1e-10, abs=1e-8)
    assert np.linalg.eigvalsh(now.matrix.dense).min() > 0.0


def test_a_linearised_objective_is_the_objective_at_its_place_and_a_least_squares_problem_elsewhere(objective, rng):
    """Value, score and matrix there; away from it the score is the slope of the value, by central differences."""
    unknowns = place(objective, 4)
    now = objective(unknowns)
    linearised = LinearisedObjective(objective, unknowns, now)
    there = linearised(unknowns)
    assert there.value == pytest.approx(now.value, rel=1e-12)
    assert there.score == pytest.approx(now.score, rel=1e-12)
    assert there.matrix.dense == pytest.approx(now.matrix.dense, rel=1e-12)
    away, direction, h = unknowns + 0.05 * rng.standard_normal(len(unknowns)), rng.standard_normal(len(unknowns)), 1e-5
    slope = (linearised(away + h * direction).value - linearised(away - h * direction).value) / (2.0 * h)
    assert linearised(away).score @ direction == pytest.approx(slope, rel=1e-5)


def test_a_linearised_objective_counts_by_the_weights_of_its_own_objective(objective):
    unknowns = place(objective, 4)
    now = objective(unknowns)
    weighting = Weighting(60.0, PowerLaw(0.4))
    other = objective.with_observations([replace(o, weighting=weighting) for o in objective.observations])
    linearised = LinearisedObjective(other, unknowns, now)
    assert linearised(unknowns).value == pytest.approx(other(unknowns).value, rel=1e-12)
    assert linearised(unknowns).score == pytest.approx(other(unknowns).score, rel=1e-12)
    assert linearised(unknowns).matrix.dense == pytest.approx(other(unknowns).matrix.dense, rel=1e-10, abs=1e-9)


def test_the_modes_of_one_image_do_not_move_the_other(twins, twin):
    objective = two_images(twins, twin)
    now = objective(place(objective, 5))
    n = twin.model.n_modes
    assert all(s.columns.tolist() == [*range(2 + n)] for s in now.linearisations[:3])
    assert all(s.columns.tolist() == [0, 1, *range(2 + n, 2 + 2 * n)] for s in now.linearisations[3:])


def test_at_the_truth_only_the_prior_pulls(twin, exact):
    objective = objective_of(exact).with_approximations([basis_of(twin.model, twin.moduli, exact.parameters)])
    now = objective(twin.unknowns)
    prior = np.concatenate([np.zeros(2), twin.coefficients])
    assert now.misfit_mm2 < 1e-16
    assert now.score == pytest.approx(prior, abs=1e-5)
    assert now.value == pytest.approx(0.5 * prior @ prior, rel=1e-9)


def test_residuals_beyond_the_cutoff_count_less(twins, twin):
    objective = robust(twins, twin)
    now = objective(np.concatenate([[0.0, 0.0], -twin.coefficients]))
    values = np.concatenate([line.residuals.values for line in now.linearisations])
    weights = np.concatenate([line.weights for line in now.linearisations])
    assert np.any(np.abs(values) > 0.5)
    shares = np.concatenate([line.residuals.weights for line in now.linearisations])
    assert np.array_equal(weights < shares, np.abs(values) > 0.5)


def with_a_held_tissue(twins, twin, sd):
    """The objective with ln E of the known tissue held but for its release, and unknowns near the truth."""
    problem = twins.voxel_problem(twin)
    tissues, regions = twin.scene.tissues, problem.states[0].model.regions
    region = next(i for i, number in enumerate(regions) if tissues[number].role is Role.KNOWN)
    blocks = (*problem.parameters.blocks, *layer_blocks((("organ", (region,), 1.0),), (0,), sd=sd, thickness_mm=1.0))
    parameters = replace(problem.parameters, blocks=blocks, priors=())
    return objective_of(replace(problem, parameters=parameters)), np.concatenate([twin.unknowns, [0.0]])


def freed(objective):
    """The prior of its unknowns with layers."""
    return objective.parameters.choosing({len(objective.parameters.blocks) - 1: 1})


def test_derivatives_are_exact_along_what_decides_with_layers_too(twins, twin):
    """So that what is compared next needs no model made exact there again."""
    held, unknowns = with_a_held_tissue(twins, twin, sd=0.4)
    evaluation, (basis,) = held(unknowns), held.approximations
    free = evaluation.with_prior(freed(held), unknowns)
    (point,) = held.linearisation_points(unknowns, [evaluation, free])
    along = freed(held).chain(0, unknowns) @ deciding_directions(free, 2)[freed(held).unknowns_of(0)]
    assert np.allclose(point.directions[:, 4:], along[:, 2:], atol=1e-12)
    assert not np.allclose(point.directions[:, 2:4], along[:, 2:], rtol=0.01)
    truth = basis.full_model.solve(point.moduli, point.coefficients).tangent() @ along
    before, after = (
        np.abs(known.model.solve(point.moduli, point.coefficients).tangent() @ along - truth).max()
        for known in (basis, basis.update(point))
    )
    assert after < 0.01 * before


def test_another_prior_is_the_same_as_evaluated_under_it(twins, twin):
    held, unknowns = with_a_held_tissue(twins, twin, sd=0.4)
    unknowns[-1] = 0.1
    seen, anew = held(unknowns).with_prior(freed(held), unknowns), held.with_prior(freed(held))(unknowns)
    pairs = [(getattr(seen, name), getattr(anew, name)) for name in ("value", "score", "prior_score")]
    pairs += [(seen.matrix.dense, anew.matrix.dense), (seen.prior.dense, anew.prior.dense)]
    for found, expected in pairs:
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-5)  # 1e8 of what is held


def test_a_known_tissue_released_as_a_whole_is_a_prior_of_the_scale(twins, twin):
    """Moduli scaled together leave u unchanged: ln E of all organs then varies by as much as that of the tissue."""
    sd = 0.4
    held, unknowns = with_a_held_tissue(twins, twin, sd)
    seen = held(unknowns).with_prior(freed(held), unknowns)
    before, after = (of.covariance_columns(2)[:2] for of in (held(unknowns), seen))
    assert after - before == pytest.approx(np.full((2, 2), sd**2), rel=0.02)
