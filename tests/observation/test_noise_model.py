"""The noise model is found from the residuals, and its covariance is the double sum over all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.observation.jacobian import Jacobian
from palpate.observation.noise_model import FitResponse, NoiseModel, fit_noise_model, mean_noise
from palpate.phantoms.motion import smooth_field

RADIUS = 20.0


def sphere(n, radius=RADIUS):
    """Places (n, 3) and normals of a Fibonacci lattice on a sphere."""
    k = np.arange(n) + 0.5
    height, turn = 1.0 - 2.0 * k / n, np.pi * (1.0 + np.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - height**2)
    normals = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height])
    return radius * normals, normals


def residuals(rng, sd, length, radius=RADIUS, count=6):
    n = int(3.75 * radius**2)
    places, normals = sphere(n, radius)
    fields = [smooth_field(rng, sd_mm=sd, correlation_mm=length, features=500) for _ in range(count)]
    values = [np.einsum("na,na->n", field.at(places), normals) for field in fields]
    return values, [places] * count, [normals] * count


def dense(noise, rows, places, normals):
    distance2 = np.sum((places[:, None] - places[None]) ** 2, axis=2)
    terms = zip(noise.variances, noise.lengths, strict=True)
    correlation = sum(v * np.exp(-distance2 / (2.0 * length**2)) for v, length in terms)
    return rows @ (correlation * (normals @ normals.T)) @ rows.T


@pytest.mark.parametrize(
    ("sd", "length", "radius", "count"),
    [(0.3, 3.0, 20.0, 6), (0.3, 6.0, 20.0, 6), (0.02, 4.5, 20.0, 6), (0.3, 5.0, 8.0, 60)],
)
def test_a_smooth_field_is_recognised(rng, sd, length, radius, count):
    """On the small ball normals turn within a correlation length: the model is of the field, not of the ball."""
    noise = fit_noise_model(*residuals(rng, sd, length, radius, count))
    assert noise.sd == pytest.approx(sd, rel=0.15)
    assert np.sqrt(noise.correlation_area / (2.0 * np.pi)) == pytest.approx(length, rel=0.25)


def smooth_motion(normals, count):
    """Columns (n, count) of a Jacobian: the first polynomials of the normal."""
    powers = [(i, j, k) for i in range(4) for j in range(4) for k in range(2)]
    powers.sort(key=sum)
    return np.column_stack([np.prod(normals**power, axis=1) for power in powers[:count]])


def response_of(jacobian, gain, places, normals):
    """The response of a fit to one surface."""
    return FitResponse([Jacobian.of(jacobian)], [Jacobian.of(gain.T)], [places], [normals])


def test_what_a_fit_leaves_of_errors_is_the_projected_covariance():
    """(1 - J G) K (1 - J G)^T in bins of distance, against the product of whole matrices."""
    places, normals = sphere(1200)
    jacobian, length = smooth_motion(normals, 12), 6.0
    gain = np.linalg.pinv(jacobian)
    found = response_of(jacobian, gain, places, normals).left([length], [(places, normals)])[:, 0]
    cosine, distance = normals @ normals.T, np.linalg.norm(places[:, None] - places[None], axis=2)
    kept = np.eye(len(places)) - jacobian @ gain
    left = kept @ (np.exp(-(distance**2) / (2.0 * length**2)) * cosine) @ kept.T
    for low in (0, 2, 5, 8, 12, 18, 24):
        pairs = (distance >= low) & (distance < low + 1) if low else distance == 0.0
        expected = np.sum((left * cosine)[pairs]) / np.sum((cosine**2)[pairs])
        assert found[low + 1 if low else 0] == pytest.approx(expected, abs=0.03)


def test_the_response_of_a_fit_tells_how_much_the_errors_move_it(rng):
    """By what it left of twelve fields: without the response their sum over a mode's gain is a quarter too small."""
    places, normals = sphere(2400, 30.0)
    jacobian = smooth_motion(normals, 12)
    gain = np.linalg.pinv(jacobian)
    left = []
    for _ in range(12):
        field = smooth_field(rng, sd_mm=0.3, correlation_mm=6.0, features=500)
        errors = np.einsum("na,na->n", field.at(places), normals)
        left.append(errors - jacobian @ (gain @ errors))
    alike = [places] * 12, [normals] * 12
    seen = fit_noise_model(left, *alike)
    told = fit_noise_model(
        left, *alike, replace(response_of(jacobian, gain, places, normals), jacobians=[Jacobian.of(jacobian)] * 12)
    )

    def sd_of_fit(noise):
        """Standard deviations (12,) of the unknowns, over the true ones."""
        true = NoiseModel(np.array([0.3**2]), np.array([6.0])).covariance(gain, places, normals)
        return np.sqrt(np.diag(noise.covariance(gain, places, normals)) / np.diag(true))

    assert np.all(sd_of_fit(seen) < 0.8)
    assert sd_of_fit(told) == pytest.approx(np.ones(12), abs=0.3)
    assert told.sd == pytest.approx(0.3, rel=0.1)


def test_independent_residuals_have_no_correlation_length(rng):
    places, normals = sphere(3000)
    noise = fit_noise_model([0.2 * rng.standard_normal(3000)], [places], [normals])
    assert noise.sd == pytest.approx(0.2, rel=0.15)
    assert noise.correlation_area < 10.0


