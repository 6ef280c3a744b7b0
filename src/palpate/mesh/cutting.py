"""Splitting tetrahedra: graded grids by bisection, and cuts along a level set that keep neighbours conforming."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.mesh.anatomy import Box, LevelSet
from palpate.mesh.space import TET_EDGES
from palpate.mesh.tet_mesh import FACES

MAX_ROUNDS = 60
CUBE_PATHS = np.array([[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]])


@dataclass(frozen=True, slots=True)
class Grid:
    """Tetrahedra under construction: nodes (n_nodes, 3) mm, tets (n_tets, 4), region (n_tets,) tissue indices."""

    nodes: NDArray[np.float64]
    tets: NDArray[np.int64]
    region: NDArray[np.int64]


def graded_grid(
    box: Box, size: Callable[[NDArray[np.float64]], NDArray[np.float64]], *, coarsest_mm: float, region: int
) -> Grid:
    """Tetrahedra of a box whose longest edges are at most `size` (points (n, 3) mm -> (n,) mm) at their centres.

    Kuhn's six tetrahedra of each cell of a lattice of about `coarsest_mm`, bisected at their longest edges
    (Rivara 1984), which keeps all angles above 30 degrees. All tetrahedra get `region`.
    """
    counts = np.maximum(np.round(box.lengths / coarsest_mm).astype(int), 1)
    steps = [np.linspace(0.0, length, n + 1) for length, n in zip(box.lengths, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    strides = np.array([(counts[1] + 1) * (counts[2] + 1), counts[2] + 1, 1])
    cells = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3) @ strides
    walks = np.concatenate([np.zeros((6, 1), dtype=int), np.cumsum(strides[CUBE_PATHS], axis=1)], axis=1)
    tets = (cells[:, None, None] + walks).reshape(-1, 4)
    flip = signed_volumes(box.world(nodes), tets) < 0.0
    tets[flip, :2] = tets[flip, 1::-1]
    grid = Grid(box.world(nodes), tets, np.full(len(tets), region))
    for _ in range(MAX_ROUNDS):
        too_large = edge_lengths(grid).max(axis=1) > size(grid.nodes[grid.tets].mean(axis=1))
        if not too_large.any():
            break
        pairs = np.sort(grid.tets[:, TET_EDGES], axis=2)
        keys, number = np.unique(pairs[..., 0] * len(grid.nodes) + pairs[..., 1], return_inverse=True)
        number = number.reshape(-1, 6)
        longest = np.take_along_axis(number, edge_lengths(grid).argmax(axis=1)[:, None], axis=1)[:, 0]
        marked, reached = np.zeros(len(keys), dtype=bool), longest[too_large]
        while not marked[reached].all():  # and others, where that keeps the grid conforming and good
            marked[reached] = True
            reached = longest[marked[number].any(axis=1)]
        grid, _ = _divide(grid, marked[number], lambda nodes, ends: nodes[ends].mean(axis=1))
    return grid


def edge_lengths(grid: Grid) -> NDArray[np.float64]:
    """Lengths (n_tets, 6) mm of the edges of each tetrahedron, in the order of TET_EDGES."""
    ends = grid.nodes[grid.tets[:, TET_EDGES]]
    return np.asarray(np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2))


def cut(
    grid: Grid, phi: LevelSet, *, inside: int, splittable: NDArray[np.bool_], touch_mm: NDArray[np.float64], box: Box
) -> Grid:
    """Give the part of the `splittable` (n_tets,) tetrahedra where `phi` is negative to the region `inside`.

    Nodes within `touch_mm` (n_nodes,) mm of the surface are moved onto it along its gradient, or if they lie on an
    earlier surface count as lying on both; edges that cross it are divided where phi, along them, is zero.
    """
    active = np.unique(grid.tets[splittable])
    values = np.zeros(len(grid.nodes))
    values[active] = phi.at(grid.nodes[active])
    touching = np.flatnonzero(np.abs(values) < touch_mm)
    values[touching] = 0.0
    low, high = np.full(len(grid.nodes), np.iinfo(np.int64).max), np.full(len(grid.nodes), -1)
    np.minimum.at(low, grid.tets, grid.region[:, None])
    np.maximum.at(high, grid.tets, grid.region[:, None])
    free = np.setdiff1d(np.intersect1d(touching, active), np.flatnonzero(high > low))  # of no earlier surface
    nodes = grid.nodes.copy()
    for _ in range(2):
        slope = within_faces(phi.gradient_at(nodes[free]), nodes[free], box)
        step = -phi.at(nodes[free]) / np.maximum((slope**2).sum(axis=1), 0.25)
        nodes[free] += step[:, None] * slope
    before = signed_volumes(grid.nodes, grid.tets)
    for _ in range(MAX_ROUNDS):
        bad = signed_volumes(nodes, grid.tets) < 0.2 * before
        if not bad.any():
            break
        nodes[grid.tets[bad]] = grid.nodes[grid.tets[bad]]
    ends = grid.tets[:, TET_EDGES]
    crossed = np.prod(np.sign(values[ends]), axis=2) < 0
    moved = Grid(nodes, grid.tets, grid.region)
    divided, parent = _divide(moved, crossed, lambda nodes, ends: _roots(nodes[ends], values[ends], phi))
    values = np.concatenate([values, np.zeros(len(divided.nodes) - len(values))])
    total = values[divided.tets].sum(axis=1)
    flat = np.flatnonzero((total == 0.0) & splittable[parent])
    total[flat] = phi.at(divided.nodes[divided.tets[flat]].mean(axis=1))
    region = np.where(splittable[parent] & (total < 0.0), inside, divided.region)
    return Grid(divided.nodes, divided.tets, region)


def within_faces(vectors: NDArray[np.float64], points: NDArray[np.float64], box: Box) -> NDArray[np.float64]:
    """Vectors (n, 3) at points (n, 3) mm, less their part normal to the faces of the box that a point lies on."""
    on_face = box.faces_at(points)
    on_face = on_face[:, :3] | on_face[:, 3:]
    return np.asarray(np.where(on_face, 0.0, vectors @ box.axes.T) @ box.axes)


def signed_volumes(nodes: NDArray[np.float64], tets: NDArray[np.int64]) -> NDArray[np.float64]:
    """Volumes (n_tets,) mm^3 of tets (n_tets, 4), negative when inverted; nodes (n_nodes, 3) mm."""
    corner = nodes[tets]
    a, b, c = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 0]
    return np.asarray(np.einsum("ni,ni->n", np.cross(a, b), c) / 6.0)


def face_pieces(tets: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Number (n_tets,) of the piece, joined through faces, of tets (n_tets, 4); of each face (n,) how many have it."""
    faces = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    _, number, count = np.unique(faces, axis=0, return_inverse=True, return_counts=True)
    owner = np.repeat(np.arange(len(tets)), 4)
    by_face = sparse.csr_matrix((np.ones(len(owner)), (owner, number.ravel())))
    piece = sparse.csgraph.connected_components(by_face @ by_face.T, directed=False)[1]
    return np.asarray(piece, dtype=np.int64), np.asarray(count, dtype=np.int64)


