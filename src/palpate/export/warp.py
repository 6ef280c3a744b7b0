"""The fitted motion as displacement fields for ITK, ANTs and 3D Slicer, between the images' own worlds.

ITK's convention: a transform takes points of the fixed image to the moving one, T(x) = x + d(x), LPS mm. `warp` takes
the points of `before` to `after`; as a resampling transform it brings the image `after` onto the grid of `before`.
`inverse_warp` is the other way round. The grid's axes lead as LPS does: programs that take derivatives along the grid
for those in the world find the right Jacobian on every image that lies straight (docs/export.md).
"""

from __future__ import annotations

from pathlib import Path

import igl
import numpy as np
from nibabel.orientations import axcodes2ornt, inv_ornt_aff, io_orientation, ornt_transform
from numpy.typing import NDArray
from scipy import ndimage

from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.groups import element_faces
from palpate.images.label_image import VoxelGrid
from palpate.images.readers import write_displacement_field
from palpate.mechanics.element import barycentric_gradients
from palpate.mesh.locate import tetrahedron_image
from palpate.mesh.space import LagrangeSpace, shape_functions
from palpate.mesh.surface import tissue_surface
from palpate.study.outputs import write_json

FINEST_MM = 1.0  # of the field's grid: the motion is smooth, and images of CT would make gigabytes
SWEEPS = 15  # of the averaging that fills what is not meshed, on each level
INVERSIONS = 30  # steps of the fixed-point iteration for the inverse
SAME_MM = 1e-3


