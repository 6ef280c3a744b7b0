"""What the finite-strain laws share: J = det F and the bulk energy u = (ln J)^2 / 2."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

IDENTITY4 = np.einsum("ik,jl->ijkl", np.eye(3), np.eye(3))  # dF_ij / dF_kl


# C (9, 81) with d cof_ij / dF_kl = sum over mn of C_mn,ijkl F_mn: products of two permutation symbols
PERMUTATION = np.fromfunction(lambda i, j, k: 0.5 * (i - j) * (j - k) * (k - i), (3, 3, 3))
COFACTOR_TENSOR = np.einsum("ikm,jln->mnijkl", PERMUTATION, PERMUTATION).reshape(9, 81)


def cofactors(F: Array) -> Array:
    """Cofactors cof F = dJ/dF = J F^-T (n, 3, 3), dimensionless, of F (n, 3, 3); needs no inverse."""
    result = np.empty_like(F)
    for i in range(3):
        a, b = F[:, (i + 1) % 3], F[:, (i + 2) % 3]
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            result[:, i, j] = a[:, k] * b[:, m] - a[:, m] * b[:, k]
    return result


def determinants(F: Array) -> Array:
    """J = det F (n,), dimensionless, of F (n, 3, 3)."""
    return np.asarray(np.einsum("nj,nj->n", F[:, 0], cofactors(F)[:, 0]))


def cofactor_derivatives(F: Array) -> Array:
    """Derivatives d cof_ij / dF_kl = e_ikm e_jln F_mn (n, 3, 3, 3, 3), dimensionless, at F (n, 3, 3)."""
    return np.asarray((F.reshape(-1, 9) @ COFACTOR_TENSOR).reshape(-1, 3, 3, 3, 3))


def dyads(a: Array, b: Array) -> Array:
    """a_ij b_kl (n, 3, 3, 3, 3) of a and b (n, 3, 3), in the unit of their product."""
    return np.asarray((a.reshape(-1, 9, 1) * b.reshape(-1, 1, 9)).reshape(-1, 3, 3, 3, 3))


def log_derivatives(F: Array) -> tuple[Array, Array, Array]:
    """Logarithm ln J (n,), its slope h = F^-T (n, 3, 3) and its curvature (n, 3, 3, 3, 3) at F (n, 3, 3) with J > 0."""
    cofactor = cofactors(F)
    J = np.einsum("nj,nj->n", F[:, 0], cofactor[:, 0])
    h = cofactor / J[:, None, None]
    return np.log(J), h, cofactor_derivatives(F) / J[:, None, None, None, None] - dyads(h, h)


class FiniteStrain:
    """Volume ratio J = det F and bulk energy (ln J)^2 / 2, as in Simo & Pister, CMAME 46 (1984) 201-215.

    Rotations cost nothing, and J must stay positive.
    """

    __slots__ = ()

    finite: ClassVar[bool] = True

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
