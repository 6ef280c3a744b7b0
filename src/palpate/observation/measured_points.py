"""Points of the body that were measured before and after: what landmarks and displacement fields have in common."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.alignment import RigidMotion
from palpate.images.input_file import whole_input
from palpate.images.label_image import LPS_TO_RAS
from palpate.images.named_labels import printable
from palpate.images.segmentation import Segmentation
from palpate.mesh.locate import located
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.tet_mesh import TetMesh
from palpate.observation.contract import DataFile, ReactionOf
from palpate.observation.point_displacement import PointDisplacement, point_displacement

MOST_BYTES = 64 * 2**20
COLUMNS = tuple(f"{when}_{axis}" for when in ("before", "after") for axis in "xyz")
FARTHEST = 1e9  # mm
SLIP = 0.5  # share of the points by which another reading must place more of them inside the mesh to be proposed
MOST_POINTS = 20_000  # points whose direction or place is checked
TELLING = 20  # least number of points at whose place the later image shows another tissue
SEVERAL = 8  # least number of points that show how displacements change in space
STRETCH = 0.5  # mm per mm in every direction, more than in any body
FLAT = 1e-6  # of the points' extent
NEAR = 0.1  # of the body's largest distance from the origin: a reading with all points nearer to it is no evidence
CLEARLY = 0.4  # share of the points by which another reading must agree better
PLACES = {  # of points that were written otherwise, by what turns them
    "x and y had the other sign: LPS read as RAS": LPS_TO_RAS,
    "they were written in metres": np.full(3, 1e3),
    "they were written in centimetres": np.full(3, 10.0),
    "they were written in micrometres, or the mesh in metres": np.full(3, 1e-3),
}
MOTIONS = {
    "as they are written": np.ones(3),
    "from the later state to the first: give those that lead from the first to the later one": -np.ones(3),
    "in LPS where RAS is read, or the other way round: write tables in RAS, and state the axes of an image": LPS_TO_RAS,
    "from the later state to the first, and in LPS where RAS is read, or the other way round": -LPS_TO_RAS,
}


@dataclass(frozen=True, slots=True)
class PointTable:
    """Pairs of points (n, 3) RAS mm, before and after; names (n,), which may be empty; digests of the files.

    `pairing`: what is to be said of how they were paired.
    """

    before: NDArray[np.float64]
    after: NDArray[np.float64]
    names: tuple[str, ...]
    digests: tuple[str, ...]
    pairing: tuple[Finding, ...] = ()

    @property
    def moved(self) -> NDArray[np.float64]:
        """Displacements (n, 3) mm."""
        return np.asarray(self.after - self.before)


@dataclass(frozen=True, slots=True)
class MeasuredPoints:
    """Pairs of points as they were read: a `DataSource`, of which each kind says how it makes a term of them."""

    file: DataFile
    table: PointTable

    description = ""

    def cells(self, mesh: TetMesh, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Numbers (n, k) that points (n, 3) mm have in common whose mean is compared; here each stands alone."""
        del mesh
        return np.arange(len(points))[:, None]

    def named(self, inside: NDArray[np.bool_]) -> tuple[tuple[str, ...], tuple[Finding, ...]]:
        """Names of the points inside the mesh, a mask (n,), or none, and what is to be said of the others."""
        del inside
        return (), ()

    @property
    def digests(self) -> tuple[str, ...]:
        """SHA-256 of each file."""
        return self.table.digests

    @property
    def in_words(self) -> str:
        """Number of pairs, and how far they move."""
        n, rms = len(self.table.before), np.sqrt(np.mean(np.sum(self.table.moved**2, axis=1)))
        return f"{n} pair{'s' * (n > 1)} of points, moved by {rms:.2g} mm (root mean square)"

    def brought(self, motion: RigidMotion) -> Self:
        """The same with the later points moved back by the rigid motion of the later state."""
        return replace(self, table=replace(self.table, after=motion.inverse().apply(self.table.after)))

    def against(self, before: Segmentation, after: Segmentation) -> None:
        """Raise `InputDataError` where the displacements lead into the wrong tissues.

        Those points tell whose place shows another tissue in the later image: they must arrive in their own.
        """
        step = -(-len(self.table.before) // MOST_POINTS)
        points, moved = self.table.before[::step], self.table.moved[::step]
        own = _tissue(before, points)
        telling = (own >= 0) & (_tissue(after, points) != own)
        if np.count_nonzero(telling) < TELLING:
            return
        points, moved, own = points[telling], moved[telling], own[telling]
        agreement = {words: np.mean(_tissue(after, points + signs * moved) == own) for words, signs in MOTIONS.items()}
        plain, (words, best) = next(iter(agreement.values())), max(agreement.items(), key=lambda found: found[1])
        if best > plain + CLEARLY:
            raise InputDataError(
                f"the displacements of '{self.file.paths[0]}' bring {plain:.0%} of the points that change their place"
                f" into their own tissue, and would bring {best:.0%} if they led {words}"
            )

    def on(self, space: LagrangeSpace, reaction_of: ReactionOf) -> tuple[PointDisplacement, tuple[Finding, ...]]:
        """The term of the points in the mesh; raises `InputDataError` where none is, or a slip explains the others."""
        del reaction_of
        before, places = self.table.before, located(space.mesh, self.table.before)
        inside = places.inside
        _refuse_slips(space.mesh, before, inside, self.file.paths[0])
        (labels, findings), cells = self.named(inside), self.cells(space.mesh, before[inside])
        pairs = (before[inside], self.table.moved[inside], places.of(inside))
        return point_displacement(space, *pairs, self.file, self.description, cells=cells, labels=labels), findings


def read_point_table(path: Path) -> PointTable:
    """Read a table with the columns before_x ... after_z, RAS mm, and label, if it has one; `InputDataError`."""
    content, digest = read_text(path)
    lines, rows, labels = csv.DictReader(io.StringIO(content)), [], []
    try:
        lines.fieldnames = names = [name.strip().lower() for name in lines.fieldnames or ()]
        if missing := [name for name in COLUMNS if name not in names]:
            raise InputDataError(
                f"'{path}' lacks the column(s) {', '.join(missing)}; its first line needs {', '.join(COLUMNS)} (RAS mm)"
            )
        for line in lines:
            rows.append([float(line[name] or "nan") for name in COLUMNS])
            labels.append(printable((line.get("label") or "").strip()[:200]))
    except (TypeError, ValueError, csv.Error) as error:
        raise InputDataError(f"line {lines.line_num} of '{path}' holds no six numbers ({error}); correct it") from error
    values = np.array(rows, dtype=np.float64).reshape(-1, 2, 3)
    return checked_table(PointTable(values[:, 0], values[:, 1], tuple(labels), (digest,)), path)


def read_text(path: Path) -> tuple[str, str]:
    """The text of a file of at most 64 MB, and its SHA-256; raises `InputDataError`."""
    content, digest = whole_input(path, MOST_BYTES)
    try:
        return content.decode("utf-8-sig"), digest
    except UnicodeDecodeError as error:
        raise InputDataError(f"'{path}' is not UTF-8 text ({error}); export it as such") from error


def checked_table(table: PointTable, path: Path) -> PointTable:
    """The table itself, if it has points, all of them numbers, that move as a body does; raises `InputDataError`."""
    if len(table.before) == 0:
        raise InputDataError(f"'{path}' holds no pair of points; export it with at least one")
    bad = np.flatnonzero(~(np.abs(np.concatenate([table.before, table.after], axis=1)) < FARTHEST).all(axis=1))
    if len(bad):
        raise InputDataError(
            f"{len(bad)} pairs of '{path}', the first {bad[0] + 1}, have absurd coordinates or no number; take them out"
        )
    if np.array_equal(table.before, table.after):
        raise InputDataError(f"the points of '{path}' lie where they lay before, to the last digit; give later ones")
    step = -(-len(table.before) // MOST_POINTS)
    points, moved = (values[::step] - values.mean(axis=0) for values in (table.before, table.moved))
    slopes = np.linalg.lstsq(points, moved, rcond=FLAT)[0]  # 0 across points that lie in a plane
    least = float(np.linalg.svd(slopes)[1][-1])
    if len(points) >= SEVERAL and least > STRETCH:  # a rotation leaves its axis where it is
        raise InputDataError(
            f"the displacements of '{path}' change by {least:.2g} mm a mm or more in every direction, as no body's do:"
            " they are positions in place of displacements, in another unit, or of other points; correct the file"
        )
    return table


def _refuse_slips(mesh: TetMesh, points: NDArray[np.float64], inside: NDArray[np.bool_], path: Path) -> None:
    """Raise `InputDataError` where points (n, 3) mm lie outside the mesh and a slip would explain that, or all do."""
    share, points = float(inside.mean()), points[:: -(-len(inside) // MOST_POINTS)]
    least = NEAR * np.abs(mesh.nodes).max()
    for words, turn in PLACES.items():
        there = float(located(mesh, points * turn).inside.mean())
        if there > max(SLIP, share + SLIP) and np.abs(points * turn).max() > least:
            raise InputDataError(
                f"{share:.0%} of the points of '{path}' lie in the mesh, and {there:.0%} would if {words}; write RAS mm"
            )
    if not inside.any():
        low, high = points.min(axis=0).round(1).tolist(), points.max(axis=0).round(1).tolist()
        raise InputDataError(
            f"no point of '{path}' lies in the mesh: they span {low} to {high} mm (RAS); give this patient's"
        )


def _tissue(image: Segmentation, points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Index (n,) of the tissue at points (n, 3) mm; -1 outside of the image."""
    index = image.grid.index(points).T
    return map_coordinates(image.index, index, np.int64, order=0, mode="grid-constant", cval=-1)
