"""What an observation of a later state owes the inversion: residuals with their derivatives, noise, fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.images.segmentation import Segmentation
from palpate.mesh.space import LagrangeSpace
from palpate.observation.noise_model import FitResponse, NoiseModel
from palpate.observation.robust_loss import RobustLoss

__all__ = ["Fit", "ImagedBody", "Observation", "Residuals", "Weighting"]


@dataclass(frozen=True, slots=True)
class ImagedBody:
    """A meshed body with its image at rest and the later ones, all that observations are made of.

    smoothing_mm: width of every distance map that is compared; stated_noise: that of the case, None where the residuals
    are to tell.
    """

    space: LagrangeSpace
    before: Segmentation
    after: tuple[Segmentation, ...]
    smoothing_mm: float
    stated_noise: NoiseModel | None = None


@dataclass(frozen=True, slots=True)
class Residuals:
    """Residuals of one observation at one displacement.

    values (n,) mm; weights (n,), dimensionless, their sum 1; places (n, 3) mm in the deformed body and normals (n, 3):
    where each was taken and along which direction; material (n, 3) mm: the same places at rest. jacobian (n, n_dofs):
    the exact d values / d displacement of the unknowns that the observation sees. smooth_jacobian: the same without
    what only image noise makes of it (that of the exact one where there is no such thing).
    """

    values: NDArray[np.float64]
    weights: NDArray[np.float64]
    places: NDArray[np.float64]
    normals: NDArray[np.float64]
    material: NDArray[np.float64]
    jacobian: sparse.csr_matrix[np.float64]
    smooth_jacobian: sparse.csr_matrix[np.float64]


@dataclass(frozen=True, slots=True)
class Weighting:
    """How residuals count in the objective: 1/2 precision sum_j w_j rho(r_j), `precision` in mm^-2, rho the `loss`."""

    precision: float
    loss: RobustLoss


@dataclass(frozen=True, slots=True)
class Fit:
    """Distance of the model to the image (mm): mean, root mean square, 95th percentile; Dice's overlap, or None."""

    mean_mm: float
    rms_mm: float
    hd95_mm: float
    dice: float | None


class Observation(Protocol):
    """One thing that the images of a later state show, with how much it counts; an immutable value.

    Observations of one `kind` share a noise model. A new kind is a file with a class that has these members; the tests
    of the contract find it by itself.
    """

    @property
    def kind(self) -> str:
        """What is compared, in words that a report can print: "surface distance"."""
        ...

    @property
    def description(self) -> str:
        """What the misfit of the kind is, as an object of a methods section's sentence: "the distance between ..."."""
        ...

    @property
    def name(self) -> str:
        """Name of what is seen, the tissue's for a surface."""
        ...

    @property
    def dofs(self) -> NDArray[np.int64]:
        """Numbers (n_dofs,) of the displacement's unknowns that it sees, 3 point + axis."""
        ...

    @property
    def of_driver(self) -> bool:
        """Whether it shows a wall whose motion is prescribed: its residuals then tell nothing of the noise."""
        ...

    @property
    def observed_share(self) -> float:
        """Share, 0 to 1, of what could be seen that is compared."""
        ...

    @property
    def weighting(self) -> Weighting:
        """How its residuals count."""
        ...

    @property
    def noise_model(self) -> NoiseModel:
        """The noise by which they count."""
        ...

    def residuals(self, displacement: NDArray[np.float64], offset: float = 0.0) -> Residuals:
        """Residuals at displacements (n_dofs,) mm of what it sees; their derivative by the `offset` is 1 each.

        offset: by how much the image shows more than what is there, in the residuals' unit: how much further out a
        surface is drawn.
        """
        ...

    def rematched(self, displacement: NDArray[np.float64], offset: float = 0.0) -> Self:
        """The same with what belongs together chosen anew at displacements (n_dofs,) mm and an offset.

        Raises `EstimationError` when nothing is left to compare.
        """
        ...

    def with_noise(self, noise: NoiseModel) -> Self:
        """The same with all its residuals counting by a noise model."""
        ...

    def reweighted(self, residuals: Residuals, beyond_modes: NDArray[np.float64] | None = None) -> Self:
        """The same with a robust loss that its residuals tell, under its noise model.

        beyond_modes (n,) mm: of a driver's residuals what no motion of its modes takes away; None: all of them.
        """
        ...

    def first_noise(self, peers: Sequence[Self]) -> NoiseModel:
        """Noise of the kind's observations in one later image, itself among its `peers`, before residuals tell."""
        ...

    def fitted_noise(self, residuals: Sequence[Residuals], response: FitResponse | None = None) -> NoiseModel:
        """Noise that the residuals of the kind's observations in one later image tell.

        response: of the fit that left them, where what it took of the errors is to be told, too.
        """
        ...

    def imaging_error(self, residuals: Residuals, before: Segmentation, after: Segmentation) -> NDArray[np.float64]:
        """Errors (n,) mm of the residuals when the model itself is imaged: `before` at rest, `after` deformed."""
        ...

    def growth_error(self, residuals: Residuals, tissue: str, peers: Sequence[Observation]) -> NDArray[np.float64]:
        """Change (n,) of the residuals, dimensionless, for each mm that `tissue` reaches further in the later image.

        Along its normals, and into its neighbours; `peers`: all observations of the later image, itself among them.
        """
        ...

    def fit(self, residuals: Residuals, modelled: NDArray[np.int16], image: NDArray[np.int16]) -> Fit:
        """How well the model fits: by residuals, and by tissue indices (nx, ny, nz) of model and image on one grid."""
        ...
