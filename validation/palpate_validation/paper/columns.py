"""The columns of a table: inverse problems from the truth's own surfaces or from its voxels, and what they say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.body import Body, ImagedStates, aligned
from palpate.images import Role, VoxelGrid, segment
from palpate.inversion import Bounds, Inversion, InversionSettings
from palpate.mechanics import LinearModel
from palpate.mesh import LagrangeSpace
from palpate.observation import Observation, observed_surface, surface_distance
from palpate.phantoms import imaged
from palpate.statement import Observed, conclude, verdict
from palpate.study import fitted_states
from palpate.uncertainty import log_interval, sandwich_covariance
from palpate.unknowns import ParameterMap
from palpate_validation.paper.paper_method import paper_estimate, paper_target
from palpate_validation.paper.table import Entry
from palpate_validation.truth import target_of_truth

__all__ = [
    "entries_by_the_paper",
    "entries_from_surfaces",
    "entries_from_voxels",
    "exact_surfaces",
    "from_half",
    "imaged_states",
    "with_motions",
]

SEARCHED = 100.0  # the moduli are sought within this factor of the start


def from_half(mapping: ParameterMap, truth: Mapping[str, float]) -> InversionSettings:
    """One start, at half of every true modulus (kPa), as in the paper."""
    start = np.log([0.5 * truth[name] / mapping.scale_kpa for name in mapping.tissues])
    reach = np.log(SEARCHED)
    return InversionSettings((start,), Bounds(start - reach, start + reach))


Motions = Sequence[NDArray[np.float64]]


def imaged_states(space: LagrangeSpace, motions: Motions, grid: VoxelGrid) -> ImagedStates:
    """The rest state of a truth and its later ones, u (n_points, 3) mm each, as label images.

    Tissues that `grid` does not show in all of them fall away.
    """
    images = [imaged(space, motion, grid) for motion in (np.zeros_like(space.points), *motions)]
    shown = set.intersection(*(set(np.unique(image.labels)) for image in images))
    numbered = enumerate(space.mesh.tissues, start=1)
    tissues = tuple(replace(tissue, labels=(label,)) for label, tissue in numbered if label in shown)
    before, *after = (segment(image, tissues) for image in images)
    return aligned(before, tuple(after), method="none")


def with_motions(states: ImagedStates, space: LagrangeSpace, motions: Motions) -> ImagedStates:
    """The same rest state with the later states of other u (n_points, 3) mm."""
    before = states.before
    images = (segment(imaged(space, u, before.grid), before.tissues) for u in motions)
    every = zip(states.later, images, strict=True)
    return replace(states, later=tuple(replace(of, image=image) for of, image in every))


def exact_surfaces(
    space: LagrangeSpace, truth: LagrangeSpace, displacement: NDArray[np.float64]
) -> tuple[Observation, ...]:
    """The `estimate` surfaces of a model's `space` held against those of a truth under u (n_points, 3) mm."""
    organs = [i for i, tissue in enumerate(truth.mesh.tissues) if tissue.role is Role.ESTIMATE]
    surfaces = (observed_surface(space, organ) for organ in organs)
    return tuple(surface_distance(target_of_truth(truth, displacement, surface)) for surface in surfaces)


def entries_by_the_paper(
    model: LinearModel,
    space: LagrangeSpace,
    displacement: NDArray[np.float64],
    truth: Mapping[str, float],
    *,
    moduli: NDArray[np.float64],
) -> dict[str, Entry]:
    """What the paper's method says of each body on surfaces of a truth's `space` under u (n_points, 3) mm.

    moduli (n_regions,) kPa: its start, and what it holds of the others.
    """
    surfaces = (observed_surface(model.space, model.space.mesh.tissue_index(name)) for name in truth)
    targets = [paper_target(space, displacement, surface) for surface in surfaces]
    fit = paper_estimate(model, targets, moduli=moduli, columns=np.array([model.names.index(name) for name in truth]))
    values = fit.moduli.tolist() if fit.converged else [None] * len(truth)
    return {
        name: Entry.of(value, kpa, iterations=fit.iterations)
        for value, (name, kpa) in zip(values, truth.items(), strict=True)
    }


def entries_from_surfaces(
    inversion: Inversion, settings: InversionSettings, truth: Mapping[str, float]
) -> dict[str, Entry]:
    """What an inversion of exact surfaces says of each body; its interval knows of no voxels."""
    mapping, minimum = inversion.objective.parameters, inversion.minimum
    spread = np.sqrt(np.diag(sandwich_covariance(inversion.objective, minimum.evaluation)))
    found = {}
    steps = _steps(inversion)
    for i, name in enumerate(mapping.tissues):
        if not minimum.outcome.converged:
            found[name] = Entry.of(None, truth[name], verdict="not identified", iterations=steps)
            continue
        low, high, value = (
            mapping.scale_kpa * float(np.exp(logs[i]))
            for logs in (settings.bounds.lower, settings.bounds.upper, minimum.unknowns)
        )
        interval = log_interval(value, float(spread[i]), lower=low, upper=high)
        word, _ = verdict(interval, at_bound=False, absolute=mapping.absolute)
        found[name] = Entry.of(value, truth[name], interval95=interval, verdict=word, iterations=steps)
    return found


def entries_from_voxels(
    inversion: Inversion, settings: InversionSettings, body: Body, truth: Mapping[str, float], *, seed: int
) -> dict[str, Entry]:
    """What an inversion of voxels says of each body, with the interval that a case's result would state."""
    images = tuple(image.index for image in body.states.after)
    observed = Observed(fitted_states(inversion, body), images)
    estimation = conclude(inversion, settings, observed, truth=truth, seed=seed)
    steps = _steps(inversion)
    return {
        e.tissue: Entry.of(e.value, truth[e.tissue], interval95=e.interval95, verdict=e.verdict, iterations=steps)
        for e in estimation.estimates
    }


def _steps(inversion: Inversion) -> int:
    """Accepted points on the way of the first start, and on that to the estimate."""
    first = inversion.starts[0]
    return len(first.minimum.history) + len(inversion.minimum.history)
