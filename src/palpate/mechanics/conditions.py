"""What acts on a body in one of its states: which displacements are prescribed, and the loads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError
from palpate.mechanics.loads import Load
from palpate.mesh.constraint import Constraint
from palpate.mesh.space import LagrangeSpace


@dataclass(frozen=True, slots=True)
class Conditions:
    """Admissible displacements of one state, and the loads that act in it.

    Models of several states of a body differ in nothing else, and share what it costs to make them.
    """

    constraint: Constraint
    loads: tuple[Load, ...] = ()

    def forces(self, space: LagrangeSpace) -> NDArray[np.float64]:
        """Nodal forces (n_dof,) mN of all loads on the body at rest."""
        still = np.zeros_like(space.points)
        return sum((load.forces(still) for load in self.loads), np.zeros(still.size))

    def require_space(self, space: LagrangeSpace) -> None:
        """Raise `ConfigurationError` unless the constraint is of the space."""
        given, n_dof = self.constraint, 3 * len(space.points)
        if given.free.shape[0] != n_dof or len(given.modes) != n_dof or len(given.offset) != n_dof:
            raise ConfigurationError(
                f"the constraint has {given.free.shape[0]} unknowns and the space {n_dof}: make both of the same space"
            )

    def require_same_free(self, other: Constraint) -> None:
        """Raise `ConfigurationError` unless the same displacements are free as under another constraint."""
        free, theirs = self.constraint.free, other.free
        if free is not theirs and (free.shape != theirs.shape or abs(free - theirs).max() > 0.0):
            raise ConfigurationError(
                f"the conditions free other displacements ({free.shape[1]}) than the model ({theirs.shape[1]}): make a"
                " model of its own for them, with `linear_model` or `finite_strain_model`"
            )
