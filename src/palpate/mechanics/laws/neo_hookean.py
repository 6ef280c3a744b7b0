"""Neo-Hookean: W = mu/2 (I1 - 3 - 2 ln J) + lambda/2 (ln J)^2, I1 = tr F^T F."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.laws.contract import LawParameter
from palpate.mechanics.laws.finite import IDENTITY4, FiniteStrain, cofactors, determinants, log_derivatives

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class NeoHookean(FiniteStrain):
    """Compressible neo-Hookean law; Bonet & Wood, Nonlinear Continuum Mechanics (2nd ed., 2008), section 6.4.3."""

    name: ClassVar[str] = "neo-hookean"
    description: ClassVar[str] = "a compressible neo-Hookean law at finite strains"
    parameters: ClassVar[tuple[LawParameter, ...]] = ()

    def shear_energy(self, F: Array) -> Array:
        """Shear energy w = (I1 - 3) / 2 - ln J (n,) at F (n, 3, 3)."""
        return np.asarray(0.5 * (np.einsum("nij,nij->n", F, F) - 3.0) - np.log(determinants(F)))

    def shear_stress(self, F: Array) -> Array:
        """dw/dF = F - F^-T (n, 3, 3) at F (n, 3, 3)."""
        cofactor = cofactors(F)
        J = np.einsum("nj,nj->n", F[:, 0], cofactor[:, 0])
        return np.asarray(F - cofactor / J[:, None, None])

    def shear_tangent(self, F: Array) -> Array:
        """d2w/dF dF = I - d2 ln J / dF dF (n, 3, 3, 3, 3) at F (n, 3, 3)."""
        return np.asarray(IDENTITY4 - log_derivatives(F)[2])
