"""Where in the image something is wrong with a mesh, in words that lead there in a viewer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.errors import GeometryError
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.mesh.space import lagrange_space
from palpate.mesh.tet_mesh import TetMesh
from palpate.mesh.voxelise import voxelise

NEIGHBOURHOOD_MM = 10.0


def in_words(point: NDArray[np.float64], grid: VoxelGrid | None) -> str:
    """A point (3,) in RAS mm with its voxel and the nearest axial slice of `grid`, if there is one."""
    place = f"RAS {np.round(point, 1).tolist()} mm"
    if grid is None:
        return place
    voxel = np.clip(np.rint(grid.index(np.asarray(point)[None])[0]), 0, np.array(grid.shape) - 1).astype(int)
    return (
        f"{place} (voxel {voxel.tolist()}, counted from 0 to the right, front and head; axial slice {voxel[2] + 1} of"
        f" {grid.shape[2]} from the feet)"
    )


def largest_difference(mesh: TetMesh, image: Segmentation, tissue: int) -> NDArray[np.float64] | None:
    """Where (3,) RAS mm, within some 10 mm, mesh and image differ most in voxels of that tissue; None: nowhere.

    Within the image's part that is meshed or enclosed by it; None, too, where the mesh's surfaces cross.
    """
    space = lagrange_space(mesh, "P1")
    try:
        shown = voxelise(space, np.zeros_like(space.points), image.grid, subdivisions=0, crossing=True)
    except GeometryError:
        return None
    index = image.grid.index(mesh.nodes)
    first = np.clip(np.floor(index.min(axis=0) + 0.5).astype(np.int64), 0, image.grid.shape)
    last = np.clip(np.ceil(index.max(axis=0) + 0.5).astype(np.int64), 0, image.grid.shape)
    inside = [slice(low, high) for low, high in zip(first, last, strict=True)]
    differ = ((shown == tissue) != image.mask(tissue))[tuple(inside)]
    if not differ.any():
        return None
    size = np.maximum(np.rint(NEIGHBOURHOOD_MM / image.grid.spacing), 1).astype(int)
    density = np.where(differ, ndimage.uniform_filter(differ.astype(float), size.tolist(), mode="constant"), 0.0)
    voxel = np.array(np.unravel_index(int(density.argmax()), density.shape)) + [s.start for s in inside]
    return np.asarray(image.grid.world(voxel[None].astype(float))[0])
