"""How far the place of the voxel grid moves the estimate: the fitted model is imaged again on shifted grids."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue_distance import tissue_distance_map
from palpate.inversion.objective import Linearisation
from palpate.inversion.posterior import gain
from palpate.inversion.problem import Inversion
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.voxelise import voxelise

__all__ = ["FittedState", "grid_position_shifts", "voxel_errors"]

AROUND = 8.0  # widths of the Gaussian: the maps are asked on the surface alone


@dataclass(frozen=True, slots=True)
class FittedState:
    """A fitted later state: displacement (n_points, 3) mm, the grids of both images, the maps' smoothing (mm).

    `space`: the state's own, where its reference state is not that of the others (a further pair of images).
    """

    displacement: NDArray[np.float64]
    before: VoxelGrid
    after: VoxelGrid
    smoothing_mm: float
    space: LagrangeSpace | None = None


def grid_position_shifts(
    inversion: Inversion,
    space: LagrangeSpace,
    states: tuple[FittedState, ...],
    *,
    draws: int,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Shifts (draws, n_parameters) of the estimated log-moduli when an exact model is imaged on random grids.

    The errors e of the distance maps go through the gain of one Gauss-Newton step, -2 G e: both directions of the
    distance see the same error, and `gain` holds half the weight in each.
    """
    rows = gain(inversion.minimum.evaluation, inversion.objective.n_parameters)
    shifts = np.zeros((draws, inversion.objective.n_parameters))
    for draw in range(draws):
        for row, error in zip(rows, voxel_errors(inversion, space, states, rng=rng), strict=True):
            shifts[draw] -= 2.0 * row[:, : len(error)] @ error
    return shifts


def voxel_errors(
    inversion: Inversion, space: LagrangeSpace, states: tuple[FittedState, ...], *, rng: np.random.Generator
) -> list[NDArray[np.float64]]:
    """Errors (n_q,) mm of the model -> image residuals of each surface when the fitted model itself is imaged.

    The model, at rest and deformed, is turned into voxels on grids shifted at random by up to half a voxel; later
    states of one reference state have the same image of it.
    """
    lines = iter(inversion.minimum.evaluation.surfaces)
    errors, known = list[NDArray[np.float64]](), list[tuple[LagrangeSpace, Segmentation]]()
    for state, fitted in zip(inversion.objective.states, states, strict=True):
        own = fitted.space or space
        rest = [image for reference, image in known if reference is own]
        before = rest[0] if rest else _imaged(own, np.zeros_like(fitted.displacement), fitted.before, rng)
        known.append((own, before))
        after = _imaged(own, fitted.displacement, fitted.after, rng)
        errors += [_error(next(lines), before, after, fitted.smoothing_mm) for _ in state.targets]
    return errors


def _error(line: Linearisation, before: Segmentation, after: Segmentation, smoothing_mm: float) -> NDArray[np.float64]:
    target = line.target
    corners = target.surface.rest[target.surface.triangles[target.triangle]]
    rest = np.einsum("qk,qka->qa", target.barycentric, corners)
    maps = [
        tissue_distance_map(image, target.surface.tissue, smoothing_mm=smoothing_mm, reach_mm=AROUND * smoothing_mm)
        for image in (before, after)
    ]
    n = len(rest)
    return np.asarray(maps[1].at(line.residuals.places[:n]) - maps[0].at(rest) - line.residuals.excess[:n])


def _imaged(
    space: LagrangeSpace, displacement: NDArray[np.float64], grid: VoxelGrid, rng: np.random.Generator
) -> Segmentation:
    affine = np.array(grid.affine)
    affine[:3, 3] += affine[:3, :3] @ rng.uniform(-0.5, 0.5, 3)
    shifted = replace(grid, affine=affine)
    return Segmentation(voxelise(space, displacement, shifted, crossing=True), shifted, space.mesh.tissues)
