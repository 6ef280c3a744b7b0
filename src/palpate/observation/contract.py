"""What a data term of a later state owes the inversion: residuals with their derivatives, noise, fit.

What only some kinds have is a capability, a protocol of its own, which the layers above ask for: to choose anew what
belongs together (`Rematched`), to be shown by a segmented image (`Imaged`), to be drawn as arrows (`OfPoints`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, Self, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.findings import Finding
from palpate.images.alignment import RigidMotion
from palpate.images.distance import NearMaps
from palpate.images.segmentation import Segmentation
from palpate.mesh.space import LagrangeSpace
from palpate.observation.noise_model import FitResponse, NoiseModel
from palpate.observation.robust_loss import RobustLoss

Float = TypeVar("Float", np.float32, np.float64)


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

    values (n,) mm, or the observation's unit; weights (n,), dimensionless, their sum 1; places (n, 3) mm in the
    deformed body and normals (n, 3): where each was taken and along which direction; material (n, 3) mm: the same
    places at rest.
    jacobian (n, n_seen): d values / d displacement of what the observation sees, without what only image noise makes of
    it. distances (m,) mm: of what is compared, where the residuals are not these themselves. direct (n, n_regions +
    n_material): their derivatives by ln E and the material's coefficients at a held displacement, where they have any.
    shares (n,): weights by area alone, where the noise model changes them.
    """

    values: NDArray[np.float64]
    weights: NDArray[np.float64]
    places: NDArray[np.float64]
    normals: NDArray[np.float64]
    material: NDArray[np.float64]
    jacobian: sparse.csr_matrix[np.float64]
    distances: NDArray[np.float64] | None = None
    direct: NDArray[np.float64] | None = None
    shares: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True)
class Weighting:
    """How residuals count: n sum_j w_j (rho(r_j) / (2 s^2) + ln Z(s)), minus the logarithm of their density.

    precision: n / s^2 (mm^-2) with the scale s; rho, Z: of the `loss`; count: n, the number of independent residuals.
    """

    precision: float
    loss: RobustLoss
    count: float = 1.0

    @property
    def sd(self) -> float:
        """The scale s, mm."""
        return float(np.sqrt(self.count / self.precision))

    @property
    def log_normaliser(self) -> float:
        """N ln Z(s)."""
        return self.count * self.loss.log_normaliser(self.sd)


@dataclass(frozen=True, slots=True)
class Fit:
    """Distance of the model to the image (mm): mean, root mean square, 95th percentile; Dice's overlap, or None."""

    mean_mm: float
    rms_mm: float
    hd95_mm: float
    dice: float | None


class Observation(Protocol):
    """One thing that was measured of a later state, with how much it counts; an immutable value.

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
    def unit(self) -> str:
        """Unit of its residuals: "mm", or that of another output of the model."""
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
        """Residuals at displacements (n_seen,) mm of what it sees; their derivative by the `offset` is 1 each.

        These are those of its unknowns, or what it makes of them (`Interpolated`).

        offset: by how much the image shows more than what is there, in the residuals' unit: how much further out a
        surface is drawn.
        """
        ...

    def with_noise(self, noise: NoiseModel) -> Self:
        """The same with all its residuals counting by a noise model."""
        ...

    @property
    def sd_bounds(self) -> tuple[float, float]:
        """Between which the scale of its residuals is sought; equal where that is known."""
        ...

    def with_sd(self, sd: float) -> Self:
        """The same with another scale of its residuals, and outliers by that."""
        ...

    def with_correlation(self, noise: NoiseModel) -> Self:
        """The same, its number of independent residuals by a noise model, the scale kept."""
        ...

    def weighed(self, residuals: Residuals) -> Residuals:
        """The same residuals with the weights that they have under the noise model."""
        ...

    def first_noise(self, peers: Sequence[Self]) -> NoiseModel:
        """Noise of the kind's observations in one later image, itself among its `peers`, before residuals tell."""
        ...

    def fitted_noise(self, residuals: Sequence[Residuals], response: FitResponse | None = None) -> NoiseModel:
        """Noise that the residuals of the kind's observations in one later image tell.

        response: of the fit that left them, where what it took of the errors is to be told, too.
        """
        ...

    def fit(self, residuals: Residuals) -> Fit:
        """How well the model fits, by its residuals; without Dice's overlap."""
        ...


