"""Signed distances between a deformed surface and an image, as differences to the rest state, with derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.mesh.surface import mean_curvature, triangle_normals, vertex_normals
from palpate.observation.contract import Residuals
from palpate.observation.observed_surface import ObservedSurface
from palpate.observation.target import SurfaceTarget, places_within, values_and_gradients

__all__ = ["Correspondence", "correspondence", "surface_residuals"]

ON_EDGE = 1e-9


@dataclass(frozen=True, slots=True)
class Correspondence:
    """What is held while one objective is minimised: of the image points n_i, and of the surface's vertices.

    kept (n_i,): the image points in use; terraces (n_i,) mm^4: the voxels' on the model's surface there; excess
    (n_vertices,) mm: the residual of a perfect fit, which the maps' smoothing and the surface's plane pieces leave.
    """

    kept: NDArray[np.bool_]
    terraces: NDArray[np.float64]
    excess: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _Closest:
    """Closest points of the deformed surface to the image's: triangle (n,), barycentric (n, 3), places (n, 3) mm."""

    triangle: NDArray[np.int64]
    barycentric: NDArray[np.float64]
    places: NDArray[np.float64]


def surface_residuals(target: SurfaceTarget, displacement: NDArray[np.float64], held: Correspondence) -> Residuals:
    """Residuals and their exact derivative at a displacement (n_vertices, 3) mm of the surface's points.

    model -> image first, then image -> model (see `SurfaceDistance`), each with half of the weight, shared out by area.
    """
    forward = _model_to_image(target, displacement, held)
    backward = _image_to_model(target, displacement, held)
    return Residuals(
        np.concatenate([forward.values, backward.values]),
        np.concatenate([forward.weights, backward.weights]),
        np.concatenate([forward.places, backward.places]),
        np.concatenate([forward.normals, backward.normals]),
        np.concatenate([forward.material, backward.material]),
        sparse.vstack([forward.jacobian, backward.jacobian], format="csr"),
        sparse.vstack([forward.smooth_jacobian, backward.smooth_jacobian], format="csr"),
    )


def correspondence(target: SurfaceTarget, displacement: NDArray[np.float64]) -> Correspondence:
    """Of a displacement (n_vertices, 3) mm: the image points that face the observed part, not its rim; the excess."""
    closest = _closest(target, displacement, target.image_points)
    surface = target.surface
    at_rim = np.any((closest.barycentric < ON_EDGE) & surface.rim[closest.triangle], axis=1)
    corners = surface.triangles[closest.triangle]
    normals = _smooth_normals(surface.rest + displacement, surface.triangles, corners, closest.barycentric)
    kept = surface.observed[closest.triangle] & ~at_rim
    if target.voxels is None:  # exact maps: nothing is smoothed, and they are made of plane pieces themselves
        excess = np.zeros(len(surface.rest))
    else:
        widths = tuple(distance.smoothing_mm for distance in target.voxels)
        excess = _shrinkage(surface, displacement, widths) - _bulge(surface, displacement)
    return Correspondence(kept, target.terraces_along(normals), excess)


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


def _model_to_image(target: SurfaceTarget, displacement: NDArray[np.float64], held: Correspondence) -> Residuals:
    surface = target.surface
    corners = surface.triangles[target.triangle]
    material, places = (
        places_within(vertices[corners], target.barycentric) for vertices in (surface.rest, surface.rest + displacement)
    )
    distance, gradient = values_and_gradients(target.after, places)
    excess = np.einsum("qk,qk->q", target.barycentric, held.excess[corners])
    values = distance - target.rest_distance - excess
    rows = target.barycentric[:, :, None] * gradient[:, None]
    normals = _smooth_normals(surface.rest + displacement, surface.triangles, corners, target.barycentric)
    slope = np.einsum("qa,qa->q", gradient, normals)
    smooth = target.barycentric[:, :, None] * (slope[:, None] * normals)[:, None]
    weights = 0.5 * target.area / target.area.sum()
    n = len(surface.rest)
    exact, normal = _sparse_rows(rows, corners, n), _sparse_rows(smooth, corners, n)
    return Residuals(values, weights, places, normals, material, exact, normal)


