"""What an elastic law offers.

Every law here is isotropic and has the energy density

    W = mu w(F) + lambda u(J),      mu = E / (2 (1 + nu)),  lambda = E nu / ((1 + nu) (1 - 2 nu))

with dimensionless w and u: the shear part carries the distortion, the bulk part resists a change of volume. Keeping
them apart is what lets an element average the volume change (no locking), and as W is proportional to E by its
dimension, dP/dE = P / E holds for every law without a further line. F = I + grad u is the deformation gradient, J its
determinant (for the small-strain law: 1 + div u), P = dW/dF the first Piola-Kirchhoff stress.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LawParameter:
    """What a case may say of a law under its `name` in [mechanics]: a number, dimensionless, within both ends."""

    name: str
    default: float
    least: float
    most: float
    description: str


class Law(Protocol):
    """An elastic law, all its functions vectorised over n places and dimensionless.

    Its constructor takes its parameters by their names, and has their defaults.
    """

    @property
    def name(self) -> str:
        """The law's name in `case.toml`."""
        ...

    @property
    def description(self) -> str:
        """What it is, as a methods section says it after "the tissues followed"."""
        ...

    @property
    def parameters(self) -> tuple[LawParameter, ...]:
        """What a case may say of it beside its name."""
        ...

    @property
    def finite(self) -> bool:
        """Whether the law is one of finite strain: it then needs J > 0 everywhere and does not feel rotations."""
        ...

    def volume(self, F: Array) -> Array:
        """Volume ratio J (n,) at F (n, 3, 3)."""
        ...

    def volume_gradient(self, F: Array) -> Array:
        """dJ/dF (n, 3, 3) at F (n, 3, 3)."""
        ...

    def volume_curvature(self, F: Array) -> Array:
        """d2J/dF_ij dF_kl (n, 3, 3, 3, 3) at F (n, 3, 3)."""
        ...

    def shear_energy(self, F: Array) -> Array:
        """Shear energy w (n,) at F (n, 3, 3)."""
        ...

    def shear_stress(self, F: Array) -> Array:
        """dw/dF (n, 3, 3) at F (n, 3, 3)."""
        ...

    def shear_tangent(self, F: Array) -> Array:
        """d2w/dF_ij dF_kl (n, 3, 3, 3, 3) at F (n, 3, 3)."""
        ...

    def bulk_energy(self, J: Array) -> Array:
        """Bulk energy u (n,) at J (n,)."""
        ...

    def bulk_pressure(self, J: Array) -> Array:
        """Pressure u' (n,) at J (n,); positive in expansion."""
        ...

    def bulk_stiffness(self, J: Array) -> Array:
        """Stiffness u'' (n,) at J (n,)."""
        ...


def energy(law: Law, F: Array, *, mu: float, lame: float) -> Array:
    """W (n,) kPa at F (n, 3, 3), with Lame's mu and lambda (`lame`) in kPa."""
    return np.asarray(mu * law.shear_energy(F) + lame * law.bulk_energy(law.volume(F)))


def stress(law: Law, F: Array, *, mu: float, lame: float) -> Array:
    """First Piola-Kirchhoff stress P = dW/dF (n, 3, 3) kPa at F (n, 3, 3), with Lame's mu and lambda in kPa."""
    pressure = lame * law.bulk_pressure(law.volume(F))
    return np.asarray(mu * law.shear_stress(F) + pressure[:, None, None] * law.volume_gradient(F))


def tangent(law: Law, F: Array, *, mu: float, lame: float) -> Array:
    """A_ijkl = dP_ij/dF_kl (n, 3, 3, 3, 3) kPa at F (n, 3, 3), with Lame's mu and lambda in kPa."""
    volume, gradient = law.volume(F), law.volume_gradient(F)
    pressure, stiffness = lame * law.bulk_pressure(volume), lame * law.bulk_stiffness(volume)
    dyads = np.einsum("n,nij,nkl->nijkl", stiffness, gradient, gradient)
    curved = pressure[:, None, None, None, None] * law.volume_curvature(F)
    return np.asarray(mu * law.shear_tangent(F) + curved + dyads)
