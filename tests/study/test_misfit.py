"""What the model misses is named, each direction and each surface; errors that are as believed never are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from palpate.images.tissue import Role, Tissue
from palpate.inversion import Linearisation
from palpate.mesh.locate import located
from palpate.observation.contract import DataFile, Fit, Residuals, Weighting
from palpate.observation.noise_model import NoiseModel
from palpate.observation.point_displacement import point_displacement
from palpate.observation.point_table import PointTable, stated_sd
from palpate.observation.robust_loss import PowerLaw
from palpate.statement.estimation import PointFit
from palpate.statement.misfit import beside_misfits, misfits_of

SD, MOST_ALARMS = 0.1, 0.01
TISSUES = (Tissue("organ", Role.ESTIMATE, (1,)), Tissue("wall", Role.DRIVER, (2,)))
ASKEW = np.array([3.0, -2.0, 1.0]) / np.sqrt(14.0)


def line_of(observation, residuals):
    """A linearisation of which only the observation and its residuals are looked at."""
    return Linearisation(observation, 0, residuals, *[None] * 5)


@dataclass
class Measured:
    """Points of a body that stands still: what they are measured to move by is what the model misses."""

    term: object
    places: np.ndarray

    def noise(self, seed):
        return SD * np.random.default_rng(seed).standard_normal(self.places.shape)

    def misfits(self, errors):
        still = np.zeros(errors.size)
        term = replace(self.term, measured=errors.ravel())
        fit = PointFit(term.name, 0, term.point_motions(still), 1.0)
        return misfits_of([line_of(term, term.residuals(still))], [fit], TISSUES)

    def text(self, errors):
        (misfit,) = self.misfits(errors)
        assert misfit.finding.code == "data-misfit"
        return misfit.text


@pytest.fixture(scope="module")
def measured(case_result):
    """A function of how many points were measured, of what is stated of their errors, of what they are called."""
    space = case_result.space

    def of(n, *, labelled=False, sd=None, **stated):
        points = np.random.default_rng(n).uniform(1.0, 39.0, (8 * n, 3))
        places = located(space.mesh, points)
        inside = np.flatnonzero(places.inside)[:n]
        mask = np.isin(np.arange(len(points)), inside)
        file = DataFile("displacement-field", "field", (Path("f.csv"),), 1, **({"sd_mm": SD} | stated))
        labels = tuple(f"bead-{k + 1}" for k in range(n)) if labelled else ()
        table = PointTable(points[mask], points[mask], stated_sd(file, n) if sd is None else sd, ("",) * n, ())
        shown = table, places.of(mask)
        return Measured(point_displacement(space, *shown, file=file, description="", labels=labels), points[mask])

    return of


def direction_in(text):
    """The vector that a warning names."""
    return [float(part) for part in text.partition("along (")[2].partition(")")[0].split(",")]


def correlated(places, length, kernel=lambda apart: np.exp(-apart)):
    """A root (n, n) of the correlation of errors that are alike over a length (mm)."""
    apart = np.linalg.norm(places[:, None] - places, axis=2) / length
    return np.linalg.cholesky(kernel(apart) + 1e-9 * np.eye(len(places)))


@pytest.mark.parametrize(("n", "labelled"), [(1, True), (4, True), (12, True), (40, True), (40, False), (300, False)])
def test_errors_as_they_are_stated_are_no_misfit(measured, n, labelled):
    points = measured(n, labelled=labelled)
    assert np.mean([bool(points.misfits(points.noise(seed))) for seed in range(200)]) <= MOST_ALARMS


def test_errors_of_a_covariance_that_is_stated_are_no_misfit(measured):
    """Ten times as large along one direction as across it; errors along the others are not explained by it."""
    covariance = SD**2 * (0.1 * np.eye(3) + 9.9 * np.outer(ASKEW, ASKEW))
    points = measured(60, covariance_mm2=covariance, sd_mm=float(np.sqrt(np.trace(covariance) / 3.0)))
    root = np.linalg.cholesky(covariance) / SD
    assert np.mean([bool(points.misfits(points.noise(seed) @ root.T)) for seed in range(200)]) <= MOST_ALARMS
    across = np.outer(SD * np.sin(points.places[:, 2] / 6.0), np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0))
    (misfit,) = points.misfits(points.noise(1) @ root.T + across)
    assert misfit.times == pytest.approx(np.sqrt(1.0 + 0.5 * 10.0), rel=0.1)  # its variance over that along it
    assert np.dot(direction_in(misfit.text), [1.0, 1.0, 0.0]) > 0.9 * np.sqrt(2.0)


@pytest.mark.parametrize("length", [0.0, 8.0])
def test_errors_that_differ_by_point_and_component_are_no_misfit_and_hide_none(measured, length):
    """As of cameras, which see no motion along z, and of points a hundred times worse than others."""
    sd = SD * np.tile([[1.0, 1.0, 500.0], [100.0, 100.0, 500.0]], (60, 1))
    points = measured(120, sd=sd, correlation_mm=length)
    root = correlated(points.places, length) if length else np.eye(120)
    errors = [sd / SD * (root @ points.noise(seed)) for seed in range(200)]
    assert np.mean([bool(points.misfits(of)) for of in errors]) <= MOST_ALARMS
    errors[0][:, 0] += 6.0 * SD
    (misfit,) = points.misfits(errors[0])
    assert misfit.times > 3.0


@pytest.mark.parametrize("stated", [True, False])
def test_errors_that_are_alike_are_no_misfit_where_that_is_stated_nor_over_short_lengths(measured, stated):
    """Errors alike over an eighth of the body, though not stated, are no larger than they are said to be."""
    length = 10.0 if stated else 5.0
    points = measured(200, **({"correlation_mm": length} if stated else {}))
    root = correlated(points.places, length)
    assert np.mean([bool(points.misfits(root @ points.noise(seed))) for seed in range(200)]) <= MOST_ALARMS


SHAPES = {
    "linear": lambda x: np.sqrt(3.0) * (x[:, 0] / 20.0 - 1.0),
    "smooth": lambda x: np.sqrt(2.0) * np.sin(x[:, 2] / 6.0),
    "the same everywhere": lambda x: np.ones(len(x)),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("direction", "words"), [([0, 0, 1], "z (superior)"), ([1, 0, 0], "x (right)"), (ASKEW, "(0.")]
)
def test_what_is_missed_along_one_direction_is_named_with_it(measured, shape, direction, words):
    """By three times the stated error, the other directions fitting: the spread of all components hardly tells."""
    points = measured(300)
    (misfit,) = points.misfits(points.noise(3) + 3.0 * SD * np.outer(SHAPES[shape](points.places), direction))
    assert misfit.times == pytest.approx(np.sqrt(10.0), rel=0.1)
    assert f"in state 1 along {words}" in misfit.text
    stated = (
        f"by {misfit.times * SD:.2g} mm (root mean square), {misfit.times:.2g} times what the stated error of 0.1 mm"
    )
    assert stated in misfit.text


def test_what_is_missed_smoothly_is_no_part_of_errors_that_are_alike(measured):
    """Of 200 residuals it is a few, and hardly tells in their mean square; beside the error of a point it does."""
    points = measured(200, correlation_mm=8.0)
    errors = correlated(points.places, 8.0) @ points.noise(1)
    errors[:, 0] += 3.5 * SD
    (misfit,) = points.misfits(errors)
    assert misfit.times == pytest.approx(3.5, rel=0.15)
    assert "along x (right)" in misfit.text
    assert points.misfits(errors - [3.0 * SD, 0.0, 0.0]) == ()


def test_a_sure_excess_that_is_small_is_not_shouted_at(measured):
    points = measured(300)
    assert points.misfits(1.3 * points.noise(1)) == ()
    assert len(points.misfits(1.7 * points.noise(1))) == 1


def test_a_tenth_of_the_points_that_lies_far_off_is_counted_and_its_worst_one_placed(measured):
    points = measured(300)
    errors = points.noise(2)
    errors[::10, 1] += 8.0 * SD
    errors[70, 1] += 8.0 * SD
    text = points.text(errors)
    assert "misses 30 of 300 points of the field in state 1" in text
    assert f"the one at {np.round(points.places[70], 1).tolist()} mm (RAS) by 1." in text


def test_a_tail_that_is_too_long_is_a_misfit_though_the_mean_square_is_not(measured):
    points = measured(400)
    errors = points.noise(2)
    errors[::16] *= 4.4 * SD / np.linalg.norm(errors[::16], axis=1, keepdims=True)
    assert "misses 25 of 400 points" in points.text(errors)
    errors[16::32] = 0.0
    assert points.misfits(errors) == ()


@pytest.mark.parametrize("n", [3, 24, 1000])
def test_one_landmark_that_is_another_is_named(measured, n):
    points = measured(n, labelled=True)
    errors = points.noise(5)
    errors[2] = [20.0 * SD, 0.0, 0.0]
    text = points.text(errors)
    assert f"misses 1 of {n} points" in text
    assert "'bead-3' by 2 mm, 20 times" in text


def test_points_that_all_lie_off_alike_are_not_counted_one_by_one(measured):
    points = measured(24, labelled=True)
    assert "along y (anterior) by 1 mm" in points.text(0.1 * points.noise(1) + [0.0, 10.0 * SD, 0.0])


@dataclass
class Surface:
    """A ball's surface, as an observation of its noise."""

    weighting: Weighting
    stated_noise: NoiseModel | None = None
    tissue: int = 0
    name: str = "organ"

    def first_noise(self, peers):
        del peers
        return self.stated_noise or NoiseModel(np.array([0.01]), np.array([1.0]))

    def fit(self, residuals):
        size = np.abs(residuals.values)
        return Fit(float(size.mean()), float(np.sqrt(np.mean(size**2))), float(np.quantile(size, 0.95)), None)

    def imaging_error(self, *args): ...

    def growth_error(self, *args): ...


