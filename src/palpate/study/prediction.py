"""What an estimate may be expected to tell, before it is run: intervals by the information of the images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.body.body import Body, joint_problem, make_body, on_linear_elements
from palpate.case.case import Case, Mechanics
from palpate.errors import EstimationError
from palpate.images.grey_field import MEAN_ML, GreyField
from palpate.inversion import Evaluation, Linearisation, Objective, first_noise_of, fit_coefficients
from palpate.observation import DataFile, DisplacementField, PointTable
from palpate.parallel import blas_on_one_thread
from palpate.progress import Line, Progress, silent
from palpate.statement.verdicts import or_as_ratio, verdict, without_scale
from palpate.study.run import inversion_settings
from palpate.uncertainty import Interval, covariance_of, error_noise, log_interval
from palpate.unknowns import KNOWN_MODULUS, Choice

GREY = "displacement field from the grey images"
WORTH = 1.05  # times as narrow, from which a field is worth its trouble
ONLY = 100.0  # times as wide: without this kind of data a modulus is not told


@dataclass(frozen=True, slots=True)
class PredictedModulus:
    """A tissue's modulus as it was guessed, in `unit` (kPa, or a ratio to `relative_to`), with its predicted interval.

    interval95: what would be left of it with all that is unknown; an open end (None) reaches beyond the bounds of the
    search; verdict: that which an estimate with this interval would have; shares: of each cause in the variance of
    ln E; wider: by what factor the standard deviation of ln E would grow without each kind of data, where there are
    several; ratio, ratio_interval95: to `relative_to`, where the modulus of that is a range.
    """

    tissue: str
    unit: str
    guess: float
    interval95: Interval
    relative_to: str
    verdict: str
    why: str
    shares: Mapping[str, float] = field(default_factory=dict)
    ratio: float | None = None
    ratio_interval95: Interval | None = None
    wider: Mapping[str, float] = field(default_factory=dict)


def _ends(interval: Interval, unit: str) -> str:
    """An interval in words; an end that is open reaches beyond the bounds of the search."""
    low, high = interval
    if low is None or high is None:
        side = f"below {high:.3g} {unit}" if high is not None else f"above {low:.3g} {unit}" if low is not None else ""
        return side or "open at both ends"
    return f"{low:.3g} to {high:.3g} {unit}"


def _without(wider: Mapping[str, float]) -> str:
    """What each kind of data is worth, in words."""
    told = [
        f"no interval without {kind}" if w >= ONLY else f"{w:.2g} times as wide without {kind}"
        for kind, w in wider.items()
    ]
    return "; " * bool(told) + ", ".join(told)


@dataclass(frozen=True, slots=True)
class Prediction:
    """The predicted intervals of a case's moduli, and the noise (mm) that they rest on.

    noise_sd_mm: of the surfaces of one image, of which a residual has two; correlation_mm: of the noise, the length of
    one Gaussian with its correlation area; stated: whether the case states it, else the images show it. narrower: by
    what factor a field from the grey images would narrow each modulus's interval, by tissue, where there are such.
    """

    moduli: tuple[PredictedModulus, ...]
    noise_sd_mm: float
    correlation_mm: float
    stated: bool
    narrower: Mapping[str, float] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """A line a modulus, for people."""
        lines = []
        for of in self.moduli:
            unit = "kPa" if of.unit == "kPa" else f"times {of.relative_to}"
            value, interval = of.guess, of.interval95
            if of.verdict == "ratio only" and of.ratio is not None and of.ratio_interval95 is not None:
                value, interval, unit = of.ratio, of.ratio_interval95, f"times {of.relative_to}"
            guess = f"predicted for {of.tissue}, if it has {value:.3g} {unit}"
            lines.append(f"{guess}: 95 % interval {_ends(interval, unit)} ({of.verdict}){_without(of.wider)}")
        for tissue, factor in self.narrower.items():
            worth = f"make the interval of {tissue} {factor:.2g} times as narrow" if factor >= WORTH else "hardly help"
            lines.append(f"a displacement field from the grey images would {worth}" + f" {tissue}" * (factor < WORTH))
        return lines

    def to_dict(self) -> dict[str, Any]:
        """For a JSON document."""
        return {
            "noise": {
                "surface_sd_mm": round(self.noise_sd_mm, 4),
                "correlation_length_mm": round(self.correlation_mm, 2),
                "stated": self.stated,
            },
            "moduli": [
                {
                    "tissue": of.tissue,
                    "unit": of.unit,
                    "guess": of.guess,
                    "interval95": list(of.interval95),
                    "relative_to": of.relative_to,
                    "ratio": of.ratio,
                    "ratio_interval95": of.ratio_interval95 and list(of.ratio_interval95),
                    "verdict": of.verdict,
                    "shares": dict(of.shares),
                    "narrower_with_field": self.narrower.get(of.tissue),
                    "wider_without": {kind: round(w, 3) if w < ONLY else None for kind, w in of.wider.items()},
                }
                for of in self.moduli
            ],
        }


def _wider(
    objective: Objective, evaluation: Evaluation, unknowns: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """By kind of data, factors (n_parameters,) by which the standard deviations of ln E grow without it.

    By H^-1 of the others and the prior; nothing where there is one kind.
    """
    n, terms = objective.n_parameters, evaluation.linearisations
    kinds = list(dict.fromkeys(term.observation.kind for term in terms))

    def variances(kept: Sequence[Linearisation]) -> NDArray[np.float64]:
        try:
            return np.diag(objective.assembled(unknowns, kept).covariance_columns(n)[:n])
        except EstimationError:
            return np.full(n, np.inf)

    every = variances(terms)
    others = {kind: [term for term in terms if term.observation.kind != kind] for kind in kinds}
    return {kind: np.sqrt(variances(kept) / every) for kind, kept in others.items() if kept}


@blas_on_one_thread()
def predicted_intervals(
    bodies: Sequence[Body], case: Case, *, progress: Progress, grey: Sequence[GreyField] = ()
) -> Prediction:
    """The intervals that an estimate of the case may be expected to have, at guessed moduli, under the linear law.

    The covariance of the log-moduli at the guess (see `covariance_of`), by the inverse of the Gauss-Newton matrix
    J^T W J + P, which for these least squares is the Fisher information of images and prior: J needs no later image but
    for the motion of what is prescribed. The noise in it is the one that the case states, or that the images show where
    an estimate begins. Elements are linear ones on the given meshes, so that this takes seconds; a modulus is guessed
    as its tissue states it, else where the search begins. Layers round organs are free, and surfaces drawn alike.
    Finite strains, the voxels' place and the mesh are not in it. grey: what a field between the grey images of the
    first two states tells, whose worth is predicted, too. Raises as an estimate does.
    """
    coarse = replace(case, mechanics=Mechanics("linear", "P1", solver=case.mechanics.solver))
    problem = joint_problem([on_linear_elements(body, coarse) for body in bodies], coarse, progress=progress)
    settings = inversion_settings(coarse, problem.parameters)
    objective, nearby = first_noise_of(problem, settings, progress=progress)
    noise_of = error_noise(nearby.evaluation)
    progress(Line("predicting the intervals from the images, at guessed moduli"))
    guess, stated = nearby.unknowns.copy(), {tissue.name: tissue.modulus_kpa for tissue in case.tissues}
    guess[: objective.n_parameters] = settings.centre
    for i, name in enumerate(objective.parameters.tissues):
        if (kpa := stated.get(name)) is not None:
            guess[i] = float(np.log(kpa / objective.parameters.scale_kpa))
    fitted = fit_coefficients(objective, guess)
    believed = {Choice.LAYERS: 1, Choice.DRAWING: 0}  # free, and drawn alike
    blocks = objective.parameters.blocks
    chosen = {i: believed[block.choice] for i, block in enumerate(blocks) if block.choice in believed}
    free = objective.with_prior(objective.parameters.choosing(chosen))
    found = covariance_of(free, fitted.evaluation.with_prior(free.parameters, fitted.unknowns), (), noise_of=noise_of)
    wider = _wider(free, fitted.evaluation, fitted.unknowns)
    surfaces = [noise for (_, kind), noise in noise_of.items() if kind == "surface distance"]
    noise = surfaces[0] if surfaces else next(iter(noise_of.values()))
    mapping, moduli = objective.parameters, list[PredictedModulus]()
    variances = np.diag(found.total - found.mesh)
    for i, name in enumerate(mapping.tissues):
        value, sd = float(np.exp(guess[i])), float(np.sqrt(variances[i]))
        limits = {"lower": float(np.exp(settings.bounds.lower[i])), "upper": float(np.exp(settings.bounds.upper[i]))}
        interval = log_interval(value, sd, **limits)
        word, why = verdict(interval, at_bound=False, absolute=mapping.absolute)
        unit = mapping.scale_kpa if mapping.absolute else 1.0
        shares = replace(found, mesh=np.zeros_like(found.mesh)).shares(i)
        of_scale, as_ratio = sd * float(np.sqrt(shares.get(KNOWN_MODULUS, 0.0))), None
        if of_scale > 0.0:
            as_ratio = without_scale(of_scale, interval, value, centre=value)
            word, why = or_as_ratio((word, why), as_ratio, at_bound=False)
        ends = (interval[0] and unit * interval[0], interval[1] and unit * interval[1])
        moduli.append(
            PredictedModulus(
                name,
                "kPa" if mapping.absolute else "ratio",
                unit * value,
                ends,
                mapping.relative_to,
                word,
                why,
                shares,
                value if as_ratio else None,
                as_ratio,
                {kind: float(factors[i]) for kind, factors in wider.items()},
            )
        )
    narrower = dict[str, float]()
    if grey:
        moved = objective.states[0].displacement(mapping.moduli(guess), mapping.coefficients(fitted.unknowns)[0])
        first = _with_field(bodies[0], case, grey, moved)
        with_field = predicted_intervals([first, *bodies[1:]], case, progress=progress)
        narrower = {of.tissue: of.wider[GREY] for of in with_field.moduli}
    return Prediction(
        tuple(moduli),
        noise.sd / np.sqrt(2.0),
        float(np.sqrt(noise.correlation_area / (2.0 * np.pi))),
        case.noise.surface_sd_mm is not None,
        narrower,
    )


def _with_field(body: Body, case: Case, grey: Sequence[GreyField], moved: NDArray[np.float64]) -> Body:
    """A body with a field of its own motion, one point for each cube of `MEAN_ML` in each tissue that is told.

    moved (n, 3) mm: of the points of its space on linear elements, the nodes first.
    """
    mesh, edge = body.space.mesh, 10.0 * MEAN_ML ** (1.0 / 3.0)
    places, motions, errors = list[NDArray[np.float64]](), list[NDArray[np.float64]](), list[NDArray[np.float64]]()
    for of in grey:
        region = next(number for number, tissue in enumerate(mesh.tissues) if tissue.name == of.tissue)
        nodes = np.unique(mesh.tets[mesh.region == region])
        own = nodes[np.unique(np.floor(mesh.nodes[nodes] / edge), axis=0, return_index=True)[1]]
        places.append(mesh.nodes[own])
        motions.append(moved[own])
        errors.append(np.full((len(own), 3), of.mean_mm))
    before = np.concatenate(places)
    image = case.images.intensities_before if case.images else None
    file = DataFile("displacement-field", GREY, (image or Path(),), 1)
    table = PointTable(before, before + np.concatenate(motions), np.concatenate(errors), ("",) * len(before), ())
    states = replace(body.states, data=(*body.states.data, DisplacementField(file, table)))
    return make_body(states, case, progress=silent, mesh=mesh)