def write(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write warp.nii.gz, inverse_warp.nii.gz (numbered where there are several later images) and warp.json."""
    del model
    space, own = body.space, body.grid
    # the same box, its axes as near to LPS as they can be, with voxels of a millimetre at least
    turn = ornt_transform(io_orientation(own.affine), axcodes2ornt("LPS"))
    shape = np.array(own.shape)[np.argsort(turn[:, 0])]
    own = VoxelGrid((int(shape[0]), int(shape[1]), int(shape[2])), own.affine @ inv_ornt_aff(turn, own.shape))
    counts = np.maximum(np.minimum(own.shape, np.ceil(np.array(own.shape) * own.spacing / FINEST_MM)), 2).astype(int)
    steps = np.array(own.shape) / counts
    affine = np.array(own.affine)
    affine[:3, :3] = affine[:3, :3] * steps
    affine[:3, 3] = own.world(0.5 * (steps - 1.0)[None])[0]
    grid = VoxelGrid((int(counts[0]), int(counts[1]), int(counts[2])), affine)
    meshed = [number for number, tissue in enumerate(body.tissues) if tissue.meshed]
    borders = np.concatenate([tissue_surface(body.mesh, number).triangles for number in meshed])
    surface = np.unique(space.facets(borders))
    numbers = [f"_{n}" for n in range(1, len(body.displacements) + 1)] if len(body.displacements) > 1 else [""]
    entries = []
    for ending, displacement, alignment in zip(numbers, body.displacements, body.alignments, strict=True):
        field = field_on_grid(space, displacement, grid)
        places = _centres(grid, np.ones(grid.shape, dtype=bool))
        back = _inverse(field, grid, places)
        # to where the later image itself has the points: x + d = A (x + u) at the voxel centres x
        moved = _by(alignment, places + field.reshape(-1, 3)) - places
        write_displacement_field(folder / f"warp{ending}.nii.gz", moved.reshape(field.shape), grid)
        there = VoxelGrid(grid.shape, alignment @ grid.affine)  # the same box in the later image's world
        # from there: y + d = z + v(z), y = A z, at the voxel centres z
        moved = places + back.reshape(-1, 3) - _by(alignment, places)
        write_displacement_field(folder / f"inverse_warp{ending}.nii.gz", moved.reshape(back.shape), there)
        before, motion = space.points[surface], displacement[surface]
        off = _sampled(field, grid, before) - motion
        returned = _sampled(back, grid, before + motion) + motion
        entries.append(
            {
                "file": f"warp{ending}.nii.gz",
                "inverse": f"inverse_warp{ending}.nii.gz",
                "surface_rms_mm": _rms(off),
                "inverse_surface_rms_mm": _rms(returned),
            }
        )
    convention = "LPS mm; x + d(x): before to after (inverse: after to before), the images' own worlds"
    write_json(folder / "warp.json", {"schema": "palpate.warp/1", "convention": convention, "fields": entries})


def field_on_grid(space: LagrangeSpace, displacement: NDArray[np.float64], grid: VoxelGrid) -> NDArray[np.float64]:
    """Displacement (n_x, n_y, n_z, 3) mm at the voxel centres of `grid` of a body with displacement (n_points, 3) mm.

    Within the mesh it is the finite elements'; in the voxels around it the polynomial of the nearest element, so that
    what is interpolated on a wall is the wall's; beyond that a smooth continuation.
    """
    tets = tetrahedron_image(space.mesh, grid)
    inside = tets >= 0
    ring = ndimage.binary_dilation(inside, structure=np.ones((3, 3, 3), dtype=bool)) & ~inside
    field = np.zeros((*grid.shape, 3))
    field[inside] = _at(space, displacement, tets[inside], _centres(grid, inside))
    beside = _centres(grid, ring)
    if len(beside):
        mesh = space.mesh
        _, faces, _ = igl.point_mesh_squared_distance(beside, mesh.nodes, np.ascontiguousarray(mesh.boundary))
        owners, _ = element_faces(mesh, mesh.boundary)
        field[ring] = _at(space, displacement, owners[np.asarray(faces)], beside)
    return _filled(field, inside | ring)


def _rms(vectors: NDArray[np.float64]) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _centres(grid: VoxelGrid, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    return grid.world(np.argwhere(mask).astype(float))


def _at(
    space: LagrangeSpace, displacement: NDArray[np.float64], tets: NDArray[np.int32], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The polynomials of tetrahedra (n,) at points (n, 3) mm, which may lie outside of them."""
    mesh, found = space.mesh, np.zeros_like(points)
    gradients, _ = barycentric_gradients(mesh.nodes, mesh.tets)
    for part in np.array_split(np.arange(len(points)), len(points) // 500_000 + 1):
        owner = tets[part]
        away = points[part] - mesh.nodes[mesh.tets[owner, 0]]
        barycentric = np.einsum("nki,ni->nk", gradients[owner], away)
        barycentric[:, 0] += 1.0
        shape = shape_functions(space.order, barycentric)
        found[part] = np.einsum("na,nai->ni", shape, displacement[space.cells[owner]])
    return found


def _filled(field: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The field (n_x, n_y, n_z, 3) continued from its `known` voxels, each other voxel near the mean of its neighbours.

    Laplace's equation by Jacobi sweeps from coarse to fine; nothing flows through the border of the grid.
    """
    if known.all() or not known.any():
        return field
    if min(known.shape) > 2:
        counts, sums = _halved(known[..., None].astype(float)), _halved(np.where(known[..., None], field, 0.0))
        coarse_known = counts[..., 0] > 0.0
        coarse = _filled(np.where(coarse_known[..., None], sums / np.maximum(counts, 1.0), 0.0), coarse_known)
        start = coarse.repeat(2, 0).repeat(2, 1).repeat(2, 2)[tuple(slice(n) for n in known.shape)]
    else:
        start = np.broadcast_to(field[known].mean(axis=0), field.shape)
    found = np.where(known[..., None], field, start)
    unknown, inner = ~known, slice(1, -1)
    for _ in range(SWEEPS):
        padded = np.pad(found, [(1, 1)] * 3 + [(0, 0)], mode="edge")
        total = padded[2:, inner, inner] + padded[:-2, inner, inner] + padded[inner, 2:, inner]
        total += padded[inner, :-2, inner] + padded[inner, inner, 2:] + padded[inner, inner, :-2]
        found[unknown] = (total / 6.0)[unknown]
    return found


def _halved(field: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums over blocks of 2 x 2 x 2 voxels."""
    padded = np.pad(field, [*((0, n % 2) for n in field.shape[:3]), (0, 0)])
    x, y, z, m = padded.shape
    return np.asarray(padded.reshape(x // 2, 2, y // 2, 2, z // 2, 2, m).sum(axis=(1, 3, 5)))


def _sampled(field: NDArray[np.float64], grid: VoxelGrid, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The field (n, 3) at points (n, 3) mm, interpolated linearly as ITK does; beyond the grid that of its border."""
    index = grid.index(points).T
    return np.stack(
        [ndimage.map_coordinates(field[..., axis], index, order=1, mode="nearest") for axis in range(3)], axis=1
    )


def _inverse(field: NDArray[np.float64], grid: VoxelGrid, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """V (n_x, n_y, n_z, 3) mm with v(y) = -u(y + v(y)) at the voxel centres (n, 3) mm, by fixed-point iteration."""
    back = -field.reshape(-1, 3)
    active = np.arange(len(places))
    for number in range(INVERSIONS):
        following = -_sampled(field, grid, places[active] + back[active])
        change = following - back[active]
        back[active] += change if number < INVERSIONS // 2 else 0.5 * change  # where u is steep it would swing
        active = active[np.abs(change).max(axis=1) > SAME_MM]
    return back.reshape(field.shape)


def _by(alignment: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(points @ alignment[:3, :3].T + alignment[:3, 3])
