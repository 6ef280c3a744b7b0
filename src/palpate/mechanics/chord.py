"""Equilibria of several states of a body side by side, by iterations with one factorisation for all of them.

Newton's method takes the stiffness of every place; here one nearby stiffness is kept (the chord method), and Anderson's
acceleration makes up for what it lacks (Walker & Ni, SIAM J. Numer. Anal. 49 (2011) 1715). A correction costs the
forces of each state, and one solution for all of them together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.balance import TissueBalance
from palpate.mechanics.solvers.contract import Factorisation
from palpate.parallel import mapped

Array = NDArray[np.float64]

MEMORY = 5  # earlier corrections that count
DEPENDENT = 1e-6  # relative size of corrections that count as dependent
NEARLY = 0.1  # relative residual of a correction


@dataclass(frozen=True, slots=True)
class _State:
    """A state on its way: displacement (n_dof,) mm, forces out of balance (n_free,) mN, their share of the internal.

    before: free displacements (n_free,) mm of the last iterations, and the corrections (n_free,) mm from each.
    """

    balance: TissueBalance
    displacement: Array
    unbalanced: Array
    share: float
    before: tuple[tuple[Array, Array], ...] = ()

    @classmethod
    def at(cls, balance: TissueBalance, displacement: Array) -> _State:
        """The state at a displacement (n_dof,) mm."""
        forces, size = balance.residual(displacement)
        unbalanced = np.asarray(balance.free.T @ forces)
        share = float(np.linalg.norm(unbalanced)) / max(size, float(np.finfo(float).tiny))
        return cls(balance, displacement, unbalanced, share if np.isfinite(share) else np.inf)

    def corrected(self, change: Array) -> _State:
        """The state after the `change` (n_free,) mm that its forces ask for, and what the last ones made of theirs."""
        free = np.asarray(self.balance.free.T @ self.displacement)
        before, step = (*self.before[-MEMORY:], (free, change)), change
        if len(before) > 1:
            places, changes = (np.diff(np.stack(each, axis=1), axis=1) for each in zip(*before, strict=True))
            shares = np.linalg.lstsq(changes, change, rcond=DEPENDENT)[0]
            step = change - (places + changes) @ shares
        return replace(_State.at(self.balance, self.displacement + self.balance.free @ step), before=before)


def chord_equilibria(
    balances: Sequence[TissueBalance],
    starts: Sequence[Array],
    factorisation: Factorisation,
    *,
    tolerance: float,
    iterations: int,
) -> list[Array | None]:
    """Displacements (n_dof,) mm of states near their `starts`, prescribed ones as there; None where there is no end.

    factorisation: of a stiffness like those of all; tolerance: of the forces out of balance, as a share of the internal
    ones. Never raises for lack of convergence.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        states = mapped(lambda of: _State.at(*of), zip(balances, starts, strict=True))
        for _ in range(iterations):
            left = [i for i, state in enumerate(states) if tolerance < state.share < np.inf]
            if not left:
                break
            loads = -np.stack([states[i].unbalanced for i in left], axis=1)
            changes = factorisation.solve(loads, tolerance=NEARLY).T
            moved = mapped(lambda of: states[of[0]].corrected(of[1]), zip(left, changes, strict=True))
            for i, state in zip(left, moved, strict=True):
                states[i] = state
        return [state.displacement if _balanced(state, tolerance) else None for state in states]


def _balanced(state: _State, tolerance: float) -> bool:
    """Whether a state is in equilibrium with no element inside out."""
    return state.share <= tolerance and state.balance.smallest_volume(state.displacement) > 0.0
