"""Tables of points that were measured before and after, with their errors: read, and refused where they cannot be."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError, InputDataError
from palpate.findings import Finding
from palpate.images.input_file import whole_input
from palpate.images.named_labels import printable
from palpate.observation.contract import DataFile

MOST_BYTES = 64 * 2**20
COLUMNS = tuple(f"{when}_{axis}" for when in ("before", "after") for axis in "xyz")
SD_COLUMNS = ("sd_x", "sd_y", "sd_z")
FARTHEST = 1e9  # mm
MOST_POINTS = 20_000  # points whose direction or place is checked
SEVERAL = 8  # least number of points that show how displacements change in space
STRETCH = 0.5  # mm per mm in every direction, more than in any body
FLAT = 1e-6  # of the points' extent


@dataclass(frozen=True, slots=True)
class PointTable:
    """Pairs of points (n, 3) RAS mm, before and after; names (n,), which may be empty; digests of the files.

    sd (n, 3) mm: standard deviations of the displacements; `pairing`: what is to be said of how points were paired;
    `remark`: what was left out, in words.
    """

    before: NDArray[np.float64]
    after: NDArray[np.float64]
    sd: NDArray[np.float64]
    names: tuple[str, ...]
    digests: tuple[str, ...]
    pairing: tuple[Finding, ...] = ()
    remark: str = ""

    @property
    def moved(self) -> NDArray[np.float64]:
        """Displacements (n, 3) mm."""
        return np.asarray(self.after - self.before)

    def where(self, chosen: NDArray[np.bool_]) -> PointTable:
        """Those of a mask (n,)."""
        names = tuple(name for name, taken in zip(self.names, chosen.tolist(), strict=True) if taken)
        return replace(self, before=self.before[chosen], after=self.after[chosen], sd=self.sd[chosen], names=names)


def stated_sd(file: DataFile, n: int) -> NDArray[np.float64]:
    """The standard deviations (n, 3) mm that a case states of the errors; raises `ConfigurationError` for none."""
    if file.sd_mm is None:
        raise ConfigurationError(
            f"[[data]] '{file.paths[0].name}' has no stated error: give sd_mm, the standard deviation of one component"
            f" in mm, or the columns {', '.join(SD_COLUMNS)} in a .csv"
        )
    return np.full((n, 3), file.sd_mm)


def read_point_table(file: DataFile) -> PointTable:
    """Read a table with the columns before_x ... after_z, RAS mm, and label and sd_x, sd_y, sd_z (mm) if it has them.

    Raises `InputDataError`; `ConfigurationError` where neither table nor case states an error.
    """
    path = file.paths[0]
    content, digest = read_text(path)
    lines, rows, labels = csv.DictReader(io.StringIO(content)), [], []
    try:
        lines.fieldnames = names = [name.strip().lower() for name in lines.fieldnames or ()]
        if missing := [name for name in COLUMNS if name not in names]:
            raise InputDataError(
                f"'{path}' lacks the column(s) {', '.join(missing)}; its first line needs {', '.join(COLUMNS)} (RAS mm)"
            )
        columns = COLUMNS + (SD_COLUMNS if file.sd_mm is None and SD_COLUMNS[0] in names else ())
        for line in lines:
            rows.append([float(line[name] or "nan") for name in columns])
            labels.append(printable((line.get("label") or "").strip()[:200]))
    except (TypeError, ValueError, csv.Error) as error:
        raise InputDataError(
            f"line {lines.line_num} of '{path}' does not hold {len(columns)} numbers ({error}); correct it"
        ) from error
    values = np.array(rows, dtype=np.float64).reshape(-1, len(columns) // 3, 3)
    sd = values[:, 2] if len(columns) > len(COLUMNS) else stated_sd(file, len(values))
    return checked_table(PointTable(values[:, 0], values[:, 1], sd, tuple(labels), (digest,)), path)


def read_text(path: Path) -> tuple[str, str]:
    """The text of a file of at most 64 MB, and its SHA-256; raises `InputDataError`."""
    content, digest = whole_input(path, MOST_BYTES)
    try:
        return content.decode("utf-8-sig"), digest
    except UnicodeDecodeError as error:
        raise InputDataError(f"'{path}' is not UTF-8 text ({error}); export it as UTF-8") from error


def checked_table(table: PointTable, path: Path) -> PointTable:
    """The table itself, if it has points, all of them numbers, that move as a body does; raises `InputDataError`."""
    if len(table.before) == 0:
        raise InputDataError(f"'{path}' holds no pair of points; export it with at least one")
    bad = np.flatnonzero(~(np.abs(np.concatenate([table.before, table.after], axis=1)) < FARTHEST).all(axis=1))
    if len(bad):
        raise InputDataError(
            f"{len(bad)} pairs of '{path}', the first {bad[0] + 1}, have no number, or coordinates beyond any body;"
            " remove them"
        )
    if not ((table.sd > 0.0) & (table.sd < FARTHEST)).all():
        raise InputDataError(f"'{path}' has standard deviations that are not positive numbers of mm; correct them")
    if np.array_equal(table.before, table.after):
        raise InputDataError(f"the points of '{path}' did not move at all; give those of a later state")
    step = -(-len(table.before) // MOST_POINTS)
    points, moved = (values[::step] - values.mean(axis=0) for values in (table.before, table.moved))
    slopes = np.linalg.lstsq(points, moved, rcond=FLAT)[0]  # 0 across points that lie in a plane
    least = float(np.linalg.svd(slopes)[1][-1])
    if len(points) >= SEVERAL and least > STRETCH:  # a rotation leaves its axis where it is
        raise InputDataError(
            f"the displacements of '{path}' change by {least:.2g} mm per mm or more in every direction, which is"
            " impossible for a body: they may be positions, in another unit, or of other points; correct the file"
        )
    return table
