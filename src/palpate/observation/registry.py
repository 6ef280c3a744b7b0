"""What a state is observed by: the kinds of data that a case may name, and those that its images show.

A new one is a file and a line here; other packages bring data as entry points `palpate.data`, each a `SourceKind`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import chain

from palpate.entry_points import brought
from palpate.observation.contract import DataFile, DataSource, ImagedBody, Observation
from palpate.observation.displacement_field import read_displacement_field
from palpate.observation.force import ForceMeasurement
from palpate.observation.landmarks import read_landmarks
from palpate.observation.surface_distance import surface_distances

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
    "displacement-field": SourceKind(read_displacement_field, may_have=(*OF_POINTS, "subset_mm", "frame")),
    "force": SourceKind(
        ForceMeasurement, ("surface", "force_n", "direction", "sd_n"), ("offset_sd_n",), tells_scale=True
    ),
}


@cache
def register_brought() -> None:
    """Add the kinds of other packages to `SOURCES`; raises `ConfigurationError` where one cannot be used.

    Not when this module is imported: a package may import it to say what it brings.
    """
    SOURCES.update(brought("palpate.data", SourceKind, taken=SOURCES))


def read_source(file: DataFile) -> DataSource:
    """Read a file of measurements by its kind, one of `SOURCES`; raises `InputDataError`."""
    return SOURCES[file.kind].read(file)


Kind = Callable[[ImagedBody], tuple[tuple[Observation, ...], ...]]
KINDS: tuple[Kind, ...] = (surface_distances,)


def observations(imaged: ImagedBody, kinds: tuple[Kind, ...] = KINDS) -> tuple[tuple[Observation, ...], ...]:
    """What each later image shows, kind after kind."""
    return tuple(tuple(chain(*of_image)) for of_image in zip(*(made(imaged) for made in kinds), strict=True))
