"""[[data]] and [[loads]] of a case: measurements of a later state, and the loads that act in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from palpate.case.schema import rule
from palpate.errors import ConfigurationError
from palpate.observation.contract import DataFile
from palpate.observation.registry import SOURCES, register_brought

Row = tuple[float, float, float]
FORCES_N = (-1e9, 1e9)
STRESSES_KPA = (-1e4, 1e4)
KEYS_OF_LOADS = {
    "pressure": ("surface", "pressure_kpa"),
    "traction": ("surface", "traction_kpa"),
    "gravity": ("acceleration_m_s2",),
}
DIRECTION = rule(between=(-1e3, 1e3), test=any, wanted="a direction other than (0, 0, 0)")
COVARIANCE = rule(
    instead_of="sd_mm",
    test=lambda rows: np.allclose(rows, np.transpose(rows)) and np.linalg.eigvalsh(rows)[0] > 0.0,
    wanted="a symmetric and positive definite matrix, mm^2",
)
register_brought()  # before the words that a case may use are listed


@dataclass(frozen=True, slots=True)
class CaseData:
    """Measurements beside the images, of the later state with the number `state`; `file_after`: of a second list.

    `sd_mm`: standard deviation of each component's error, or `covariance_mm2` (3, 3) of a point's; `correlation_mm`:
    length over which a field's errors are alike; `subset_mm`: edge of the box whose motion each
    displacement is, by digital volume correlation; by default, what the file says. `frame`: which field of a file of
    several, by default that of its state; `axes`: of a field's vectors, where its file does not tell. A force
    has no file: `force_n` on `surface` (see `CaseLoad`) along `direction`, with `sd_n` and that of the load cell's
    offset, `offset_sd_n`.
    """

    kind: str = field(metadata=rule(choices=tuple(SOURCES)))
    file: Path | None = None
    file_after: Path | None = None
    state: int = field(default=1, metadata=rule(between=(1, 1000)))
    sd_mm: float | None = field(default=None, metadata=rule(between=(1e-6, 100.0)))
    covariance_mm2: tuple[Row, Row, Row] | None = field(default=None, metadata=COVARIANCE)
    correlation_mm: float | None = field(default=None, metadata=rule(between=(0.0, 1e3)))
    subset_mm: float | None = field(default=None, metadata=rule(between=(0.0, 1e3)))
    frame: int | None = field(default=None, metadata=rule(between=(1, 100_000)))
    axes: str | None = field(default=None, metadata=rule(choices=("LPS", "RAS")))
    surface: str | None = None
    force_n: float | None = field(default=None, metadata=rule(between=FORCES_N))
    direction: Row | None = field(default=None, metadata=DIRECTION)
    sd_n: float | None = field(default=None, metadata=rule(between=(1e-9, 1e6)))
    offset_sd_n: float = field(default=0.0, metadata=rule(between=(0.0, 1e6)))

    def __post_init__(self) -> None:
        kind = SOURCES[self.kind]
        _check_keys(self, "[[data]]", kind.needs, kind.may_have)

    @property
    def tells_scale(self) -> bool:
        """Whether it tells kilopascals by itself."""
        return SOURCES[self.kind].tells_scale

    def named(self, name: str) -> DataFile:
        """What the layers below are told of it, under a name of its term."""
        matrix = None if self.covariance_mm2 is None else np.array(self.covariance_mm2)
        paths = tuple(path for path in (self.file, self.file_after) if path is not None)
        sd_mm = self.sd_mm if matrix is None else float(np.sqrt(np.trace(matrix) / 3.0))
        edges = None if self.subset_mm is None else (self.subset_mm, self.subset_mm, self.subset_mm)
        errors = (sd_mm, matrix, self.correlation_mm, edges, self.frame, self.axes or "")
        force = (self.surface or "", self.force_n or 0.0, self.direction or (0.0, 0.0, 1.0), self.sd_n or 1.0)
        return DataFile(self.kind, name, paths, self.state, *errors, *force, self.offset_sd_n)


@dataclass(frozen=True, slots=True)
class CaseLoad:
    """A known load on a later state: a pressure or traction on a surface, or gravity; kPa, RAS directions.

    `surface`: a hollow tissue whose wall moves freely (role `void`), or "outer", the cut of the image; a pressure of
    `pressure_kpa` pushes into the body, on the surface as it moves or (`following` false) as it was; `traction_kpa`
    (3,) is per area at rest; `acceleration_m_s2` (3,) acts on the tissues' `density_kg_m3`. `state`: number, from 1, of
    the later image in which it acts, those of further [[pairs]] after those of [images]; None: it acts in all of them;
    0: it acts in the reference state, whose shape the images, or the mesh, show under it.
    """

    kind: str = field(metadata=rule(choices=tuple(KEYS_OF_LOADS)))
    state: int | None = field(default=None, metadata=rule(between=(0, 1000)))
    surface: str | None = None
    pressure_kpa: float | None = field(default=None, metadata=rule(between=STRESSES_KPA))
    following: bool = True
    traction_kpa: Row | None = field(default=None, metadata=rule(between=STRESSES_KPA))
    acceleration_m_s2: Row | None = field(default=None, metadata=rule(between=(-100.0, 100.0)))

    @property
    def taken(self) -> CaseLoad:
        """What takes the load off a body that bears it: its forces, turned round."""
        pressure = None if self.pressure_kpa is None else -self.pressure_kpa
        traction, acceleration = _turned(self.traction_kpa), _turned(self.acceleration_m_s2)
        return replace(
            self, following=False, pressure_kpa=pressure, traction_kpa=traction, acceleration_m_s2=acceleration
        )

    def __post_init__(self) -> None:
        _check_keys(self, "[[loads]]", KEYS_OF_LOADS[self.kind], ("following",))


def _turned(vector: Row | None) -> Row | None:
    return None if vector is None else (-vector[0], -vector[1], -vector[2])


def _check_keys(stated: CaseData | CaseLoad, table: str, needs: Sequence[str], may_have: Sequence[str]) -> None:
    """Raise `ConfigurationError` where a key that its kind needs is missing, or another kind's is given."""
    for item in fields(stated):
        value = getattr(stated, item.name)
        if item.name in needs and value is None:
            raise ConfigurationError(f"{table}: a {stated.kind} needs the key '{item.name}'")
        if item.name not in ("kind", "state", *needs, *may_have) and value != item.default:
            known = " and ".join((*needs, *may_have))
            raise ConfigurationError(f"{table}: a {stated.kind} has no '{item.name}'; it has {known}")