@runtime_checkable
class Interpolated(Protocol):
    """An observation of the displacement between nodes, which has fewer points than the elements round them nodes."""

    @property
    def interpolation(self) -> sparse.csr_matrix[np.float64]:
        """What it sees of the displacements of its unknowns (n_seen, n_dofs), dimensionless."""
        ...


def seen_by(observation: Observation, displacement: NDArray[Float]) -> NDArray[Float]:
    """What an observation sees (n_seen,) or (n_seen, k) of displacements (n_dof,) or (n_dof, k) mm of all points."""
    own = displacement[observation.dofs]
    if not isinstance(observation, Interpolated):
        return own
    return np.asarray(observation.interpolation.astype(own.dtype, copy=False) @ own)


def n_seen(observation: Observation) -> int:
    """Number of displacements that an observation sees."""
    return int(observation.interpolation.shape[0] if isinstance(observation, Interpolated) else len(observation.dofs))


@runtime_checkable
class Rematched(Protocol):
    """An observation that compares what belongs together, and must find it again as the model moves."""

    def rematched(self, displacement: NDArray[np.float64], offset: float = 0.0) -> Self:
        """The same with what belongs together chosen anew at displacements (n_dofs,) mm and an offset.

        Raises `EstimationError` when nothing is left to compare.
        """
        ...


