"""What every model of dense blocks answers in the same way: some outputs, at no cost of the mesh's size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError
from palpate.mechanics.forward import SolveCounts

__all__ = ["DenseEquilibrium"]


class DenseEquilibrium:
    """The part of `Equilibrium` that follows from the outputs `values` (n_outputs,) mm alone."""

    __slots__ = ()
    values: NDArray[np.float64]

    @property
    def displacement(self) -> NDArray[np.float64]:
        """Displacement u (n_outputs / 3, 3) mm; raises `ConfigurationError` when the outputs are not whole points."""
        if len(self.values) % 3:
            raise ConfigurationError(f"the model has {len(self.values)} outputs, not three a point: use `values`")
        return self.values.reshape(-1, 3)

    @property
    def counts(self) -> SolveCounts:
        """Nothing of the size of the mesh was solved."""
        return SolveCounts()

    @property
    def tangent_counts(self) -> SolveCounts:
        """Nothing of the size of the mesh is solved."""
        return SolveCounts()

    @property
    def adjoint_counts(self) -> SolveCounts:
        """Nothing of the size of the mesh is solved."""
        return SolveCounts()
