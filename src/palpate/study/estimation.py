"""What is stated of an inversion: moduli with interval and verdict, every start, the fit of everything observed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from palpate.errors import EstimationError
from palpate.findings import Finding
from palpate.inversion import (
    Inversion,
    InversionSettings,
    Iterate,
    Linearisation,
    Outcome,
    OuterIterate,
    StartRun,
    as_good,
    frozen_posterior,
    with_released,
)
from palpate.mesh.voxelise import voxelise
from palpate.observation.contract import Fit, Imaged, OfInstrument, OfPoints, PointMotions, seen_by
from palpate.parallel import mapped
from palpate.progress import Progress, silent
from palpate.study.discrepancy import (
    FittedMaterial,
    FoundDiscrepancy,
    discrepancy_findings,
    discrepancy_of,
    fitted_materials,
)
from palpate.study.estimate_findings import (
    data_findings,
    fold_findings,
    inversion_findings,
    pair_findings,
)
from palpate.study.map_words import map_findings
from palpate.study.poisson_ratios import NOT_IDENTIFIED, PoissonRatioEstimate, no_ratio, ratio_verdict
from palpate.study.samples import CHAINS, ModulusSamples, draw_moduli, sample_findings
from palpate.study.together import (
    ImagePairs,
    ModulusRegion,
    StatedPosterior,
    combinations_of,
    image_pairs_of,
    regions_of,
)
from palpate.study.variations import Variation
from palpate.uncertainty import (
    GRID_DRAWS,
    NORMAL_95,
    Combination,
    Covariance,
    FittedState,
    Information,
    Interval,
    ModulusInterval,
    StiffnessMap,
    covariance_of,
    grid_errors,
    information,
    information_shares,
    log_interval,
    modulus_interval,
    sandwich_covariance,
    stiffness_maps,
)
from palpate.unknowns import KNOWN_MODULUS, ratio_of_eta

IDENTIFIED, WEAK = 4.0, 10.0  # largest ratio of an interval's ends: a factor of 2 to each side, and of 3.2


@dataclass(frozen=True, slots=True)
class Iteration:
    """One step of one start: misfit (mm^2), moduli (kPa, or ratios), and the decrement still promised."""

    objective_mm2: float
    moduli: Mapping[str, float]
    decrement: float


@dataclass(frozen=True, slots=True)
class Start:
    """What one start did alone: moduli (kPa, or ratios) it began and ended with, its steps and how they ended.

    minimum: number, from 0, of the distinct minimum that it leads to; None where that was not followed, others being
    lower.
    """

    start: Mapping[str, float]
    end: Mapping[str, float]
    objective_mm2: float
    status: str
    reason: str
    minimum: int | None
    history: tuple[Iteration, ...]

    @property
    def iterations(self) -> int:
        """Number of accepted points."""
        return len(self.history)


@dataclass(frozen=True, slots=True)
class ModulusEstimate:
    """Young's modulus of one tissue, in `unit` (kPa, or a ratio to `relative_to`), with its 95 % interval.

    interval95: what is believed with all discrepancies of the model unknown, layers too, by which the verdict is told;
    interval95_given_model: what would be left if the model held. None: no interval is stated, as of every modulus that
    is not identified; `value` is None in ratio mode and when nothing converged. variance_shares: of each cause in the
    variance of ln E; profile: values (kPa, or ratios) with their signed root deviances.
    """

    tissue: str
    unit: str
    value: float | None
    interval95: Interval | None
    interval_kind: str
    relative_to: str
    ratio: float | None
    ratio_interval95: Interval | None
    verdict: str
    why: str
    truth: float | None = None
    parameter: str = "youngs_modulus"
    variance_shares: Mapping[str, float] | None = None
    profile: tuple[tuple[float, float], ...] = ()
    interval95_given_model: Interval | None = None


@dataclass(frozen=True, slots=True)
class TissueFit:
    """Fit of one observation in one later image, before and after the estimation; `tissue`: its name."""

    tissue: str
    start: Fit
    end: Fit
    observed_share: float


@dataclass(frozen=True, slots=True)
class ForceFit:
    """A measured and the fitted force of a later state (its number, from 0), N, with its standard deviation."""

    name: str
    state: int
    measured_n: float
    fitted_n: float
    sd_n: float


@dataclass(frozen=True, slots=True)
class PointFit:
    """Points whose motion was measured in a later state (its number, from 0), beside the fitted model's.

    misfit: root mean square of the residuals that count, over the standard deviation stated, dimensionless.
    """

    name: str
    state: int
    motions: PointMotions
    misfit: float


@dataclass(frozen=True, slots=True)
class Estimation:
    """Result of one inversion.

    estimates: of the moduli; poisson_ratios: of those that were sought beside them; covariance, correlation (n, n): of
    the log-moduli, then of those ratios' eta = ln(lambda / mu); fits: the tissues of each later image; displacements:
    (n_points, 3) mm of each later image;
    outer_loop: the steps from the best start's minimum to the estimate, which all starts of that minimum share;
    counts: of all starts and minima together; observations: what was compared, in words, by its kind; information: the
    directions of the log-moduli by how well they are known; information_shares: by tissue, of each kind of data, and of
    what was believed before; discrepancy: what the images say of frame, drawing and material; combinations: what is
    known where single moduli are not; regions: joint ones of two moduli; forces, points: measured and fitted;
    image_pairs: what each of several later images says alone; samples: of the moduli's posterior,
    where the case asks for them and the estimate converged; variations: what would change the answer; maps: of tissues
    whose modulus is a field; materials: of the elements, one a later state.
    """

    status: str
    reason: str
    estimates: tuple[ModulusEstimate, ...]
    covariance: Covariance
    starts: tuple[Start, ...]
    fits: tuple[tuple[TissueFit, ...], ...]
    displacements: tuple[NDArray[np.float64], ...]
    counts: Mapping[str, int]
    outer_loop: tuple[Iteration, ...] = ()
    remarks: tuple[Finding, ...] = ()
    observations: Mapping[str, str] = field(default_factory=dict)
    information: Information | None = None
    information_shares: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    combinations: tuple[Combination, ...] = ()
    discrepancy: FoundDiscrepancy = field(default_factory=FoundDiscrepancy)
    regions: tuple[ModulusRegion, ...] = ()
    image_pairs: ImagePairs | None = None
    samples: ModulusSamples | None = None
    poisson_ratios: tuple[PoissonRatioEstimate, ...] = ()
    forces: tuple[ForceFit, ...] = ()
    points: tuple[PointFit, ...] = ()
    variations: tuple[Variation, ...] = ()
    maps: tuple[StiffnessMap, ...] = ()
    materials: tuple[FittedMaterial, ...] = ()

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Correlation (n, n) of the parameters, dimensionless."""
        total = self.covariance.total
        sd = np.sqrt(np.diag(total))
        return np.asarray(total / np.outer(sd, sd))