@runtime_checkable
class OfMaterial(Protocol):
    """An observation that depends on the moduli directly, not through the displacement alone, as a force does."""

    def with_material(self, moduli: NDArray[np.float64], material: NDArray[np.float64]) -> Self:
        """The same at moduli (n_regions,) kPa and coefficients (n_material,) of the material modes."""
        ...

    def combined(self, fields: NDArray[np.float64]) -> Self:
        """The same where the unknowns are combinations (n_fields, k) of the material's fields."""
        ...

    def by_poisson(self, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives (n, n_regions) of its residuals by the regions' Poisson's ratios at displacements (n_dofs,) mm.

        At the moduli and coefficients that it is `under`.
        """
        ...


@runtime_checkable
class OfInstrument(Protocol):
    """An observation whose instrument may be off by one unknown amount, as a load cell is."""

    @property
    def offset_sd(self) -> float:
        """Standard deviation of that amount, in the residuals' unit; 0: it is known to be none."""
        ...

    @property
    def measured(self) -> float:
        """What it showed, in the same unit."""
        ...


@dataclass(frozen=True, slots=True)
class PointMotions:
    """How points of the body move, which lie at `rest` (n, 3) RAS mm: `observed` and `fitted` displacements (n, 3) mm.

    over_errors (n, 3, 3), 1/mm: what makes the components of a point's stated error independent, of variance 1; labels
    (n,): what the points are called; () where they have no names.
    """

    rest: NDArray[np.float64]
    observed: NDArray[np.float64]
    fitted: NDArray[np.float64]
    over_errors: NDArray[np.float64]
    labels: tuple[str, ...] = ()


@runtime_checkable
class OfPoints(Protocol):
    """An observation of single points of the body, whose motion can be drawn beside the model's."""

    def point_motions(self, displacement: NDArray[np.float64]) -> PointMotions:
        """The points that are compared, with the model's motion at displacements (n_dofs,) mm of what it sees."""
        ...


class Reaction(Protocol):
    """The force that holds a surface of a model, along one direction; N."""

    @property
    def dofs(self) -> NDArray[np.int64]:
        """Numbers (n,) of the displacement's unknowns on which it depends."""
        ...

    @property
    def centre(self) -> NDArray[np.float64]:
        """Middle (3,) mm of the surface."""
        ...

    def combined(self, fields: NDArray[np.float64]) -> Self:
        """The same by combinations (n_fields, k) of the material's fields."""
        ...

    def at(
        self, displacement: NDArray[np.float64], moduli: NDArray[np.float64], coefficients: NDArray[np.float64]
    ) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
        """Force, its derivatives by u (n,) and by ln E and the material (n_regions + n_material,).

        At displacements (n,) mm, moduli (n_regions,) kPa and coefficients (n_material,).
        """
        ...

    def by_poisson(
        self, displacement: NDArray[np.float64], moduli: NDArray[np.float64], coefficients: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Its derivatives (n_regions,) by the regions' Poisson's ratios, at the same."""
        ...


ReactionOf = Callable[[str, NDArray[np.float64]], Reaction]
"""That on a named surface along a direction (3,)."""


@runtime_checkable
class Imaged(Protocol):
    """An observation of a tissue that segmented images show: it errs as voxels do, and as the tissue is drawn."""

    @property
    def tissue(self) -> int:
        """Index of the tissue whose voxels it is made of."""
        ...

    @property
    def stated_noise(self) -> NoiseModel | None:
        """The noise of the images' drawing that a case states; None where the residuals are to tell."""
        ...

    def imaging_error(self, residuals: Residuals, before: NearMaps, after: NearMaps) -> NDArray[np.float64]:
        """Errors (n,) mm of the residuals when the model itself is imaged: `before` at rest, `after` deformed."""
        ...

    def growth_error(self, residuals: Residuals, tissue: str, peers: Sequence[Observation]) -> NDArray[np.float64]:
        """Change (n,) of the residuals, dimensionless, for each mm that `tissue` reaches further in the later image.

        Along its normals, and into its neighbours; `peers`: all observations of the later image, itself among them.
        """
        ...


@dataclass(frozen=True, slots=True)
class DataFile:
    """What a case says of a file of measurements beside the images: [[data]]; name: what its term is called.

    state: number of the later state, from 1; sd_mm: standard deviation of each component's errors; covariance_mm2 (3,
    3): of a point's error instead; correlation_mm: length over which errors of a field are alike, exp(-d / length);
    subset_mm: edges along x, y and z of the box whose motion each displacement of a field is; None where the file is to
    tell. frame: which field of a file of several, from 1; axes: of the vectors of a field, "LPS" or "RAS", "" where its
    file is to tell; force_n on a surface along a direction, with its standard deviation and that of the load cell's
    offset, N.
    """

    kind: str
    name: str
    paths: tuple[Path, ...]
    state: int
    sd_mm: float | None = None
    covariance_mm2: NDArray[np.float64] | None = None
    correlation_mm: float | None = None
    subset_mm: tuple[float, float, float] | None = None
    frame: int | None = None
    axes: str = ""
    surface: str = ""
    force_n: float = 0.0
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    sd_n: float = 1.0
    offset_sd_n: float = 0.0


class DataSource(Protocol):
    """Measurements as they were read, before there is a mesh; an immutable value. One file a kind, see `sources`."""

    @property
    def file(self) -> DataFile:
        """What the case says of it."""
        ...

    @property
    def digests(self) -> tuple[str, ...]:
        """SHA-256 (hexadecimal) of each file that was read."""
        ...

    @property
    def in_words(self) -> str:
        """What was read, as a line of `check` says it: "30 pairs of points, moved by 4.1 mm (rms)"."""
        ...

    def brought(self, motion: RigidMotion) -> Self:
        """The same with the later state moved back by the rigid motion that its alignment found."""
        ...

    def against(self, before: Segmentation, after: Segmentation) -> None:
        """Raise `InputDataError` where the images say that it is another's, or was written otherwise than stated."""
        ...

    def on(self, space: LagrangeSpace, reaction_of: ReactionOf) -> tuple[Observation, tuple[Finding, ...]]:
        """The data term on a meshed body, and what the user should know of it; raises `InputDataError`.

        reaction_of: the forces that hold its surfaces.
        """
        ...
