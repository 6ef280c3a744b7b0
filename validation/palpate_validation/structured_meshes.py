"""Small structured meshes of known shape: boxes, eighths of balls, quarters of tubes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from palpate.images import Role, Tissue
from palpate.mesh import OUTER, TetMesh, boundary_of

__all__ = [
    "VOID",
    "box_mesh",
    "known",
    "kuhn_tets",
    "make_mesh",
    "octant_mesh",
    "oriented",
    "quarter_ring_mesh",
    "unknown",
]

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

VOID = Tissue("void", Role.VOID)


def kuhn_tets(n: tuple[int, int, int]) -> tuple[Array, Integers]:
    """Grid places (n_nodes, 3) in steps and tetrahedra (n_tets, 4), 6 a cell, of a box of n cells."""
    grid = np.stack(np.meshgrid(*[np.arange(k + 1) for k in n], indexing="ij"), axis=-1)
    number = np.arange(grid[..., 0].size).reshape(grid.shape[:3])
    tets = []
    for order in permutations(range(3)):
        steps = np.cumsum(np.vstack([np.zeros(3, int), np.eye(3, dtype=int)[list(order)]]), axis=0)
        corners = [number[s[0] : s[0] + n[0], s[1] : s[1] + n[1], s[2] : s[2] + n[2]].ravel() for s in steps]
        tets.append(np.stack(corners, axis=1))
    return grid.reshape(-1, 3).astype(float), np.concatenate(tets)


def oriented(nodes: Array, tets: Integers) -> Integers:
    """Tetrahedra (n_tets, 4) on nodes (n_nodes, 3) mm, all turned to positive volume."""
    corner = nodes[tets]
    flip = np.linalg.det(corner[:, 1:] - corner[:, :1]) < 0
    result = tets.copy()
    result[flip] = result[flip][:, [1, 0, 2, 3]]
    return result


def make_mesh(
    nodes: Array,
    tets: Integers,
    region: Integers,
    tissues: Sequence[Tissue],
    beyond: Callable[[Array], Integers] | None = None,
) -> TetMesh:
    """A mesh of nodes (n_nodes, 3) mm and tets (n_tets, 4) with tissues region (n_tets,).

    beyond(centroids (n, 3)) gives the neighbour of each outer face, OUTER by default.
    """
    tets = oriented(nodes, tets)
    boundary = boundary_of(tets)
    behind = np.full(len(boundary), OUTER) if beyond is None else beyond(nodes[boundary].mean(axis=1))
    return TetMesh(nodes, tets, region, boundary, behind, tuple(tissues))


def known(name: str, modulus: float = 1.0, nu: float = 0.3) -> Tissue:
    """A tissue of known Young's modulus (kPa) and Poisson's ratio nu."""
    return Tissue(name, Role.KNOWN, poisson_ratio=nu, youngs_modulus_kpa=modulus)


def unknown(name: str, nu: float = 0.3) -> Tissue:
    """A tissue whose modulus is to be estimated, with Poisson's ratio nu."""
    return Tissue(name, Role.ESTIMATE, poisson_ratio=nu)


def box_mesh(
    n: int | tuple[int, int, int] = 3,
    *,
    size: float = 1.0,
    tissues: Sequence[Tissue] | None = None,
    region: Callable[[Array], Integers] | None = None,
    distortion: float = 0.0,
    beyond: Callable[[Array], Integers] | None = None,
) -> TetMesh:
    """Box of edge `size` mm, n cells a side; region(centroids (n, 3)) -> tissue; inner nodes moved by `distortion`."""
    n = (n, n, n) if isinstance(n, int) else n
    places, tets = kuhn_tets(n)
    inner = np.all((places > 0) & (places < np.array(n)), axis=1)
    nodes = places / np.array(n)
    nodes[inner] += distortion / np.array(n) * np.random.default_rng(1).uniform(-1, 1, (int(inner.sum()), 3))
    nodes *= size
    number = np.zeros(len(tets), int) if region is None else region(nodes[tets].mean(axis=1))
    return make_mesh(nodes, tets, number, tissues or [known("block")], beyond)


