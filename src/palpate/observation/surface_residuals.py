"""Signed distances between a deformed surface and an image, as differences to the rest state, with derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import igl
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.mesh.anatomy import values_and_gradients
from palpate.mesh.surface import mean_curvature, triangle_normals, vertex_normals
from palpate.observation.contract import Residuals
from palpate.observation.observed_surface import ObservedSurface
from palpate.observation.target import SurfaceTarget, places_within

T = TypeVar("T", bound=np.generic)
ON_EDGE = 1e-9


@dataclass(frozen=True, slots=True)
class Correspondence:
    """What is held while one objective is minimised: of the image points n_i, and of the surface's vertices.

    kept (n_i,): the image points in use; terraces (n_i,) mm^4: the voxels' on the model's surface there; excess
    (n_vertices,) mm: the residual of a perfect fit, which the maps' smoothing and the surface's plane pieces leave;
    shown (n_q,): the quadrature points of the model's surface in use, None: all of them.
    """

    kept: NDArray[np.bool_]
    terraces: NDArray[np.float64]
    excess: NDArray[np.float64]
    shown: NDArray[np.bool_] | None = None

    def of_model(self, values: NDArray[T]) -> NDArray[T]:
        """The rows of `values` (n_q, ...) that belong to the quadrature points in use."""
        return values if self.shown is None else np.asarray(values[self.shown])


@dataclass(frozen=True, slots=True)
class _Closest:
    """Closest points of the deformed surface to the image's: triangle (n,), barycentric (n, 3), places (n, 3) mm."""

    triangle: NDArray[np.int64]
    barycentric: NDArray[np.float64]
    places: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _Direction:
    """Residuals (n,) of one direction of the distance, as `Residuals` has them.

    corners (n, 3): vertices of the triangle of each; by_corners (n, 3 corners, 3 axes): derivatives by their motion.
    """

    values: NDArray[np.float64]
    weights: NDArray[np.float64]
    places: NDArray[np.float64]
    normals: NDArray[np.float64]
    material: NDArray[np.float64]
    corners: NDArray[np.int64]
    by_corners: NDArray[np.float64]


def surface_residuals(target: SurfaceTarget, displacement: NDArray[np.float64], held: Correspondence) -> Residuals:
    """Residuals and their derivative at a displacement (n_vertices, 3) mm of the surface's points.

    model -> image first, then image -> model (see `SurfaceDistance`), each with half of the weight, shared out by area.
    The derivative is that of smooth surfaces, along the model's normal; what the image's voxels add to it, along the
    surface and by the closest points that slide, is noise.
    """
    vertices = target.surface.rest + displacement
    normals = vertex_normals(vertices, target.surface.triangles)
    both = (_model_to_image(target, vertices, normals, held), _image_to_model(target, vertices, normals, held))
    corners = np.concatenate([d.corners for d in both])
    columns = (3 * corners[:, :, None] + np.arange(3)).ravel()
    starts, shape = 9 * np.arange(len(corners) + 1), (len(corners), 3 * len(vertices))
    by_corners = np.concatenate([d.by_corners for d in both])
    return Residuals(
        np.concatenate([d.values for d in both]),
        np.concatenate([d.weights for d in both]),
        np.concatenate([d.places for d in both]),
        np.concatenate([d.normals for d in both]),
        np.concatenate([d.material for d in both]),
        sparse.csr_matrix((by_corners.ravel(), columns, starts), shape=shape),
    )


def correspondence(target: SurfaceTarget, displacement: NDArray[np.float64]) -> Correspondence:
    """Of a displacement (n_vertices, 3) mm: which points of either surface are compared; the excess."""
    surface, vertices = target.surface, target.surface.rest + displacement
    closest = _closest(surface, vertices, target.image_points)
    at_rim = np.any((closest.barycentric < ON_EDGE) & surface.rim[closest.triangle], axis=1)
    corners = surface.triangles[closest.triangle]
    normals = _within(vertex_normals(vertices, surface.triangles), corners, closest.barycentric)
    kept = surface.observed[closest.triangle] & ~at_rim
    if target.voxels is None:  # exact maps: nothing is smoothed, and they are made of plane pieces themselves
        excess = np.zeros(len(surface.rest))
    else:
        widths = tuple(distance.smoothing_mm for distance in target.voxels)
        excess = _shrinkage(surface, displacement, widths) - _bulge(surface, displacement)
    shown = None if target.view is None else target.shown(displacement)
    return Correspondence(kept, target.terraces_along(normals), excess, shown)


def _shrinkage(
    surface: ObservedSurface, displacement: NDArray[np.float64], widths: tuple[float, ...]
) -> NDArray[np.float64]:
    """How much further smoothing draws in the deformed surface than the one at rest, (n_vertices,) mm.

    A Gaussian of width sigma moves the half level of an indicator by sigma^2 H towards the inside, H the surface's mean
    curvature (its heat flow for a time sigma^2 / 2; Merriman, Bence & Osher 1994): sigma_after^2 H(x) - sigma_before^2
    H(X). None beside parts that are not observed, where the image's cut makes edges, nor where the surface is open.
    """
    before, after = (
        width**2 * mean_curvature(vertices, surface.triangles)
        for width, vertices in zip(widths, (surface.rest, surface.rest + displacement), strict=True)
    )
    shrinkage = after - before
    shrinkage[np.unique(surface.triangles[~surface.observed])] = 0.0
    shrinkage[np.array(igl.is_border_vertex(np.ascontiguousarray(surface.triangles)))] = 0.0
    return np.asarray(shrinkage)