@dataclass(frozen=True, slots=True)
class Observed:
    """The fitted later states, and each image's tissue index (nx, ny, nz), None of a state that is not imaged."""

    states: tuple[FittedState, ...]
    images: tuple[NDArray[np.int16] | None, ...]


def conclude(
    inversion: Inversion,
    settings: InversionSettings,
    observed: Observed,
    *,
    truth: Mapping[str, float],
    seed: int,
    samples: int = 0,
    progress: Progress = silent,
) -> Estimation:
    """State the result of an inversion; `truth`: true moduli (kPa) by tissue where they are known.

    samples: draws in each chain of the moduli's posterior, where the estimate converged; 0: none.
    The covariance is the sandwich under the residuals' noise model plus the scatter over grid positions.
    """
    objective, minimum = inversion.objective, inversion.minimum
    rng = np.random.default_rng(seed)
    progress(f"intervals: correlation of the residuals, and the model as {GRID_DRAWS} random voxel grids show it")
    errors = grid_errors(objective, minimum.evaluation, observed.states, rng=rng)
    bonded = covariance_of(objective, minimum.evaluation, errors, unknowns=minimum.unknowns)
    released, remark = released_of(inversion, settings, progress=progress)
    covariance, posteriors = stated_posteriors(inversion, bonded, released)
    progress("intervals: profiles, and the fit of every surface before and after")
    pairs = image_pairs_of(inversion, settings.bounds, errors, released)
    known = intervals_of(inversion, settings, posteriors)
    estimates = estimates_of(inversion, known, covariance, truth=truth, layers_told=not remark)
    of_moduli = covariance.total[: len(estimates), : len(estimates)]
    stating = {e.tissue for e in estimates if e.verdict != NOT_IDENTIFIED}
    pairs = pairs and pairs.with_intervals_of(stating)
    regions = regions_of(inversion, posteriors, settings.bounds, tissues=stating)
    drawn = None
    if samples and minimum.converged:
        progress(f"intervals: {samples} samples of the posterior in each of {CHAINS} chains")
        stated = [e.interval95 if objective.parameters.absolute else e.ratio_interval95 for e in estimates]
        drawn = draw_moduli(posteriors[-1], stated, bounds=settings.bounds, draws=samples, rng=rng)
    found_discrepancy = discrepancy_of(inversion, observed.states) if minimum.converged else FoundDiscrepancy()
    maps = stiffness_maps(inversion, np.diag(covariance.total)) if minimum.converged else ()
    findings = (
        *inversion_findings(inversion, covariance.total),
        *remark,
        *pair_findings(pairs),
        *fold_findings(observed.states),
        *data_findings(inversion),
        *sample_findings(drawn),
        *discrepancy_findings(found_discrepancy),
        *map_findings(maps),
    )
    return Estimation(
        status="converged" if minimum.converged else "not converged",
        reason=_reason(inversion),
        estimates=estimates,
        poisson_ratios=_ratios(inversion, known, covariance),
        covariance=covariance,
        starts=tuple(_start(inversion, start) for start in inversion.starts),
        fits=_fits(inversion, observed),
        forces=_forces(inversion),
        points=_points(inversion, observed),
        displacements=tuple(state.displacement for state in observed.states),
        counts=asdict(inversion.counts) | {"evaluations": inversion.evaluations},
        outer_loop=tuple(_iteration(inversion, iterate) for iterate in minimum.history),
        remarks=findings,
        observations={observation.kind: observation.description for observation in objective.observations},
        information=information(of_moduli),
        information_shares=_shares(inversion) if minimum.converged else {},
        discrepancy=found_discrepancy,
        combinations=combinations_of(inversion, posteriors[0].frozen, of_moduli, settings.bounds, within=IDENTIFIED),
        regions=regions,
        image_pairs=pairs,
        samples=drawn,
        maps=maps,
        materials=fitted_materials(inversion),
    )


