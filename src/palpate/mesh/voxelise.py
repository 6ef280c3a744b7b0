"""From a deformed mesh back to voxels: which tissue lies at each voxel's centre."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from palpate.errors import GeometryError
from palpate.images.label_image import VoxelGrid
from palpate.mesh.space import LagrangeSpace, shape_functions
from palpate.mesh.surface import tissue_surface
from palpate.mesh.tet_mesh import OUTER, TetMesh

TIES = 4  # largest number of voxels that two faces at an edge round differently; a neighbour decides these


Warp = Callable[[NDArray[np.float64]], NDArray[np.float64]]

LATTICE = 2.0**16  # corners are rounded to voxel / LATTICE: products of their differences are then exact in float64
TIE = 2.0**-14  # voxels: a face that is so near to a voxel's centre counts as just below it
BRICKS = (8, 4)  # voxels along each edge of a brick that is decided at once
BASE = 4  # region r is the digit r in this base, so that sums of unrelated crossings match no region


def voxelise(
    space: LagrangeSpace,
    displacement: NDArray[np.float64],
    grid: VoxelGrid,
    *,
    subdivisions: int = 2,
    warp: Warp | None = None,
    crossing: bool = False,
) -> NDArray[np.int16]:
    """Tissue (n_x, n_y, n_z), an index into `space.mesh.tissues`, at each voxel centre of the deformed mesh.

    `displacement` (n_points, 3) mm belongs to `space.points`. Every face between two regions is split into
    4^subdivisions plane triangles whose corners lie on the deformed (for P2 curved) face, then moved by `warp`
    (n, 3) mm -> (n, 3) mm. Columns of voxel centres are followed through these triangles: each crossing changes the
    tissue, with one decision for both sides, so that touching regions leave neither gap nor overlap. A voxel in no
    meshed region is of the hollow tissue behind the nearest boundary face, or, where that face is the domain's outer
    border, of the face's own region. Raises `GeometryError` when surfaces cross each other (unless `crossing`: then
    voxels in two regions take their nearest neighbour's) or the numbers of points differ. Method: scan conversion with
    a symbolic perturbation at ties.
    """
    return DeformedFaces.of(space, displacement, subdivisions=subdivisions, warp=warp).on(grid, crossing=crossing)


@dataclass(frozen=True, slots=True)
class DeformedFaces:
    """The deformed faces between regions, in plane pieces, which several grids may be laid over (see `voxelise`).

    pieces (n, 3, 3) mm: their corners; step (n,): change of the code of what lies beyond them. Where that is no meshed
    region, behind (n_regions,): the regions that may lie there; nearest: of each, the middles of its pieces.
    """

    mesh: TetMesh
    pieces: NDArray[np.float64]
    step: NDArray[np.int64]
    behind: NDArray[np.int64]
    nearest: tuple[KDTree, ...]

    @classmethod
    def of(
        cls,
        space: LagrangeSpace,
        displacement: NDArray[np.float64],
        *,
        subdivisions: int = 2,
        warp: Warp | None = None,
    ) -> DeformedFaces:
        """Those of a displacement (n_points, 3) mm of a space; raises `GeometryError` for other numbers of points."""
        if displacement.shape != space.points.shape:
            raise GeometryError(
                f"the displacement has the shape {displacement.shape}, the space {space.points.shape}: give one row"
                " for each point"
            )
        faces = []  # between regions, each once, normals out of `inner` (n,) into `other` (n,)
        for region in np.unique(space.mesh.region):
            surface = tissue_surface(space.mesh, int(region))
            first = (surface.other > region) | ~np.isin(surface.other, space.mesh.region)
            faces.append((surface.triangles[first], np.full(int(first.sum()), region), surface.other[first]))
        triangles, inner, other = (np.concatenate(parts) for parts in zip(*faces, strict=True))
        pieces = _pieces(space, displacement, triangles, subdivisions=subdivisions, warp=warp)
        count = 4**subdivisions
        code_inner, code_other = (
            np.repeat(np.where(np.isin(side, space.mesh.region), BASE ** np.maximum(side, 0), 0), count)
            for side in (inner, other)
        )
        hollow = code_other == 0
        behind, centres = np.repeat(np.where(other == OUTER, inner, other), count)[hollow], pieces[hollow].mean(axis=1)
        trees = tuple(KDTree(centres[behind == name]) for name in np.unique(behind))
        return cls(space.mesh, pieces, code_other - code_inner, np.unique(behind), trees)

    def on(self, grid: VoxelGrid, *, crossing: bool = False) -> NDArray[np.int16]:
        """Tissue (n_x, n_y, n_z) at each voxel's centre; raises `GeometryError` as `voxelise`."""
        tissue = _regions(_accumulate(self.pieces, self.step, grid), self.mesh, crossing)
        empty = np.argwhere(tissue < 0)
        if len(empty):
            tissue[tuple(empty.T)] = self._behind(empty, grid)
        return tissue

    def _behind(self, voxels: NDArray[np.int64], grid: VoxelGrid) -> NDArray[np.int64]:
        """Of each voxel (m, 3) the region behind the nearest face.

        Bricks of voxels are decided first, large ones before small ones. A region that is nearer to a brick's middle
        than all others, by more than the brick's diameter, is nearest for all of its voxels.
        """
        found, left = np.zeros(len(voxels), dtype=np.int64), np.arange(len(voxels))
        if len(self.nearest) == 1:
            return np.asarray(self.behind[found])
        for size in (*BRICKS, 1):
            shape = tuple(-(-n // size) for n in grid.shape)
            brick = np.ravel_multi_index((voxels[left] // size).T, shape)
            asked = np.flatnonzero(np.bincount(brick, minlength=math.prod(shape)))
            middle = np.stack(np.unravel_index(asked, shape), axis=1).astype(float) * size + 0.5 * (size - 1)
            apart = np.stack([tree.query(grid.world(middle), workers=-1)[0] for tree in self.nearest])
            half = (size - 1) * np.array(list(itertools.product((-0.5, 0.5), repeat=3))) @ grid.affine[:3, :3].T
            place = np.searchsorted(asked, brick)
            found[left] = apart.argmin(axis=0)[place]
            first, second = np.partition(apart, 1, axis=0)[:2]
            decided = second - first > 2.0 * np.linalg.norm(half, axis=1).max()
            left = left[~decided[place]]
        return np.asarray(self.behind[found])


def _regions(codes: NDArray[np.int64], mesh: TetMesh, crossing: bool) -> NDArray[np.int16]:
    """Index of the region of each code, -1 where nothing is meshed."""
    tissue = np.full(codes.shape, -1, dtype=np.int16)
    known = codes == 0
    for region in np.unique(mesh.region):
        here = codes == BASE**region
        tissue[here] = region
        known |= here
    unknown = int(np.count_nonzero(~known))
    if 0 < unknown <= (known.size if crossing else TIES):
        nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
        return np.asarray(tissue[tuple(nearest)])
    if unknown:
        raise GeometryError(
            f"{unknown} voxel centres lie in two regions at once or in an open surface: the deformed"
            " surfaces cross each other; check the displacement for fold-over, or make the boundary noise smaller"
        )
    return tissue


def _pieces(
    space: LagrangeSpace,
    displacement: NDArray[np.float64],
    triangles: NDArray[np.int64],
    *,
    subdivisions: int,
    warp: Warp | None,
) -> NDArray[np.float64]:
    """Corners (n_triangles 4^subdivisions, 3, 3) mm of the deformed and warped pieces of each triangle."""
    n = 2**subdivisions
    lattice = [(i, j) for i in range(n + 1) for j in range(n + 1 - i)]
    number = {corner: k for k, corner in enumerate(lattice)}
    cells = [(number[i, j], number[i + 1, j], number[i, j + 1]) for i, j in lattice if i + j < n]
    cells += [(number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]) for i, j in lattice if i + j < n - 1]
    shares = np.array(lattice) / n
    barycentric = np.column_stack([1.0 - shares.sum(axis=1), shares])
    moved = (space.points + displacement)[space.facets(triangles)]
    points = np.einsum("lk,fkd->fld", shape_functions(space.order, barycentric), moved)
    if warp is not None:
        distinct, place = np.unique(np.round(points.reshape(-1, 3), 9), axis=0, return_inverse=True)
        points = warp(distinct)[place.reshape(-1)].reshape(points.shape)
    return np.asarray(points[:, np.array(cells)].reshape(-1, 3, 3))


def _accumulate(pieces: NDArray[np.float64], step: NDArray[np.int64], grid: VoxelGrid) -> NDArray[np.int64]:
    """Sum (n_x, n_y, n_z) of the steps (n,) of all faces crossed on the way up the voxel's column."""
    nx, ny, nz = grid.shape
    corners = np.round(grid.index(pieces.reshape(-1, 3)) * LATTICE).reshape(-1, 3, 3) / LATTICE
    turn = np.sign(np.linalg.det(grid.affine[:3, :3]))
    area = _cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    signed = (step * np.sign(area) * turn).astype(np.int64)
    corners[area < 0] = corners[area < 0][:, ::-1]
    hit, x, y = _columns(corners, np.flatnonzero(area), (nx, ny))
    met = corners[hit]  # and where the column meets the triangle's plane
    first, second, to = met[:, 1] - met[:, 0], met[:, 2] - met[:, 0], np.stack([x, y], axis=1) - met[:, 0, :2]
    rise = (_cross(to, second) * first[:, 2] + _cross(first, to) * second[:, 2]) / _cross(first, second)
    height = met[:, 0, 2] + rise
    start = np.clip(np.ceil(height - TIE), 0, nz).astype(np.int64)
    flat = ((x * ny + y) * (nz + 1) + start).astype(np.int64)
    jumps = np.bincount(flat, weights=signed[hit], minlength=nx * ny * (nz + 1))
    total = np.cumsum(jumps.astype(np.int64).reshape(nx, ny, nz + 1), axis=2)
    if total[:, :, nz].any():
        raise GeometryError(f"{np.count_nonzero(total[:, :, nz])} voxel columns enter a region but never leave it")
    return total[:, :, :nz]


def _columns(
    corners: NDArray[np.float64], faces: NDArray[np.int64], shape: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of a face (number) and a voxel column (x, y) that passes through it; corners turn anticlockwise."""
    limits = np.array(shape) - 1
    low = np.maximum(np.ceil(corners[faces, :, :2].min(axis=1)), 0).astype(np.int64)
    high = np.minimum(np.floor(corners[faces, :, :2].max(axis=1)), limits).astype(np.int64)
    extent = np.maximum(high - low + 1, 0)
    count = extent.prod(axis=1)
    owner = np.repeat(np.arange(len(faces)), count)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    x = low[owner, 0] + within // np.maximum(extent[owner, 1], 1)
    y = low[owner, 1] + within % np.maximum(extent[owner, 1], 1)
    inside, place = np.ones(len(owner), dtype=np.bool_), (x.astype(float), y.astype(float))
    own = corners[faces]
    for k in range(3):
        start, (along_x, along_y) = own[:, k], (own[:, (k + 1) % 3, :2] - own[:, k, :2]).T
        tie = (along_y < 0) | ((along_y == 0) & (along_x > 0))  # on an edge, as if moved by (e, e^2)
        to_x, to_y = place[0] - start[owner, 0], place[1] - start[owner, 1]
        side = along_x[owner] * to_y - along_y[owner] * to_x
        inside &= (side > 0) | ((side == 0) & tie[owner])
    return faces[owner[inside]], x[inside], y[inside]


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Third component (n,) of the cross product of the first two components of a and b."""
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
