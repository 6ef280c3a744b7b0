"""Landmarks: pairs of points of the body, before and after, as 3D Slicer and tables have them."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.label_image import LPS_TO_RAS
from palpate.mesh.locate import located
from palpate.mesh.space import LagrangeSpace
from palpate.observation.contract import DataFile, ReactionOf
from palpate.observation.measured_points import (
    MeasuredPoints,
    PointTable,
    checked_table,
    read_point_table,
    read_text,
    refuse_slips,
)
from palpate.observation.point_displacement import PointDisplacement, point_displacement

TO_RAS = {"LPS": LPS_TO_RAS, "RAS": np.ones(3), "1": LPS_TO_RAS, "0": np.ones(3)}
MOST_NAMED = 8  # points outside, by name


@dataclass(frozen=True, slots=True)
class Landmarks(MeasuredPoints):
    """Pairs of points, each of which counts by itself; implements `DataSource`."""

    def on(self, space: LagrangeSpace, reaction_of: ReactionOf) -> tuple[PointDisplacement, tuple[Finding, ...]]:
        """The term of the pairs that lie in the mesh; raises `InputDataError` where none does."""
        del reaction_of
        table, places = self.table, located(space.mesh, self.table.before)
        refuse_slips(space, table.before, places.inside, self.file.paths[0])
        inside, findings = places.inside, list[Finding]()
        names = [name or f"number {number}" for number, name in enumerate(table.names, start=1)]
        if not inside.all():
            out = [names[i] for i in np.flatnonzero(~inside)]
            shown = ", ".join(out[:MOST_NAMED]) + (" ..." if len(out) > MOST_NAMED else "")
            text = (
                f"{len(out)} of {len(inside)} landmarks of '{self.file.paths[0].name}' lie outside of the meshed body"
                f" and are left out: {shown}"
            )
            findings.append(Finding("points-outside", text, place=f"in state {self.file.state}"))
        term = point_displacement(
            space,
            table.before[inside],
            table.moved[inside],
            places.of(inside),
            file=self.file,
            description="the distance between landmarks of the model and where they were measured",
            labels=tuple(names[i] for i in np.flatnonzero(inside)),
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
        content, digest = read_text(path)
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
    return Landmarks(file, checked_table(table, file.paths[0]))


def _markups(content: str, path: Path) -> list[list[tuple[str, NDArray[np.float64]]]]:
    """The lists of points of a .mrk.json of 3D Slicer."""
    lists = []
    try:
        for markup in json.loads(content)["markups"]:
            system = str(markup.get("coordinateSystem", "LPS")).upper()
            units = str(markup.get("coordinateUnits", "mm"))  # a word, or a list with a code
            if system not in TO_RAS or "mm" not in units:
                raise InputDataError(
                    f"'{path}' has coordinates in {system[:20]!r}, {units[:20]!r}; export LPS or RAS in mm"
                )
            points = []
            for point in markup["controlPoints"]:
                if point.get("positionStatus", "defined") != "defined":
                    continue
                position = np.array([float(x) for x in point["position"]], dtype=np.float64)
                if position.shape != (3,):
                    raise InputDataError(f"a control point of '{path}' has {len(position)} coordinates; export three")
                points.append((str(point.get("label", ""))[:200], TO_RAS[system] * position))
            lists.append(points)
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        raise InputDataError(
            f"'{path}' is no markups file of 3D Slicer ({type(error).__name__}: {error}); landmarks are read from"
            " .mrk.json, .fcsv and .csv"
        ) from error
    return lists


def _fcsv(content: str, path: Path) -> list[list[tuple[str, NDArray[np.float64]]]]:
    """The one list of points of a .fcsv of 3D Slicer; its head says LPS or RAS, by name or number."""
    head = [line[1:].split("=", 1) for line in content.splitlines() if line.startswith("#") and "=" in line]
    keys = {key.strip().lower(): value.strip() for key, value in head}
    system = keys.get("coordinatesystem", "0").upper()
    columns = [name.strip().lower() for name in keys.get("columns", "id,x,y,z").split(",")]
    if system not in TO_RAS or not {"x", "y", "z"} <= set(columns):
        raise InputDataError(f"'{path}' states the coordinate system {system[:20]!r}; export it in LPS or RAS")
    points = []
    for line in csv.reader(line for line in content.splitlines() if line.strip() and not line.startswith("#")):
        row = dict(zip(columns, line, strict=False))
        try:
            position = np.array([float(row[axis]) for axis in "xyz"])
        except (KeyError, ValueError) as error:
            raise InputDataError(f"a line of '{path}' holds no point ({error}); export it again") from error
        points.append((row.get("label", "").strip()[:200], TO_RAS[system] * position))
    return [points]