def no_estimate(
    tissue: str, *, absolute: bool, relative_to: str, why: str, truth: float | None = None
) -> ModulusEstimate:
    """The entry of a tissue when nothing converged: no value that could be taken for a result."""
    return ModulusEstimate(
        tissue=tissue,
        unit="kPa" if absolute else "ratio",
        value=None,
        interval95=None,
        interval_kind="linearised",
        relative_to=relative_to,
        ratio=None,
        ratio_interval95=None,
        verdict=NOT_IDENTIFIED,
        why=why,
        truth=truth,
    )


def hull(intervals: Sequence[Interval]) -> Interval:
    """Smallest interval that holds all of one or more; an end that is open in one of them is open."""
    lows, highs = [low for low, _ in intervals], [high for _, high in intervals]
    low = None if None in lows else min(end for end in lows if end is not None)
    high = None if None in highs else max(end for end in highs if end is not None)
    return low, high


def verdict(interval: Interval, *, at_bound: bool, absolute: bool) -> tuple[str, str]:
    """Verdict and its reason from the interval of a modulus or ratio.

    `identified`: closed and high/low <= 4, a factor of 2 to each side; `weak`: closed and wider; `not identified`: an
    open end, a bound, or high/low > 10; `ratio only`: identified or weak, but no known modulus holds the scale.
    """
    low, high = interval
    if at_bound:
        return NOT_IDENTIFIED, "the estimate lies at its bound; the images do not hold it back"
    if low is None or high is None:
        return NOT_IDENTIFIED, "the 95 % interval is open: it reaches beyond the bounds of the search"
    width = high / low
    if width > WEAK:
        return NOT_IDENTIFIED, f"the 95 % interval spans a factor {width:.1f}"
    if not absolute:
        return "ratio only", f"no modulus is known, so only the ratio is determined (within a factor {width:.2f})"
    if width <= IDENTIFIED:
        return "identified", f"the 95 % interval spans a factor {width:.2f}"
    return "weak", f"the 95 % interval spans a factor {width:.2f}; more image pairs or a larger motion narrow it"


def _reason(inversion: Inversion) -> str:
    """How the estimate ended, and what became of the starts."""
    converged = sum(start.minimum.converged for start in inversion.starts)
    distinct = {s.candidate for s in inversion.starts if s.minimum.converged}
    outcomes = [candidate.minimum.outcome for candidate in inversion.candidates]
    lost, left = outcomes.count(Outcome.NO_EQUILIBRIUM), outcomes.count(Outcome.NOT_FOLLOWED)
    return (
        f"{inversion.minimum.outcome.value}; {converged} of {len(inversion.starts)} starts converged,"
        f" to {len(distinct)} distinct {'minimum' if len(distinct) == 1 else 'minima'}"
        + (f", {lost} of which {'has' if lost == 1 else 'have'} no equilibrium under the law" if lost else "")
        + (f", {left} of which could not be followed under the law" if left else "")
    )


