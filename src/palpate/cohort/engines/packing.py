"""Tasks shared out among places by their memory, and tried again where another attempt may succeed.

Nobody knows what a case needs before its images are read. So a first attempt reserves an equal share of its place; a
child that sees that it needs more computes nothing, says so, and waits until there is as much room.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from palpate.cohort.plan import held_soon, write_mark
from palpate.cohort.task import Outcome, Task
from palpate.errors import FolderInUse, ResourceError

LOST_ATTEMPTS = 3
GRACE_S = 10.0
COARSER = 1.3  # times the edge length: about half the unknowns
NOBODY = "there is no worker to compute on; start some, and run the cohort again with --resume"


@dataclass(frozen=True, slots=True)
class Place:
    """Where tasks run: memory for all of them together (GB), and how many at a time."""

    memory_gb: float
    slots: int


class Pool(Protocol):
    """Places that tasks can be started on; one attempt each."""

    def places(self) -> Mapping[str, Place]:
        """What there is at the moment, by name; may wait for the first. Raises `ResourceError` when it is gone."""
        ...

    def start(self, task: Task, place: str) -> Hashable:
        """Begin an attempt there, and give a handle of it."""
        ...

    def ended(self, running: Mapping[Hashable, Task]) -> Sequence[tuple[Hashable, Outcome]]:
        """Those of the handles that have ended, after a while or as soon as there is one."""
        ...


@dataclass(slots=True)
class _Load:
    """What runs where, and how much memory (GB) each reserves."""

    places: Mapping[str, Place] = field(default_factory=dict)
    reserved: dict[Hashable, tuple[str, float]] = field(default_factory=dict)

    def room(self, task: Task) -> tuple[str, float, bool] | None:
        """A place for a task, the memory (GB) it reserves there, and whether it is alone and may take what it needs."""
        most = max((place.memory_gb for place in self.places.values()), default=0.0)
        fitting: list[tuple[float, str, float]] = []
        for name, place in self.places.items():
            taken = [gb for where, gb in self.reserved.values() if where == name]
            need = place.memory_gb / place.slots if task.expected_gb is None else task.expected_gb
            free = place.memory_gb - sum(taken)
            if len(taken) < place.slots and need <= free * (1.0 + 1e-9):
                fitting.append((free, name, need))
            elif not taken and need > most == place.memory_gb:
                return name, place.memory_gb, True  # larger than any place: alone on the largest, come what may
        if not fitting:
            return None
        _, name, need = max(fitting) if task.expected_gb is None else min(fitting)
        return name, need, False


def packed(pool: Pool, tasks: Sequence[Task]) -> Iterator[Outcome]:
    """The outcome of each task on the places of a pool; what cannot be tried again is marked as failed."""
    waiting, running, load = deque(tasks), dict[Hashable, Task](), _Load()
    while waiting or running:
        load.places = pool.places()
        while waiting and (found := load.room(waiting[0])) is not None:
            task = waiting.popleft()
            place, reserved, unlimited = found
            handle = pool.start(replace(task, room_gb=None if unlimited else reserved), place)
            running[handle], load.reserved[handle] = task, (place, reserved)
        if not running:
            raise ResourceError(NOBODY)
        for handle, outcome in pool.ended(running):
            task = running.pop(handle)
            del load.reserved[handle]
            if (next_one := again(task, outcome)) is not None:
                waiting.appendleft(next_one)
            else:
                yield outcome if outcome.state == "done" else marked(task, outcome)


def again(task: Task, outcome: Outcome) -> Task | None:
    """The next attempt of a task after an outcome, None where there is none to be made.

    One without room waits for it; a lost one is tried again, twice; one that ran out of memory is tried on a coarser
    mesh, once; nothing else would end otherwise.
    """
    if outcome.cause == "room":
        return replace(task, expected_gb=outcome.expected_gb)
    if outcome.cause == "lost" and task.attempt < LOST_ATTEMPTS:
        return replace(task, attempt=task.attempt + 1)
    if outcome.cause == "memory" and task.coarser == 1.0:
        remark = f"{outcome.message}; so its mesh was made {COARSER} times as coarse as asked for"
        return replace(task, coarser=COARSER, expected_gb=None, attempt=task.attempt + 1, remarks=(remark,))
    return None


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
