"""Forces and stiffness of elements under any law: total Lagrangian, all quadrature points at once.

Energy of an element: V sum_q w_q [mu w(F_q) + lambda_p u(J_q)] + V lambda_m u(J_mean), J_mean = sum_q w_q J_q, with the
parts lambda_p + lambda_m = lambda that `dilatation` says. Forces and stiffness are its exact derivatives (Bonet & Wood,
Nonlinear Continuum Mechanics, 2nd ed. 2008, sections 8.6 and 9.4).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.errors import NotConverged
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.element import quadrature, shape_derivatives
from palpate.mechanics.laws.contract import Law
from palpate.mechanics.stiffness import checked_gradients
from palpate.mesh.space import LagrangeSpace
from palpate.parallel import mapped

Array = NDArray[np.float64]

CHUNK = 2048  # elements together, for a few numbers of each
STIFFNESS_CHUNK = 128  # the same for stiffnesses, which then stay in the cache and take half of the time


@dataclass(frozen=True, slots=True)
class Moduli:
    """Lame's constants of each element, kPa: mu (n_cells,), lambda at the points and in the mean (n_cells,) each."""

    mu: Array
    pointwise: Array
    mean: Array

    def part(self, part: slice) -> Moduli:
        """Those of the elements `part`, (n,) each."""
        return Moduli(self.mu[part], self.pointwise[part], self.mean[part])