@dataclass(frozen=True, slots=True)
class Known:
    """Of one parameter: its own interval, one that holds all minima that fit as well, both of e^theta; at a bound."""

    own: ModulusInterval
    interval: Interval
    at_bound: bool


def stated_posteriors(
    inversion: Inversion, bonded: Covariance, released: OuterIterate | None
) -> tuple[Covariance, tuple[StatedPosterior, ...]]:
    """All that is stated rests on these: the covariance by all causes, and the posteriors, the widest last.

    The first is that of the estimate, with its covariance while released blocks are held (`bonded`); the other, where
    they were `released`, is about the minimum with them free, and has what they add.
    """
    objective, minimum = inversion.objective, inversion.minimum
    fixed = frozen_posterior(objective, minimum.unknowns, minimum.evaluation)
    first = StatedPosterior(fixed, minimum, bonded.total)
    if released is None:
        return bonded, (first,)
    sandwich = sandwich_covariance(released.objective, released.minimum.evaluation)
    covariance = bonded.with_released(objective, minimum.evaluation, sandwich)
    free = frozen_posterior(released.objective, released.minimum.unknowns, released.minimum.evaluation)
    return covariance, (first, StatedPosterior(free, released.minimum, covariance.total))


def intervals_of(
    inversion: Inversion, settings: InversionSettings, posteriors: Sequence[StatedPosterior]
) -> tuple[Known, ...]:
    """Of each parameter its interval, which holds that of each of the `posteriors`; none where nothing converged."""
    if not inversion.minimum.converged:
        return ()
    first, n, bounds = posteriors[0], inversion.objective.n_parameters, settings.bounds
    found, variances, at_bound = [], np.diag(first.covariance), bounds.reached(inversion.minimum.unknowns[:n])

    def interval(of: tuple[int, StatedPosterior]) -> ModulusInterval:
        """That of one parameter by one posterior."""
        number, by = of
        variance = float(by.covariance[number, number])
        return modulus_interval(by.frozen, by.minimum, number, variance=variance, bounds=bounds)

    every = mapped(interval, product(range(n), posteriors))
    best = inversion.candidates[inversion.best]
    minima = [c for c in inversion.candidates if c is not best and c.minimum.converged]
    scales = np.diag(inversion.minimum.evaluation.covariance_columns(n)[:n]) / variances  # of a profile's deviance
    for i in range(n):
        limits = {"lower": float(np.exp(bounds.lower[i])), "upper": float(np.exp(bounds.upper[i]))}
        own, *wider = every[i * len(posteriors) : (i + 1) * len(posteriors)]
        sd = float(np.sqrt(variances[i]))
        good = [c.minimum.unknowns for c in minima if as_good(c.value, best.value, scale=float(scales[i]))]
        ellipses = (log_interval(float(np.exp(x[i])), sd, **limits) for x in good)
        whole = hull([own.ends, *ellipses, *(of.ends for of in wider)])
        found.append(Known(own, whole, bool(at_bound[i])))
    return tuple(found)


def released_of(
    inversion: Inversion, settings: InversionSettings, *, progress: Progress = silent
) -> tuple[OuterIterate | None, tuple[Finding, ...]]:
    """The minimum with released blocks free, where there is one, and what is told where there should be."""
    try:
        found = with_released(inversion, settings, progress=progress)
    except EstimationError as error:
        found, why = None, str(error)
    else:
        if found is None or found.minimum.converged:
            return found, ()
        why = found.minimum.outcome.value
    text = (
        f"with the stiffness of layers round organs free the estimate did not end ({why}), so that the intervals do not"
        " hold what a soft or stiff layer would do; another [mesh] edge_length_mm may help, or [discrepancy]"
        " layer_sd = 0 where there is none"
    )
    return found, (Finding("unsettled", text),)


