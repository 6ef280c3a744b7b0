"""A measured force on a named surface: an `Observation` that tells kilopascals by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import ConfigurationError
from palpate.findings import Finding
from palpate.images.alignment import RigidMotion
from palpate.images.segmentation import Segmentation
from palpate.mesh.space import LagrangeSpace
from palpate.observation.contract import DataFile, Fit, Reaction, ReactionOf, Residuals, Weighting
from palpate.observation.noise_model import FitResponse, NoiseModel
from palpate.observation.robust_loss import FAR, PowerLaw

ALONE = 1e-3  # mm: no other residual is alike


@dataclass(frozen=True, slots=True)
class Force:
    """Residual r = F(u; E) + b - f of a force f (N) on a surface, b the load cell's offset; an `Observation`.

    at: moduli (n_regions,) kPa and coefficients (n_material,) of the material under which it is asked, None: none yet.
    """

    name: str
    reaction: Reaction
    direction: NDArray[np.float64]
    measured: float
    stated: NoiseModel
    noise_model: NoiseModel
    weighting: Weighting
    offset_sd: float = 0.0
    at: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    @property
    def kind(self) -> str:
        """Each force has an error of its own."""
        return self.name

    @property
    def description(self) -> str:
        """What the misfit is, for a methods section."""
        return "the difference between the force that holds a surface of the model and the measured one"

    @property
    def unit(self) -> str:
        """Newton."""
        return "N"

    @property
    def dofs(self) -> NDArray[np.int64]:
        """Numbers (n_dofs,) of the unknowns of the elements at the surface."""
        return self.reaction.dofs

    @property
    def of_driver(self) -> bool:
        """It shows no wall."""
        return False

    @property
    def observed_share(self) -> float:
        """The whole force."""
        return 1.0

    def under(self, moduli: NDArray[np.float64], material: NDArray[np.float64]) -> Force:
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
            raise ConfigurationError(f"the {self.name} depends on the moduli: ask for its residuals `under` some")
        return self.at

    def with_noise(self, noise: NoiseModel) -> Force:
        """The same, counting by the variance of the noise."""
        return replace(self, noise_model=noise, weighting=Weighting(1.0 / noise.sd**2, PowerLaw()))

    @property
    def sd_bounds(self) -> tuple[float, float]:
        """What is stated: there is no second force that would tell more."""
        return self.stated.sd, self.stated.sd

    def with_sd(self, sd: float) -> Force:
        """The same; a force that all else contradicts counts less, the further off it is."""
        return replace(self, weighting=Weighting(1.0 / sd**2, PowerLaw(FAR * sd)))

    def with_correlation(self, noise: NoiseModel) -> Force:
        """The same noise: it is one residual."""
        return replace(self, noise_model=noise)

    def weighed(self, residuals: Residuals) -> Residuals:
        """The same: it is one residual."""
        return residuals

    def first_noise(self, peers: Sequence[Force]) -> NoiseModel:
        """What is stated."""
        del peers
        return self.stated

    def fitted_noise(self, residuals: Sequence[Residuals], response: FitResponse | None = None) -> NoiseModel:
        """What is stated."""
        del residuals, response
        return self.stated

    def fit(self, residuals: Residuals) -> Fit:
        """How far the model's force is off, N."""
        off = float(np.abs(residuals.values[0]))
        return Fit(off, off, off, None)


@dataclass(frozen=True, slots=True)
class ForceMeasurement:
    """A force as a case states it; implements `DataSource`."""

    file: DataFile

    @property
    def digests(self) -> tuple[str, ...]:
        """There is no file."""
        return ()

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
        stated = NoiseModel(np.array([file.sd_n**2]), np.array([ALONE]))
        reaction = reaction_of(file.surface, direction)
        term = Force(
            file.name,
            reaction,
            direction / np.linalg.norm(direction),
            file.force_n,
            stated,
            stated,
            Weighting(1.0 / file.sd_n**2, PowerLaw()),
            offset_sd=file.offset_sd_n,
        )
        return term, ()


def read_force(file: DataFile) -> ForceMeasurement:
    """The force that a case states."""
    return ForceMeasurement(file)
