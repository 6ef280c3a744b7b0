"""Small strain: W = mu e:e + lambda/2 (tr e)^2, e = (grad u + grad u^T) / 2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.laws.contract import LawParameter
from palpate.mechanics.laws.finite import IDENTITY4

Array = NDArray[np.float64]

SYMMETRIC = IDENTITY4 + np.einsum("il,jk->ijkl", np.eye(3), np.eye(3))


@dataclass(frozen=True, slots=True)
class Linear:
    """Hooke's law for small strains; rotations count as strain, and J stands for 1 + div u, without a limit."""

    name: ClassVar[str] = "linear"
    description: ClassVar[str] = "isotropic linear elasticity at small strains"
    parameters: ClassVar[tuple[LawParameter, ...]] = ()
    finite: ClassVar[bool] = False

    def volume(self, F: Array) -> Array:
        """1 + div u (n,) at F (n, 3, 3)."""
        return np.asarray(np.einsum("nii->n", F) - 2.0)

    def volume_gradient(self, F: Array) -> Array:
        """I (n, 3, 3) at F (n, 3, 3)."""
        return np.broadcast_to(np.eye(3), F.shape)

    def volume_curvature(self, F: Array) -> Array:
        """0 (n, 3, 3, 3, 3) at F (n, 3, 3)."""
        return np.zeros((len(F), 3, 3, 3, 3))

    def shear_energy(self, F: Array) -> Array:
        """Shear energy w = e:e (n,) at F (n, 3, 3)."""
        return np.asarray(0.25 * np.einsum("nij,nij->n", self.shear_stress(F), self.shear_stress(F)))

    def shear_stress(self, F: Array) -> Array:
        """dw/dF = 2 e (n, 3, 3) at F (n, 3, 3)."""
        return np.asarray(F + np.swapaxes(F, 1, 2) - 2.0 * np.eye(3))

    def shear_tangent(self, F: Array) -> Array:
        """d2w/dF dF (n, 3, 3, 3, 3) at F (n, 3, 3), the same everywhere."""
        return np.broadcast_to(SYMMETRIC, (len(F), 3, 3, 3, 3))

    def bulk_energy(self, J: Array) -> Array:
        """Bulk energy u = (J - 1)^2 / 2 (n,) at J (n,)."""
        return np.asarray(0.5 * (J - 1.0) ** 2)

    def bulk_pressure(self, J: Array) -> Array:
        """Pressure u' = J - 1 (n,) at J (n,)."""
        return np.asarray(J - 1.0)

    def bulk_stiffness(self, J: Array) -> Array:
        """Stiffness u'' = 1 (n,) at J (n,)."""
        return np.ones_like(J)
