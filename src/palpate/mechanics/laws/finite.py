"""What the finite-strain laws share: J = det F and the bulk energy u = (ln J)^2 / 2."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.laws.kinematics import cofactor_derivatives, cofactors, determinants

__all__ = ["FiniteStrain"]

Array = NDArray[np.float64]


class FiniteStrain:
    """Volume ratio J = det F and bulk energy (ln J)^2 / 2, as in Simo & Pister, CMAME 46 (1984) 201-215."""

    __slots__ = ()

    @property
    def finite(self) -> bool:
        """Rotations cost nothing, and J must stay positive."""
        return True

    def volume(self, F: Array) -> Array:
        """J = det F (n,) at F (n, 3, 3)."""
        return determinants(F)

    def volume_gradient(self, F: Array) -> Array:
        """dJ/dF = cof F (n, 3, 3) at F (n, 3, 3)."""
        return cofactors(F)

    def volume_curvature(self, F: Array) -> Array:
        """d2J/dF dF (n, 3, 3, 3, 3) at F (n, 3, 3)."""
        return cofactor_derivatives(F)

    def bulk_energy(self, J: Array) -> Array:
        """Bulk energy u = (ln J)^2 / 2 (n,) at J (n,)."""
        return np.asarray(0.5 * np.log(J) ** 2)

    def bulk_pressure(self, J: Array) -> Array:
        """Pressure u' = ln J / J (n,) at J (n,)."""
        return np.asarray(np.log(J) / J)

    def bulk_stiffness(self, J: Array) -> Array:
        """Stiffness u'' = (1 - ln J) / J^2 (n,) at J (n,)."""
        return np.asarray((1.0 - np.log(J)) / J**2)
