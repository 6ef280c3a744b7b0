"""Node smoothing: the worst dihedral angles are opened by moving the nodes around them, the surfaces kept."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.mesh.cutting import Grid, signed_volumes, within_faces
from palpate.mesh.snapping import Contacts
from palpate.mesh.tet_mesh import tet_dihedrals

SHARPNESS_DEG = 4.0  # of the penalty sum exp(-angle / sharpness); small, so that the worst angles dominate
INVERTED_DEG = -60.0  # angle that an inverted tetrahedron counts with
TRIALS = 12


def smoothed(grid: Grid, contacts: Contacts, *, step_mm: float, sweeps: int, below_deg: float = 20.0) -> Grid:
    """Move the nodes of bad tetrahedra to where sum exp(-angle / 4 deg) over the tetrahedra around them is least.

    A pattern search for many nodes at a time, no two of which share a tetrahedron: interior nodes are free, those of
    the box stay on its faces, those of surfaces slide on them. Only improvements are kept, so nothing gets inverted.
    Bad is an angle under `below_deg`; `step_mm` is the first step's length.
    """
    rng = np.random.default_rng(0)
    nodes = grid.nodes.copy()
    count = len(grid.tets)
    star = sparse.csr_matrix(
        (np.ones(4 * count), (grid.tets.ravel(), np.repeat(np.arange(count), 4))), shape=(len(nodes), count)
    )
    reach = np.full(len(nodes), step_mm)
    worst = tet_dihedrals(nodes[grid.tets]).min(axis=1)
    for _ in range(sweeps):
        # nodes of bad tetrahedra with the lowest priority around, so that no two share a tetrahedron
        candidates = np.unique(grid.tets[worst < below_deg])
        priority = np.full(len(nodes), np.inf)
        priority[candidates] = rng.random(len(nodes))[candidates]
        lowest = np.full(len(nodes), np.inf)
        np.minimum.at(lowest, grid.tets, priority[grid.tets].min(axis=1)[:, None])
        chosen = candidates[lowest[candidates] == priority[candidates]]
        if not len(chosen):
            break
        frames = np.linalg.qr(rng.normal(size=(TRIALS // 6, 3, 3)))[0].reshape(-1, 3)
        steps = reach[chosen, None, None] * np.concatenate([frames, -frames])  # both ways along random axes
        better, points = _search(nodes, grid.tets, contacts, star[chosen], chosen, steps)
        nodes[chosen[better]] = points[better]
        reach[chosen] *= np.where(better, 1.2, 0.6)
        touched = np.unique(star[chosen].indices)
        worst[touched] = tet_dihedrals(nodes[grid.tets[touched]]).min(axis=1)
    return Grid(nodes, grid.tets, grid.region)


def _search(
    nodes: NDArray[np.float64],
    tets: NDArray[np.int64],
    contacts: Contacts,
    star: sparse.csr_matrix[np.float64],
    chosen: NDArray[np.int64],
    steps: NDArray[np.float64],
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Best of the trial points (n, 3) of each chosen node, and whether it is better than where the node is."""
    n_trials = steps.shape[1]
    start = np.repeat(nodes[chosen], n_trials, axis=0)
    points = start + within_faces(steps.reshape(-1, 3), start, contacts.box)
    index = np.repeat(chosen, n_trials)
    surface = np.flatnonzero(contacts.on[index].any(axis=1))
    limit = float(np.abs(steps).max()) * 1.5
    for _ in range(2):
        points[surface] += contacts.onto(points[surface], index[surface], limit_mm=limit)
    local = np.clip(contacts.box.local(points), 0.0, contacts.box.lengths)
    trials = contacts.box.world(local).reshape(len(chosen), n_trials, 3)
    trials = np.concatenate([nodes[chosen][:, None], trials], axis=1)
    owner = np.repeat(np.arange(len(chosen)), np.diff(star.indptr))
    around = tets[star.indices]
    corners = np.repeat(nodes[around][:, None], trials.shape[1], axis=1)
    mine = around == chosen[owner][:, None]
    corners = np.where(mine[:, None, :, None], trials[owner][:, :, None, :], corners).reshape(-1, 4, 3)
    angles = tet_dihedrals(corners)
    angles[signed_volumes(corners.reshape(-1, 3), np.arange(4 * len(corners)).reshape(-1, 4)) <= 0.0] = INVERTED_DEG
    penalty = np.zeros(trials.shape[:2])
    np.add.at(penalty, owner, np.exp(-angles / SHARPNESS_DEG).sum(axis=1).reshape(len(owner), -1))
    best = penalty.argmin(axis=1)
    rows = np.arange(len(chosen))
    return penalty[rows, best] < 0.999 * penalty[:, 0], trials[rows, best]
