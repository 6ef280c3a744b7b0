"""Landmarks: pairs of points of the body, before and after, as 3D Slicer and tables have them."""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.findings import Finding, listing
from palpate.images.label_image import LPS_TO_RAS
from palpate.images.named_labels import printable
from palpate.observation.contract import DataFile
from palpate.observation.measured_points import MeasuredPoints
from palpate.observation.point_table import PointTable, checked_table, read_point_table, read_text, stated_sd

Marks = list[tuple[str, NDArray[np.float64]]]  # labels and points, RAS mm, NaN of one that was not placed
TO_RAS = {"LPS": LPS_TO_RAS, "RAS": np.ones(3), "1": LPS_TO_RAS, "0": np.ones(3)}
NOWHERE = (np.nan, np.nan, np.nan)
OUTSIDE = ". Check that they are points of the body that was meshed."
PLACED = ("2", "")  # behind the columns that a .fcsv of 3D Slicer 5 names: 0 undefined, 1 preview, 3 missing


@dataclass(frozen=True, slots=True)
class Landmarks(MeasuredPoints):
    """Pairs of points, each of which counts by itself; implements `DataSource`."""

    description = "the distance between landmarks of the model and where they were measured"

    def named(self, inside: NDArray[np.bool_]) -> tuple[tuple[str, ...], tuple[Finding, ...]]:
        """Names of the points inside the mesh, a mask (n,); those outside, and how the pairs were found, are told."""
        names = np.array([name or f"number {number}" for number, name in enumerate(self.table.names, start=1)])
        if inside.all():
            return tuple(names.tolist()), self.table.pairing
        count, name = np.count_nonzero(~inside), self.file.paths[0].name
        lead = f"{count} of {len(inside)} landmarks of '{name}' lie outside the mesh and are left out: "
        text = listing(lead, _quoted(names[~inside].tolist()), OUTSIDE)
        outside = Finding("points-outside", text, place=f"in state {self.file.state}")
        return tuple(names[inside].tolist()), (*self.table.pairing, outside)


def read_landmarks(file: DataFile) -> Landmarks:
    """Read pairs of points: .csv of six columns, or one or two of .mrk.json and .fcsv; see `_pairs`.

    Raises `InputDataError` for whatever is wrong.
    """
    if file.paths[0].suffix.lower() == ".csv" and len(file.paths) == 1:
        return Landmarks(file, read_point_table(file))
    lists, digests = list[Marks](), list[str]()
    for path in file.paths:
        content, digest = read_text(path)
        lists += (_fcsv if path.name.lower().endswith(".fcsv") else _markups)(content, path)
        digests.append(digest)
    where = " and ".join(f"'{path.name}'" for path in file.paths)
    if len(lists) != 2:
        raise InputDataError(
            f"{where} hold {len(lists)} list(s) of points; landmarks need two: name two files, file and file_after"
        )
    first, second = ([label for label, _ in own] for own in lists)
    before, after = (np.reshape([point for _, point in own], (-1, 3)) for own in lists)
    pairs = np.reshape(_pairs(first, second, where), (-1, 2)).astype(np.int64)
    pairs = pairs[np.isfinite(before[pairs[:, 0]] + after[pairs[:, 1]]).all(axis=1)]
    left = dict.fromkeys(
        labels[n] or f"number {n + 1}"
        for labels, used in zip((first, second), pairs.T, strict=True)
        for n in np.setdiff1d(np.arange(len(labels)), used)
    )
    lead = f"{len(left)} landmarks of {where} are not placed in both lists and are left out: "
    text = listing(lead, _quoted(list(left)), ". Place them in both lists, with the same label.")
    findings = (Finding("points-unpaired", text, place=f"in state {file.state}"),) if left else ()
    names = tuple(first[n] for n in pairs[:, 0])
    sd = stated_sd(file, len(pairs))
    table = PointTable(before[pairs[:, 0]], after[pairs[:, 1]], sd, names, tuple(digests), findings)
    return Landmarks(file, checked_table(table, file.paths[0]))


