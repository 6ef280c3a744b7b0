"""What travels between a cohort and the workers that compute its rows: plain values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from palpate.errors import (
    ConfigurationError,
    EstimationError,
    GeometryError,
    InputDataError,
    ResourceError,
)

CLASS_OF_EXIT_CODE = {
    ConfigurationError.exit_code: "usage",
    InputDataError.exit_code: "input",
    GeometryError.exit_code: "geometry",
    EstimationError.exit_code: "solver",
    ResourceError.exit_code: "resources",
}
FAILURE_CLASSES = (*CLASS_OF_EXIT_CODE.values(), "crash", "timeout", "lost")
PROGRAM = ("-P", "-W", "ignore", "-m", "palpate.cohort.child")
A_DAY = 86400.0  # seconds


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the cohort's table: who, and either a case file or images with a template.

    after: several later states of one rest state are allowed; names: a label table beside the images; covariates: the
    table's further columns, name -> text; problem: why the line cannot be computed, in words.
    """

    id: str
    patient: str
    session: str = ""
    stage: int | None = None
    case: str = ""
    before: str = ""
    after: tuple[str, ...] = ()
    names: str = ""
    template: str = ""
    covariates: Mapping[str, str] = field(default_factory=dict)
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Limits:
    """What one row may take: memory (GB), None: its worker's share; time (s)."""

    memory_gb: float | None = None
    seconds: float = A_DAY


@dataclass(frozen=True, slots=True)
class Task:
    """A row to be computed into its folder.

    key: digest of what the row depends on, when the task was made; overrides: --set of the whole cohort; program:
    arguments of Python that run `palpate`.
    """

    row: Row
    folder: str
    key: str = ""
    overrides: tuple[str, ...] = ()
    limits: Limits = field(default_factory=Limits)
    program: tuple[str, ...] = PROGRAM


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a row came to: `state` "done" or "failed" with a class and a sentence.

    result: SHA-256 of the result.json that it speaks of; seconds and peak_gb: what it took.
    """

    id: str
    state: str
    key: str = ""
    failure_class: str = ""
    message: str = ""
    result: str = ""
    seconds: float = 0.0
    peak_gb: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)

    @classmethod
    def failed(cls, task: Task, failure_class: str, message: str) -> Outcome:
        """A failure of a task."""
        return cls(task.row.id, "failed", task.key, failure_class, message)
