"""All that a report's page needs, as one value that can be kept in a file and drawn again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.images.label_image import VoxelGrid
from palpate.study.archive import MAY_BE_NAN, read_archive, write_archive

MESH = "a mesh"  # the setting "body" of a case without images
MAP_OF = "map of "  # a setting with a tissue's name

FORMAT = "palpate.report-data/4"
MOST_ARROWS = 400  # of one kind of data in a later state: more hide each other
GREY_STEPS = 1023  # from the darkest to the brightest value that a volume keeps


@dataclass(frozen=True, slots=True)
class ReportTissue:
    """A tissue as the page shows it: name, role, colour (#rrggbb), Poisson's ratio, and Young's modulus.

    given_kpa: the modulus that the case gives, kPa; modulus: that of the result, in the result's unit; None: neither.
    """

    name: str
    role: str
    colour: str
    poisson_ratio: float
    given_kpa: float | None
    modulus: float | None


@dataclass(frozen=True, slots=True)
class TriangleSurface:
    """The surface of `tissue` (index): points (n, 3) RAS mm, triangles (m, 3) into them."""

    tissue: int
    points: NDArray[np.float32]
    triangles: NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class ModelSurface:
    """The model's surface of `tissue` (index), earlier and as fitted to one later image.

    rest, fitted (n, 3) RAS mm; triangles (m, 3) into them; distance_rest, distance_fitted (n,) mm: signed distance to
    the later image less that of the rest state to the earlier one, NaN where the surface is not observed; area (n,)
    mm^2: the observed surface around each point.
    """

    tissue: int
    rest: NDArray[np.float32]
    fitted: NDArray[np.float32]
    triangles: NDArray[np.int32]
    distance_rest: NDArray[np.float32] = field(metadata=MAY_BE_NAN)
    distance_fitted: NDArray[np.float32] = field(metadata=MAY_BE_NAN)
    area: NDArray[np.float32]

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Which points (n,) the later image shows."""
        return np.asarray(np.isfinite(self.distance_fitted) & np.isfinite(self.distance_rest))


@dataclass(frozen=True, slots=True)
class Volume:
    """Values (n_x, n_y, n_z) on a grid along the axes of the world; `origin` (3,) mm and `step` (3,) mm of its voxels.

    kind "labels": the tissue's index + 1, 0 outside of the image; kind "grey": steps from 0 to GREY_STEPS, which stand
    for the image's values span[0] to span[1], in `unit`; window: the values that are shown black and white at first.
    """

    kind: str
    values: NDArray[np.uint16]
    origin: NDArray[np.float64]
    step: NDArray[np.float64]
    span: tuple[float, float] = (0.0, 1.0)
    window: tuple[float, float] = (0.0, 1.0)
    unit: str = ""

    @property
    def grid(self) -> VoxelGrid:
        """The place of the voxels in the world."""
        nx, ny, nz = self.values.shape
        affine = np.diag([*self.step, 1.0])
        affine[:3, 3] = self.origin
        return VoxelGrid((nx, ny, nz), affine)

    def shade(self, steps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Brightness, 0 to 1, of a grey volume's steps in its window; arrays of any shape, dimensionless."""
        values = self.span[0] + steps * ((self.span[1] - self.span[0]) / GREY_STEPS)
        return np.asarray(np.clip((values - self.window[0]) / (self.window[1] - self.window[0]), 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class SliceBox:
    """What the slices show: a box `low` to `high` (3,) mm, and where the first three slices lie, `position` (3,) mm."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    position: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Reference:
    """The reference state of a pair of images: what its slices show, its grey values or labels, its surfaces.

    voxel_mm: the largest edge of a voxel in it and its later images; whole: the box of the whole image.
    """

    name: str
    voxel_mm: float
    slices: SliceBox | None = None
    background: Volume | None = None
    surfaces: tuple[TriangleSurface, ...] = ()
    whole: SliceBox | None = None


@dataclass(frozen=True, slots=True)
class BoneDistance:
    """How far the surface of a rigid tissue (index) lies from that of the aligned later image, mm: mean and 95 %."""

    tissue: int
    mean_mm: float
    p95_mm: float


@dataclass(frozen=True, slots=True)
class LaterImage:
    """One later image: its name, its surfaces, the model fitted to it, its grey values or labels.

    reference: number of its reference state; outlines: the reference state's surfaces of what moves, carried by the
    fitted motion; both: the whole of the reference state's image and of this one, of one kind; bones: of every rigid
    tissue that both show; motion (n_nodes, 3) mm: of the nodes of `ReportData.mesh` as fitted to this image, (0, 3)
    where nothing was fitted or the mesh is that of another reference state.
    """

    name: str
    reference: int = 0
    surfaces: tuple[TriangleSurface, ...] = ()
    model: tuple[ModelSurface, ...] = ()
    background: Volume | None = None
    outlines: tuple[TriangleSurface, ...] = ()
    both: tuple[Volume, ...] = ()
    bones: tuple[BoneDistance, ...] = ()
    motion: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), dtype=np.float32))


@dataclass(frozen=True, slots=True)
class MeasuredPoints:
    """Points whose motion was measured, of which those that are drawn lie at `rest` (n, 3) RAS mm.

    observed, fitted (n, 3) mm: their motion as measured and as the fitted model has it; near_mm: how near to a slice an
    arrow begins that it shows; total: number of points that were compared, of which these are about one measure:
    moved_rms_mm, left_rms_mm: root mean square of the measured motion, and of what the fit leaves; misfit: the latter
    over the errors stated; largest_mm, largest_at (3,) RAS mm, largest_label: the longest that is left, and whose.
    Raises `ValueError` for arrays that are not of one size, are no numbers, or more than a page draws.
    """

    name: str
    total: int
    rest: NDArray[np.float32]
    observed: NDArray[np.float32]
    fitted: NDArray[np.float32]
    near_mm: float
    moved_rms_mm: float
    left_rms_mm: float
    misfit: float
    largest_mm: float
    largest_at: NDArray[np.float64]
    largest_label: str = ""

    def __post_init__(self) -> None:
        arrays, n = (self.rest, self.observed, self.fitted), len(self.rest)
        numbers = (self.near_mm, self.moved_rms_mm, self.left_rms_mm, self.misfit, self.largest_mm)
        if not 0 < n <= min(self.total, MOST_ARROWS) or any(array.shape != (n, 3) for array in arrays):
            raise ValueError(f"{n} points of {self.total} are to be drawn, of at most {MOST_ARROWS}")
        if self.largest_at.shape != (3,) or not all(
            np.isfinite(of).all() for of in (*arrays, self.largest_at, numbers)
        ):
            raise ValueError("the motion of a point is no number")


@dataclass(frozen=True, slots=True)
class MeasuredState:
    """The points that were measured in one later state, over its reference state (a number); `box`: of its slices.

    outlines: as those of a `LaterImage`; motion_factor, left_factor: how many times longer than it is an arrow of the
    motion, and of what the fit leaves, is drawn.
    """

    name: str
    reference: int
    box: SliceBox
    points: tuple[MeasuredPoints, ...]
    outlines: tuple[TriangleSurface, ...]
    motion_factor: float
    left_factor: float


@dataclass(frozen=True, slots=True)
class InputImage:
    """One label image of the case: its name, number of its pair, its voxels and their edges (mm), SHA-256 of its file.

    later: whether it shows a later state; volumes_ml: of each tissue, of its voxels, or of its
    elements where the body is given as a mesh, mL.
    """

    name: str
    pair: int
    later: bool
    shape: tuple[int, int, int]
    spacing_mm: tuple[float, float, float]
    volumes_ml: tuple[float, ...]
    sha256: str


@dataclass(frozen=True, slots=True)
class MeshPicture:
    """The mesh of the first reference state: nodes (n, 3) RAS mm, tets (m, 4), region (m,) tissue index.

    angles (m, 6): dihedral, degrees; strains (m,): the largest principal strain of its fitted states, dimensionless;
    (0,) where nothing was fitted.
    """

    nodes: NDArray[np.float32]
    tets: NDArray[np.int32]
    region: NDArray[np.int16]
    angles: NDArray[np.float32]
    strains: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class MapSlice:
    """A slice of a map: modulus in the result's unit, sd of ln E, resolution, (n_up, n_across) each; NaN outside."""

    modulus: NDArray[np.float32] = field(metadata=MAY_BE_NAN)
    sd: NDArray[np.float32] = field(metadata=MAY_BE_NAN)
    resolution: NDArray[np.float32] = field(metadata=MAY_BE_NAN)


@dataclass(frozen=True, slots=True)
class TissueMap:
    """The map of `tissue` (index), in words and slices; its mean modulus in the result's unit.

    low, high, position (3,) mm: the slices' box, and where they lie, in the order of `VIEWS`; elements (n,): of the
    mesh; moduli (n,): of them, in the result's unit, the mean where the data do not resolve them.
    """

    tissue: int
    words: str
    mean: float
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    position: NDArray[np.float64]
    slices: tuple[MapSlice, ...]
    elements: NDArray[np.int32]
    moduli: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ReportData:
    """One case's report before it is drawn.

    document: that of result.json; unit: of the moduli, "kPa" or "ratio"; images: every label image, pair after pair;
    moduli_paths: of each start, and last of the outer loop, tissue -> moduli by iteration; references: the reference
    states, that of the mesh first; later: their later images; measured: the later states in which points were measured;
    maps: of tissues whose modulus is a field, in the first reference state;
    missing: part of the page ("mesh", "maps", or "slices", "surfaces", "background", "distances", "outlines",
    "alignment", "points" of an image) -> why it is not there.
    """

    document: Mapping[str, Any]
    created: str
    settings: tuple[tuple[str, str], ...]
    tissues: tuple[ReportTissue, ...]
    unit: str
    images: tuple[InputImage, ...] = ()
    moduli_paths: tuple[Mapping[str, tuple[float, ...]], ...] = field(default=(), metadata=MAY_BE_NAN)
    references: tuple[Reference, ...] = ()
    later: tuple[LaterImage, ...] = ()
    measured: tuple[MeasuredState, ...] = ()
    mesh: MeshPicture | None = None
    maps: tuple[TissueMap, ...] = ()
    missing: Mapping[str, str] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """Write everything to `path` (.npz without pickles); `ResourceError` when the disk refuses."""
        write_archive(self, path, version=FORMAT)

    @classmethod
    def load(cls, path: Path, *, sha256: str | None = None) -> ReportData:
        """Read what `save` wrote.

        Raises `InputDataError` when the file is missing, damaged, too large, another, has not the SHA-256 given, or
        holds NaN where a number belongs.
        """
        return read_archive(cls, path, version=FORMAT, sha256=sha256, finite=True)
