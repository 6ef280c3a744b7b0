"""The kinds of measurements that a case may name beside its images; a new one is a file and a line here.

Other packages bring theirs as entry points `palpate.data`, each a `SourceKind`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from palpate.entry_points import brought
from palpate.observation.contract import DataFile, DataSource
from palpate.observation.displacement_field import read_displacement_field
from palpate.observation.force import read_force
from palpate.observation.landmarks import read_landmarks

__all__ = ["SOURCES", "SourceKind", "read_source"]

OF_POINTS = ("file", "file_after", "sd_mm", "covariance_mm2", "correlation_mm", "axes")


@dataclass(frozen=True, slots=True)
class SourceKind:
    """How measurements of a kind are read, which keys of [[data]] they need, and which others they may have.

    tells_scale: whether they tell kilopascals by themselves.
    """

    read: Callable[[DataFile], DataSource]
    needs: tuple[str, ...] = ("file",)
    may_have: tuple[str, ...] = OF_POINTS
    tells_scale: bool = False


SOURCES = {
    "landmarks": SourceKind(read_landmarks),
    "displacement-field": SourceKind(read_displacement_field),
    "force": SourceKind(read_force, ("surface", "force_n", "direction", "sd_n"), ("offset_sd_n",), tells_scale=True),
}
SOURCES |= brought("palpate.data", SourceKind, taken=SOURCES)


def read_source(file: DataFile) -> DataSource:
    """Read a file of measurements by its kind, one of `SOURCES`; raises `InputDataError`."""
    return SOURCES[file.kind].read(file)
