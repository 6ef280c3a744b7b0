"""Which displacements are free, which follow unknown modes, which are given."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse


@dataclass(frozen=True, slots=True)
class Constraint:
    """Admissible displacements u = free z + modes q + offset of a Lagrange space with n_dof = 3 n_points unknowns.

    The unknown of point p along axis a has the number 3 p + a. free (n_dof, n_free) sparse with orthonormal columns,
    dimensionless; modes (n_dof, n_modes) mm per unit of q; offset (n_dof,) mm. Rows of `modes` and `offset` are zero
    where `free` is not (but for a sliding node, which is given along its normal only).
    """

    free: sparse.csr_matrix[np.float64]
    modes: NDArray[np.float64]
    offset: NDArray[np.float64]

    @property
    def n_modes(self) -> int:
        """Number of unknown modes."""
        return int(self.modes.shape[1])