@dataclass(frozen=True, slots=True)
class Elements:
    """Elements of one law: cells (n_cells, n_a), shape gradients (n_cells, n_q, n_a, 3) 1/mm, volumes (n_cells,) mm^3.

    weights (n_cells, n_q) of the quadrature points sum to 1 in each element. strained (n_points, 3) mm: how far what is
    described, free of stress, has moved to where displacements are counted from; forces are then what is added to
    those there. None: it has not.
    """

    law: Law
    dilatation: Dilatation
    cells: NDArray[np.int64]
    gradients: Array
    volumes: Array
    weights: Array
    strained: Array | None = None

    def unloaded(self, strained: Array) -> Elements:
        """The same elements, of a body that is free of stress at x - w, w = `strained` (n_points, 3) mm.

        With X = x - w the gradients are dN/dX = dN/dx (I - dw/dx)^-1 and volumes det(I - dw/dx) dV at the quadrature
        points. Raises `NotConverged` where that turns an element inside out.
        """
        change = strained if self.strained is None else strained - self.strained
        nodal = np.swapaxes(change[self.cells], 1, 2)
        slope = np.eye(3) - nodal[:, None] @ self.gradients
        volume = np.linalg.det(slope)
        if volume.min() <= 0.0:
            raise NotConverged(
                f"the state without stress turns {int((volume.min(axis=1) <= 0.0).sum())} elements inside out: the"
                " loads are too large for these moduli"
            )
        weights = self.weights * volume
        total = weights.sum(axis=1)
        gradients = self.gradients @ np.linalg.inv(slope)
        return replace(
            self,
            gradients=gradients,
            volumes=self.volumes * total,
            weights=weights / total[:, None],
            strained=strained,
        )

    def deformation(self, displacement: Array, part: slice = slice(None)) -> Array:
        """F = I + grad (w + u) (n, n_q, 3, 3) of the elements `part`, u (n_points, 3) mm, w = `strained`."""
        moved = displacement if self.strained is None else self.strained + displacement
        nodal = np.swapaxes(moved[self.cells[part]], 1, 2)
        return np.asarray(np.eye(3) + nodal[:, None] @ self.gradients[part])

    def smallest_volume(self, displacement: Array) -> tuple[float, int]:
        """Smallest J at a quadrature point and the number of its element; u (n_points, 3) mm."""
        volume = np.empty(len(self.cells))

        def fill(part: slice) -> None:
            """Those of the elements `part`."""
            F = self.deformation(displacement, part)
            volume[part] = self.law.volume(F.reshape(-1, 3, 3)).reshape(F.shape[:2]).min(axis=1)

        mapped(fill, self._parts(CHUNK))
        worst = int(np.argmin(volume))
        return float(volume[worst]), worst

    def energy(self, displacement: Array, moduli: Moduli) -> float:
        """Stored energy, mN mm, at u (n_points, 3) mm."""
        F = self.deformation(displacement)
        flat, shape = F.reshape(-1, 3, 3), F.shape[:2]
        volume = self.law.volume(flat).reshape(shape)
        density = moduli.mu[:, None] * self.law.shear_energy(flat).reshape(shape)
        density += moduli.pointwise[:, None] * self.law.bulk_energy(volume.ravel()).reshape(shape)
        mean = moduli.mean * self.law.bulk_energy(self._mean(volume))
        return float(self.volumes @ (self._mean(density) + mean))

    def forces(self, displacement: Array, moduli: Moduli) -> Array:
        """Internal forces (n_cells, n_a, 3), mN, of each element at u (n_points, 3) mm: derivatives of its energy.

        Less those at u = 0 where that is a strained state.
        """
        forces = self._forces(displacement, moduli)
        return forces if self.strained is None else forces - self._forces(np.zeros_like(displacement), moduli)

    def _forces(self, displacement: Array, moduli: Moduli) -> Array:
        """Derivatives (n_cells, n_a, 3), mN, of each element's energy at u (n_points, 3) mm."""
        result = np.empty((len(self.cells), self.cells.shape[1], 3))

        def fill(part: slice) -> None:
            """Those of the elements `part`."""
            F = self.deformation(displacement, part)
            flat, (n, n_q) = F.reshape(-1, 3, 3), F.shape[:2]
            pressure = self._pressure(self.law.volume(flat).reshape(n, n_q), moduli.part(part), self.weights[part])
            stress = np.repeat(moduli.mu[part], n_q)[:, None, None] * self.law.shear_stress(flat)
            stress += pressure.reshape(-1, 1, 1) * self.law.volume_gradient(flat)
            weighted = stress.reshape(n, n_q, 3, 3) * (self.volumes[part, None] * self.weights[part])[:, :, None, None]
            result[part] = (self._stacked(part) @ np.swapaxes(weighted, 2, 3).reshape(n, -1, 3)).reshape(n, -1, 3)

        mapped(fill, self._parts(CHUNK))
        return result

    def pressure_ahead(self, displacement: Array, change: Array, moduli: Moduli) -> Array:
        """Mean pressures lambda_m (u' + u'' dJ_mean) (n_cells,) kPa, with dJ_mean linear in du (n_points, 3) mm."""
        pressure = np.empty(len(self.cells))

        def fill(part: slice) -> None:
            """Those of the elements `part`."""
            F, weights = self.deformation(displacement, part), self.weights[part]
            flat, shape = F.reshape(-1, 3, 3), F.shape[:2]
            mean = (self.law.volume(flat).reshape(shape) * weights).sum(axis=1)
            slope = np.swapaxes(change[self.cells[part]], 1, 2)[:, None] @ self.gradients[part]
            growth = (self.law.volume_gradient(flat) * slope.reshape(-1, 3, 3)).reshape(*shape, 9).sum(axis=2)
            ahead = self.law.bulk_stiffness(mean) * (growth * weights).sum(axis=1)
            pressure[part] = moduli.mean[part] * (self.law.bulk_pressure(mean) + ahead)

        mapped(fill, self._parts(CHUNK))
        return pressure

    def stiffness(self, displacement: Array, moduli: Moduli, *, pressure: Array | None = None) -> Array:
        """Derivatives of the forces at u (n_points, 3): blocks (n_cells * n_a * n_a, 9), mN/mm, of pairs of points.

        pressure (n_cells,) kPa takes the place of the mean pressures at u.
        """
        n_a = self.cells.shape[1]
        result = np.empty((len(self.cells), n_a, n_a, 3, 3))

        def fill(part: slice) -> None:
            """Those of the elements `part`."""
            F, own, weights = self.deformation(displacement, part), moduli.part(part), self.weights[part]
            flat, (n, n_q) = F.reshape(-1, 3, 3), F.shape[:2]
            volume, gradient = self.law.volume(flat).reshape(n, n_q), self.law.volume_gradient(flat)
            foreseen = self._pressure(volume, own, weights, None if pressure is None else pressure[part])
            tangent = self._tangent(flat, gradient, own, volume, foreseen)
            tangent *= (self.volumes[part, None] * weights).reshape(-1, 1)
            stacked = self._stacked(part)
            by_second = tangent.reshape(n, n_q, 3, 3, 3, 3).transpose(0, 1, 3, 2, 4, 5).reshape(n, n_q, 27, 3)
            half = (by_second @ np.swapaxes(self.gradients[part], 2, 3)).reshape(n, n_q * 3, 9 * n_a)
            if np.any(own.mean):  # dJ_mean/du_ai times what stiffens dJ_mean/du_bk: three further rows, i by i
                weighted = gradient.reshape(n, n_q, 3, 3) * weights[:, :, None, None]
                slope = stacked @ np.swapaxes(weighted, 2, 3).reshape(n, -1, 3)
                size = self.volumes[part] * own.mean * self.law.bulk_stiffness((volume * weights).sum(axis=1))
                rows = np.eye(3)[:, :, None, None] * (size[:, None, None] * np.swapaxes(slope, 1, 2))[:, None, None]
                stacked = np.concatenate([stacked, slope], axis=2)
                half = np.concatenate([half, rows.reshape(n, 3, 9 * n_a)], axis=1)
            blocks = stacked @ half
            result[part] = blocks.reshape(n, n_a, 3, 3, n_a).transpose(0, 1, 4, 2, 3)

        mapped(fill, self._parts(STIFFNESS_CHUNK))
        return result.reshape(-1, 9)

    def _parts(self, size: int) -> Iterator[slice]:
        return (slice(start, start + size) for start in range(0, len(self.cells), size))

    def _stacked(self, part: slice) -> Array:
        """Shape gradients (n, n_a, n_q * 3), quadrature points side by side."""
        gradients = np.swapaxes(self.gradients[part], 1, 2)
        return np.ascontiguousarray(gradients).reshape(len(gradients), gradients.shape[1], -1)

    def _mean(self, values: Array) -> Array:
        """Means (n_cells,) over each element of values (n_cells, n_q) at its quadrature points."""
        return np.asarray((values * self.weights).sum(axis=1))

    def _pressure(self, volume: Array, moduli: Moduli, weights: Array, foreseen: Array | None = None) -> Array:
        """dW/dJ (n, n_q) kPa at J (n, n_q), or with other mean pressures (n,)."""
        mean = moduli.mean * self.law.bulk_pressure((volume * weights).sum(axis=1)) if foreseen is None else foreseen
        if not np.any(moduli.pointwise):
            return np.broadcast_to(mean[:, None], volume.shape)
        points = self.law.bulk_pressure(volume.ravel()).reshape(volume.shape)
        return np.asarray(moduli.pointwise[:, None] * points + mean[:, None])

    def _tangent(self, flat: Array, gradient: Array, moduli: Moduli, volume: Array, pressure: Array) -> Array:
        """dP/dF (n * n_q, 81) kPa but for the part of the mean volume."""
        n_q = volume.shape[1]
        tangent = np.repeat(moduli.mu, n_q)[:, None] * self.law.shear_tangent(flat).reshape(-1, 81)
        tangent += pressure.reshape(-1, 1) * self.law.volume_curvature(flat).reshape(-1, 81)
        if np.any(moduli.pointwise):
            stiffness = np.repeat(moduli.pointwise, n_q) * self.law.bulk_stiffness(volume.ravel())
            rows = gradient.reshape(-1, 9)
            tangent += ((stiffness[:, None] * rows)[:, :, None] * rows[:, None, :]).reshape(-1, 81)
        return np.asarray(tangent)


def elements_of(space: LagrangeSpace, law: Law, dilatation: Dilatation) -> Elements:
    """All elements of `space` under one law; raises `GeometryError` where a tetrahedron has no positive volume."""
    points, weights = quadrature(2 if space.order == 2 else 1)
    gradients, volumes = checked_gradients(space, np.ones(len(space.cells), dtype=np.bool_))
    derivatives = shape_derivatives(space.order, points)
    return Elements(
        law, dilatation, space.cells, derivatives @ gradients[:, None], volumes, np.tile(weights, (len(volumes), 1))
    )
