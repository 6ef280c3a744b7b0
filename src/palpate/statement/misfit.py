"""Data that the fitted model misses by more than their noise explains: surfaces, points and forces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, chi2

from palpate.body.poisson_ratios import PoissonRatioEstimate
from palpate.findings import Finding
from palpate.images.tissue import Tissue
from palpate.inversion import Linearisation
from palpate.observation.contract import Imaged, OfInstrument, OfPoints, PointMotions
from palpate.statement.estimation import ModulusEstimate, PointFit

T = TypeVar("T", ModulusEstimate, PoissonRatioEstimate)

CHANCE = 1e-3  # probability of a false alarm for each kind of data: with ten kinds, one in a hundred runs
RELEVANT = 1.5  # times the noise; a smaller misfit, however certain, hardly changes a modulus
DIRECTIONS = 30.0  # number of independent tests to which the worst direction amounts, by simulation of 1 to 200 points
TAIL, MOST = 0.05, 0.5  # shares of the data that lie far off: too many by chance, and too many to be named one by one
AXES = ("x (right)", "y (anterior)", "z (superior)")
ALONG = 0.9  # cosine to an axis, above which a direction is named as that axis


@dataclass(frozen=True, slots=True)
class Misfit:
    """One kind of data that is missed, by `times` what its noise explains, in words of a verdict and of a finding.

    whole: the data as a whole, and not some points, which a robust loss leaves little weight.
    """

    about: str
    state: int
    times: float
    short: str
    text: str
    whole: bool = True

    @property
    def finding(self) -> Finding:
        """The warning."""
        return Finding("data-misfit", self.text, self.about, place=f"in state {self.state + 1}")


def misfits_of(
    lines: Sequence[Linearisation], points: Sequence[PointFit], tissues: Sequence[Tissue]
) -> tuple[Misfit, ...]:
    """The misfits of all data of a fit; points: measured and fitted motions, in the order of `lines`.

    Of the surfaces those of `tissues` that are meshed: the modes of a driver follow its wall, and a hollow tissue is
    seen where no mesh is beside it, too, so that parts of it in the image belong to nothing.
    """
    motions, found = iter(points), list[Misfit | None]()
    meshed = {number for number, tissue in enumerate(tissues) if tissue.meshed}
    for line in lines:
        if isinstance(line.observation, OfPoints):
            found.append(_of_points(line, next(motions).motions))
        elif isinstance(line.observation, OfInstrument):
            found.append(_of_instrument(line, line.observation))
        elif isinstance(line.observation, Imaged) and line.observation.tissue in meshed:
            found.append(_of_surface(line, line.observation))
    return tuple(filter(None, found))


def beside_misfits(estimates: Sequence[T], misfits: Sequence[Misfit]) -> tuple[T, ...]:
    """Estimates whose reasons tell of the worst misfit, if there is one.

    No interval covers what a model lacks: beside data that are missed as a whole no estimate is `identified`.
    """
    if not misfits:
        return tuple(estimates)
    worst = max(misfits, key=lambda misfit: (misfit.whole, misfit.times))
    words = f"but the model misses {worst.short} (warning `data-misfit`)"

    def told(estimate: T) -> T:
        """The same with the reason, and the verdict that is left."""
        word = "weak" if worst.whole and estimate.verdict == "identified" else estimate.verdict
        return replace(estimate, verdict=word, why=f"{estimate.why}, {words}")

    return tuple(map(told, estimates))


def _of_points(line: Linearisation, motions: PointMotions) -> Misfit | None:
    """That of points along the direction in which they are missed most, or of some that lie far off."""
    name, sd = line.observation.name, line.observation.first_noise((line.observation,)).sd
    scaled = line.residuals.values.reshape(-1, 3) / sd
    sizes, n = np.linalg.norm(scaled, axis=1), len(scaled)
    usual = float(np.sqrt(chi2.isf(TAIL, 3)))
    off = sizes > RELEVANT * usual
    left = motions.fitted - motions.observed
    alone = np.einsum("nij,nj->ni", motions.over_errors, left)
    count = _independent(line, motions.over_errors)
    smooth, limit = _worst_direction(alone), _limit(count, DIRECTIONS)
    times, direction = _worst_direction(scaled)
    sure = bool(motions.labels) and sizes.max() > np.sqrt(chi2.isf(CHANCE / n, 3))
    if not (times > _limit(n, DIRECTIONS) or smooth[0] > limit or _is_tail(float(off.mean()), n, off=3) or sure):
        return None
    what = f"the {name} in state {line.state + 1}"
    others = scaled[~off]
    spared = len(others) > 0 and _worst_direction(others)[0] <= _limit(len(others), DIRECTIONS)
    if spared and _worst_direction(alone[~off])[0] <= limit and 0.0 < off.mean() <= MOST:
        far, worst = int(off.sum()), int(sizes.argmax())
        place = f"the one at {np.round(motions.rest[worst], 1).tolist()} mm (RAS)"
        which = f"'{motions.labels[worst]}'" if motions.labels else place
        times, by = float(sizes[worst]), float(np.linalg.norm(left[worst]))
        short = f"{far} of {n} points of {what} by up to {times:.2g} times their stated error"
        text = (
            f"The fitted model misses {far} of {n} points of {what}, most of all {which} by {by:.2g} mm, {times:.2g}"
            f" times what the stated error of {sd:.2g} mm explains. Check that they are the same points in both states;"
            " correct or remove them."
        )
        return Misfit(name, line.state, times, short, text, whole=False)
    if smooth[0] > max(times, limit):
        (times, direction), scaled = smooth, alone
    along = left.T @ (scaled @ direction)  # the direction in space, from that of the scaled residuals
    along *= np.sign(along[np.abs(along).argmax()]) / np.linalg.norm(along)
    words = "".join(axis for axis, cosine in zip(AXES, along, strict=True) if cosine > ALONG)
    words = words or f"({', '.join(f'{cosine:.2f}' for cosine in along)})"
    by = float(np.sqrt(np.mean((left @ along) ** 2)))
    means = " for means of neighbouring points" if by < 0.9 * times * sd else ""
    text = (
        f"The fitted model misses {what} along {words} by {by:.2g} mm (root mean square), {times:.2g} times what the"
        f" stated error of {sd:.2g} mm explains{means}. Check the file's state, its axes and its stated error; try"
        " another law or boundary."
    )
    short = f"{what} along {words.split(' (')[0]} by {times:.2g} times its stated error"
    return Misfit(name, line.state, times, short, text)


def _of_surface(line: Linearisation, seen: Imaged) -> Misfit | None:
    """That of a surface, beside the noise that is stated or that all of the image show, voxels' rounding at least."""
    observation, of = line.observation, line.residuals
    name, sd = observation.name, observation.first_noise((observation,)).sd
    noise = "stated"
    if seen.stated_noise is None:
        sd, noise = max(sd, observation.weighting.sd), "estimated"
    shares, fit, n = of.weights / of.weights.sum(), observation.fit(of), observation.weighting.count
    usual = float(np.sqrt(chi2.isf(TAIL, 1))) * sd
    far = float(shares[np.abs(of.values) > RELEVANT * usual].sum())
    if not (fit.rms_mm / sd > _limit(n, 1.0) or _is_tail(far, n, off=1)):
        return None
    times, what = max(fit.rms_mm / sd, fit.hd95_mm / usual), f"the surface of '{name}' in state {line.state + 1}"
    text = (
        f"The fitted model misses {what} by {fit.rms_mm:.2g} mm (root mean square; 95th percentile {fit.hd95_mm:.2g}"
        f" mm), {times:.2g} times what the {noise} noise of {sd:.2g} mm explains. Look at it in the report: check how"
        " it is drawn, and try another law or boundary."
    )
    return Misfit(name, line.state, times, f"{what} by {times:.2g} times its noise", text)


