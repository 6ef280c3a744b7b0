"""The columns of a table: what the truth's own surfaces, its voxels, and the paper's own method say of each body.

The paper's method: linear tetrahedra, small strain, squared distances of the surfaces' nodes, L-BFGS. Eq. 4: Phi = 1/2
sum over organs and nodes of |d(u_l + delta u_l, u_r)|^2, d the distance between the deformed surface and the observed
one, both ways; the unknowns are the moduli in kPa (Eq. 5), from one start. What it does not have: areas, a difference
to the rest state, robust weights, a motion of the driver that is estimated (it is prescribed).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import igl
import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from palpate.body import Body, ImagedStates, aligned
from palpate.images import Role, VoxelGrid, segment
from palpate.inversion import Bounds, Inversion, InversionSettings
from palpate.mechanics import LinearModel
from palpate.mesh import LagrangeSpace
from palpate.observation import Observation, ObservedSurface, observed_surface, surface_distance
from palpate.phantoms import imaged
from palpate.statement import Observed, conclude, verdict
from palpate.study import fitted_states
from palpate.uncertainty import log_interval, sandwich_covariance
from palpate.unknowns import ParameterMap
from palpate_validation.paper.table import Entries, entry_of
from palpate_validation.truth import target_of_truth

__all__ = [
    "PaperFit",
    "PaperTarget",
    "entries_by_the_paper",
    "entries_from_surfaces",
    "entries_from_voxels",
    "exact_surfaces",
    "from_half",
    "imaged_states",
    "paper_estimate",
    "paper_target",
    "with_motions",
]

Array = NDArray[np.float64]
Motions = Sequence[Array]

SEARCHED = 100.0  # the moduli are sought within this factor of the start


def from_half(mapping: ParameterMap, truth: Mapping[str, float]) -> InversionSettings:
    """One start, at half of every true modulus (kPa), as in the paper."""
    start = np.log([0.5 * truth[name] / mapping.scale_kpa for name in mapping.tissues])
    reach = np.log(SEARCHED)
    return InversionSettings((start,), Bounds(start - reach, start + reach))


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


def exact_surfaces(space: LagrangeSpace, truth: LagrangeSpace, displacement: Array) -> tuple[Observation, ...]:
    """The `estimate` surfaces of a model's `space` held against those of a truth under u (n_points, 3) mm."""
    organs = [i for i, tissue in enumerate(truth.mesh.tissues) if tissue.role is Role.ESTIMATE]
    surfaces = (observed_surface(space, organ) for organ in organs)
    return tuple(surface_distance(target_of_truth(truth, displacement, surface)) for surface in surfaces)


def entries_by_the_paper(
    model: LinearModel,
    space: LagrangeSpace,
    displacement: Array,
    truth: Mapping[str, float],
    *,
    moduli: Array,
) -> Entries:
    """What the paper's method says of each body on surfaces of a truth's `space` under u (n_points, 3) mm.

    moduli (n_regions,) kPa: its start, and what it holds of the others.
    """
    surfaces = (observed_surface(model.space, model.space.mesh.tissue_index(name)) for name in truth)
    targets = [paper_target(space, displacement, surface) for surface in surfaces]
    fit = paper_estimate(model, targets, moduli=moduli, columns=np.array([model.names.index(name) for name in truth]))
    values = fit.moduli.tolist() if fit.converged else [None] * len(truth)
    return {
        name: entry_of(value, kpa, iterations=fit.iterations)
        for value, (name, kpa) in zip(values, truth.items(), strict=True)
    }


def entries_from_surfaces(inversion: Inversion, settings: InversionSettings, truth: Mapping[str, float]) -> Entries:
    """What an inversion of exact surfaces says of each body; its interval knows of no voxels."""
    mapping, minimum = inversion.objective.parameters, inversion.minimum
    spread = np.sqrt(np.diag(sandwich_covariance(inversion.objective, minimum.evaluation)))
    found = {}
    steps = _steps(inversion)
    for i, name in enumerate(mapping.tissues):
        if not minimum.outcome.converged:
            found[name] = entry_of(None, truth[name], verdict="not identified", iterations=steps)
            continue
        low, high, value = (
            mapping.scale_kpa * float(np.exp(logs[i]))
            for logs in (settings.bounds.lower, settings.bounds.upper, minimum.unknowns)
        )
        interval = log_interval(value, float(spread[i]), lower=low, upper=high)
        word, _ = verdict(interval, at_bound=False, absolute=mapping.absolute)
        found[name] = entry_of(value, truth[name], interval95=interval, verdict=word, iterations=steps)
    return found


