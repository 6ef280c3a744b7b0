"""Landmarks: pairs of points of the body, before and after, as 3D Slicer and tables have them."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.alignment import RigidMotion
from palpate.images.input_file import read_input
from palpate.images.segmentation import Segmentation
from palpate.mesh.locate import located
from palpate.mesh.space import LagrangeSpace
from palpate.observation.contract import DataFile, ReactionOf
from palpate.observation.direction import refuse_direction
from palpate.observation.point_displacement import PointDisplacement, point_displacement

__all__ = ["KIND", "Landmarks", "PointTable", "read_landmarks", "read_point_table", "refuse_slips"]

KIND = "landmarks"
MOST_BYTES = 64 * 2**20
COLUMNS = tuple(f"{when}_{axis}" for when in ("before", "after") for axis in "xyz")
TO_RAS = {"LPS": np.array([-1.0, -1.0, 1.0]), "RAS": np.ones(3), "1": np.array([-1.0, -1.0, 1.0]), "0": np.ones(3)}
METRES = 1000.0
SLIP = 0.5  # share of the points inside the mesh, from which on a slip explains them

_Points = dict[str, NDArray[np.float64]]  # by label, RAS mm


@dataclass(frozen=True, slots=True)
class PointTable:
    """Pairs of points (n, 3) RAS mm, before and after; names (n,), which may be empty; digests of the files."""

    before: NDArray[np.float64]
    after: NDArray[np.float64]
    names: tuple[str, ...]
    digests: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Landmarks:
    """Pairs of points as they were read; implements `DataSource`."""

    file: DataFile
    table: PointTable

    @property
    def digests(self) -> tuple[str, ...]:
        """SHA-256 of each file."""
        return self.table.digests

    @property
    def in_words(self) -> str:
        """Number of pairs, and how far they move."""
        moved = np.linalg.norm(self.table.after - self.table.before, axis=1)
        return f"{len(moved)} pairs of points, which move by {np.sqrt(np.mean(moved**2)):.2g} mm (root mean square)"

    def brought(self, motion: RigidMotion) -> Landmarks:
        """The same with the later points moved back by the rigid motion of the later state."""
        return replace(self, table=replace(self.table, after=motion.inverse().apply(self.table.after)))

    def against(self, before: Segmentation, after: Segmentation) -> None:
        """Raise `InputDataError` where the points arrive in other tissues (see `refuse_direction`)."""
        table = self.table
        refuse_direction(table.before, table.after - table.before, before, after, self.file.paths[0])

    def on(self, space: LagrangeSpace, reaction_of: ReactionOf) -> tuple[PointDisplacement, tuple[Finding, ...]]:
        """The term of the pairs that lie in the mesh; raises `InputDataError` where none does."""
        del reaction_of
        table, places = self.table, located(space.mesh, self.table.before)
        refuse_slips(space, table.before, places.inside, self.file.paths[0])
        inside, findings = places.inside, list[Finding]()
        if not inside.all():
            out = [table.names[i] or f"number {i + 1}" for i in np.flatnonzero(~inside)]
            shown = ", ".join(out[:8]) + (" ..." if len(out) > 8 else "")
            text = (
                f"{len(out)} of {len(inside)} landmarks of '{self.file.paths[0].name}' lie outside of the meshed body"
                f" and are left out: {shown}"
            )
            findings.append(Finding("points-outside", text, place=f"in state {self.file.state}"))
        term = point_displacement(
            space,
            table.before[inside],
            (table.after - table.before)[inside],
            replace(places, tet=places.tet[inside], barycentric=places.barycentric[inside]),
            file=self.file,
            kind=KIND,
            description="the distance between landmarks of the model and where they were measured",
        )
        return term, tuple(findings)


def read_landmarks(file: DataFile) -> Landmarks:
    """Read pairs of points: .csv of six columns, or one or two of .mrk.json and .fcsv.

    Two lists of points are paired by their labels where these are the same and differ from each other, else by their
    order. Raises `InputDataError` for whatever is wrong.
    """
    if file.paths[0].suffix.lower() == ".csv" and len(file.paths) == 1:
        return Landmarks(file, read_point_table(file.paths[0]))
    lists, digests = list[list[tuple[str, NDArray[np.float64]]]](), []
    for path in file.paths:
        content, digest = _read(path)
        reader = _fcsv if path.name.lower().endswith(".fcsv") else _markups
        lists += reader(content, path)
        digests.append(digest)
    where = " and ".join(f"'{path}'" for path in file.paths)
    if len(lists) != 2:
        raise InputDataError(
            f"{where} hold {len(lists)} list(s) of points; landmarks need two, before and after: name two files,"
            " file and file_after"
        )
    first, second = lists
    if len(first) != len(second):
        raise InputDataError(
            f"{where} hold {len(first)} points before and {len(second)} after; every landmark needs both: take out"
            " those that are seen once"
        )
    labels = [[label for label, _ in points] for points in lists]
    if all(len(set(own)) == len(own) and all(own) for own in labels) and set(labels[0]) == set(labels[1]):
        by_label = dict(second)
        second = [(label, by_label[label]) for label in labels[0]]
    table = PointTable(
        np.array([point for _, point in first]),
        np.array([point for _, point in second]),
        tuple(labels[0]),
        tuple(digests),
    )
    return Landmarks(file, _checked(table, file.paths[0]))


def read_point_table(path: Path) -> PointTable:
    """Read a table with the columns before_x ... after_z, RAS mm, and label, if it has one; `InputDataError`."""
    content, digest = _read(path)
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
                raise InputDataError(f"line {number} of '{path}' holds no six numbers: {error}") from error
            labels.append((line.get("label") or "").strip()[:200])
    except csv.Error as error:
        raise InputDataError(f"the table '{path}' is damaged: {error}; export it again") from error
    values = np.array(rows, dtype=np.float64).reshape(-1, 2, 3)
    return _checked(PointTable(values[:, 0], values[:, 1], tuple(labels), (digest,)), path)


def refuse_slips(space: LagrangeSpace, points: NDArray[np.float64], inside: NDArray[np.bool_], path: Path) -> None:
    """Raise `InputDataError` where points (n, 3) mm lie outside the mesh, with the slip that would explain it."""
    share = float(inside.mean()) if len(inside) else 0.0
    slips = {
        "as if they were written in LPS and read as RAS (x and y have the other sign)": points * TO_RAS["LPS"],
        "as if they were written in metres": points * METRES,
        "as if they were written in micrometres": points / METRES,
    }
    for words, other in slips.items():
        there = float(located(space.mesh, other).inside.mean()) if len(points) else 0.0
        if there > max(SLIP, share + SLIP):
            raise InputDataError(
                f"{share:.0%} of the points of '{path}' lie in the meshed body, and {there:.0%} would {words}: tables"
                " of points are read as RAS mm; export it so"
            )
    if not inside.any():
        low, high = points.min(axis=0).round(1).tolist(), points.max(axis=0).round(1).tolist()
        raise InputDataError(
            f"none of the {len(points)} points of '{path}' lies in the meshed body: they lie between {low} and"
            f" {high} mm (RAS); are they of this patient, and in the world of the first image?"
        )


def _checked(table: PointTable, path: Path) -> PointTable:
    """The table itself, if it has points, all of them numbers."""
    if len(table.before) == 0:
        raise InputDataError(f"'{path}' holds no pair of points; export it with at least one")
    bad = np.flatnonzero(~np.isfinite(np.concatenate([table.before, table.after], axis=1)).all(axis=1))
    if len(bad):
        raise InputDataError(
            f"pair {bad[0] + 1} of '{path}' has a coordinate that is missing or no number ({len(bad)} of"
            f" {len(table.before)} pairs); take such pairs out"
        )
    if np.array_equal(table.before, table.after):
        raise InputDataError(
            f"the points of '{path}' lie after where they lay before, to the last digit; is it one list?"
        )
    return table


def _read(path: Path) -> tuple[str, str]:
    try:
        content, digest = read_input(path, MOST_BYTES)
    except (OSError, ValueError) as error:
        raise InputDataError(f"'{path}' cannot be read: {error}") from error
    if len(content) > MOST_BYTES:
        raise InputDataError(f"'{path}' is larger than {MOST_BYTES // 2**20} MB; points are given as a smaller table")
    try:
        return content.decode("utf-8-sig"), digest
    except UnicodeDecodeError as error:
        raise InputDataError(f"'{path}' is not UTF-8 text ({error.reason} at byte {error.start})") from error


def _markups(content: str, path: Path) -> list[list[tuple[str, NDArray[np.float64]]]]:
    """The lists of points of a .mrk.json of 3D Slicer."""
    try:
        document = json.loads(content)
        every = document["markups"]
        return [list(_control_points(markup, path)) for markup in every]
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        raise InputDataError(
            f"'{path}' is no markups file of 3D Slicer ({type(error).__name__}: {error}); landmarks are read from"
            " .mrk.json, .fcsv and .csv"
        ) from error


def _control_points(markup: Any, path: Path) -> Iterator[tuple[str, NDArray[np.float64]]]:
    system = str(markup.get("coordinateSystem", "LPS")).upper()
    units = str(markup.get("coordinateUnits", "mm"))  # a word, or a list with a code
    if system not in TO_RAS or (units not in ("mm", "[mm]") and not units.startswith("[")):
        raise InputDataError(
            f"'{path}' has the coordinates {system[:20]!r} in {units[:20]!r}; LPS or RAS in mm are read"
        )
    for point in markup["controlPoints"]:
        if point.get("positionStatus", "defined") == "defined":
            position = np.array([float(x) for x in point["position"]], dtype=np.float64)
            if position.shape != (3,):
                raise InputDataError(f"a control point of '{path}' has {len(position)} coordinates; it must have three")
            yield str(point.get("label", ""))[:200], TO_RAS[system] * position


def _fcsv(content: str, path: Path) -> list[list[tuple[str, NDArray[np.float64]]]]:
    """The one list of points of a .fcsv of 3D Slicer; its head says LPS or RAS, by name or number."""
    head = [line[1:].split("=", 1) for line in content.splitlines() if line.startswith("#") and "=" in line]
    keys = {key.strip().lower(): value.strip() for key, value in head}
    system = keys.get("coordinatesystem", "0").upper()
    columns = [name.strip().lower() for name in keys.get("columns", "id,x,y,z").split(",")]
    if system not in TO_RAS or not {"x", "y", "z"} <= set(columns):
        raise InputDataError(f"'{path}' states the coordinate system {system[:20]!r}; LPS or RAS are read")
    points = []
    for line in csv.reader(line for line in content.splitlines() if line.strip() and not line.startswith("#")):
        row = dict(zip(columns, line, strict=False))
        try:
            position = np.array([float(row[axis]) for axis in "xyz"])
        except (KeyError, ValueError) as error:
            raise InputDataError(f"a line of '{path}' holds no point: {error}") from error
        points.append((row.get("label", "").strip()[:200], TO_RAS[system] * position))
    return [points]
