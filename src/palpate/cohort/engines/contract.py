"""What the cohort owes nothing but rows to: an engine takes tasks, and gives an outcome for each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

from palpate.cohort.task import Outcome, Task

__all__ = ["Engine"]


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
