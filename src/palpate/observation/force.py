"""A measured force on a named surface: an `Observation` that tells kilopascals by itself."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import ConfigurationError
from palpate.findings import Finding
from palpate.images.alignment import RigidMotion
from palpate.images.segmentation import Segmentation
from palpate.mesh.space import LagrangeSpace
from palpate.observation.contract import DataFile, Reaction, ReactionOf, Residuals
from palpate.observation.stated_noise import StatedNoise, stated_noise


@dataclass(frozen=True, slots=True)
class Force(StatedNoise):
    """Residual r = F(u; E) + b - f of a force f (N) on a surface, b the load cell's offset; an `Observation`.

    at: moduli (n_regions,) kPa and coefficients (n_material,) of the material under which it is asked, None: none yet.
    """

    reaction: Reaction
    direction: NDArray[np.float64]
    measured: float
    offset_sd: float = 0.0
    at: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    description = "the difference between the force that holds a surface of the model and the measured one"
    unit = "N"

    @property
    def dofs(self) -> NDArray[np.int64]:
        """Numbers (n_dofs,) of the unknowns of the elements at the surface."""
        return self.reaction.dofs

    def with_material(self, moduli: NDArray[np.float64], material: NDArray[np.float64]) -> Force:
        """The same at moduli (n_regions,) kPa and coefficients (n_material,) of the material."""
        return replace(self, at=(moduli, material))

    def combined(self, fields: NDArray[np.float64]) -> Force:
        """The same by combinations (n_fields, k) of the material's fields."""
        return replace(self, reaction=self.reaction.combined(fields))

    def residuals(self, displacement: NDArray[np.float64], offset: float = 0.0) -> Residuals:
        """The residual (1,) N at displacements (n_dofs,) mm and an offset (N) of the load cell, with its derivatives.

        Raises `ConfigurationError` before moduli are known, see `under`.
        """
        value, by_displacement, direct = self.reaction.at(displacement, *self._known)
        centre, row = self.reaction.centre[None], sparse.csr_matrix(by_displacement[None])
        values = np.array([value + offset - self.measured])
        along = self.direction[None]
        return Residuals(values, np.ones(1), centre, along, centre, row, direct=direct[None])

    def by_poisson(self, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives (1, n_regions) N of the residual by the regions' Poisson's ratios at displacements (n_dofs,) mm.

        Raises as `residuals`.
        """
        return self.reaction.by_poisson(displacement, *self._known)[None]

    @property
    def _known(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        if self.at is None:
            raise ConfigurationError(f"the {self.name} depends on the moduli: use its residuals `under` given moduli")
        return self.at


@dataclass(frozen=True, slots=True)
class ForceMeasurement:
    """A force as a case states it; implements `DataSource`."""

    file: DataFile

    digests = ()  # there is no file

    @property
    def in_words(self) -> str:
        """The force, and where it acts."""
        return f"{self.file.force_n:g} N on '{self.file.surface}' along {list(self.file.direction)}"

    def brought(self, motion: RigidMotion) -> ForceMeasurement:
        """The same with its direction turned back by the rigid motion of the later state."""
        turned = motion.rotation.T @ np.array(self.file.direction)
        return replace(self, file=replace(self.file, direction=(float(turned[0]), float(turned[1]), float(turned[2]))))

    def against(self, before: Segmentation, after: Segmentation) -> None:
        """No image contradicts a force."""

    def on(self, space: LagrangeSpace, reaction_of: ReactionOf) -> tuple[Force, tuple[Finding, ...]]:
        """The term on a meshed body; raises `ConfigurationError` for a surface that it has not."""
        del space
        file, direction = self.file, np.array(self.file.direction)
        reaction, along = reaction_of(file.surface, direction), direction / np.linalg.norm(direction)
        noise = stated_noise(file.sd_n, 1)
        return Force(file.name, *noise, reaction, along, file.force_n, file.offset_sd_n), ()