RADIUS, ALIKE = 15.0, 4.0  # mm


def ball(n=300):
    """Points (n, 3) mm, spread evenly."""
    z, turn = np.linspace(-1.0, 1.0, n), np.pi * (1.0 + np.sqrt(5.0)) * np.arange(n)
    return RADIUS * np.c_[np.sqrt(1.0 - z**2) * np.cos(turn), np.sqrt(1.0 - z**2) * np.sin(turn), z]


def misfits_of_surface(values, scale=0.3, **changes):
    """What is said of residuals (n,) mm of the ball, whose image shows noise of a `scale`, alike over `ALIKE`."""
    count = 4.0 * np.pi * RADIUS**2 / (2.0 * np.pi * ALIKE**2)
    seen = Surface(Weighting(count / scale**2, PowerLaw(), count), **changes)
    places, n = ball(len(values)), len(values)
    residuals = Residuals(values, np.full(n, 1.0 / n), places, places / RADIUS, places, None)
    return misfits_of([line_of(seen, residuals)], [], TISSUES)


@pytest.fixture(scope="module")
def smooth_noise():
    """Draws (400, n) of noise of 0.3 mm on the ball."""
    root = correlated(ball(), ALIKE, lambda apart: np.exp(-0.5 * apart**2))
    return 0.3 * np.random.default_rng(1).standard_normal((400, 300)) @ root.T


