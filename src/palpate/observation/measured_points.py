"""Points of the body that were measured before and after: what landmarks and displacement fields have in common."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.alignment import RigidMotion
from palpate.images.input_file import read_input
from palpate.images.label_image import LPS_TO_RAS
from palpate.images.named_labels import printable
from palpate.images.segmentation import Segmentation
from palpate.mesh.locate import located
from palpate.mesh.space import LagrangeSpace
from palpate.observation.contract import DataFile

MOST_BYTES = 64 * 2**20
COLUMNS = tuple(f"{when}_{axis}" for when in ("before", "after") for axis in "xyz")
METRES = 1000.0
FARTHEST = 1e9  # mm
SLIP = 0.5  # share of the points inside the mesh, from which on a slip explains them
MOST_POINTS = 20_000  # whose direction, or place, is looked at
TELLING = 20  # points whose tissue tells where they went
SEVERAL = 8  # points that tell how displacements change
STRETCH = 0.5  # mm a mm, in every direction: more than any body's
FLAT = 1e-6  # of the points' extent
NEAR = 0.1  # of the body's farthest place from the origin: in a smaller unit any points shrink onto the origin
CLEARLY = 0.4  # share of these by which another reading must agree better
OTHERWISE = {
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
    """Pairs of points as they were read: the part of `DataSource` that does not depend on how many they are."""

    file: DataFile
    table: PointTable

    @property
    def digests(self) -> tuple[str, ...]:
        """SHA-256 of each file."""
        return self.table.digests

    @property
    def in_words(self) -> str:
        """Number of pairs, and how far they move."""
        rms = np.sqrt(np.mean(np.sum(self.table.moved**2, axis=1)))
        n = len(self.table.before)
        many = f"{n} pairs of points, which move by" if n > 1 else "1 pair of points, which moves by"
        return f"{many} {rms:.2g} mm (root mean square)"

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

        def agreement(signs: NDArray[np.float64]) -> float:
            """Share of the points that arrive in their own tissue."""
            return float(np.mean(_tissue(after, points[telling] + signs * moved[telling]) == own[telling]))

        plain = agreement(np.ones(3))
        words, best = max(((words, agreement(signs)) for words, signs in OTHERWISE.items()), key=lambda found: found[1])
        if best > plain + CLEARLY:
            raise InputDataError(
                f"the displacements of '{self.file.paths[0]}' bring {plain:.0%} of the points that change their place"
                f" into their own tissue, and would bring {best:.0%} if they led {words}"
            )


def read_point_table(path: Path) -> PointTable:
    """Read a table with the columns before_x ... after_z, RAS mm, and label, if it has one; `InputDataError`."""
    content, digest = read_text(path)
    lines = csv.DictReader(io.StringIO(content))
    names = [name.strip().lower() for name in lines.fieldnames or ()]
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise InputDataError(
            f"the table '{path}' lacks the column(s) {', '.join(missing)}; its first line must name before_x, before_y,"
            " before_z, after_x, after_y, after_z (RAS, mm)"
        )
    lines.fieldnames = names
    rows, labels = [], []
    try:
        for number, line in enumerate(lines, start=2):
            try:
                rows.append([float(line[name] or "nan") for name in COLUMNS])
            except (TypeError, ValueError) as error:
                raise InputDataError(
                    f"line {number} of '{path}' holds no six numbers ({error}); correct it, or take it out"
                ) from error
            labels.append(printable((line.get("label") or "").strip()[:200]))
    except csv.Error as error:
        raise InputDataError(f"the table '{path}' is damaged: {error}; export it again") from error
    values = np.array(rows, dtype=np.float64).reshape(-1, 2, 3)
    return checked_table(PointTable(values[:, 0], values[:, 1], tuple(labels), (digest,)), path)


def read_text(path: Path) -> tuple[str, str]:
    """The text of a file of at most 64 MB, and its SHA-256; raises `InputDataError`."""
    try:
        content, digest = read_input(path, MOST_BYTES)
    except (OSError, ValueError) as error:
        raise InputDataError(f"'{path}' cannot be read: {error}; check the path") from error
    if len(content) > MOST_BYTES:
        raise InputDataError(f"'{path}' is larger than {MOST_BYTES // 2**20} MB; give fewer points, or a vector image")
    try:
        return content.decode("utf-8-sig"), digest
    except UnicodeDecodeError as error:
        raise InputDataError(
            f"'{path}' is not UTF-8 text ({error.reason} at byte {error.start}); export it as such"
        ) from error


def checked_table(table: PointTable, path: Path) -> PointTable:
    """The table itself, if it has points, all of them numbers, that move as a body does; raises `InputDataError`."""
    if len(table.before) == 0:
        raise InputDataError(f"'{path}' holds no pair of points; export it with at least one")
    bad = np.flatnonzero(~(np.abs(np.concatenate([table.before, table.after], axis=1)) < FARTHEST).all(axis=1))
    if len(bad):
        raise InputDataError(
            f"pair {bad[0] + 1} of '{path}' has a coordinate that is missing, no number or absurd ({len(bad)} of"
            f" {len(table.before)} pairs); take such pairs out"
        )
    if np.array_equal(table.before, table.after):
        raise InputDataError(
            f"the points of '{path}' lie where they lay before, to the last digit; give the later ones, too"
        )
    step = -(-len(table.before) // MOST_POINTS)
    points, moved = (values[::step] - values.mean(axis=0) for values in (table.before, table.moved))
    slopes = np.linalg.lstsq(points, moved, rcond=FLAT)[0]  # 0 across points that lie in a plane
    least = float(np.linalg.svd(slopes)[1][-1])
    if len(points) >= SEVERAL and least > STRETCH:  # a rotation leaves its axis where it is
        raise InputDataError(
            f"the displacements of '{path}' change by {least:.2g} mm or more for each mm between its points, in every"
            " direction, as no body's do: they are positions in place of displacements, in another unit, or of other"
            " points; correct the file"
        )
    return table


def refuse_slips(space: LagrangeSpace, points: NDArray[np.float64], inside: NDArray[np.bool_], path: Path) -> None:
    """Raise `InputDataError` where points (n, 3) mm lie outside the mesh, with the slip that would explain it.

    inside (n,): which of them lie in it.
    """
    share, points = float(inside.mean()), points[:: -(-len(inside) // MOST_POINTS)]
    least = NEAR * np.abs(space.mesh.nodes).max()
    slips = {
        "x and y had the other sign: LPS read as RAS": points * LPS_TO_RAS,
        "they were written in metres": points * METRES,
        "they were written in micrometres": points / METRES,
    }
    for words, other in slips.items():
        there = float(located(space.mesh, other).inside.mean())
        if there > max(SLIP, share + SLIP) and np.abs(other).max() > least:
            raise InputDataError(
                f"{share:.0%} of the points of '{path}' lie in the meshed body, and {there:.0%} would if {words};"
                " tables of points are read as RAS mm: export it so"
            )
    if not inside.any():
        low, high = points.min(axis=0).round(1).tolist(), points.max(axis=0).round(1).tolist()
        raise InputDataError(
            f"none of the {len(inside)} points of '{path}' lies in the meshed body: they lie between {low} and"
            f" {high} mm (RAS); give points of this patient, in the world of the first image"
        )


def _tissue(image: Segmentation, points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Index (n,) of the tissue at points (n, 3) mm; -1 outside of the image."""
    index = np.rint(image.grid.index(points)).astype(np.int64)
    inside = np.all((index >= 0) & (index < image.grid.shape), axis=1)
    found = np.full(len(points), -1, dtype=np.int64)
    found[inside] = image.index[tuple(index[inside].T)]
    return found