def entries_from_voxels(
    inversion: Inversion, settings: InversionSettings, body: Body, truth: Mapping[str, float], *, seed: int
) -> Entries:
    """What an inversion of voxels says of each body, with the interval that a case's result would state."""
    images = tuple(image.index for image in body.states.after)
    observed = Observed(fitted_states(inversion, body), images)
    estimation = conclude(inversion, settings, observed, truth=truth, seed=seed)
    steps = _steps(inversion)
    return {
        e.tissue: entry_of(e.value, truth[e.tissue], interval95=e.interval95, verdict=e.verdict, iterations=steps)
        for e in estimation.estimates
    }


def _steps(inversion: Inversion) -> int:
    """Accepted points on the way of the first start, and on that to the estimate."""
    first = inversion.starts[0]
    return len(first.minimum.history) + len(inversion.minimum.history)


@dataclass(frozen=True, slots=True)
class PaperTarget:
    """The model's `surface`, and the observed one: vertices (n, 3) mm, triangles (m, 3), seen (m,)."""

    surface: ObservedSurface
    vertices: Array
    triangles: NDArray[np.int64]
    seen: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class PaperFit:
    """Moduli (n_parameters,) kPa where L-BFGS ended, its iterations, evaluations of Phi, and Phi (mm^2) there."""

    moduli: Array
    iterations: int
    evaluations: int
    objective_mm2: float
    converged: bool


def paper_target(space: LagrangeSpace, displacement: Array, surface: ObservedSurface) -> PaperTarget:
    """The deformed surface of a truth, u (n_points, 3) mm on its `space`, for the model's surface of that tissue."""
    truth = observed_surface(space, surface.tissue)
    return PaperTarget(surface, truth.rest + displacement[truth.points], truth.triangles, truth.observed)


def paper_estimate(
    model: LinearModel, targets: Sequence[PaperTarget], *, moduli: Array, columns: NDArray[np.int64]
) -> PaperFit:
    """Minimise Eq. 4 over the moduli of the regions `columns` (n_parameters,), from `moduli` (n_regions,) kPa.

    The others stay; the model's boundary motion is its offset alone. L-BFGS-B (Byrd et al. 1995) with SciPy's
    tolerances, in units of the start; the gradient is exact, by one adjoint solve.
    """
    start = moduli[columns]
    evaluations = 0

    def phi(relative: Array) -> tuple[float, Array]:
        """Eq. 4 of the paper (mm^2) and its gradient at moduli relative to the start's (n,)."""
        nonlocal evaluations
        evaluations += 1
        trial = moduli.copy()
        trial[columns] = relative * start
        equilibrium = model.solve(trial, np.zeros(model.n_modes))
        value, pull = 0.0, np.zeros_like(equilibrium.displacement)
        for target in targets:
            part, slope = _distances(target, equilibrium.displacement[target.surface.points])
            value += part
            np.add.at(pull, target.surface.points, slope)
        by_log = equilibrium.adjoint(pull.ravel())[columns]
        return value, by_log / relative

    ones = np.ones(len(columns))
    bounds = optimize.Bounds(ones / SEARCHED, ones * SEARCHED)
    found = optimize.minimize(phi, ones, jac=True, method="L-BFGS-B", bounds=bounds)
    return PaperFit(found.x * start, int(found.nit), evaluations, float(found.fun), bool(found.success))


def _distances(target: PaperTarget, motion: Array) -> tuple[float, Array]:
    """Eq. 4 of one organ, mm^2, and its derivative (n_vertices, 3) mm at a motion (n_vertices, 3) mm of its nodes.

    Closest points are held for the derivative, which is exact: where they slide, the distance is stationary.
    """
    surface = target.surface
    deformed = np.ascontiguousarray(surface.rest + motion)
    slope = np.zeros_like(deformed)
    own = np.unique(surface.triangles[surface.observed])
    faces = np.ascontiguousarray(target.triangles)
    _, _, nearest = igl.point_mesh_squared_distance(deformed[own], target.vertices, faces)[:3]
    away = deformed[own] - np.asarray(nearest)
    slope[own] += away
    seen = np.unique(target.triangles[target.seen])
    image = np.ascontiguousarray(target.vertices[seen])
    faces = np.ascontiguousarray(surface.triangles)
    _, triangle, places = igl.point_mesh_squared_distance(image, deformed, faces)[:3]
    corners = surface.triangles[np.asarray(triangle, dtype=np.int64)]
    back = np.asarray(places) - image
    weights = np.asarray(igl.barycentric_coordinates(places, *(deformed[corners[:, k]] for k in range(3))))
    np.add.at(slope, corners, weights[:, :, None] * back[:, None, :])
    return 0.5 * float(np.sum(away**2) + np.sum(back**2)), slope
