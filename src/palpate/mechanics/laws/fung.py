"""Fung-type exponential, isotropic: W = mu/(2 b) (exp(b (I1 - 3 - 2 ln J)) - 1) + lambda/2 (ln J)^2, I1 = tr F^T F.

Demiray, J. Biomech. 5 (1972) 309, for incompressible tissue, where J = 1. The stiffness grows with the strain: pulled
by a strain e along one axis, where volume stays, it is about 1 + 9 b e^2 times that at rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError
from palpate.mechanics.laws.contract import LawParameter
from palpate.mechanics.laws.finite import FiniteStrain, dyads
from palpate.mechanics.laws.neo_hookean import NeoHookean

Array = NDArray[np.float64]

EXPONENT = LawParameter("fung_exponent", 1.0, 0.001, 10_000.0, "b of the law: how fast it stiffens; near 0 neo-hookean")
NEO_HOOKEAN = NeoHookean()
MOST = 200.0  # exponent, beyond which no tissue is: numbers stay finite while Newton's method looks too far


@dataclass(frozen=True, slots=True)
class Fung(FiniteStrain):
    """Compressible exponential law with the dimensionless exponent b > 0; the neo-Hookean law as b tends to 0."""

    name: ClassVar[str] = "fung"
    parameters: ClassVar[tuple[LawParameter, ...]] = (EXPONENT,)

    fung_exponent: float = EXPONENT.default

    def __post_init__(self) -> None:
        if not 0.0 < self.fung_exponent < np.inf:
            raise ConfigurationError(f"fung_exponent is {self.fung_exponent}; give a finite number greater than zero")

    @property
    def description(self) -> str:
        """For a methods section."""
        return f"a compressible Fung-type exponential law (Demiray 1972; b = {self.fung_exponent:g}) at finite strains"

    def _growth(self, F: Array) -> Array:
        """exp(2 b w') (n,) of the neo-Hookean shear energy w' = (I1 - 3) / 2 - ln J, which is zero at rest."""
        return np.asarray(np.exp(np.minimum(2.0 * self.fung_exponent * NEO_HOOKEAN.shear_energy(F), MOST)))

    def shear_energy(self, F: Array) -> Array:
        """Shear energy w = (exp(2 b w') - 1) / (2 b) (n,) at F (n, 3, 3)."""
        b = self.fung_exponent
        return np.asarray(np.expm1(np.minimum(2.0 * b * NEO_HOOKEAN.shear_energy(F), MOST)) / (2.0 * b))

    def shear_stress(self, F: Array) -> Array:
        """dw/dF = exp(2 b w') (F - F^-T) (n, 3, 3) at F (n, 3, 3)."""
        return self._growth(F)[:, None, None] * NEO_HOOKEAN.shear_stress(F)

    def shear_tangent(self, F: Array) -> Array:
        """d2w/dF dF = exp(2 b w') (d2w'/dF dF + 2 b dw'/dF dw'/dF) (n, 3, 3, 3, 3) at F (n, 3, 3)."""
        slope = NEO_HOOKEAN.shear_stress(F)
        bend = NEO_HOOKEAN.shear_tangent(F) + 2.0 * self.fung_exponent * dyads(slope, slope)
        return self._growth(F)[:, None, None, None, None] * bend