def test_smooth_noise_of_a_surface_is_no_misfit(smooth_noise):
    assert np.mean([bool(misfits_of_surface(values)) for values in smooth_noise]) <= MOST_ALARMS


def test_a_surface_that_is_drawn_otherwise_is_named_whole_or_in_part(smooth_noise):
    values, cap = smooth_noise[0], ball()[:, 2] > 0.75 * RADIUS
    (whole,) = misfits_of_surface(values + 0.6)
    rms = float(np.sqrt(np.mean((values + 0.6) ** 2)))
    assert f"misses the surface of 'organ' in state 1 by {rms:.2g} mm" in whole.text
    assert f"{whole.times:.2g} times what the estimated noise of 0.3 mm explains" in whole.text
    (part,) = misfits_of_surface(0.3 * values + 1.0 * cap)
    assert "by 0.34 mm (root mean square; 95th percentile 0.93 mm)" in part.text
    assert part.times > 1.5


def test_a_surface_is_held_against_the_noise_that_is_stated(smooth_noise):
    """Though the residuals count by a larger one; rounding to voxels is never a misfit; nor is a driver's wall."""
    stated = NoiseModel(np.array([0.1**2]), np.array([3.0]))
    (misfit,) = misfits_of_surface(smooth_noise[0], stated_noise=stated)
    assert f"{misfit.times:.2g} times what the stated noise of 0.1 mm explains" in misfit.text
    assert misfit.times == pytest.approx(3.0, rel=0.1)
    assert misfits_of_surface(0.4 * smooth_noise[0], scale=0.01) == ()
    assert misfits_of_surface(10.0 * smooth_noise[0], tissue=1) == ()