def _divide(
    grid: Grid,
    marked: NDArray[np.bool_],
    place: Callable[[NDArray[np.float64], NDArray[np.int64]], NDArray[np.float64]],
) -> tuple[Grid, NDArray[np.int64]]:
    """Divide every marked edge (n_tets, 6) at `place` (nodes and ends (n, 2) -> (n, 3) mm); the parent of each child.

    In each tetrahedron the longest marked edge goes first. That order is the same on both sides of a face, so the
    result conforms.
    """
    if not marked.any():
        return grid, np.arange(len(grid.tets))
    n = len(grid.nodes)
    pairs = np.sort(grid.tets[:, TET_EDGES][marked], axis=1)
    length = np.linalg.norm(grid.nodes[pairs[:, 0]] - grid.nodes[pairs[:, 1]], axis=1)
    keys, first = np.unique(pairs[:, 0] * n + pairs[:, 1], return_index=True)
    rank = np.empty(len(keys), dtype=np.int64)
    rank[np.argsort(-np.round(length[first], 6), kind="stable")] = np.arange(len(keys))
    nodes = np.concatenate([grid.nodes, place(grid.nodes, np.stack([keys // n, keys % n], axis=1))])
    tets, parent = grid.tets, np.arange(len(grid.tets))
    done: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    while len(tets):
        pairs = np.sort(tets[:, TET_EDGES], axis=2)
        key = np.where(pairs[..., 1] < n, pairs[..., 0] * n + pairs[..., 1], -1)  # none of edges to nodes that are new
        place_of = np.clip(np.searchsorted(keys, key), 0, len(keys) - 1)
        order = np.where(keys[place_of] == key, rank[place_of], len(keys))
        whole = order.min(axis=1) == len(keys)
        done.append((tets[whole], parent[whole]))
        tets, parent, edge = tets[~whole], parent[~whole], order[~whole].argmin(axis=1)
        rows = np.arange(len(tets))
        middle = n + place_of[~whole][rows, edge]
        halves = []
        for end in range(2):
            half = tets.copy()
            half[rows, TET_EDGES[edge, end]] = middle
            halves.append(half)
        tets, parent = np.concatenate(halves), np.concatenate([parent, parent])
    parent = np.concatenate([p for _, p in done])
    return Grid(nodes, np.concatenate([t for t, _ in done]), grid.region[parent]), parent


def _roots(ends: NDArray[np.float64], values: NDArray[np.float64], phi: LevelSet) -> NDArray[np.float64]:
    """Points (n, 3) of the segments `ends` (n, 2, 3) where phi is zero, by regula falsi (Illinois)."""
    low, high = np.zeros(len(ends)), np.ones(len(ends))
    f_low, f_high = values[:, 0].copy(), values[:, 1].copy()
    at = f_low / (f_low - f_high)
    for _ in range(4):
        f = phi.at(ends[:, 0] + at[:, None] * (ends[:, 1] - ends[:, 0]))
        left = np.sign(f) == np.sign(f_low)
        low, f_low, f_high = np.where(left, at, low), np.where(left, f, f_low), np.where(left, 0.5 * f_high, f_high)
        high, f_high, f_low = (np.where(left, high, at), np.where(left, f_high, f), np.where(left, f_low, 0.5 * f_low))
        at = (low * f_high - high * f_low) / np.where(f_high == f_low, 1.0, f_high - f_low)
    at = np.clip(at, 0.05, 0.95)
    return np.asarray(ends[:, 0] + at[:, None] * (ends[:, 1] - ends[:, 0]))