def estimates_of(
    inversion: Inversion,
    known: Sequence[Known],
    covariance: Covariance,
    *,
    truth: Mapping[str, float],
    layers_told: bool = True,
) -> tuple[ModulusEstimate, ...]:
    """What is stated of the moduli whose intervals are `known`; `truth`: true moduli (kPa) by tissue, where known.

    layers_told: whether the covariance holds what layers round organs would do; where it does not, nothing is
    `identified`.
    """
    mapping, scale = inversion.objective.parameters, inversion.objective.parameters.scale_kpa
    none = [
        no_estimate(
            name,
            absolute=mapping.absolute,
            relative_to=mapping.relative_to,
            why=_not_converged(inversion),
            truth=truth.get(name),
        )
        for name in mapping.tissues
    ]
    if not known:
        return tuple(none)
    found, unit = [], scale if mapping.absolute else 1.0
    given = np.diag(covariance.total if covariance.given_model is None else covariance.given_model)
    shift = mapping.reference_shift(inversion.minimum.unknowns)
    for i, (nothing, of) in enumerate(zip(none, known, strict=False)):
        theta, (low, high) = float(inversion.minimum.unknowns[i]), of.interval
        value, shares = float(np.exp(theta)), covariance.shares(i)
        of_scale = float(np.sqrt(shares.get(KNOWN_MODULUS, 0.0) * covariance.total[i, i]))
        by_ratio = _without(of_scale, of.interval, value, centre=float(np.exp(theta - shift)))
        word, why = verdict(of.interval, at_bound=of.at_bound, absolute=mapping.absolute)
        if word != "identified" and of_scale > 0.0:
            word, why = _of_range(word, why, verdict(by_ratio, at_bound=of.at_bound, absolute=True))
        if not layers_told and word != NOT_IDENTIFIED:
            word = "weak" if word == "identified" else word
            why = f"{why}, but does not hold what layers round the organs would do (warning `unsettled`)"
        points = zip(unit * np.exp(of.own.profile.theta), of.own.profile.root, strict=True)
        inside = log_interval(value, float(np.sqrt(given[i])), lower=low or 0.0, upper=high or np.inf)
        within = (inside[0] or low, inside[1] or high)
        found.append(
            replace(
                nothing,
                interval_kind=of.own.kind,
                interval95_given_model=_stated(within, word, unit),
                variance_shares=shares,
                profile=tuple((float(at), float(root)) for at, root in points),
                value=value * scale if mapping.absolute else None,
                interval95=_stated(of.interval, word, scale) if mapping.absolute else None,
                ratio=None if mapping.by_load else float(np.exp(theta - shift)),
                ratio_interval95=None if mapping.by_load else _stated(by_ratio, word),
                verdict=word,
                why=why,
            )
        )
    return tuple(found)


def _without(sd: float, interval: Interval, value: float, *, centre: float) -> Interval:
    """An interval of a value about another centre, its half-widths in ln less those of an independent cause of it.

    sd: that of the cause, in ln; h -> sqrt(h^2 - (1.96 sd)^2).
    """
    halves = [None if end is None else abs(np.log(end / value)) for end in interval]
    low, high = (None if h is None else float(np.sqrt(max(h**2 - (NORMAL_95 * sd) ** 2, 0.0))) for h in halves)
    return (
        None if low is None else float(centre * np.exp(-low)),
        None if high is None else float(centre * np.exp(high)),
    )


def _of_range(word: str, why: str, of_ratio: tuple[str, str]) -> tuple[str, str]:
    """The verdict on a modulus whose scale is known within a range alone: the ratio may say more."""
    if of_ratio[0] == NOT_IDENTIFIED or of_ratio[0] == word:
        return word, why
    return "ratio only", f"of the ratio {of_ratio[1]}; the range of the known modulus leaves more of it open in kPa"


def _stated(interval: Interval, word: str, unit: float = 1.0) -> Interval | None:
    """The interval, times a unit, that a verdict lets stand: of what is not identified there is none."""
    low, high = interval
    return None if word == NOT_IDENTIFIED else (low and low * unit, high and high * unit)


def _ratios(inversion: Inversion, known: Sequence[Known], covariance: Covariance) -> tuple[PoissonRatioEstimate, ...]:
    mapping, found = inversion.objective.parameters, list[PoissonRatioEstimate]()
    for open_ in mapping.poisson:
        i, nothing = open_.column, no_ratio(open_.tissue, why=_not_converged(inversion))
        if not known:
            found.append(nothing)
            continue
        of = known[i]
        low, high = (None if end is None else ratio_of_eta(np.log(end)) for end in of.interval)
        of_prior = float(np.sqrt(covariance.total[i, i] * mapping.prior_precision[i, i]))
        word, why = ratio_verdict((low, high), at_bound=of.at_bound, of_prior=of_prior)
        points = zip(of.own.profile.theta, of.own.profile.root, strict=True)
        found.append(
            replace(
                nothing,
                value=open_.ratio(inversion.minimum.unknowns),
                interval95=_stated((low, high), word),
                interval_kind=of.own.kind,
                verdict=word,
                why=why,
                variance_shares=covariance.shares(i),
                profile=tuple((ratio_of_eta(eta), float(root)) for eta, root in points),
            )
        )
    return tuple(found)


