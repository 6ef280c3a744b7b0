"""Surfaces of a report: those of the images as triangles, those of the model with their distance to the image."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import igl
import numpy as np
from scipy import ndimage

from palpate.images.distance import cropped, observation_width, tissue_distance_map, window_around
from palpate.images.segmentation import Segmentation
from palpate.mesh.surface import tissue_surface, triangle_normals
from palpate.observation.observed_surface import observed_surface
from palpate.report.report_data import ModelSurface, TriangleSurface
from palpate.statement.result import CaseResult

MOST_TRIANGLES = 40_000  # of one surface
ROOM_MM = 10.0  # around a surface, so that what lies beyond its distance map changes nothing there
TRIANGLES_A_VOXEL = 2.5  # of marching cubes, for each voxel on the surface


def outer_first(surfaces: Iterable[TriangleSurface]) -> tuple[TriangleSurface, ...]:
    """The surfaces that have triangles, the widest first: of walls that meet, the inner organ's is drawn last."""
    drawn = [surface for surface in surfaces if len(surface.triangles)]
    return tuple(sorted(drawn, key=lambda of: -float(np.linalg.norm(np.ptp(of.points, axis=0)))))


def image_surface(
    image: Segmentation, tissue: int, *, smoothing_mm: float, most_triangles: int = MOST_TRIANGLES
) -> TriangleSurface:
    """The surface of a tissue (index), where its voxels blurred by a Gaussian of `smoothing_mm` make up one half.

    Open where the image cuts the tissue; empty where it has no voxel; coarser when it had over `most_triangles`.
    """
    mask, empty = image.mask(tissue), TriangleSurface(tissue, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    if not mask.any():
        return empty
    window = window_around(mask, image.grid, reach_mm=4.0 * smoothing_mm + float(image.grid.spacing.max()))
    inside, grid = mask[window], cropped(image.grid, window)
    skin = np.count_nonzero(inside & ~ndimage.binary_erosion(inside))
    step = int(np.ceil(np.sqrt(TRIANGLES_A_VOXEL * skin / most_triangles)))
    sigma = np.maximum(smoothing_mm / grid.spacing, 0.6 * step if step > 1 else 0.0)
    share = ndimage.gaussian_filter(inside.astype(np.float32), sigma, mode="nearest")[::step, ::step, ::step]
    flat = share.astype(np.float64).ravel(order="F")
    if min(share.shape) < 2 or not flat.min() < 0.5 < flat.max():
        return empty
    places = np.ascontiguousarray(np.indices(share.shape, dtype=np.float64).reshape(3, -1, order="F").T)
    points, triangles, _ = igl.marching_cubes(flat, places, *share.shape, 0.5)
    corners = grid.world(np.asarray(points) * step).astype(np.float32)
    return TriangleSurface(tissue, corners, np.asarray(triangles, dtype=np.int32))


def model_surface(result: CaseResult, tissue: int, after: int) -> ModelSurface:
    """The model's surface of a tissue (index), fitted to later image number `after`.

    Distances as in the fit: d_after(X + u) - d_before(X). Raises `GeometryError` when too little of it is observed.
    """
    surface = observed_surface(result.space, tissue)
    width = observation_width(result.before.grid, *(image.grid for image in result.after))
    motion = result.estimation.displacements[after][surface.points]
    fitted = surface.rest + motion
    reach = float(np.linalg.norm(motion, axis=1).max()) + ROOM_MM
    images = (result.before, result.after[after])
    before, later = (tissue_distance_map(image, tissue, smoothing_mm=width, reach_mm=reach) for image in images)
    level = before.at(surface.rest)
    # around each point: a third of each of its observed triangles
    size = np.linalg.norm(triangle_normals(surface.rest, surface.triangles), axis=1) * surface.observed
    area = np.asarray(np.bincount(surface.triangles.ravel(), np.repeat(size / 3.0, 3), minlength=len(surface.rest)))
    hidden = np.where(area > 0.0, 0.0, np.nan)
    return ModelSurface(
        tissue=tissue,
        rest=surface.rest.astype(np.float32),
        fitted=fitted.astype(np.float32),
        triangles=surface.triangles.astype(np.int32),
        distance_rest=(later.at(surface.rest) - level + hidden).astype(np.float32),
        distance_fitted=(later.at(fitted) - level + hidden).astype(np.float32),
        area=area.astype(np.float32),
    )


def carried_outline(result: CaseResult, outline: TriangleSurface, after: int) -> TriangleSurface:
    """A surface of the earlier image as the motion fitted to later image number `after` carries it.

    Each point moves as the nearest one of its tissue's surface in the mesh, whose own edges where organs touch are as
    coarse as its tetrahedra; so the outline keeps the image's shape, and lies on the later one's where the fit is good.
    """
    space, points = result.space, outline.points.astype(np.float64)
    faces = np.ascontiguousarray(tissue_surface(space.mesh, outline.tissue).triangles, dtype=np.int64)
    _, nearest, places = igl.point_mesh_squared_distance(points, space.mesh.nodes, faces)
    corners = faces[nearest]
    weights = igl.barycentric_coordinates(places, *(np.ascontiguousarray(space.mesh.nodes[c]) for c in corners.T))
    motion = space.interpolation(corners, weights) @ result.estimation.displacements[after]
    return replace(outline, points=(points + motion).astype(np.float32))
