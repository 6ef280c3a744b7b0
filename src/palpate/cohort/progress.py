"""Where a cohort stands: rows by state, and the time that is left."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate.cohort.plan import CASES, read_plan
from palpate.cohort.task import Outcome
from palpate.progress import about
from palpate.study.lock import is_held


@dataclass(frozen=True, slots=True)
class Status:
    """Rows by state and failed ones by class; seconds that are left, None where nobody can tell; whether one runs."""

    rows: int
    done: int
    failed: dict[str, int]
    running: int
    waiting: int
    seconds_left: float | None
    active: bool

    def to_dict(self) -> dict[str, Any]:
        """A JSON document, schema palpate.status/1."""
        left = None if self.seconds_left is None else round(self.seconds_left)
        counts = {"done": self.done, "failed": sum(self.failed.values()), "running": self.running}
        return {
            "schema": "palpate.status/1",
            "rows": self.rows,
            **counts,
            "waiting": self.waiting,
            "failed_by_class": self.failed,
            "seconds_left": left,
            "active": self.active,
        }

    def text(self) -> str:
        """The same in a line for people."""
        classes = ", ".join(f"{count} {name}" for name, count in sorted(self.failed.items()))
        failed = f"{sum(self.failed.values())} failed" + (f" ({classes})" if classes else "")
        parts = [f"{self.rows} rows: {self.done} done", failed, f"{self.running} running", f"{self.waiting} waiting"]
        if self.seconds_left is not None and self.waiting + self.running:
            parts.append(f"{about(self.seconds_left)} left")
        return ", ".join(parts)


def status_of(folder: Path) -> Status:
    """Where the cohort in `folder` stands, as its files tell; raises `InputDataError` when there is none."""
    plan = read_plan(folder)
    marks = plan.marks(folder, checked=False)
    running = [
        row.id for row, mark in zip(plan.rows, marks, strict=True) if mark is None and is_held(folder / CASES / row.id)
    ]
    took = [mark.seconds for mark in marks if mark is not None and mark.state == "done"]
    waiting = sum(mark is None for mark in marks)
    return Status(
        rows=len(marks),
        done=len(took),
        failed=dict(Counter(mark.failure_class for mark in marks if mark is not None and mark.state == "failed")),
        running=len(running),
        waiting=waiting - len(running),
        seconds_left=sum(took) / len(took) * waiting / max(len(running), plan.workers or 1) if took else None,
        active=is_held(folder),
    )


@dataclass(slots=True)
class Tally:
    """Counts of a run while it goes on."""

    rows: int
    left: int
    states: Counter[str]
    began: float = field(default_factory=time.monotonic)
    ended: int = 0

    def add(self, outcome: Outcome) -> str:
        """Count one more outcome, and say where the run stands."""
        self.states[outcome.state] += 1
        self.ended, self.left = self.ended + 1, self.left - 1
        seconds = (time.monotonic() - self.began) / self.ended * self.left
        what = f"failed ({outcome.failure_class}): {outcome.message}" if outcome.state == "failed" else "done"
        counts = f"{self.states['done']} done, {self.states['failed']} failed, {self.left} to go of {self.rows}"
        return f"{outcome.id}: {what} [{counts}{f', {about(seconds)} left' if self.left else ''}]"