def _not_converged(inversion: Inversion) -> str:
    return f"the estimation did not converge: {inversion.minimum.outcome.value}"


def _start(inversion: Inversion, start: StartRun) -> Start:
    minimum = start.minimum
    return Start(
        start=_moduli(inversion, start.theta),
        end=_moduli(inversion, minimum.unknowns[: len(start.theta)]),
        objective_mm2=minimum.evaluation.misfit_mm2,
        status="converged" if minimum.converged else "not converged",
        reason=minimum.outcome.value,
        minimum=start.candidate,
        history=tuple(_iteration(inversion, iterate) for iterate in minimum.history),
    )


def _iteration(inversion: Inversion, iterate: Iterate) -> Iteration:
    return Iteration(iterate.misfit_mm2, _moduli(inversion, iterate.theta), iterate.decrement)


def _moduli(inversion: Inversion, theta: NDArray[np.float64]) -> dict[str, float]:
    """Moduli in kPa, or ratios when no modulus is known."""
    mapping = inversion.objective.parameters
    moduli = mapping.scale_kpa * np.exp(theta[: len(mapping.tissues)])
    return dict(zip(mapping.tissues, moduli.tolist(), strict=True))


def _fit(line: Linearisation, modelled: NDArray[np.int16] | None, image: NDArray[np.int16] | None) -> Fit:
    """The fit of one observation; of a tissue that images show with Dice's 2 |A and B| / (|A| + |B|)."""
    found, seen = line.observation.fit(line.residuals), line.observation
    if not isinstance(seen, Imaged) or modelled is None or image is None:
        return found
    both = modelled == seen.tissue, image == seen.tissue
    overlap = 2.0 * int((both[0] & both[1]).sum()) / max(sum(int(of.sum()) for of in both), 1)
    return replace(found, dice=overlap)


def _forces(inversion: Inversion) -> tuple[ForceFit, ...]:
    """The readings of instruments beside what the fitted model says."""
    found = []
    for line in inversion.minimum.evaluation.linearisations:
        seen = line.observation
        if isinstance(seen, OfInstrument):
            fitted = seen.measured + float(line.residuals.values[0])
            sd = line.observation.noise_model.sd
            found.append(ForceFit(line.observation.name, line.state, seen.measured, fitted, sd))
    return tuple(found)


def _points(inversion: Inversion, observed: Observed) -> tuple[PointFit, ...]:
    """The points of every observation that has some, as measured and as the fitted states move them."""
    found = []
    for line in inversion.minimum.evaluation.linearisations:
        seen = line.observation
        if isinstance(seen, OfPoints):
            motions = seen.point_motions(seen_by(line.observation, observed.states[line.state].displacement.ravel()))
            stated = line.observation.first_noise((line.observation,)).sd
            misfit = float(np.sqrt(np.mean(line.residuals.values**2))) / stated
            found.append(PointFit(line.observation.name, line.state, motions, misfit))
    return tuple(found)


def _shares(inversion: Inversion) -> dict[str, Mapping[str, float]]:
    """By tissue, the share of each kind of data in what is known of its modulus."""
    shares = information_shares(inversion.minimum.evaluation, inversion.objective.n_parameters)
    return dict(zip(inversion.objective.parameters.tissues, shares, strict=False))


def _fits(inversion: Inversion, observed: Observed) -> tuple[tuple[TissueFit, ...], ...]:
    fits = []
    for s, (fitted, image) in enumerate(zip(observed.states, observed.images, strict=True)):
        motions = (np.zeros_like(fitted.displacement), fitted.displacement)
        modelled = [None if image is None else voxelise(fitted.space, u, fitted.after, crossing=True) for u in motions]
        seen = zip(inversion.rest.linearisations, inversion.minimum.evaluation.linearisations, strict=True)
        of_state = [pair for pair in seen if pair[0].state == s and pair[0].observation.unit == "mm"]
        fits.append(
            tuple(
                TissueFit(
                    end.observation.name,
                    _fit(start, modelled[0], image),
                    _fit(end, modelled[1], image),
                    end.observation.observed_share,
                )
                for start, end in of_state
            )
        )
    return tuple(fits)