@dataclass
class Reading:
    """A load cell's, of 2 N with an error of 0.1 N."""

    measured: float = 2.0
    offset_sd: float = 0.0
    unit: str = "N"
    name: str = "force"

    def first_noise(self, peers):
        del peers
        return NoiseModel(np.array([0.01]), np.array([1.0]))


def misfits_of_reading(left):
    return misfits_of([line_of(Reading(), Residuals(np.array([left]), np.ones(1), *[None] * 4))], [], TISSUES)


def test_a_force_that_is_missed_is_named():
    assert misfits_of_reading(-0.3) == ()
    (misfit,) = misfits_of_reading(-0.5)
    assert "needs 1.5 N for the force in state 1, but 2 N was measured, which differs by 5 times" in misfit.text


def test_every_verdict_tells_of_the_worst_misfit(case_result):
    worst, slight = *misfits_of_reading(1.0), *misfits_of_reading(0.5)
    estimates = case_result.estimation.estimates
    assert beside_misfits(estimates, ()) == estimates
    for told, plain in zip(beside_misfits(estimates, (worst, slight)), estimates, strict=True):
        words = "but the model misses the force in state 1 by 10 times its stated error (warning `data-misfit`)"
        assert told.why == f"{plain.why}, {words}"
        assert (plain.verdict, told.verdict) == ("identified", "weak")
        assert replace(told, why=plain.why, verdict=plain.verdict) == plain


@pytest.mark.parametrize("word", ["weak", "ratio only", "not identified"])
def test_a_misfit_raises_no_verdict(case_result, word):
    plain = replace(case_result.estimation.estimates[0], verdict=word)
    (told,) = beside_misfits((plain,), misfits_of_reading(1.0))
    assert told.verdict == word


def test_some_points_that_count_less_leave_the_verdict(measured, case_result):
    """They pull at no modulus; what the points miss together does, and is told first."""
    points = measured(24, labelled=True)
    errors = points.noise(5)
    errors[2] = [20.0 * SD, 0.0, 0.0]
    one, estimates = points.misfits(errors), case_result.estimation.estimates
    (told, _) = beside_misfits(estimates, one)
    assert told.verdict == "identified"
    assert "but the model misses 1 of 24 points" in told.why
    (told, _) = beside_misfits(estimates, (*one, *misfits_of_reading(0.5)))
    assert told.verdict == "weak"
    assert "but the model misses the force" in told.why