def octant_mesh(
    radii: Array, n_radial: Sequence[int], n_surface: int, tissues: Sequence[Tissue], *, solid: bool = False
) -> TetMesh:
    """Layers of an eighth of a ball between `radii` (n_radii,) mm, > 0; its flat sides are OUTER.

    n_radial: cells across each layer; n_surface: along each edge of the spherical triangle, a regular grid of
    barycentric places lifted to the sphere. The spheres' facets enclose the volume of the true spheres: their corners
    lie a little outside of them. The spherical sides face the last tissue, `VOID`. solid: a centre joins the innermost
    triangles, in region 0.
    """
    directions, triangles = _spherical_triangle(n_surface)
    levels = np.concatenate(
        [np.linspace(a, b, m + 1)[:-1] for a, b, m in zip(radii[:-1], radii[1:], n_radial, strict=True)] + [radii[-1:]]
    )
    nodes = (levels[:, None, None] * directions).reshape(-1, 3)
    layer_of = np.repeat(np.arange(len(n_radial)), n_radial)
    prisms = []  # between two levels, three tetrahedra each
    for level in range(len(layer_of)):
        a, b, c = (triangles + level * len(directions)).T
        d, e, f = (triangles + (level + 1) * len(directions)).T
        prisms += [np.stack(corners, axis=1) for corners in ((a, b, c, f), (a, b, e, f), (a, d, e, f))]
    tets, region = np.concatenate(prisms), np.repeat(layer_of, 3 * len(triangles))
    if solid:
        tets = np.vstack([tets, np.column_stack([np.full(len(triangles), len(nodes)), triangles])])
        region = np.concatenate([region, np.zeros(len(triangles), int)])
        nodes = np.vstack([nodes, np.zeros(3)])
    nodes[np.abs(nodes) < 1e-12] = 0.0

    def beyond(faces: Array) -> Integers:
        """What is behind faces with centroids (n, 3) mm: OUTER (n,) on the flat sides, `VOID` on the round ones."""
        return np.where(np.any(np.abs(faces) < 1e-9, axis=1), OUTER, len(tissues))

    return make_mesh(nodes, tets, region, [*tissues, VOID], beyond)


def _spherical_triangle(n: int) -> tuple[Array, Integers]:
    """Directions (n_places, 3), a little longer than 1, and triangles (n_triangles, 3) with sorted corners."""
    places = [(i, j) for i in range(n + 1) for j in range(n + 1 - i)]
    index = {p: k for k, p in enumerate(places)}
    flat = np.array([[i, j, n - i - j] for i, j in places]) / n
    lifted = np.sin(0.5 * np.pi * flat)  # equal angles along the edges: better elements than central projection
    directions = lifted / np.linalg.norm(lifted, axis=1, keepdims=True)
    up = [(index[i, j], index[i + 1, j], index[i, j + 1]) for i, j in places if i + j < n]
    down = [(index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]) for i, j in places if i + j < n - 1]
    triangles = np.sort(np.array(up + down), axis=1)
    volume = np.abs(np.linalg.det(directions[triangles])).sum() / 6.0
    return directions * (np.pi / 6.0 / volume) ** (1 / 3), triangles


def quarter_ring_mesh(inner: float, outer: float, n_radial: int, n_turn: int, tissue: Tissue) -> TetMesh:
    """A slice of a quarter of a tube, radii in mm, its flat sides OUTER, its round sides facing `VOID`."""
    places, tets = kuhn_tets((n_radial, n_turn, 1))
    radius = inner + (outer - inner) * places[:, 0] / n_radial
    angle = 0.5 * np.pi * places[:, 1] / n_turn
    thick = (outer - inner) / n_radial
    nodes = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), thick * places[:, 2]])
    nodes[np.abs(nodes) < 1e-12] = 0.0

    def beyond(faces: Array) -> Integers:
        """What is behind faces with centroids (n, 3) mm: OUTER (n,) on the flat sides, `VOID` on the round ones."""
        flat = np.any(np.abs(faces) < 1e-9, axis=1) | (np.abs(faces[:, 2] - thick) < 1e-9)
        return np.where(flat, OUTER, 1)

    return make_mesh(nodes, tets, np.zeros(len(tets), int), [tissue, VOID], beyond)
