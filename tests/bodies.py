"""Labelled bodies whose organs move by themselves and that move as a whole, in closed form."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from palpate.images.alignment import RigidMotion
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.statement.result import CaseResult

TISSUES = (
    Tissue("prostate", Role.ESTIMATE, (1,)),
    Tissue("bladder", Role.ESTIMATE, (2,)),
    Tissue("rectum", Role.DRIVER, (3,)),
    Tissue("air", Role.VOID, (4,)),
    Tissue("rest", Role.KNOWN, (), youngs_modulus_kpa=10.0),
)
STILL = RigidMotion.identity()
ELSEWHERE = RigidMotion(Rotation.from_rotvec(np.deg2rad([2.0, -1.0, 3.0])).as_matrix(), np.array([4.0, -3.0, 2.0]))
FIELD = (110.0, 100.0, 100.0)
VOXEL = 1.6
BAR_MM = (20.0, 20.0, 30.0)
HEAD = "before_x,before_y,before_z,after_x,after_y,after_z"


def body(
    motion: RigidMotion, *, filling: float = 0.0, skin: bool = True, field: tuple[float, ...] = FIELD, seed: int = 0
) -> Segmentation:
    """Two organs, a tube behind them that fills and pushes them, and the skin around all."""
    shape = tuple(int(side / VOXEL) for side in field)
    affine = np.diag([VOXEL, VOXEL, VOXEL, 1.0])
    affine[:3, 3] = -0.5 * VOXEL * (np.array(shape) - 1.0) + np.random.default_rng(seed).uniform(-0.5, 0.5, 3)
    grid = VoxelGrid((shape[0], shape[1], shape[2]), affine)
    index = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1).reshape(-1, 3).astype(float)
    x = motion.inverse().apply(grid.world(index))
    pushed = x - np.array([0.0, 0.4 * filling, 0.1 * filling]) * np.exp(-((x[:, 1:2] + 20.0) ** 2) / 40.0**2)
    tissue = np.full(len(x), 4)
    if skin:
        tissue[((x[:, :2] / [50.0, 38.0]) ** 2).sum(axis=1) > 1.0] = 3
    tissue[inside(pushed, (0.0, 5.0, -12.0), (20.0, 16.0, 15.0))] = 0
    tissue[inside(pushed, (2.0, 10.0, 16.0), (25.0, 16.0, 12.0))] = 1
    tissue[np.hypot(x[:, 0], x[:, 1] + 22.0 - 0.05 * x[:, 2]) < 8.0 + filling * np.exp(-((x[:, 2] / 30.0) ** 2))] = 2
    return Segmentation(tissue.reshape(grid.shape), grid, TISSUES)


def inside(points: NDArray[np.float64], centre: tuple[float, ...], axes: tuple[float, ...]) -> NDArray[np.bool_]:
    return np.asarray((((points - centre) / axes) ** 2).sum(axis=1) < 1.0)


def box_cells(counts: tuple[int, int, int], size: tuple[float, ...]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Nodes (n, 3) mm and tetrahedra (m, 4) of a box, six to a cell, some with their corners in another order."""
    ends = np.array(counts) + 1
    index = np.stack(np.meshgrid(*map(np.arange, ends), indexing="ij"), axis=-1).reshape(-1, 3)
    corner = index[(index < ends - 1).all(axis=1)]
    tets = []
    for order in permutations(range(3)):
        steps = np.cumsum(np.concatenate([np.zeros((1, 3), int), np.eye(3, dtype=int)[list(order)]]), axis=0)
        tets.append(np.stack([np.ravel_multi_index((corner + step).T, ends) for step in steps], axis=1))
    return index / (ends - 1) * size, np.concatenate(tets)


def write_bar(folder: Path, *, strain: float, ratio: float) -> None:
    """Files bar.vtu and field.csv: a bar, and points in it that move as it is pulled, with an error of 0.01 mm."""
    size, rng = np.array(BAR_MM), np.random.default_rng(1)
    nodes, tets = box_cells((4, 4, 6), BAR_MM)
    meshio.write(folder / "bar.vtu", meshio.Mesh(nodes, [("tetra", tets)]))
    points = rng.uniform(0.5, size - 0.5, (300, 3))
    moved = strain * points * np.array([-ratio, -ratio, 1.0]) + 0.01 * rng.standard_normal((300, 3))
    np.savetxt(folder / "field.csv", np.c_[points, points + moved], delimiter=",", header=HEAD, comments="")


def with_first_pair(result: CaseResult, **changes: Any) -> CaseResult:
    """A result with changes of its first reference state."""
    return replace(result, pairs=(replace(result.pairs[0], **changes), *result.pairs[1:]))
