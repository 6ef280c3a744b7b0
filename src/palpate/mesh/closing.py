"""Gaps and slivers too thin to mesh: closed in the level sets, before anything is cut."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.mesh.anatomy import Anatomy, Box, LevelSet, values_and_gradients

STEEPNESS = 3.0  # how much faster than the gap a closed surface approaches: makes it cross the other, not graze it
PARALLEL, CROSSING = np.cos(np.radians([20.0, 45.0]))  # surfaces at less than 20 degrees are closed, over 45 are not


def closed(anatomy: Anatomy, *, gap_mm: float) -> Anatomy:
    """The anatomy without gaps, between tissues or to the box, and without slivers that are thinner than 3/4 `gap_mm`.

    Only where two surfaces are nearly parallel; in a gap the tissue of lower priority grows, a sliver of it vanishes.
    """
    level_sets = list(anatomy.level_sets)
    winners: list[LevelSet] = [_Outside(anatomy.box)]
    for tissue in anatomy.priority:
        phi = level_sets[tissue]
        if phi is not None:
            level_sets[tissue] = _Closed(phi, tuple(winners), gap_mm)
            winners.append(phi)
    return Anatomy(anatomy.tissues, tuple(level_sets), anatomy.box)


@dataclass(frozen=True, slots=True)
class _Outside:
    """Level set of all that lies outside a box."""

    box: Box

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance (n,) mm to the nearest side at points (n, 3) mm: positive inside the box."""
        local = self.box.local(points)
        return np.asarray(np.minimum(local, self.box.lengths - local).min(axis=1))

    def gradient_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit vectors (n, 3), dimensionless, away from the nearest side at points (n, 3) mm."""
        local = self.box.local(points)
        nearest = np.concatenate([local, self.box.lengths - local], axis=1).argmin(axis=1)
        return np.asarray(np.concatenate([self.box.axes, -self.box.axes])[nearest])


@dataclass(frozen=True, slots=True)
class _Closed:
    """`phi` made lower in thin gaps to its winners, higher in thin slivers along them."""

    phi: LevelSet
    winners: tuple[LevelSet, ...]
    gap_mm: float

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The changed level set (n,) mm at points (n, 3) mm."""
        values = self.phi.at(points)
        near = np.flatnonzero(np.abs(values) < self.gap_mm)
        shift = np.zeros(len(points))
        for winner in self.winners if len(near) else ():
            shift[near] += self._change(winner, points[near], values[near])[0]
        return np.asarray(values + STEEPNESS * shift)

    def gradient_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient (n, 3), dimensionless, of the changed level set at points (n, 3) mm."""
        return self.values_and_gradients(points)[1]

    def values_and_gradients(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The changed level set (n,) mm and its gradient (n, 3), dimensionless, at points (n, 3) mm."""
        values, gradient = values_and_gradients(self.phi, points)
        near = np.flatnonzero(np.abs(values) < self.gap_mm)
        shift, change = np.zeros_like(values), np.zeros_like(gradient)
        for winner in self.winners if len(near) else ():
            by_value, by_gradient = self._change(winner, points[near], values[near], gradient[near])
            shift[near] += by_value
            change[near] += by_gradient
        return np.asarray(values + STEEPNESS * shift), np.asarray(gradient + STEEPNESS * change)

    def _change(
        self,
        winner: LevelSet,
        points: NDArray[np.float64],
        values: NDArray[np.float64],
        gradient: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Change of the level set (n,) and of its gradient (n, 3), per steepness, next to one winner.

        values (n,) mm and, where it is known, gradient (n, 3): of the level set itself at points (n, 3) mm.
        """
        change, slope = np.zeros(len(points)), np.zeros((len(points), 3))
        distance = winner.at(points)
        here = np.flatnonzero(np.abs(distance) < self.gap_mm)
        if not len(here):
            return change, slope
        own = self.phi.gradient_at(points[here]) if gradient is None else gradient[here]
        other = winner.gradient_at(points[here])
        lengths = np.linalg.norm(own, axis=1) * np.linalg.norm(other, axis=1)
        cosine = np.einsum("ni,ni->n", own, other) / np.maximum(lengths, 1e-12)
        weight = np.sign(cosine) * np.clip((np.abs(cosine) - CROSSING) / (PARALLEL - CROSSING), 0.0, 1.0)
        # a gap has opposed gradients and counts positive values, a sliver equal ones and negative values
        reach = np.maximum(-np.sign(cosine) * values[here], 0.0)
        missing = self.gap_mm - np.maximum(distance[here], 0.0) - reach
        weight = np.where(missing > 0.0, weight, 0.0)
        change[here] = weight * missing
        slope[here] = -weight[:, None] * (
            np.where(distance[here] > 0.0, 1.0, 0.0)[:, None] * other - (np.sign(cosine) * (reach > 0.0))[:, None] * own
        )
        return change, slope
