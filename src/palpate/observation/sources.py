"""The kinds of measurements that a case may name beside its images; a new one is a file and a line here."""

from __future__ import annotations

from collections.abc import Callable

from palpate.observation.contract import DataFile, DataSource
from palpate.observation.displacement_field import read_displacement_field
from palpate.observation.force import read_force
from palpate.observation.landmarks import read_landmarks

__all__ = ["SOURCES", "read_source"]

SOURCES: dict[str, Callable[[DataFile], DataSource]] = {
    "landmarks": read_landmarks,
    "displacement-field": read_displacement_field,
    "force": read_force,
}


def read_source(file: DataFile) -> DataSource:
    """Read a file of measurements by its kind, one of `SOURCES`; raises `InputDataError`."""
    return SOURCES[file.kind](file)