def _of_instrument(line: Linearisation, seen: OfInstrument) -> Misfit | None:
    """That of a reading."""
    observation, left = line.observation, float(line.residuals.values[0])
    sd, unit = observation.first_noise((observation,)).sd, observation.unit
    times = abs(left) / sd
    if times <= _limit(1.0, 1.0):
        return None
    what = f"the {observation.name} in state {line.state + 1}"
    text = (
        f"The fitted model needs {seen.measured + left:.3g} {unit} for {what}, but {seen.measured:.3g} {unit} was"
        f" measured, which differs by {times:.2g} times the stated error of {sd:.2g} {unit}. Check its unit, direction"
        " and surface, or state a larger error."
    )
    return Misfit(observation.name, line.state, times, f"{what} by {times:.2g} times its stated error", text)


def _independent(line: Linearisation, over_errors: NDArray[np.float64]) -> float:
    """How many independent points a field amounts to at the least, by what is known of the mean of all.

    Of errors that are alike a smooth misfit is a few of n independent residuals, and no larger than these in their
    mean: (1 x I)^T C^-1 (1 x I) of the correlation C of the points' errors.
    """
    usual = line.observation.first_noise((line.observation,)).sd
    of_one = np.asarray(line.residuals.jacobian @ np.linalg.inv(over_errors).reshape(-1, 3)) / usual
    return min(float(np.sum(of_one**2)) / 3.0, float(len(over_errors)))


def _worst_direction(scaled: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Largest root mean square of residuals (n, 3) along a direction, and that unit vector (3,)."""
    squares, directions = np.linalg.eigh(scaled.T @ scaled / len(scaled))
    return float(np.sqrt(squares[-1])), directions[:, -1]


def _limit(count: float, directions: float) -> float:
    """Root mean square of so many independent residuals of standard deviation 1 that noise hardly exceeds."""
    return max(RELEVANT, float(np.sqrt(chi2.isf(CHANCE / directions, count) / count)))


def _is_tail(share: float, count: float, *, off: int) -> bool:
    """Whether a share of independent residuals beyond 1.5 times their 95th percentile is more than noise has there.

    off: number of components of each.
    """
    chance = chi2.sf(RELEVANT**2 * chi2.isf(TAIL, off), off)
    return share > max(TAIL, float(binom.isf(CHANCE, round(count), chance)) / count)
