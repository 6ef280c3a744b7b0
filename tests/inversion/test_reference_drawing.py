"""How the reference image is drawn is an error that all later images share: more images do not average it out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

from palpate.inversion import (
    InverseProblem,
    LinearisedObjective,
    cheapest_posterior,
    fixed_correspondence,
    frozen_posterior,
    invert,
    mixture_of,
)
from palpate.observation.drawn_at_rest import UNIT_MM, modes_at_rest
from palpate.progress import silent
from palpate.unknowns import Acts, reference_block, unit_blocks
from palpate.unknowns.parameters import Volume

DRAWN = 0.25  # standard deviation of how the reference image draws what is read


def alike(patients, rng, n_images, *, sd=DRAWN, learned=False, **named):
    """Images of one body in one motion, that all show the same error of the reference image; each reading is a mode."""
    of = patients.patient(rng, n_images, **named)
    of = patients.without(of, range(len(of.parameters.blocks)))
    of = replace(of, bodies=of.bodies[:1] * n_images)
    return patients.drawn_at_rest(of, np.eye(patients.N_READ), [sd**2 * np.eye(patients.N_READ)], learned=learned)


def mixture_at(objective, patients):
    at = np.zeros(objective.parameters.n_unknowns)
    evaluation = objective(at)
    return mixture_of(cheapest_posterior(objective, at, evaluation), at, evaluation, patients.WIDE)


def differences(of, unknowns, h):
    """Slopes (n_unknowns,) of an objective's value, by central differences."""
    return np.array([(of(unknowns + s).value - of(unknowns - s).value) / (2.0 * h) for s in h * np.eye(len(unknowns))])


@pytest.mark.parametrize("n_images", [2, 4, 16])
def test_more_images_tell_no_more_than_their_common_error_allows(patients, n_images):
    """Readings T theta + x + e_k of all images k: (T^T T)^-1 (x^2 + e^2 / K)."""
    rng = np.random.default_rng(3)
    of = alike(patients, rng, n_images)
    mixture = mixture_at(of.objective(rng), patients)
    pulls = of.design()[: 2 * patients.N_READ, :2]
    expected = np.linalg.inv(pulls.T @ pulls) * (DRAWN**2 + patients.SD**2 / n_images)
    assert mixture.covariance == pytest.approx(expected, rel=1e-6)


def test_intervals_of_many_images_hold_with_an_error_of_the_reference_image(patients):
    """Errors over their standard deviations have the mean square 1, and many times that where each image is new."""
    rng, found = np.random.default_rng(5), {"shared": [], "new": []}
    for _ in range(40):
        of = alike(patients, rng, 8)
        of = replace(of, truth=np.append(of.truth[:2], DRAWN * rng.standard_normal(len(of.truth) - 2)))
        shared = of.objective(rng)
        none = replace(shared.parameters, blocks=unit_blocks(*8 * (0,)), priors=())
        for name, objective in (("shared", shared), ("new", shared.with_prior(none))):
            mixture = mixture_at(objective, patients)
            found[name] += list((mixture.mean - of.truth[:2]) ** 2 / np.diag(mixture.covariance))
    assert np.mean(found["shared"]) == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / len(found["shared"])))
    assert np.mean(found["new"]) > 10.0


@pytest.mark.parametrize("seed", range(3))
def test_amplitudes_are_those_of_the_largest_restricted_likelihood(patients, seed):
    """Of mean readings T theta + x + e of 4 images, one variance of x an organ (Patterson & Thompson 1971)."""
    rng = np.random.default_rng(seed)
    of = alike(patients, rng, 4, learned=True, sd=0.5)
    of = replace(of, truth=np.append(of.truth[:2], DRAWN * rng.standard_normal(len(of.truth) - 2)))
    problem = of.problem(rng)
    pulls, n = of.design()[: 2 * patients.N_READ, :2], patients.N_READ
    read = np.mean([np.concatenate([o.seen for o in state.observations]) for state in problem.states], axis=0)

    def unlikely(logarithms):
        """Minus the restricted likelihood of ln of both standard deviations."""
        variances = np.repeat(np.exp(2.0 * logarithms), n) + patients.SD**2 / 4
        matrix = pulls.T @ (pulls / variances[:, None])
        left = read - pulls @ np.linalg.solve(matrix, pulls.T @ (read / variances))
        return 0.5 * (left @ (left / variances) + np.log(variances).sum() + np.linalg.slogdet(matrix)[1])

    expected = np.exp(optimize.minimize(unlikely, np.log(np.full(2, DRAWN))).x)
    found = invert(problem, patients.settings(), progress=silent).objective.parameters
    assert [np.sqrt(prior.covariance[0, 0]) for prior in found.priors] == pytest.approx(expected, rel=0.005)