def _image_to_model(target: SurfaceTarget, displacement: NDArray[np.float64], held: Correspondence) -> Residuals:
    surface, kept = target.surface, held.kept
    image = target.image_points[kept]
    closest = _closest(target, displacement, image)
    corners = surface.triangles[closest.triangle]
    deformed = (surface.rest + displacement)[corners]
    offset = closest.places - image
    normal = np.cross(deformed[:, 1] - deformed[:, 0], deformed[:, 2] - deformed[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    length = np.linalg.norm(offset, axis=1)
    side = np.where(np.einsum("na,na->n", offset, normal) < 0.0, -1.0, 1.0)
    direction = np.where(length[:, None] > 1e-9, side[:, None] * offset / np.maximum(length, 1e-30)[:, None], normal)
    rest = surface.rest[corners]
    material = (closest.barycentric[:, None] @ rest)[:, 0]
    at_vertices = held.excess[corners]
    excess = np.einsum("nk,nk->n", closest.barycentric, at_vertices)
    at_rest, gradient = values_and_gradients(target.before, material)
    values = side * length - (at_rest - target.level) - excess
    rows = closest.barycentric[:, :, None] * direction[:, None]
    at_corners = (rest @ gradient[:, :, None])[:, :, 0] + at_vertices
    rows += _slide(closest, deformed, offset, at_corners)
    normals = _smooth_normals(surface.rest + displacement, surface.triangles, corners, closest.barycentric)
    smooth = closest.barycentric[:, :, None] * normals[:, None]
    weights = 0.5 * target.image_area[kept] / max(target.image_area[kept].sum(), 1e-30)
    n = len(surface.rest)
    exact, plane = _sparse_rows(rows, corners, n), _sparse_rows(smooth, corners, n)
    return Residuals(values, weights, closest.places, normals, material, exact, plane)


def _smooth_normals(
    vertices: NDArray[np.float64],
    triangles: NDArray[np.int64],
    corners: NDArray[np.int64],
    barycentric: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Unit normals (n, 3) interpolated from area-weighted ones at the corners (n, 3) of the places' triangles."""
    normals = (barycentric[:, None] @ vertex_normals(vertices, triangles)[corners])[:, 0]
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))


def _slide(
    closest: _Closest,
    deformed: NDArray[np.float64],
    offset: NDArray[np.float64],
    at_corners: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Derivative (n, 3 corners, 3 axes) of -d_before - b at the closest material point, which slides with the model.

    at_corners (n, 3): d_before + b to first order at its triangle's corners, up to a constant, mm. With tangents t_i,
    Gram matrix G_ij = t_i . t_j and the closest-point condition (x - y) . t_i = 0:
    G_ij d xi_j = -(t_i . sum_a N_a du_a + (x - y) . d t_i), on an edge with its one tangent, at a corner not at all.
    """
    # directions (n, 2, 3) in barycentric coordinates along which the point may slide; zero where none
    zero = closest.barycentric < ON_EDGE
    count = zero.sum(axis=1)
    along = np.zeros((len(zero), 2, 3))
    along[count == 0] = [[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]]
    for corner in range(3):
        first, second = [c for c in range(3) if c != corner]
        on_edge = (count == 1) & zero[:, corner]
        along[on_edge, 0, first], along[on_edge, 0, second] = -1.0, 1.0
    tangent = along @ deformed  # (n, 2, 3 corners) x (n, 3 corners, 3 axes) -> (n, 2, 3 axes)
    gram = tangent @ tangent.transpose(0, 2, 1)
    still = ~np.any(along != 0.0, axis=2)
    gram[:, [0, 1], [0, 1]] += still
    change = along @ at_corners[:, :, None]
    rate = np.linalg.solve(gram, change).transpose(0, 2, 1)  # (n, 1, 2)
    rows = closest.barycentric[:, :, None] * (rate @ tangent)
    return np.asarray(rows + (rate @ along).transpose(0, 2, 1) * offset[:, None])


def _closest(target: SurfaceTarget, displacement: NDArray[np.float64], image: NDArray[np.float64]) -> _Closest:
    vertices = np.ascontiguousarray(target.surface.rest + displacement)
    triangles = np.ascontiguousarray(target.surface.triangles)
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


def _sparse_rows(
    rows: NDArray[np.float64], corners: NDArray[np.int64], n_vertices: int
) -> sparse.csr_matrix[np.float64]:
    """Rows (n, 3 corners, 3 axes) as a sparse matrix (n, 3 n_vertices)."""
    columns = (3 * corners[:, :, None] + np.arange(3)).reshape(len(rows), 9)
    start = 9 * np.arange(len(rows) + 1)
    shape = (len(rows), 3 * n_vertices)
    return sparse.csr_matrix((rows.reshape(-1), columns.ravel(), start), shape=shape)
