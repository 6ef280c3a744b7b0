"""Surface nodes put exactly where they belong: on their level sets, less the sag of the facets between them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.mesh.anatomy import Anatomy, Box, LevelSet, values_and_gradients
from palpate.mesh.cutting import Grid, signed_volumes, within_faces
from palpate.mesh.tet_mesh import FACES

GRAZING = 0.25  # two surfaces that meet at a smaller (relative) angle count as one where they meet
SHRINK_LIMIT = 0.25  # share of a tetrahedron's volume; a move that leaves less is shortened
MAX_HALVINGS = 6
# Strang and Fix: six points, exact to degree four, on the reference triangle
QUADRATURE = np.array([[0.108103018168070, 0.445948490915965, 0.445948490915965],
                       [0.816847572980459, 0.091576213509771, 0.091576213509771]])  # fmt: skip
QUADRATURE_WEIGHTS = np.repeat([0.223381589678011, 0.109951743655322], 3)


@dataclass(frozen=True, slots=True)
class Union:
    """Level set of several tissues taken together: the lowest of theirs."""

    parts: tuple[LevelSet, ...]

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values (n,) mm at points (n, 3) in RAS mm."""
        return np.asarray(np.min([part.at(points) for part in self.parts], axis=0))

    def gradient_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient (n, 3), mm per mm, of the lowest part at points (n, 3) in RAS mm."""
        return self.values_and_gradients(points)[1]

    def values_and_gradients(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values (n,) mm and the lowest part's gradients (n, 3), mm per mm, at points (n, 3) in RAS mm."""
        if len(self.parts) == 1:
            return values_and_gradients(self.parts[0], points)
        values = np.array([part.at(points) for part in self.parts])
        lowest, gradient = values.argmin(axis=0), np.zeros((len(points), 3))
        for i, part in enumerate(self.parts):
            mine = lowest == i
            gradient[mine] = part.gradient_at(points[mine])
        return values.min(axis=0), gradient


