"""The neo-Hookean law of Abaqus and CalculiX, W = mu/2 (J^(-2/3) I1 - 3) + K/2 (J - 1)^2, in our form.

With K = lambda + 2 mu / 3: w = (J^(-2/3) I1 - 3) / 2 + (J - 1)^2 / 3 and u = (J - 1)^2 / 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

__all__ = ["Decoupled"]


@dataclass(frozen=True)
class Decoupled:
    """Shear and volume apart, as both programs have it; a `Law` of `palpate.mechanics`."""

    name: str = "decoupled neo-hookean"
    description: str = "the neo-Hookean law of Abaqus"
    parameters: tuple[()] = ()
    finite: bool = True

    def volume(self, F: Array) -> Array:
        """J = det F (n,)."""
        return np.asarray(np.linalg.det(F))

    def volume_gradient(self, F: Array) -> Array:
        """dJ/dF = J F^-T (n, 3, 3)."""
        J, _, _, h = parts(F)
        return np.asarray(J[:, None, None] * h)

    def volume_curvature(self, F: Array) -> Array:
        """d2J/dF dF = J (h h + dh/dF) (n, 3, 3, 3, 3)."""
        J, _, _, h = parts(F)
        return np.asarray(J[:, None, None, None, None] * (dyads(h, h) + slope_of(h)))

    def shear_energy(self, F: Array) -> Array:
        """W (n,)."""
        J, power, first, _ = parts(F)
        return np.asarray(0.5 * (power * first - 3.0)[:, 0, 0] + (J - 1.0) ** 2 / 3.0)

    def shear_stress(self, F: Array) -> Array:
        """dw/dF = J^(-2/3) (F - I1 h / 3) + 2/3 (J - 1) J h (n, 3, 3)."""
        J, power, first, h = parts(F)
        return np.asarray(power * (F - first / 3.0 * h) + (2.0 / 3.0 * (J - 1.0) * J)[:, None, None] * h)

    def shear_tangent(self, F: Array) -> Array:
        """d2w/dF dF (n, 3, 3, 3, 3)."""
        J, power, first, h = parts(F)
        unit = np.einsum("ik,jl->ijkl", np.eye(3), np.eye(3))
        wide = power[..., None, None], first[..., None, None]
        isochoric = unit - 2.0 / 3.0 * (dyads(F, h) + dyads(h, F)) + wide[1] * (2.0 / 9.0 * dyads(h, h))
        isochoric = wide[0] * (isochoric - wide[1] / 3.0 * slope_of(h))
        volumetric = 2.0 / 3.0 * (dyads(self.volume_gradient(F), self.volume_gradient(F)))
        return np.asarray(
            isochoric + volumetric + (2.0 / 3.0 * (J - 1.0))[:, None, None, None, None] * self.volume_curvature(F)
        )

    def bulk_energy(self, J: Array) -> Array:
        """U (n,)."""
        return np.asarray(0.5 * (J - 1.0) ** 2)

    def bulk_pressure(self, J: Array) -> Array:
        """U' (n,)."""
        return np.asarray(J - 1.0)

    def bulk_stiffness(self, J: Array) -> Array:
        """U'' (n,)."""
        return np.ones_like(J)


def parts(F: Array) -> tuple[Array, Array, Array, Array]:
    """J (n,), J^(-2/3) (n, 1, 1), I1 (n, 1, 1) and h = F^-T (n, 3, 3)."""
    J = np.linalg.det(F)
    first = np.einsum("nij,nij->n", F, F)[:, None, None]
    return J, J[:, None, None] ** (-2.0 / 3.0), first, np.swapaxes(np.linalg.inv(F), 1, 2)


def slope_of(h: Array) -> Array:
    """dh_ij / dF_kl = -h_il h_kj (n, 3, 3, 3, 3) of h = F^-T (n, 3, 3)."""
    return np.asarray(-np.einsum("nil,nkj->nijkl", h, h))


def dyads(A: Array, B: Array) -> Array:
    """A_ij B_kl (n, 3, 3, 3, 3) of (n, 3, 3) each."""
    return np.asarray(np.einsum("nij,nkl->nijkl", A, B))
