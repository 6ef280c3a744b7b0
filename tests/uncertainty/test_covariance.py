"""The sandwich is the covariance that repeated experiments show, correlated residuals and driver included."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from palpate.errors import EstimationError
from palpate.images.alignment import within_border
from palpate.inversion import LaterState, Objective
from palpate.inversion.objective import Evaluation, Linearisation, deciding_directions
from palpate.inversion.optimise import Minimum, Outcome, posterior_sd
from palpate.observation.contract import Residuals, Weighting
from palpate.observation.jacobian import Jacobian
from palpate.observation.noise_model import NoiseModel
from palpate.observation.robust_loss import PowerLaw
from palpate.phantoms.motion import smooth_field
from palpate.uncertainty import NORMAL_95, FittedState, gain, sandwich_covariance
from palpate.uncertainty.covariance import (
    error_noise,
    grid_covariance,
    grid_position_shifts,
    imaging_errors,
    scatter,
)
from palpate.uncertainty.intervals import log_interval
from palpate.unknowns import Arrowhead, ParameterMap, unit_blocks

SD = 0.3


def sphere(n, radius):
    k = np.arange(n) + 0.5
    height, turn = 1.0 - 2.0 * k / n, np.pi * (1.0 + np.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - height**2)
    normals = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height])
    return radius * normals, normals


@dataclass(frozen=True)
class Seen:
    """An observation of which only its noise and its weight matter, in the state with this number."""

    noise_model: NoiseModel
    weighting: Weighting
    state: int = 0
    kind: str = "surface distance"
    of_driver: bool = False
    shown: list = field(default_factory=list)  # what a fit was asked with

    def fitted_noise(self, residuals, response):
        self.shown.append((residuals, response))
        return self.noise_model


def surface(places, normals, jacobian, *, precision, noise, state=0, kind="surface distance", of_driver=False):
    n = len(places)
    weights = np.full(n, 1.0 / n)
    residuals = Residuals(np.zeros(n), weights, places, normals, places, None)
    seen = Seen(noise, Weighting(precision, PowerLaw()), state, kind, of_driver)
    return Linearisation.of(seen, state, residuals, np.arange(jacobian.shape[1]), Jacobian.of(jacobian), weights)


def test_what_neither_images_nor_prior_determine_ends_as_an_estimation_that_says_so(toys):
    """Two log-moduli that only their sum moves."""
    evaluation = toys.Quadratic(np.ones((2, 2)), np.zeros(2))(np.ones(2))
    minimum = Minimum(np.ones(2), evaluation, Outcome.CONVERGED, ())
    for of in (
        lambda: posterior_sd(minimum, 2),
        lambda: gain(evaluation, 2),
        lambda: deciding_directions(evaluation, 2),
    ):
        with pytest.raises(EstimationError, match="do not determine"):
            of()


def observed(*lines, n_parameters=2, rests=(0, 1)):
    """Objective and evaluation of surfaces, with a prior of unit variance on all unknowns after the first ones."""
    n = lines[0].jacobian.shape[1]
    parameters = ParameterMap(
        np.ones(2), np.eye(2), ("a", "b")[:n_parameters], "c", True, unit_blocks(n - n_parameters)
    )
    prior = np.diag(np.where(np.arange(n) < n_parameters, 0.0, 1.0))
    matrix = prior.copy()
    for line in lines:
        matrix += line.information
    numbers = sorted({line.state for line in lines})
    states = [
        LaterState(None, tuple(line.observation for line in lines if line.state == s), reference=rests[s])
        for s in numbers
    ]
    evaluation = Evaluation(0.0, 0.0, np.zeros(n), Arrowhead.of(matrix), tuple(lines), Arrowhead.of(prior), np.zeros(n))
    return Objective(tuple(states), parameters), evaluation


def noise_of(length, sd=SD):
    return NoiseModel(np.array([sd**2]), np.array([length]))


@pytest.fixture
def smooth():
    """A smooth Jacobian on a sphere: two log-moduli, then three modes."""
    places, normals = sphere(600, 15.0)
    x, y, z = normals.T
    jacobian = np.column_stack([0.3 * x * y, 0.3 * z, 0.4 * z + 0.2 * x, 0.5 * y, 0.3 * (z**2 - x**2)])
    return places, normals, jacobian


def test_independent_residuals_give_the_usual_formula(rng):
    places = 10.0 * np.stack(np.meshgrid(*[np.arange(5.0)] * 3), axis=-1).reshape(-1, 3)
    normals = np.tile([[0.0, 0.0, 1.0]], (len(places), 1))
    jacobian = rng.standard_normal((len(places), 4))
    line = surface(places, normals, jacobian, precision=len(places) / SD**2, noise=noise_of(0.5))
    objective, now = observed(line)
    assert sandwich_covariance(objective, now) == pytest.approx(np.linalg.inv(now.matrix.dense)[:2, :2], rel=1e-9)


def test_the_gain_moves_the_estimate_as_a_normal_equation_does(smooth, rng):
    _, now = observed(surface(*smooth, precision=50.0, noise=noise_of(5.0)))
    errors = rng.standard_normal(len(smooth[0]))
    expected = np.linalg.solve(now.matrix.dense, 50.0 / len(errors) * smooth[2].T @ errors)[:2]
    assert gain(now, 2)[0] @ errors == pytest.approx(expected, rel=1e-9)


def test_the_interval_covers_the_truth_of_repeated_experiments(smooth, rng):
    places, normals, jacobian = smooth
    objective, now = observed(surface(*smooth, precision=200.0, noise=noise_of(5.0)))
    covariance = sandwich_covariance(objective, now)
    draws = []
    for _ in range(400):
        motion = smooth_field(rng, sd_mm=SD, correlation_mm=5.0, features=100)
        error = np.einsum("na,na->n", motion.at(places), normals)
        prior = np.concatenate([np.zeros(2), rng.standard_normal(3)])
        score = prior - 200.0 / len(places) * jacobian.T @ error
        draws.append(-np.linalg.solve(now.matrix.dense, score)[:2])
    spread = np.cov(np.transpose(draws))
    assert np.sqrt(np.diag(covariance)) == pytest.approx(np.sqrt(np.diag(spread)), rel=0.12)
    inside = np.abs(draws) < 1.96 * np.sqrt(np.diag(covariance))
    assert np.all((inside.mean(axis=0) > 0.92) & (inside.mean(axis=0) < 0.98))


def test_the_noise_of_errors_is_sought_by_what_the_fit_leaves_of_them(smooth, rng):
    """Errors of a later state's surfaces, a driver's too, move the fit; residuals that tell lose J times that."""
    places, normals, jacobian = smooth
    none = np.zeros((len(places), 3))
    own = {0: np.hstack([jacobian, none]), 1: np.hstack([jacobian[:, :2], none, jacobian[:, 2:]])}
    given = {"precision": 200.0, "noise": noise_of(5.0)}
    lines = [
        surface(places, normals, columns * scale, state=state, of_driver=driver, **given)
        for state, columns in own.items()
        for driver, scale in ((True, 2.0), (False, 1.0))
    ]
    _, now = observed(*lines)
    assert set(error_noise(now)) == {(0, "surface distance"), (1, "surface distance")}
    for state, (driver, telling) in enumerate(zip(lines[::2], lines[1::2], strict=True)):
        ((residuals, response),) = driver.observation.shown + telling.observation.shown
        assert residuals == [telling.residuals]
        errors = rng.standard_normal(2 * len(places))
        halves = np.split(errors, 2)
        score = sum(
            line.jacobian.transposed_times(line.precision * line.weights * error)
            for line, error in zip((driver, telling), halves, strict=True)
        )
        taken = telling.jacobian.times(np.linalg.solve(now.matrix.dense, score))
        moved = sum(gain.transposed_times(error) for gain, error in zip(response.gains, halves, strict=True))
        assert response.jacobians[0].times(moved) == pytest.approx(taken), state


def test_correlated_residuals_tell_less(smooth):
    short, long = (
        sandwich_covariance(*observed(surface(*smooth, precision=200.0, noise=noise_of(length))))
        for length in (0.8, 6.0)
    )
    assert np.all(np.diag(long) > 1.5 * np.diag(short))


def twice(smooth, *, sign, rests):
    """Two later states, the second with `sign` times the motion of the first, with modes of their own."""
    places, normals, jacobian = smooth
    modes, none = jacobian[:, 2:], np.zeros((len(places), 3))
    first = np.hstack([jacobian[:, :2], modes, none])
    second = np.hstack([sign * jacobian[:, :2], none, modes])
    given = {"precision": 200.0, "noise": noise_of(5.0)}
    lines = [surface(places, normals, rows, state=i, **given) for i, rows in enumerate((first, second))]
    return observed(*lines, rests=rests)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_second_pair_of_images_halves_the_variance(smooth, sign):
    one = sandwich_covariance(*observed(surface(*smooth, precision=200.0, noise=noise_of(5.0))))
    two = sandwich_covariance(*twice(smooth, sign=sign, rests=(0, 1)))
    assert two == pytest.approx(0.5 * one, rel=1e-6)


def test_the_noise_of_a_shared_rest_state_is_not_averaged_away_by_a_like_motion_but_cancels_in_an_opposite_one(smooth):
    pairs = sandwich_covariance(*twice(smooth, sign=1.0, rests=(0, 1)))
    alike = sandwich_covariance(*twice(smooth, sign=1.0, rests=(0, 0)))
    opposite = sandwich_covariance(*twice(smooth, sign=-1.0, rests=(0, 0)))
    assert np.all(np.diag(alike) > 1.2 * np.diag(pairs))
    assert np.all(np.diag(opposite) < 0.8 * np.diag(pairs))


def test_each_kind_of_observation_has_the_noise_of_its_kind_and_errs_on_its_own(smooth):
    """Two kinds that see the same: noise of theirs adds, each by its own size; of one kind it is the same noise."""
    rough, fine = noise_of(5.0, 2.0 * SD), noise_of(5.0, SD)

    def covariance(*seen):
        lines = [surface(*smooth, precision=200.0, noise=noise, kind=kind) for kind, noise in seen]
        objective, now = observed(*lines)
        rest = np.linalg.solve(now.matrix.dense, np.eye(5)[:, :2])
        return sandwich_covariance(objective, now) - rest.T @ now.prior.dense @ rest

    both = covariance(("surface distance", rough), ("point", fine))
    alike = covariance(("surface distance", fine), ("surface distance", fine))
    assert both == pytest.approx((4.0 + 1.0) / 4.0 * alike, rel=1e-9)


@pytest.fixture(scope="module")
def imaged(twins, twin, voxels):
    """The objective of voxels and its evaluation at the truth."""
    objective = twins.objective_of(voxels, twin.coefficients).rematched(twin.unknowns)
    return objective, objective(twin.unknowns)


def fitted(twins, twin, spacing):
    grid = twins.centred_grid((44.0,) * 3, (spacing,) * 3)
    return FittedState(twin.model.space, twin.scene.displacement, grid, grid)


def test_finer_voxels_leave_less_to_the_place_of_the_grid(twins, twin, imaged):
    spread = []
    for spacing in (3.0, 1.5):
        states = (fitted(twins, twin, spacing),)
        shifts = grid_position_shifts(*imaged, states, draws=6, rng=np.random.default_rng(2))
        spread.append(np.sqrt(np.mean(shifts**2)))
    assert 0.0 < spread[1] < 0.7 * spread[0]


def test_the_image_around_the_surfaces_errs_there_as_the_whole_one(twins, twin, imaged):
    objective, evaluation = imaged
    states = (fitted(twins, twin, 1.5),)

    def errors(**margin):
        return np.concatenate(imaging_errors(objective, evaluation, states, rng=np.random.default_rng(4), **margin))

    near = errors()
    assert near == pytest.approx(errors(margin_mm=1e3), abs=1e-4)
    assert np.std(near) > 0.01


def test_where_an_image_ends_a_grid_that_lies_elsewhere_tells_of_no_error(twins, twin, imaged):
    """Images that end within the organs: a surface that is cut there errs no more than where it is whole."""
    objective, evaluation = imaged
    whole, grid = fitted(twins, twin, 1.5), twins.centred_grid((16.0, 44.0, 44.0), (1.5,) * 3)
    places = np.concatenate([line.residuals.places for line in evaluation.linearisations])
    beyond = ~within_border(grid, places, 0.0)

    def errors(state):
        of_draws = (imaging_errors(objective, evaluation, (state,), rng=np.random.default_rng(k)) for k in range(4))
        return np.stack([np.concatenate(of_draw) for of_draw in of_draws])

    cut = errors(replace(whole, before=grid, after=grid))
    assert np.count_nonzero(beyond) > 50
    assert not cut[:, beyond].any()
    assert np.abs(cut).max() < 1.5 * np.abs(errors(whole)).max()


def test_later_states_of_one_rest_state_have_the_same_image_of_it(twins, twin, imaged):
    """Two states that are alike err alike in what their rest states show, where that is one, and else not."""
    objective, evaluation = imaged
    state = fitted(twins, twin, 1.5)

    def errors(reference):
        states = (objective.states[0], replace(objective.states[0], reference=reference))
        lines = [*evaluation.linearisations, *(replace(line, state=1) for line in evaluation.linearisations)]
        both = replace(evaluation, linearisations=tuple(lines))
        found = imaging_errors(replace(objective, states=states), both, (state, state), rng=np.random.default_rng(3))
        first, second = np.concatenate(found[:3]), np.concatenate(found[3:])
        return np.corrcoef(first, second)[0, 1]

    assert errors(0) > errors(1) + 0.2


def test_the_interval_is_symmetric_in_the_logarithm():
    low, high = log_interval(3.0, 0.2, lower=0.02, upper=200.0)
    assert np.log(high / 3.0) == pytest.approx(1.96 * 0.2, rel=1e-4)
    assert low * high == pytest.approx(9.0)


@pytest.mark.parametrize(
    ("centre", "open_low", "open_high"), [(0.05, True, False), (100.0, False, True), (2.0, False, False)]
)
def test_an_end_beyond_the_bounds_is_open(centre, open_low, open_high):
    low, high = log_interval(centre, 0.5, lower=0.02, upper=200.0)
    assert (low is None, high is None) == (open_low, open_high)


def test_an_interval_by_few_draws_holds_as_often_as_it_says(rng):
    """The standard deviation of eight draws is itself uncertain; 1.96 of it would hold 91 %."""
    draws = rng.standard_normal((4000, 9))
    held = [abs(one[8]) < NORMAL_95 * np.sqrt(scatter(one[:8, None])[0, 0]) for one in draws]
    assert np.mean(held) == pytest.approx(0.95, abs=0.012)


def test_the_grid_adds_to_stated_noise_and_to_what_residuals_tell_what_that_lacks(imaged, rng):
    """With it that is as large as both in every direction, and no larger where it was so already."""
    grid, noise = (root @ root.T for root in rng.standard_normal((2, 3, 3)))
    _, told = imaged
    together = noise + grid_covariance(told, grid, noise)
    for part in (grid, noise):
        assert np.linalg.eigvalsh(together - part).min() > -1e-12
    assert grid_covariance(told, noise, 1.1 * noise) == pytest.approx(np.zeros((3, 3)), abs=1e-12)
    lines = [
        replace(line, observation=replace(line.observation, stated_noise=NoiseModel(np.ones(1), np.ones(1))))
        for line in told.linearisations
    ]
    assert np.array_equal(grid_covariance(replace(told, linearisations=tuple(lines)), grid, noise), grid)