def _bulge(surface: ObservedSurface, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far quadratic faces bulge beyond their four plane triangles, (n_vertices,) mm, shared out by area.

    On a triangle with the edges e a quadratic map differs from its linear interpolant by -1/2 sum_e b_i b_j D_e, D_e
    its second derivative along e, in the mean by -1/24 sum_e D_e; D_01 = x_0 - 2 x_3 + x_1 for each of the four.
    """
    vertices = surface.rest + displacement
    nodes = vertices[surface.faces]  # (n_faces, 6, 3)
    bend = (2.0 * nodes[:, :3] - 2.0 * nodes[:, 3:]).sum(axis=1) / 24.0
    triangles = surface.triangles
    vectors = triangle_normals(vertices, triangles)
    areas = np.linalg.norm(vectors, axis=1)
    beyond = -np.einsum("ta,ta->t", np.repeat(bend, 4, axis=0), vectors[: 4 * len(bend)])  # mm^3
    volumes = np.bincount(triangles[: 4 * len(bend)].ravel(), np.repeat(beyond, 3), len(vertices))
    return np.asarray(volumes / np.bincount(triangles.ravel(), np.repeat(areas, 3), len(vertices)))


def _model_to_image(
    target: SurfaceTarget, vertices: NDArray[np.float64], normals: NDArray[np.float64], held: Correspondence
) -> _Direction:
    """Of the deformed vertices (n_vertices, 3) mm with unit normals (n_vertices, 3)."""
    barycentric, area = held.of_model(target.barycentric), held.of_model(target.area)
    corners = target.surface.triangles[held.of_model(target.triangle)]
    material, places = (places_within(of[corners], barycentric) for of in (target.surface.rest, vertices))
    distance, gradient = values_and_gradients(target.after, places)
    excess = np.einsum("qk,qk->q", barycentric, held.excess[corners])
    normal = _within(normals, corners, barycentric)
    slope = np.einsum("qa,qa->q", gradient, normal)
    by_corners = barycentric[:, :, None] * (slope[:, None] * normal)[:, None]
    values = distance - held.of_model(target.rest_distance) - excess
    weights = 0.5 * area / max(float(area.sum()), 1e-30)
    return _Direction(values, weights, places, normal, material, corners, by_corners)


def _image_to_model(
    target: SurfaceTarget, vertices: NDArray[np.float64], normals: NDArray[np.float64], held: Correspondence
) -> _Direction:
    """Of the deformed vertices (n_vertices, 3) mm with unit normals (n_vertices, 3)."""
    surface, kept = target.surface, held.kept
    image = target.image_points[kept]
    closest = _closest(surface, vertices, image)
    corners = surface.triangles[closest.triangle]
    offset = closest.places - image
    plane = triangle_normals(vertices, surface.triangles)
    plane = (plane / np.maximum(_length(plane), 1e-30)[:, None])[closest.triangle]
    length = _length(offset)
    side = np.where(np.einsum("na,na->n", offset, plane) < 0.0, -1.0, 1.0)
    material = places_within(surface.rest[corners], closest.barycentric)
    excess = np.einsum("nk,nk->n", closest.barycentric, held.excess[corners])
    normal = _within(normals, corners, closest.barycentric)
    by_corners = closest.barycentric[:, :, None] * normal[:, None]
    weights = 0.5 * target.image_area[kept] / max(target.image_area[kept].sum(), 1e-30)
    values = side * length - (target.before.at(material) - target.level) - excess
    return _Direction(values, weights, closest.places, normal, material, corners, by_corners)


def _within(
    normals: NDArray[np.float64], corners: NDArray[np.int64], barycentric: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Unit normals (n, 3) interpolated from those (n_vertices, 3) at the corners (n, 3) of the places' triangles."""
    within = np.einsum("nk,nka->na", barycentric, normals[corners])
    return np.asarray(within / np.maximum(_length(within), 1e-30)[:, None])


def _length(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths (n,) of vectors (n, 3)."""
    return np.asarray(np.sqrt(np.einsum("na,na->n", vectors, vectors)))


def _closest(surface: ObservedSurface, vertices: NDArray[np.float64], image: NDArray[np.float64]) -> _Closest:
    triangles = np.ascontiguousarray(surface.triangles)
    _, triangle, places = igl.point_mesh_squared_distance(np.ascontiguousarray(image), vertices, triangles)[:3]
    corner = vertices[triangles[triangle]]
    barycentric = igl.barycentric_coordinates(
        np.ascontiguousarray(places),
        np.ascontiguousarray(corner[:, 0]),
        np.ascontiguousarray(corner[:, 1]),
        np.ascontiguousarray(corner[:, 2]),
    )
    barycentric = np.clip(barycentric, 0.0, 1.0)
    barycentric[barycentric < ON_EDGE] = 0.0
    barycentric /= barycentric.sum(axis=1, keepdims=True)
    return _Closest(np.asarray(triangle, dtype=np.int64), barycentric, np.asarray(places))