def test_a_mixture_shows_both_of_its_parts(rng):
    values, places, normals = residuals(rng, 0.3, 6.0)
    rough = [v + 0.3 * rng.standard_normal(len(v)) for v in values]
    noise = fit_noise_model(rough, places, normals)
    short = noise.lengths < 2.0
    assert np.sqrt(noise.variances[short].sum()) == pytest.approx(0.3, rel=0.2)
    assert np.sqrt(noise.variances[~short].sum()) == pytest.approx(0.3, rel=0.2)


def test_the_model_does_not_jump_when_a_few_residuals_come_or_go(rng):
    """All cells are compared: draws of some would move it by 2 to 6 %."""
    places, normals = sphere(40000)
    values = 0.2 * rng.standard_normal(len(places))
    whole = fit_noise_model([values], [places], [normals])
    for hole in range(2000, 40000, 5000):
        kept = np.linalg.norm(places - places[hole], axis=1) > 1.2
        without = fit_noise_model([values[kept]], [places[kept]], [normals[kept]])
        assert without.sd == pytest.approx(whole.sd, rel=4e-3)


def test_the_model_does_not_hang_on_where_cells_end(rng):
    """As surfaces of 5 000 cells move by a hundredth of a millimetre, or all of them by a part of a cell."""
    values, places, normals = residuals(rng, 0.3, 4.5, radius=40.0, count=2)
    noise = fit_noise_model(values, places, normals)
    shaken = [place + 0.01 * rng.standard_normal(place.shape) for place in places]
    for other, off in ((shaken, 2e-3), ([place + 0.37 for place in places], 2e-2)):
        found = fit_noise_model(values, other, normals).correlation_area
        assert found == pytest.approx(noise.correlation_area, rel=off)


def test_far_pairs_of_large_cells_tell_what_those_of_small_cells_do(rng, monkeypatch):
    values, places, normals = residuals(rng, 0.3, 9.5)
    noise = fit_noise_model(values, places, normals)
    monkeypatch.setattr("palpate.observation.noise_model.FAR_CELL", 1.0)
    every = fit_noise_model(values, places, normals)
    assert noise.sd == pytest.approx(every.sd, rel=5e-3)
    assert noise.correlation_area == pytest.approx(every.correlation_area, rel=2e-2)


def test_how_far_residuals_are_correlated_does_not_depend_on_their_size(rng):
    """Down to a few thousandths of a millimetre: no term is raised on its own, however little it counts."""
    values, places, normals = residuals(rng, 0.3, 1.5)
    rough = [value + 0.1 * rng.standard_normal(len(value)) for value in values]
    noise = fit_noise_model(rough, places, normals)
    small = fit_noise_model([0.01 * value for value in rough], places, normals)
    assert small.sd == pytest.approx(0.01 * noise.sd)
    assert small.correlation_area == pytest.approx(noise.correlation_area)


def test_residuals_of_nothing_leave_the_floor():
    places, normals = sphere(200)
    noise = fit_noise_model([np.zeros(200)], [places], [normals])
    assert noise.sd == pytest.approx(1e-3)


@pytest.mark.parametrize("lengths", [(3.0,), (1.2, 9.5)])
def test_the_covariance_is_the_double_sum(rng, lengths):
    places, normals = sphere(700)
    rows = np.stack([normals[:, 0], np.ones(700), places[:, 2] * normals[:, 1], rng.standard_normal(700)])
    noise = NoiseModel(np.full(len(lengths), 0.04), np.array(lengths))
    expected = dense(noise, rows, places, normals)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs(noise.covariance(rows, places, normals) - expected).max() < 0.06 * scale.max()
    assert np.diag(noise.covariance(rows, places, normals)) == pytest.approx(np.diag(expected), rel=0.06)


def test_distant_residuals_are_independent_and_opposite_normals_count_negative():
    noise = NoiseModel(np.array([0.09]), np.array([2.0]))
    places = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [1e-3, 0.0, 0.0]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    one, two, both = np.eye(3)[:1], np.eye(3)[:2], np.array([[1.0, 0.0, 1.0]])
    assert noise.covariance(two, places, normals) == pytest.approx(0.09 * np.eye(2), abs=1e-12)
    assert noise.covariance(one, places, normals) == pytest.approx(0.09)
    assert noise.covariance(both, places, normals) == pytest.approx(0.0, abs=1e-7)


def test_the_correlation_area_of_one_gaussian():
    assert NoiseModel(np.array([0.5]), np.array([3.0])).correlation_area == pytest.approx(2.0 * np.pi * 9.0)


def test_the_mean_of_several_has_the_mean_covariance_and_equal_ones_are_one(rng):
    places, normals = sphere(60)
    rows = rng.standard_normal((2, len(places)))
    a, b = NoiseModel(np.array([0.04, 0.01]), np.array([3.0, 6.0])), NoiseModel(np.array([0.25]), np.array([9.0]))
    expected = (2.0 * dense(a, rows, places, normals) + dense(b, rows, places, normals)) / 3.0
    assert dense(mean_noise([a, b, a]), rows, places, normals) == pytest.approx(expected)
    assert len(mean_noise([a, b, a]).variances) == 3
    again = mean_noise([a, a])
    assert np.array_equal(again.lengths, a.lengths)
    assert again.variances == pytest.approx(a.variances)