@dataclass(frozen=True, slots=True)
class Contacts:
    """Which surfaces the nodes of a grid lie on.

    level_sets: one a surface; faces (n_faces, 3) node numbers and surface (n_faces,) their surface;
    on (n_nodes, n_surfaces) whether a node is on a surface; target (n_nodes, n_surfaces) mm, the level set's value that
    the node is to have: zero, or what makes the facets around it unbiased.
    """

    level_sets: tuple[LevelSet, ...]
    faces: NDArray[np.int64]
    surface: NDArray[np.int64]
    on: NDArray[np.bool_]
    target: NDArray[np.float64]
    box: Box

    def released(self) -> Contacts:
        """The same box, but nodes are free to leave the surfaces."""
        return replace(self, on=np.zeros_like(self.on))

    def _values_and_gradients(
        self, points: NDArray[np.float64], nodes: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Level sets less targets (n, n_surfaces) mm at `points` (n, 3) mm of the `nodes` (n,), and their gradients.

        These (n, n_surfaces, 3) are along the box's faces where a node lies on one. All zero where it is not on it.
        """
        values = np.zeros((len(nodes), len(self.level_sets)))
        gradients = np.zeros((*values.shape, 3))
        for k, phi in enumerate(self.level_sets):
            rows = np.flatnonzero(self.on[nodes, k])
            if len(rows):
                value, gradient = values_and_gradients(phi, points[rows])
                values[rows, k] = value - self.target[nodes[rows], k]
                gradients[rows, k] = within_faces(gradient, points[rows], self.box)
        return values, gradients

    def onto(self, points: NDArray[np.float64], nodes: NDArray[np.int64], *, limit_mm: float) -> NDArray[np.float64]:
        """One Newton step (n, 3) mm, of least length, that brings `points` of the `nodes` onto their surfaces."""
        values, gradients = self._values_and_gradients(points, nodes)
        step = -np.einsum("nik,nk->ni", np.linalg.pinv(gradients, rcond=GRAZING), values)
        length = np.linalg.norm(step, axis=1, keepdims=True)
        return np.asarray(step * np.minimum(1.0, limit_mm / np.maximum(length, 1e-12)))


def contacts_of(grid: Grid, anatomy: Anatomy) -> Contacts:
    """The surfaces of `anatomy` in a grid of its meshed tissues.

    All hollow tissues are one surface, the first; then one a meshed tissue, in the order of priority. A face belongs
    to the tissue on its two sides that wins. The faces of the box belong to none.
    """
    hollow = tuple(
        phi
        for tissue, phi in zip(anatomy.tissues, anatomy.level_sets, strict=True)
        if phi is not None and not tissue.meshed
    )
    level_sets: list[LevelSet] = [Union(hollow)] if hollow else []
    number = np.full(len(anatomy.tissues) + 1, len(anatomy.tissues) + 1)
    for i in anatomy.priority:
        phi = anatomy.level_sets[i]
        if phi is None or not anatomy.tissues[i].meshed:
            number[i] = 0
        else:
            number[i] = len(level_sets)
            level_sets.append(phi)
    faces, behind = _sides(grid, anatomy)
    rank = number[behind].min(axis=1)
    keep = rank < len(level_sets)
    faces, rank = faces[keep], rank[keep]
    on = np.zeros((len(grid.nodes), len(level_sets)), dtype=bool)
    on[faces, rank[:, None]] = True
    return Contacts(tuple(level_sets), faces, rank, on, np.zeros(on.shape), anatomy.box)


def snapped(grid: Grid, contacts: Contacts, *, limit_mm: float, sweeps: int = 3) -> Grid:
    """Move surface nodes onto their level sets along the gradients, no further than keeps every tetrahedron alive."""
    nodes = np.flatnonzero(contacts.on.any(axis=1))
    for _ in range(sweeps):
        step = np.zeros(grid.nodes.shape)
        step[nodes] = contacts.onto(grid.nodes[nodes], nodes, limit_mm=limit_mm)
        before = signed_volumes(grid.nodes, grid.tets)
        for _ in range(MAX_HALVINGS):  # around every tetrahedron that it would flatten
            bad = signed_volumes(grid.nodes + step, grid.tets) < SHRINK_LIMIT * before
            if not bad.any():
                break
            step[np.unique(grid.tets[bad])] *= 0.5
        while bad.any():
            step[np.unique(grid.tets[bad])] = 0.0
            bad = signed_volumes(grid.nodes + step, grid.tets) < SHRINK_LIMIT * before
        grid = Grid(grid.nodes + step, grid.tets, grid.region)
    return grid


def debiased(grid: Grid, contacts: Contacts) -> tuple[Grid, Contacts]:
    """Move surface nodes until the level set's mean over the facets around each, weighted by its hat, vanishes.

    Chords of a curved surface lie on its inner side: with nodes on the surface every convex organ is too small.
    Returns the grid and the contacts with the targets that it was given.
    """
    for _ in range(3):
        corners = grid.nodes[contacts.faces]
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        total, weight = np.zeros(contacts.on.shape), np.zeros(contacts.on.shape)
        barycentric = np.concatenate([np.roll(row, shift)[None] for row in QUADRATURE for shift in range(3)])
        for place, share in zip(barycentric, QUADRATURE_WEIGHTS, strict=True):
            points = np.einsum("k,nki->ni", place, corners)
            value = np.zeros(len(points))
            for k, phi in enumerate(contacts.level_sets):
                mine = contacts.surface == k
                if mine.any():
                    value[mine] = phi.at(points[mine])
            for corner in range(3):
                key = (contacts.faces[:, corner], contacts.surface)
                np.add.at(total, key, share * area * place[corner] * value)
                np.add.at(weight, key, share * area * place[corner])
        target = contacts.target - total / np.where(weight > 0.0, weight, 1.0)
        contacts = replace(contacts, target=np.where(contacts.on, target, 0.0))
        grid = snapped(grid, contacts, limit_mm=1.0, sweeps=1)
    return grid, contacts


def _sides(grid: Grid, anatomy: Anatomy) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Faces (n, 3) between different tissues with the two (n, 2) tissues; -1 for a hollow one on the box's faces.

    The first hollow tissue by priority represents all hollow ones, or the filler where there is no other.
    """
    faces = grid.tets[:, FACES].reshape(-1, 3)
    region = np.repeat(grid.region, 4)
    _, inverse, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(inverse.ravel(), kind="stable")
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    double = first[count == 2]
    a, b = order[double], order[double + 1]
    differ = region[a] != region[b]
    border = order[first[count == 1]]
    hollow = [i for i in anatomy.priority if not anatomy.tissues[i].meshed] or [anatomy.filler]
    behind = np.where(np.any(anatomy.box.faces_of(grid.nodes[faces[border]]), axis=1), -1, hollow[0])
    if not anatomy.tissues[anatomy.filler].meshed:  # some look at the filler, not at another hollow tissue
        others = [rank for rank, i in enumerate(anatomy.priority) if not anatomy.tissues[i].meshed]
        values = np.abs(anatomy.values(grid.nodes[faces[border]].mean(axis=1)))
        rank = np.array([anatomy.priority.index(int(i)) for i in region[border]], dtype=int)
        nearer = values[others].min(axis=0, initial=np.inf) > values[rank, np.arange(len(border))]
        behind[(behind >= 0) & nearer] = anatomy.filler
    inner = behind >= 0
    tissues = np.concatenate(
        [np.column_stack([region[a], region[b]])[differ], np.column_stack([region[border], behind])[inner]]
    )
    return np.concatenate([faces[a[differ]], faces[border[inner]]]), tissues
