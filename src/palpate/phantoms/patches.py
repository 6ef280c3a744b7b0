"""Tissues that are not homogeneous: regions of one tissue, each with its own modulus."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.errors import GeometryError
from palpate.mesh.tet_mesh import TetMesh

__all__ = ["patched"]


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