@pytest.mark.parametrize("volume", [False, True], ids=["bare", "volume"])
@pytest.mark.parametrize("n_images", [1, 2])
def test_the_score_of_an_objective_is_its_slope(patients, n_images, volume):
    """With modes of the surface at rest, and with the room of all others; also of what is made of it."""
    rng = np.random.default_rng(7)
    of = patients.without(patients.patient(rng, n_images, bend=0.6), (2, 3))
    modes, covariances = rng.standard_normal((patients.N_READ, 3)), [np.eye(3), 0.2 * np.eye(3)]
    of = patients.drawn_at_rest(of, modes, covariances)
    objective = of.objective(rng, whole=True)
    if volume:
        room = Volume(np.array([-30.0, 20.0]), np.array([0.1, 0.4]))
        objective = objective.with_prior(replace(objective.parameters, volume=room))
    x = 0.3 * rng.standard_normal(of.parameters.n_unknowns)
    now, linear = objective(x), LinearisedObjective(objective, x, objective(x))
    for each in (objective, fixed_correspondence(objective, x, now), linear):
        for at in (x, x + 0.1 * rng.standard_normal(len(x))):
            expected = differences(each, at, 1e-5)
            assert each(at).score == pytest.approx(expected, rel=1e-5, abs=1e-6 * np.abs(expected).max())
    drawn = np.concatenate([of.parameters.acting(Acts.REFERENCE, s) for s in range(n_images)])
    assert np.abs(now.score - now.prior_score)[drawn].min() > 1e-3 * np.abs(now.score).max()
    assert np.abs(now.prior_score[:2]).min() > 1.0 if volume else np.all(now.prior_score[:2] == 0.0)


def with_reference(twins, twin):
    """A frozen voxel problem of two later images with the modes of both balls, its room, and all unknowns somewhere."""
    problem = twins.voxel_problem(twin, twins.deformed(twin.model, seed=6))
    found = {surface.name: modes_at_rest(surface) for surface in twin.surfaces if not surface.driver}
    blocks = [reference_block(name, (0, 1), own, unit_mm=UNIT_MM) for name, (_, own) in found.items()]
    room = Volume(np.array([-3.0, 2.0]), np.array([0.9, 0.9]))
    parameters = replace(problem.parameters, blocks=(*problem.parameters.blocks, *blocks), priors=(), volume=room)
    states = [replace(s, at_rest={name: modes for name, (modes, _) in found.items()}) for s in problem.states]
    objective = twins.objective_of(InverseProblem(tuple(states), parameters), twin.coefficients)
    rng = np.random.default_rng(8)
    x = np.concatenate([twins.TRUTH, 0.5 * rng.standard_normal(parameters.n_coefficients)])
    return objective.rematched(x), x


def test_a_frozen_posterior_has_the_same_value_and_score_and_its_own_slope(twins, twin):
    objective, x = with_reference(twins, twin)
    now, rng = objective(x), np.random.default_rng(9)
    frozen, fixed = frozen_posterior(objective, x, now), fixed_correspondence(objective, x, now)
    assert frozen(x).score == pytest.approx(now.score, rel=1e-7, abs=1e-7 * np.abs(now.score).max())
    assert frozen(x).matrix.dense == pytest.approx(now.matrix.dense, rel=1e-7, abs=1e-7 * now.matrix.diagonal.max())
    away = x + 0.2 * rng.standard_normal(len(x))
    assert frozen(away).value == pytest.approx(fixed(away).value, rel=1e-8)
    for _ in range(4):
        along = rng.standard_normal(len(x))
        slope = (frozen(away + 1e-5 * along).value - frozen(away - 1e-5 * along).value) / 2e-5
        assert frozen(away).score @ along == pytest.approx(slope, rel=1e-5)
    drawn = objective.parameters.acting(Acts.REFERENCE, 0)
    assert len(drawn) > 10
    assert np.abs((now.score - now.prior_score)[drawn]).max() > 1.0


def test_a_surface_that_the_reference_image_draws_otherwise_is_where_it_lies_and_moves_from_there(twins, twin):
    """By 0.3 mm, in all images alike: its residuals are those of an organ that is so much larger."""
    objective, _ = with_reference(twins, twin)
    parameters, nothing = objective.parameters, np.zeros(objective.parameters.n_unknowns)
    objective = objective.rematched(nothing)
    state = objective.states[0]
    (gland,) = (o for o in state.observations if o.name == "gland")
    modes = state.at_rest["gland"]
    normals = gland.target.surface.rest - gland.target.surface.rest.mean(axis=0)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    z = np.linalg.lstsq(modes, 0.3 * normals.ravel(), rcond=None)[0]
    assert modes @ z == pytest.approx(0.3 * normals.ravel(), abs=0.06)
    x = nothing.copy()
    (number,) = (i for i, b in enumerate(parameters.blocks) if b.acts is Acts.REFERENCE and b.of == "gland")
    x[parameters.columns(number)] = z
    for before, after in zip(objective(nothing).linearisations, objective(x).linearisations, strict=True):
        change = (after.residuals.values - before.residuals.values) @ before.residuals.weights
        assert change == pytest.approx(0.3 if before.observation.name == "gland" else 0.0, abs=0.05)
