"""What is stated of an inversion: the intervals of its moduli, every start, the fit of everything observed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.body.poisson_ratios import NOT_IDENTIFIED, ratios_of
from palpate.images.checks import later_names
from palpate.inversion import (
    EarlierImages,
    Inversion,
    InversionSettings,
    Iterate,
    Linearisation,
    StartRun,
    earlier_images,
)
from palpate.mesh.voxelise import voxelise
from palpate.observation.contract import Fit, Imaged, OfInstrument, OfPoints, seen_by
from palpate.progress import Progress, silent
from palpate.statement.discrepancy import FoundDiscrepancy, discrepancy_findings, discrepancy_of, fitted_materials
from palpate.statement.estimate_findings import (
    data_findings,
    fold_findings,
    inversion_findings,
    pair_findings,
    variation_findings,
)
from palpate.statement.estimation import Estimation, ForceFit, Iteration, PointFit, Start, StatedExplanation, TissueFit
from palpate.statement.image_pairs import image_pairs_of
from palpate.statement.joint import combinations_of, regions_of
from palpate.statement.map_summary import map_findings
from palpate.statement.misfit import beside_misfits, misfits_of
from palpate.statement.samples import draw_moduli
from palpate.statement.stated_posterior import StatedPosterior, as_stated
from palpate.statement.variations import Variation
from palpate.statement.verdicts import IDENTIFIED, estimates_of, intervals_of
from palpate.uncertainty import (
    GRID_DRAWS,
    Covariance,
    FittedState,
    correlated_factor,
    covariance_of,
    grid_errors,
    information,
    information_shares,
    stiffness_maps,
)

LEAST_TOLD = 0.01  # probability of an explanation that the result names


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
    vary: Callable[[StatedPosterior], tuple[Variation, ...]] = lambda _: (),
    progress: Progress = silent,
) -> Estimation:
    """State the result of an inversion; `truth`: true moduli (kPa) by tissue where they are known.

    samples: draws of the moduli's posterior, where the estimate converged; 0: none; vary: what would change it then.
    The covariance is the sandwich under the residuals' noise model plus the scatter over grid positions.
    """
    objective, minimum = inversion.objective, inversion.minimum
    rng = np.random.default_rng(seed)
    progress(f"intervals: correlation of the residuals, and the model as {GRID_DRAWS} random voxel grids show it")
    errors = grid_errors(objective, minimum.evaluation, observed.states, rng=rng)
    sought = [objective.parameters.columns(i) for i, block in enumerate(objective.parameters.blocks) if block.sought]
    every = covariance_of(objective, minimum.evaluation, errors, further=sought)
    own = every.of_first(objective.n_parameters)
    progress("intervals: the models made exact where profiles end")
    posterior = as_stated(inversion, own, settings.bounds)
    covariance = posterior.mixture.covariance
    progress("intervals: profiles, and the fit of every surface before and after")
    pairs = image_pairs_of(inversion, settings.bounds, errors, posterior.frozen)
    known = intervals_of(inversion, settings, posterior)
    fits, forces, points = _seen(inversion, observed)
    misfits = misfits_of(minimum.evaluation.linearisations, points, observed.states[0].space.mesh.tissues)
    told = misfits if minimum.converged else ()
    estimates = beside_misfits(estimates_of(inversion, known, covariance, truth=truth), told)
    stating = {e.tissue for e in estimates if e.verdict != NOT_IDENTIFIED}
    pairs = pairs and pairs.with_intervals_of(stating)
    regions = regions_of(inversion, posterior, settings.bounds, tissues=stating)
    drawn = None
    if samples and minimum.converged:
        progress(f"intervals: {samples} samples of the posterior")
        marginals, ends = [of.marginal for of in known], [of.interval for of in known]
        drawn = draw_moduli(objective.parameters, posterior.mixture, marginals, ends, draws=samples, rng=rng)
    found_discrepancy = discrepancy_of(inversion, observed.states) if minimum.converged else FoundDiscrepancy()
    maps = stiffness_maps(inversion, np.diag(covariance.total)) if minimum.converged else ()
    shares = dict[str, Mapping[str, float]]()
    if minimum.converged:  # of each kind of data in what is known of a tissue's modulus
        of_tissues = information_shares(minimum.evaluation, objective.n_parameters)
        shares = dict(zip(objective.parameters.tissues, of_tissues, strict=False))
    variations = vary(posterior) if minimum.converged else ()
    names = later_names(len(observed.images))
    if all(image is None for image in observed.images):  # the body is given as a mesh
        names = [f"state {number}" for number in range(1, len(observed.images) + 1)]
    findings = (
        *inversion_findings(inversion, covariance.total),
        *pair_findings(pairs, names),
        *fold_findings(observed.states, names),
        *data_findings(inversion),
        *(misfit.finding for misfit in misfits),
        *discrepancy_findings(found_discrepancy),
        *map_findings(maps),
        *variation_findings(variations, estimates),
    )
    return Estimation(
        status="converged" if minimum.converged else "not converged",
        reason=_reason(inversion),
        estimates=estimates,
        poisson_ratios=beside_misfits(ratios_of(inversion, every), told),
        covariance=covariance,
        with_ratios=every if sought else None,
        starts=tuple(_start(inversion, start) for start in inversion.starts),
        fits=fits,
        forces=forces,
        points=points,
        displacements=tuple(state.displacement for state in observed.states),
        counts=asdict(inversion.counts) | {"evaluations": inversion.evaluations},
        outer_loop=tuple(_iteration(inversion, iterate) for iterate in minimum.history),
        remarks=findings,
        observations={observation.kind: observation.description for observation in objective.observations},
        information=information(covariance.total),
        information_shares=shares,
        discrepancy=found_discrepancy,
        combinations=combinations_of(inversion, posterior, settings.bounds, within=IDENTIFIED),
        regions=regions,
        image_pairs=pairs,
        samples=drawn,
        maps=maps,
        explanations=_explanations(inversion) if minimum.converged else (),
        materials=fitted_materials(inversion),
        variations=variations,
        images=_told(inversion, settings, own) if known and all(None not in of.interval for of in known) else None,
    )


def _told(inversion: Inversion, settings: InversionSettings, own: Covariance) -> EarlierImages | None:
    """What the images tell, for others that are added; None where that is no law.

    With the errors that the posterior leaves out, but the mesh's, which added images share. It is not asked of a
    posterior with an open end, which is far from normal: added images would be held where nothing tells a modulus.
    """
    parameters, n_images = inversion.objective.parameters, len(inversion.objective.states)
    wider, beside = correlated_factor(own), own.of_held + own.grid
    seen = np.isfinite(wider) & np.isfinite(np.diag(beside))  # a modulus that moves nothing has no errors
    errors = {"wider": np.where(seen, wider, 1.0), "beside": np.where(np.outer(seen, seen), beside, 0.0)}
    try:
        return earlier_images(inversion.mixture, parameters, settings.bounds, n_images=n_images, **errors)
    except np.linalg.LinAlgError:
        return None


def _reason(inversion: Inversion) -> str:
    """How the estimate ended, and what became of the starts.

    These are followed alone on the cheapest model: all of them may end, and the estimate that goes on from there not.
    """
    ended = [start.candidate for start in inversion.starts if start.minimum.converged]
    distinct = len({candidate for candidate in ended if candidate is not None})
    minima = f"{distinct} distinct {'minimum' if distinct == 1 else 'minima'}"
    starts = f"{inversion.minimum.outcome.value}; {len(ended)} of {len(inversion.starts)} starts"
    if not inversion.minimum.converged:
        return f"{starts} led to {minima} of the starting model, but the estimate from there did not converge"
    return f"{starts} converged, to {minima}"


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


def _explanations(inversion: Inversion) -> tuple[StatedExplanation, ...]:
    """Those with a probability of `LEAST_TOLD` at least, the likeliest first."""
    return tuple(
        StatedExplanation(of.scenario, of.images, of.weight, _moduli(inversion, of.theta))
        for of in inversion.mixture.explanations
        if of.weight >= LEAST_TOLD
    )


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


def _seen(
    inversion: Inversion, observed: Observed
) -> tuple[tuple[tuple[TissueFit, ...], ...], tuple[ForceFit, ...], tuple[PointFit, ...]]:
    """All that was observed beside what the fitted model says: in each later image, by instruments, at points."""
    fits, forces, points = list[tuple[TissueFit, ...]](), list[ForceFit](), list[PointFit]()
    for line in inversion.minimum.evaluation.linearisations:
        seen, name = line.observation, line.observation.name
        if isinstance(seen, OfInstrument):
            fitted = seen.measured + float(line.residuals.values[0])
            forces.append(ForceFit(name, line.state, seen.measured, fitted, line.observation.noise_model.sd))
        elif isinstance(seen, OfPoints):
            motions = seen.point_motions(seen_by(line.observation, observed.states[line.state].displacement.ravel()))
            stated = line.observation.first_noise((line.observation,)).sd
            misfit = float(np.sqrt(np.mean(line.residuals.values**2))) / stated
            points.append(PointFit(name, line.state, motions, misfit))
    for s, (state, image) in enumerate(zip(observed.states, observed.images, strict=True)):
        ways = (np.zeros_like(state.displacement), state.displacement)
        modelled = [None if image is None else voxelise(state.space, u, state.after, crossing=True) for u in ways]
        lines = zip(inversion.rest.linearisations, inversion.minimum.evaluation.linearisations, strict=True)
        of_state = [pair for pair in lines if pair[0].state == s and pair[0].observation.unit == "mm"]
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
    return tuple(fits), tuple(forces), tuple(points)
