"""Mooney-Rivlin: W = c10 (I1 - 3) + c01 (I2 - 3) - 2 (c10 + 2 c01) ln J + (lambda/2 - 2 c01) (ln J)^2.

mu = 2 (c10 + c01), I1 = tr C, I2 = ((tr C)^2 - tr C^2) / 2, C = F^T F. The terms in ln J make the rest state free of
stress, and (mu, lambda) the moduli at small strain: the I2 term alone would add 4 c01 to lambda.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError
from palpate.mechanics.laws.contract import LawParameter
from palpate.mechanics.laws.finite import IDENTITY4, FiniteStrain, cofactors, determinants, dyads, log_derivatives

Array = NDArray[np.float64]

C01_OVER_C10 = LawParameter("c01_over_c10", 0.25, 0.0, 1000.0, "ratio of the law's two constants; 0 is neo-hookean")


@dataclass(frozen=True, slots=True)
class MooneyRivlin(FiniteStrain):
    """Compressible Mooney-Rivlin law with the dimensionless ratio c01 / c10 >= 0; 0 is the neo-Hookean law."""

    name: ClassVar[str] = "mooney-rivlin"
    parameters: ClassVar[tuple[LawParameter, ...]] = (C01_OVER_C10,)

    c01_over_c10: float = C01_OVER_C10.default

    def __post_init__(self) -> None:
        if not 0.0 <= self.c01_over_c10 < np.inf:
            raise ConfigurationError(f"c01_over_c10 is {self.c01_over_c10}; give a finite number, zero or greater")

    @property
    def description(self) -> str:
        """For a methods section."""
        return f"a compressible Mooney-Rivlin law (c01 / c10 = {self.c01_over_c10:g}) at finite strains"

    @property
    def coefficients(self) -> tuple[float, float]:
        """c10 and c01, both over mu: 1 / (2 (1 + k)) and k / (2 (1 + k)) with k = c01 / c10."""
        first = 0.5 / (1.0 + self.c01_over_c10)
        return first, self.c01_over_c10 * first

    def shear_energy(self, F: Array) -> Array:
        """Shear energy w (n,) at F (n, 3, 3): all terms but lambda/2 (ln J)^2, over mu."""
        a, b = self.coefficients
        C = np.einsum("nki,nkj->nij", F, F)
        first = np.einsum("nii->n", C)
        second = 0.5 * (first**2 - np.einsum("nij,nij->n", C, C))
        log = np.log(determinants(F))
        return np.asarray(a * (first - 3.0) + b * (second - 3.0) - 2.0 * (a + 2.0 * b) * log - 2.0 * b * log**2)

    def shear_stress(self, F: Array) -> Array:
        """dw/dF = 2 a F + 2 b (I1 F - F C) - (2 (a + 2 b) + 4 b ln J) F^-T (n, 3, 3) at F (n, 3, 3)."""
        a, b = self.coefficients
        C = np.einsum("nki,nkj->nij", F, F)
        cofactor = cofactors(F)
        J = np.einsum("nj,nj->n", F[:, 0], cofactor[:, 0])
        factor = (2.0 * (a + 2.0 * b) + 4.0 * b * np.log(J)) / J
        first = np.einsum("nii->n", C)[:, None, None]
        return np.asarray(2.0 * a * F + 2.0 * b * (first * F - F @ C) - factor[:, None, None] * cofactor)

    def shear_tangent(self, F: Array) -> Array:
        """d2w/dF_ij dF_kl (n, 3, 3, 3, 3) at F (n, 3, 3)."""
        a, b = self.coefficients
        log, h, curvature = log_derivatives(F)
        factor = 2.0 * (a + 2.0 * b) + 4.0 * b * log
        logs = factor[:, None, None, None, None] * curvature + 4.0 * b * dyads(h, h)
        # d(I1 F - F C)_ij / dF_kl = 2 F_ij F_kl + I1 I - (d_ik C_jl + F_il F_kj + (F F^T)_ik d_jl)
        identity = np.eye(3)
        C, B = np.einsum("nki,nkj->nij", F, F), np.einsum("nik,njk->nij", F, F)
        result = 2.0 * dyads(F, F) + np.einsum("nii->n", C)[:, None, None, None, None] * IDENTITY4
        result -= np.einsum("ik,njl->nijkl", identity, C)
        result -= np.einsum("nil,nkj->nijkl", F, F)
        result -= np.einsum("nik,jl->nijkl", B, identity)
        return np.asarray(2.0 * a * IDENTITY4 + 2.0 * b * result - logs)
