"""From the minima to the statement: intervals, verdicts, fits and every start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.inversion.estimation import Estimation, Iteration, ModulusEstimate, Remark, Start, SurfaceFit, TissueFit
from palpate.inversion.gauss_newton import Iterate
from palpate.inversion.grid_position import FittedState, grid_position_shifts
from palpate.inversion.objective import Linearisation
from palpate.inversion.posterior import sandwich_covariance
from palpate.inversion.problem import Inversion, InversionSettings
from palpate.inversion.verdict import hull, log_interval, verdict
from palpate.mechanics.deformation import deformation_determinants
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.voxelise import voxelise

__all__ = ["Observed", "conclude"]

GRID_DRAWS = 8
AT_BOUND = 1e-6
STRONG_CORRELATION = 0.99
AS_GOOD = 0.05  # of the objective: another minimum that is worse by less cannot be excluded


@dataclass(frozen=True, slots=True)
class Observed:
    """The displacements' space, the fitted later states (some on their own), each image's tissue index (nx, ny, nz)."""

    space: LagrangeSpace
    states: tuple[FittedState, ...]
    images: tuple[NDArray[np.int16], ...]


def conclude(
    inversion: Inversion, settings: InversionSettings, observed: Observed, *, truth: Mapping[str, float], seed: int
) -> Estimation:
    """State the result of an inversion; `truth`: true moduli (kPa) by tissue where they are known.

    The covariance is the sandwich under the residuals' law plus the scatter over grid positions.
    """
    n = inversion.objective.n_parameters
    shifts = grid_position_shifts(
        inversion, observed.space, observed.states, draws=GRID_DRAWS, rng=np.random.default_rng(seed)
    )
    grid_part = shifts.T @ shifts / len(shifts)
    covariance = sandwich_covariance(inversion.minimum.evaluation, inversion.law, n) + grid_part
    converged = inversion.minimum.outcome.converged
    return Estimation(
        status="converged" if converged else "not converged",
        reason=_reason(inversion),
        estimates=_estimates(inversion, settings, covariance, truth),
        covariance=covariance,
        starts=tuple(_start(inversion, i, theta) for i, theta in enumerate(settings.starts)),
        fits=_fits(inversion, observed),
        displacements=tuple(state.displacement for state in observed.states),
        counts=_counts(inversion),
        remarks=(*_remarks(inversion, covariance), *_folds(observed)),
        grid_covariance=grid_part,
    )


def _reason(inversion: Inversion) -> str:
    outcome = inversion.minimum.outcome
    converged = sum(m.outcome.converged for m in inversion.minima)
    distinct = len({g for g, m in zip(inversion.groups, inversion.minima, strict=True) if m.outcome.converged})
    return (
        f"{outcome.value}; {converged} of {len(inversion.minima)} starts converged,"
        f" to {distinct} distinct {'minimum' if distinct == 1 else 'minima'}"
    )


def _estimates(
    inversion: Inversion, settings: InversionSettings, covariance: NDArray[np.float64], truth: Mapping[str, float]
) -> tuple[ModulusEstimate, ...]:
    mapping = inversion.objective.modulus_map
    theta = inversion.minimum.unknowns[: len(mapping.tissues)]
    bounds = settings.bounds
    scale = mapping.scale_kpa
    if not inversion.minimum.outcome.converged:
        return tuple(_no_estimate(inversion, name, truth.get(name)) for name in mapping.tissues)
    found = []
    for i, name in enumerate(mapping.tissues):
        ratio = float(np.exp(theta[i]))
        limits = {"lower": float(np.exp(bounds.lower[i])), "upper": float(np.exp(bounds.upper[i]))}
        sd = float(np.sqrt(covariance[i, i]))
        interval = hull([log_interval(float(np.exp(t[i])), sd, **limits) for t in _as_good(inversion)])
        at_bound = bool(np.min(np.abs([theta[i] - bounds.lower[i], theta[i] - bounds.upper[i]])) < AT_BOUND)
        word, why = verdict(interval, at_bound=at_bound, absolute=mapping.absolute)
        low, high = interval
        found.append(
            ModulusEstimate(
                tissue=name,
                unit="kPa" if mapping.absolute else "ratio",
                value=ratio * scale if mapping.absolute else None,
                interval95=(low and low * scale, high and high * scale) if mapping.absolute else None,
                interval_kind="linearised",
                relative_to=mapping.relative_to,
                ratio=None if mapping.by_load else ratio,
                ratio_interval95=None if mapping.by_load else interval,
                verdict=word,
                why=why,
                truth=truth.get(name),
            )
        )
    return tuple(found)


def _as_good(inversion: Inversion) -> list[NDArray[np.float64]]:
    """Log-moduli (n_parameters,) of the best minimum and of every other that explains the images nearly as well.

    Voxels make the objective rough by some hundredths of it, so that its value alone cannot choose between them.
    """
    n, best = inversion.objective.n_parameters, inversion.minimum
    limit = (1.0 + AS_GOOD) * best.evaluation.value
    pairs = zip(inversion.groups, inversion.minima, strict=True)
    distinct = {g: m for g, m in pairs if m.outcome.converged and m.evaluation.value <= limit}
    return [m.unknowns[:n] for m in (distinct | {inversion.groups[inversion.best]: best}).values()]


def _no_estimate(inversion: Inversion, tissue: str, truth: float | None) -> ModulusEstimate:
    """The entry of a tissue when nothing converged: no value that could be taken for a result."""
    mapping = inversion.objective.modulus_map
    return ModulusEstimate(
        tissue=tissue,
        unit="kPa" if mapping.absolute else "ratio",
        value=None,
        interval95=None,
        interval_kind="linearised",
        relative_to=mapping.relative_to,
        ratio=None,
        ratio_interval95=None,
        verdict="not identified",
        why=f"the estimation did not converge: {inversion.minimum.outcome.value}",
        truth=truth,
    )


def _start(inversion: Inversion, number: int, theta: NDArray[np.float64]) -> Start:
    minimum = inversion.minima[number]
    return Start(
        start=_moduli(inversion, theta),
        end=_moduli(inversion, minimum.unknowns[: len(theta)]),
        objective_mm2=minimum.evaluation.misfit_mm2,
        status="converged" if minimum.outcome.converged else "not converged",
        reason=minimum.outcome.value,
        minimum=inversion.groups[number],
        history=tuple(_iteration(inversion, iterate) for iterate in minimum.history),
    )


def _iteration(inversion: Inversion, iterate: Iterate) -> Iteration:
    return Iteration(iterate.misfit_mm2, _moduli(inversion, iterate.theta), iterate.decrement)


def _moduli(inversion: Inversion, theta: NDArray[np.float64]) -> dict[str, float]:
    """Moduli in kPa, or ratios when no modulus is known."""
    mapping = inversion.objective.modulus_map
    return {name: float(mapping.scale_kpa * np.exp(value)) for name, value in zip(mapping.tissues, theta, strict=True)}


def _fits(inversion: Inversion, observed: Observed) -> tuple[tuple[TissueFit, ...], ...]:
    fits, number = [], 0
    for state, fitted, image in zip(inversion.objective.states, observed.states, observed.images, strict=True):
        still = np.zeros_like(fitted.displacement)
        overlaps = [
            voxelise(fitted.space or observed.space, motion, fitted.after, crossing=True)
            for motion in (still, fitted.displacement)
        ]
        tissues = []
        for target in state.targets:
            tissue = target.surface.tissue
            dice = [_dice(model == tissue, image == tissue) for model in overlaps]
            start = _surface_fit(inversion.rest.surfaces[number], dice[0])
            end = _surface_fit(inversion.minimum.evaluation.surfaces[number], dice[1])
            tissues.append(TissueFit(target.surface.name, start, end, target.surface.share))
            number += 1
        fits.append(tuple(tissues))
    return tuple(fits)


def _folds(observed: Observed) -> tuple[Remark, ...]:
    """A warning for each later image in which the fitted model turns elements inside out."""
    remarks = []
    for number, state in enumerate(observed.states, start=1):
        space = state.space or observed.space
        smallest = deformation_determinants(space, state.displacement).min(axis=1)
        folded = int(np.count_nonzero(smallest <= 0.0))
        if folded:
            worst = space.mesh.nodes[space.mesh.tets[int(smallest.argmin())]].mean(axis=0)
            remarks.append(
                Remark(
                    "fold-over",
                    f"after image {number}: {folded} of {len(smallest)} elements are turned inside out, the worst near"
                    f" {np.round(worst).astype(int).tolist()} mm (RAS): the motion is too large there for the law or"
                    " the mesh",
                )
            )
    return tuple(remarks)


def _surface_fit(line: Linearisation, dice: float) -> SurfaceFit:
    distance, weights = np.abs(line.residuals.values), line.residuals.weights
    order = np.argsort(distance)
    share = np.cumsum(weights[order]) / float(weights.sum())
    return SurfaceFit(
        mean_mm=float(np.average(distance, weights=weights)),
        rms_mm=float(np.sqrt(np.average(distance**2, weights=weights))),
        hd95_mm=float(distance[order][np.searchsorted(share, 0.95)]),
        dice=dice,
    )


def _dice(model: NDArray[np.bool_], image: NDArray[np.bool_]) -> float:
    """Dice coefficient 2 |A and B| / (|A| + |B|)."""
    voxels = int(model.sum()) + int(image.sum())
    return 2.0 * int((model & image).sum()) / max(voxels, 1)


def _counts(inversion: Inversion) -> dict[str, int]:
    counts = inversion.counts
    return {
        "forward": counts.forward,
        "adjoint": counts.adjoint,
        "tangent": counts.tangent,
        "factorisations": counts.factorisations,
        "evaluations": inversion.evaluations,
    }


def _remarks(inversion: Inversion, covariance: NDArray[np.float64]) -> tuple[Remark, ...]:
    mapping = inversion.objective.modulus_map
    remarks = []
    if not mapping.absolute:
        remarks.append(
            Remark(
                "ratio-only",
                f"no tissue's modulus is known, so only ratios to '{mapping.relative_to}' are determined; give one"
                " tissue role `known` with its youngs_modulus_kpa to get kPa",
            )
        )
    if not inversion.settled:
        remarks.append(
            Remark(
                "unsettled",
                "residuals' law and estimate still changed each other in the last round; the model may not fit the"
                " images (edge length, driver modes, law), or [noise] should be given",
            )
        )
    if len(set(inversion.groups)) > 1:
        remarks.append(
            Remark(
                "several-minima",
                "the starts ended in different minima; the best fit is reported, and the intervals reach over all that"
                " fit nearly as well",
            )
        )
    sd = np.sqrt(np.diag(covariance))
    for i in range(len(sd)):
        for j in range(i):
            if abs(covariance[i, j]) > STRONG_CORRELATION * sd[i] * sd[j]:
                names = f"'{mapping.tissues[j]}' and '{mapping.tissues[i]}'"
                remarks.append(Remark("correlated", f"the moduli of {names} cannot be told apart by these images"))
    return tuple(remarks)