def _pairs(first: Sequence[str], second: Sequence[str], where: str) -> list[tuple[int, int]]:
    """Which points of two lists with these labels belong together.

    Those with one label, where most have a partner so; else those whose labels end with one number ("before-7",
    "after-7"), where most do; where no label tells, those of one place in lists of one length.
    """
    most = 0
    for told in (r".+", r"\d+$"):
        places = list[dict[str, int]]()
        for own in (first, second):
            names = [found[0] if (found := re.search(told, label)) else "" for label in own]
            counts = Counter(names)
            places.append({name: n for n, name in enumerate(names) if name and counts[name] == 1})
        both = [(n, places[1][name]) for name, n in places[0].items() if name in places[1]]
        if 2 * len(both) > min(len(first), len(second)):
            return both
        most = max(most, len(both))
    if most or len(first) != len(second):
        raise InputDataError(
            f"{where} hold {len(first)} and {len(second)} points, of which {most} have the same label; label both"
            " points of each pair alike"
        )
    return [(n, n) for n in range(len(first))]


def _markups(content: str, path: Path) -> list[Marks]:
    """The lists of points of a .mrk.json of 3D Slicer."""
    lists = []
    try:
        for markup in json.loads(content)["markups"]:
            system = str(markup.get("coordinateSystem", "LPS")).upper()
            units = markup.get("coordinateUnits", "mm")  # a word, or a list of a code, its scheme and its meaning
            if system not in TO_RAS or (units[0] if isinstance(units, list) else units) != "mm":
                raise InputDataError(
                    f"'{path}' is in {system[:20]!r} and {str(units)[:20]!r}; export it in LPS or RAS, in mm"
                )
            points = []
            for point in markup["controlPoints"]:
                placed = point.get("positionStatus", "defined") == "defined" and point.get("position") is not None
                x, y, z = map(float, point["position"]) if placed else NOWHERE
                points.append((printable(str(point.get("label", "")).strip()[:200]), TO_RAS[system] * (x, y, z)))
            lists.append(points)
    except (ValueError, RecursionError, LookupError, TypeError, AttributeError) as error:
        raise InputDataError(
            f"'{path}' is no markups file of 3D Slicer ({type(error).__name__}: {error}); landmarks are read from"
            " .mrk.json and .fcsv, or from one .csv with both points of a pair in each line (before_x ... after_z)"
        ) from error
    return lists


def _fcsv(content: str, path: Path) -> list[Marks]:
    """The one list of points of a .fcsv of 3D Slicer; its head says LPS or RAS, by name or number."""
    head = [line[1:].split("=", 1) for line in content.splitlines() if line.startswith("#") and "=" in line]
    keys = {key.strip().lower(): value.strip() for key, value in head}
    system = keys.get("coordinatesystem", "0").upper()
    columns = [name.strip().lower() for name in keys.get("columns", "label,x,y,z,sel,vis").split(",")]
    if system not in TO_RAS or not {"x", "y", "z"} <= set(columns):
        raise InputDataError(f"'{path}' states the coordinate system {system[:20]!r}; export it in LPS or RAS")
    points = []
    try:
        for line in csv.reader(line for line in content.splitlines() if line.strip() and not line.startswith("#")):
            row = dict(zip([*columns, "status"], line, strict=False))
            placed = row.get("status", "") in PLACED
            position = [float(row[axis]) for axis in "xyz"] if placed else NOWHERE
            points.append((printable(row.get("label", "").strip()[:200]), TO_RAS[system] * position))
    except (KeyError, ValueError, csv.Error) as error:
        raise InputDataError(f"'{path}' has a line that is not a point ({error}); export it again") from error
    return [points]


def _quoted(names: Sequence[str]) -> list[str]:
    return [f"'{name}'" for name in names]
