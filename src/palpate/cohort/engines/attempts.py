"""Attempts of a task, as many as may help, in the memory of the place where they run.

Nobody knows what a case needs before its images are read. So a first attempt takes an equal share of the memory; a
child that sees that it needs more computes nothing, says so, and waits in turn until there is as much.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Condition, Lock
from typing import Protocol

from palpate.cohort.plan import held_soon, write_mark
from palpate.cohort.supervise import Supervisor
from palpate.cohort.task import Outcome, Task
from palpate.errors import FolderInUse

UNKNOWN_GB = 1e6  # where the system does not tell what is free
SHARE = 0.9  # of the free memory: predictions are rough, and other programs run, too
LOST_ATTEMPTS = 3
GRACE_S = 10.0
COARSER = 1.3  # times the edge length: about half the unknowns


class Memory:
    """Memory (GB) of a place, which the attempts in its slots share: who asks first has it first."""

    def __init__(self, total_gb: float, slots: int) -> None:
        self.total_gb, self.share_gb = total_gb, total_gb / slots
        self._free_gb, self._freed, self._turn = total_gb, Condition(), Lock()

    @contextmanager
    def held(self, gb: float) -> Iterator[None]:
        """While the block works it has so much, all that there is where that is less; waits until it is free."""
        taken = min(gb, self.total_gb)
        with self._turn, self._freed:
            self._freed.wait_for(lambda: taken <= self._free_gb + 1e-9 * self.total_gb)
            self._free_gb -= taken
        try:
            yield
        finally:
            with self._freed:
                self._free_gb += taken
                self._freed.notify()


def outcome_of(task: Task, supervisor: Supervisor, memory: Memory, *, elsewhere_gb: float = 0.0) -> Outcome:
    """What a task comes to; a failure has its mark in the row's folder.

    One that is lost is tried again, twice; one that ran out of memory is tried on a coarser mesh, once; nothing else
    would end otherwise. One that needs more than there is runs alone, come what may, or is given back (cause "room")
    where another place has `elsewhere_gb`. Of a supervisor that was closed no failure is marked.
    """
    need = memory.share_gb
    while True:
        with memory.held(need):
            room = None if need > memory.total_gb else need
            outcome = supervisor.attempt(replace(task, room_gb=room))
        if supervisor.closed or outcome.state == "done":
            return outcome
        if outcome.cause == "room":
            need = outcome.expected_gb or memory.total_gb
            if memory.total_gb < min(need, elsewhere_gb):
                return outcome
        elif outcome.cause == "lost" and task.attempt < LOST_ATTEMPTS:
            task = replace(task, attempt=task.attempt + 1)
        elif outcome.cause == "memory" and task.coarser == 1.0:
            remark = f"{outcome.message}; so its mesh was made {COARSER} times as coarse as asked for"
            task, need = replace(task, coarser=COARSER, attempt=task.attempt + 1, remarks=(remark,)), memory.share_gb
        else:
            return marked(task, outcome)


def marked(task: Task, outcome: Outcome) -> Outcome:
    """A failure with its mark in the row's folder; without one while a lost process still works there."""
    folder = Path(task.folder)
    try:
        with held_soon(folder, GRACE_S):
            return write_mark(folder, outcome)
    except FolderInUse:
        return outcome


class Engine(Protocol):
    """Who computes the rows of a cohort. Results and done marks are files in the rows' folders, never its own."""

    @property
    def name(self) -> str:
        """What `--engine` calls it."""
        ...

    def outcomes(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """The outcome of each task, in the order in which they end; a failed one's mark is written by then.

        Whoever stops asking ends what still runs. Raises `ResourceError` when the engine itself is gone: the rows
        without an outcome are then waiting.
        """
        ...
