"""An organ drawn larger or smaller than it is, as by another hand or from another modality."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.images.label_image import LabelImage
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.voxelise import Warp
from palpate.observation.observed_surface import observed_surface
from palpate.phantoms.exact_targets import TriangulatedDistance

__all__ = ["redrawn"]


def redrawn(
    image: LabelImage,
    space: LagrangeSpace,
    displacement: NDArray[np.float64],
    tissues: Sequence[str],
    *,
    outwards_mm: float,
    into: str,
    warp: Warp | None = None,
) -> LabelImage:
    """The image of the mesh under `displacement` (n_points, 3) mm with some tissues' surfaces drawn `outwards_mm` off.

    image: what `imaged` gives, with the same `warp`. Each surface is drawn alone: inwards (negative), what two
    tissues that touch give up goes to the tissue `into`, too; outwards, voxels of `into` alone are taken, each by the
    tissue that is nearest. A voxel is decided by the signed distance of its centre to the surface.
    """
    labels, mesh = image.labels.copy(), space.mesh
    filler = mesh.tissue_index(into) + 1
    near = np.full(labels.shape, abs(outwards_mm))  # signed distance to the nearest tissue that a voxel is given to
    for name in tissues:
        index = mesh.tissue_index(name)
        own = image.labels == index + 1
        changing = own if outwards_mm < 0.0 else image.labels == filler
        reach = 2.0 + abs(outwards_mm) / float(image.grid.spacing.min())  # voxels; a centre is that near to the surface
        other = ~own if outwards_mm < 0.0 else own
        voxels = np.argwhere(changing & (ndimage.distance_transform_edt(~other) <= reach))
        surface = observed_surface(space, index)
        vertices = surface.rest + displacement[surface.points]
        vertices = vertices if warp is None else warp(vertices)
        distance = TriangulatedDistance(np.ascontiguousarray(vertices), np.ascontiguousarray(surface.triangles))
        phi = distance.at(image.grid.world(voxels.astype(float)))
        place = tuple(voxels.T)
        if outwards_mm < 0.0:
            labels[tuple(voxels[phi > outwards_mm].T)] = filler
            continue
        nearer = phi < near[place]
        chosen = tuple(voxels[nearer].T)
        labels[chosen] = index + 1
        near[chosen] = phi[nearer]
    return replace(image, labels=labels)
