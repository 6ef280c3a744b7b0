"""What travels between a cohort, its engines and the processes that compute: plain values that are JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from palpate.errors import (
    ConfigurationError,
    EstimationError,
    GeometryError,
    InputDataError,
    PalpateError,
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
MEMORY_FACTOR = 2.0  # how far the prediction of `check` may be off
LEAST_MEMORY_GB = 2.0  # small predictions are off by more: libraries alone take half of one
TIME_FACTOR = 10.0  # a busy machine, and a start that takes long
LEAST_SECONDS = 900.0


def failure_class_of(error: BaseException) -> str:
    """The failure class of an error, by the exit code that `estimate` would end with."""
    if isinstance(error, MemoryError):
        return "resources"
    return CLASS_OF_EXIT_CODE.get(error.exit_code, "crash") if isinstance(error, PalpateError) else "crash"


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
    """What one case may take: memory (GB) and time (s), None: a multiple of what is predicted for it."""

    memory_gb: float | None = None
    seconds: float | None = None

    def memory_for(self, expected_gb: float) -> float:
        """Memory (GB) of a case whose estimate is predicted to take that much."""
        return self.memory_gb or max(MEMORY_FACTOR * expected_gb, LEAST_MEMORY_GB)

    def seconds_for(self, expected_seconds: float) -> float:
        """Seconds by the clock of a case whose estimate is predicted to take that long."""
        return self.seconds or max(TIME_FACTOR * expected_seconds, LEAST_SECONDS)


@dataclass(frozen=True, slots=True)
class Task:
    """A row to be computed into its folder.

    key: digest of what the row depends on, when the task was made; overrides: --set of the whole cohort; coarser: by
    which factor the mesh is coarser than asked for; expected_gb: predicted memory (GB), None until an attempt has told;
    room_gb: memory (GB) that it may count on where it runs, None: whatever there is; remarks: what earlier attempts
    came to; attempt: number of this one, from 1.
    """

    row: Row
    folder: str
    key: str = ""
    overrides: tuple[str, ...] = ()
    limits: Limits = field(default_factory=Limits)
    coarser: float = 1.0
    expected_gb: float | None = None
    room_gb: float | None = None
    remarks: tuple[str, ...] = ()
    attempt: int = 1

    def to_json(self) -> str:
        """One line of JSON."""
        return json.dumps(asdict(self), allow_nan=False)

    @classmethod
    def from_json(cls, text: str | bytes) -> Task:
        """The task that `to_json` wrote."""
        content = json.loads(text)
        row = content["row"] | {"after": tuple(content["row"]["after"])}
        plain = {key: tuple(content[key]) for key in ("overrides", "remarks")}
        return cls(**(content | plain | {"row": Row(**row), "limits": Limits(**content["limits"])}))


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a row came to: `state` "done" or "failed" with a class and a sentence.

    message of a row that is done: what to know of it, such as a coarser mesh; cause: why an attempt failed where the
    class alone does not say whether another may succeed: "memory", "lost", or "room" for one that needs more room than
    it had (expected_gb); result: SHA-256 of the result.json that it speaks of; seconds and peak_gb: what it took.
    """

    id: str
    state: str
    key: str = ""
    failure_class: str = ""
    message: str = ""
    cause: str = ""
    result: str = ""
    attempts: int = 1
    seconds: float = 0.0
    expected_gb: float | None = None
    peak_gb: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)

    @classmethod
    def failed(cls, task: Task, failure_class: str, message: str, *, cause: str = "") -> Outcome:
        """A failure of a task's attempt."""
        sentence = "; ".join((*task.remarks, message))
        return cls(task.row.id, "failed", task.key, failure_class, sentence, cause, attempts=task.attempt)

    def took(self, seconds: float, *, expected_gb: float | None, peak_gb: float | None) -> Outcome:
        """The same with what it took."""
        return replace(self, seconds=round(seconds, 3), expected_gb=expected_gb, peak_gb=peak_gb)
