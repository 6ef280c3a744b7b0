"""Bodies and images that are not what the model takes them for: uneven tissues, organs drawn too large, sheaths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.errors import GeometryError
from palpate.images import LabelImage
from palpate.mesh import LagrangeSpace, LevelSet, TetMesh
from palpate.observation import observed_surface
from palpate_validation.truth import TriangulatedDistance

__all__ = ["Grown", "patched", "redrawn"]


def patched(mesh: TetMesh, log_factors: NDArray[np.float64], *, levels: int = 12) -> TetMesh:
    """The mesh with each meshed tissue cut into regions of constant modulus, by log_factors (n_tets,) dimensionless.

    E = E_tissue exp(f - mean f), with the mean over the tissue's volume: what the tissue states is the geometric mean
    of its modulus. A tissue with more than `levels` values of f gets so many regions, of equal numbers of tetrahedra,
    with the mean of f in each. The first region stands in the tissue's place, the others behind all tissues. Raises
    `GeometryError` when the numbers of tetrahedra differ.
    """
    if log_factors.shape != mesh.region.shape:
        raise GeometryError(
            f"the factors have the shape {log_factors.shape}, for {len(mesh.tets)} tetrahedra: give one each"
        )
    region, tissues, volumes = mesh.region.copy(), list(mesh.tissues), mesh.volumes
    for index, tissue in enumerate(mesh.tissues):
        tets = np.flatnonzero(mesh.region == index)
        if not len(tets) or tissue.youngs_modulus_kpa is None:
            continue
        level = _levels(log_factors[tets], levels)
        mean = np.average(log_factors[tets], weights=volumes[tets])
        for number in range(level.max() + 1):
            here = tets[level == number]
            factor = np.exp(np.average(log_factors[here], weights=volumes[here]) - mean)
            modulus = float(tissue.youngs_modulus_kpa * factor)
            if number == 0:
                tissues[index] = replace(tissue, youngs_modulus_kpa=modulus)
                continue
            region[here] = len(tissues)
            tissues.append(replace(tissue, name=f"{tissue.name} {number + 1}", youngs_modulus_kpa=modulus))
    return replace(mesh, region=region, tissues=tuple(tissues))


def _levels(values: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """Number (n,) of the region that each of some values (n,) belongs to, from the least upwards, none empty."""
    distinct, level = np.unique(values, return_inverse=True)
    if len(distinct) > most:
        ends = np.quantile(values, np.linspace(0.0, 1.0, most + 1)[1:-1])
        level = np.unique(np.searchsorted(ends, values), return_inverse=True)[1]
    return np.asarray(level)


def redrawn(
    image: LabelImage,
    space: LagrangeSpace,
    displacement: NDArray[np.float64],
    tissues: Sequence[str],
    *,
    outwards_mm: float,
    into: str,
    warp: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
) -> LabelImage:
    """The image of the mesh under `displacement` (n_points, 3) mm with some tissues' surfaces drawn `outwards_mm` off.

    image: what `imaged` gives, with the same `warp` (n, 3) mm -> (n, 3) mm. Each surface is drawn alone: inwards
    (negative), what two tissues that touch give up goes to the tissue `into`, too; outwards, voxels of `into` alone are
    taken, each by the tissue that is nearest. A voxel is decided by the signed distance of its centre to the surface.
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


@dataclass(frozen=True, slots=True)
class Grown:
    """A shape grown by `by_mm`: all places within that distance of `part`."""

    part: LevelSet
    by_mm: float

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance (n,) mm."""
        return self.part.at(points) - self.by_mm

    def gradient_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient (n, 3), mm per mm."""
        return self.part.gradient_at(points)
