"""From unknowns to Young's moduli: theta = ln(E / E_reference), one for each `estimate` tissue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError
from palpate.images.tissue import Role, Tissue

__all__ = ["ModulusMap", "modulus_map"]

LOADS = "the known loads"


@dataclass(frozen=True, slots=True)
class ModulusMap:
    """theta (n_parameters,) -> moduli (n_regions,) kPa of the meshed tissues, in the order of the mesh's regions.

    base (n_regions,) kPa at theta = 0; columns (n_parameters,) the region that each unknown scales; `tissues` their
    names; `relative_to` the tissue that holds the scale; `absolute` is False when nothing sets a scale: then the first
    `estimate` tissue is held at 1 and every value is a ratio to it. Where known loads alone set it, `relative_to` says
    so, and the base is 1 kPa.
    """

    base: NDArray[np.float64]
    columns: NDArray[np.int64]
    tissues: tuple[str, ...]
    relative_to: str
    absolute: bool

    @property
    def by_load(self) -> bool:
        """Whether known loads, and no known modulus, set the scale."""
        return self.relative_to == LOADS

    @property
    def scale_kpa(self) -> float:
        """Modulus (kPa) of the tissue that holds the scale; 1 when none is known."""
        return float(self.base[self.columns[0]])

    def moduli(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Young's moduli (n_regions,) kPa of theta (n_parameters,)."""
        moduli = self.base.copy()
        moduli[self.columns] *= np.exp(theta)
        return moduli

    def pullback(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative (n_parameters,) by theta from a derivative (n_regions,) by ln E."""
        return np.asarray(gradient[self.columns])


def modulus_map(tissues: tuple[Tissue, ...], regions: tuple[int, ...], *, loaded: bool = False) -> ModulusMap:
    """Make the map for a mesh whose regions are `tissues[i] for i in regions`; `loaded`: known loads act on it.

    The scale is the modulus of the first `known` tissue in the file, or without one what the loads say. Raises
    `ConfigurationError` when there is nothing to estimate, or a single tissue and nothing to compare it with.
    """
    meshed = [tissues[i] for i in regions]
    known = [tissue for tissue in meshed if tissue.role is Role.KNOWN]
    unknown = [i for i, tissue in enumerate(meshed) if tissue.role is Role.ESTIMATE]
    absolute = bool(known)
    columns = unknown if absolute or loaded else unknown[1:]
    if not columns:
        raise ConfigurationError(
            "nothing can be estimated: displacements fix ratios of moduli only, so a case needs an `estimate` tissue"
            " and a `known` tissue, a known load, or a second `estimate` tissue"
        )
    if loaded and not known:
        names = tuple(meshed[i].name for i in columns)
        return ModulusMap(np.ones(len(meshed)), np.array(columns), names, LOADS, absolute=True)
    scale = known[0] if absolute else meshed[unknown[0]]
    unit = scale.youngs_modulus_kpa or 1.0 if absolute else 1.0
    base = [t.youngs_modulus_kpa or unit if t.role is Role.KNOWN else unit for t in meshed]
    names = tuple(meshed[i].name for i in columns)
    return ModulusMap(np.array(base), np.array(columns), names, scale.name, absolute)
