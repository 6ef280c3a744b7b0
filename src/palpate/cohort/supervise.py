"""One attempt of one task: in a child of a warm process, watched for memory, time and sudden ends."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, cast

from palpate.cohort.task import Outcome, Task
from palpate.errors import ResourceError

__all__ = ["ESTIMATE", "Supervisor"]

ESTIMATE = "palpate.cohort.work:estimate_row"
# One thread for each row: several would sum in another order, and the numbers would tell in their last digits how many
# workers there were, and where.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
LOOK_S = 0.1  # how often memory is looked at
START_S = 600.0  # for the warm process to import what it needs
BEFORE_PREDICTION_S = 3600.0  # for the images, each of which has limits of its own
MUCH = 0.5  # of the limit on memory: a child that the system kills beyond that was most likely too large
READ_SIZE = 65536


@dataclass(slots=True)
class Supervisor:
    """Runs tasks one after the other with the function `work` ("module:function"), on one thread each.

    Holds a process that has imported the work and forks a child for each task; `close` ends both.
    """

    work: str = ESTIMATE
    _process: subprocess.Popen[bytes] | None = None
    _rest: bytes = b""
    _closed: bool = False

    def attempt(self, task: Task) -> Outcome:
        """What one attempt of a task comes to; whatever happens to the child is an outcome, and the next one is new."""
        watch = _Watch(task)
        try:
            process = self._started()
            self._send(process, task)
            while watch.ended is None:
                for message in self._heard(process, LOOK_S):
                    watch.hear(message)
                watch.look()
        except (OSError, EOFError, ValueError):  # gone, closed from another thread, or no line of ours
            self._drop()
        return watch.verdict()

    def close(self) -> None:
        """End the process, and with it the child; from any thread."""
        self._closed = True
        self._drop()

    def _drop(self) -> None:
        process, self._process, self._rest = self._process, None, b""
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                cast("BinaryIO", pipe).close()

    def _started(self) -> subprocess.Popen[bytes]:
        if self._closed:
            raise EOFError
        if self._process is not None and self._process.poll() is None:
            return self._process
        self._drop()
        places = os.pathsep.join(str(Path(place).resolve()) for place in sys.path if place)
        environment = {**os.environ, **dict.fromkeys(THREADS, "1"), "PYTHONPATH": places}
        command = [sys.executable, "-P", "-W", "ignore", "-m", "palpate.cohort.warm", self.work]
        try:
            self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module, no shell
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
            )
        except OSError as error:
            raise ResourceError(
                f"no process could be started ({error.strerror}): is memory left, and a process for this user?"
            ) from error
        return self._process

    def _send(self, process: subprocess.Popen[bytes], task: Task) -> None:
        pipe = cast("BinaryIO", process.stdin)
        pipe.write(task.to_json().encode("ascii") + b"\n")
        pipe.flush()

    def _heard(self, process: subprocess.Popen[bytes], seconds: float) -> list[dict[str, Any]]:
        """The messages that have come; waits so long for the first. Raises `EOFError` when the process is gone."""
        pipe = cast("BinaryIO", process.stdout).fileno()
        if not select.select([pipe], [], [], seconds)[0]:
            return []
        part = os.read(pipe, READ_SIZE)
        if not part:
            raise EOFError
        *lines, self._rest = (self._rest + part).split(b"\n")
        return [json.loads(line) for line in lines]


@dataclass(slots=True)
class _Watch:
    """What is known of a running child, and the verdict when it has ended."""

    task: Task
    pid: int = 0
    began: float = field(default_factory=time.monotonic)  # of the child, once there is one
    expected_gb: float | None = None
    memory_gb: float = float("inf")  # limits
    seconds: float = BEFORE_PREDICTION_S
    peak_gb: float = 0.0
    stopped: str = ""  # why we ended it
    outcome: Outcome | None = None
    ended: int | None = None
    page: int = field(default_factory=lambda: os.sysconf("SC_PAGE_SIZE"))

    def __post_init__(self) -> None:
        if self.task.limits.seconds is not None:
            self.seconds = self.task.limits.seconds
        if self.task.limits.memory_gb is not None:
            self.memory_gb = self.task.limits.memory_gb

    def hear(self, message: dict[str, Any]) -> None:
        """Take one message."""
        if "pid" in message:
            self.pid, self.began = int(message["pid"]), time.monotonic()
        elif "expected" in message:
            self.expected_gb, seconds = map(float, message["expected"])
            self.memory_gb = self.task.limits.memory_for(self.expected_gb)
            self.seconds = self.task.limits.seconds_for(seconds)
        elif "outcome" in message:
            self.outcome = Outcome(**message["outcome"])
        else:
            self.ended, self.peak_gb = int(message["ended"]), max(float(message["peak_gb"]), self.peak_gb)

    def look(self) -> None:
        """End the child when it runs over a limit; raises `EOFError` when none comes."""
        seconds = time.monotonic() - self.began
        if not self.pid and seconds > START_S:
            raise EOFError
        if self.ended is not None or self.outcome is not None or not self.pid or self.stopped:
            return
        try:
            pages = int(Path(f"/proc/{self.pid}/statm").read_text(encoding="ascii").split()[1])
        except (OSError, IndexError, ValueError):  # it has ended, or the system does not tell
            pages = 0
        self.peak_gb = max(self.peak_gb, pages * self.page / 1e9)
        if pages * self.page / 1e9 > self.memory_gb:
            self._stop("memory")
        elif seconds > self.seconds:
            self._stop("time")

    def _stop(self, reason: str) -> None:
        self.stopped = reason
        for end in (os.killpg, os.kill):
            try:
                end(self.pid, signal.SIGKILL)
            except OSError:  # it has just ended, or its group has
                continue

    def verdict(self) -> Outcome:
        """The outcome that the child told, or what its end means."""
        seconds = time.monotonic() - self.began
        told = self.outcome if self.outcome is not None and not self.stopped else self._sudden_end()
        expected = told.expected_gb if self.expected_gb is None else self.expected_gb
        return told.took(seconds, expected_gb=expected, peak_gb=round(self.peak_gb, 3))

    def _sudden_end(self) -> Outcome:
        task, limit = self.task, self.memory_gb
        if self.stopped == "time":
            return Outcome.failed(task, "timeout", f"it took more than the {self.seconds:g} s that it was given")
        if self.stopped == "memory":
            text = f"it took more than the {limit:.1f} GB of memory that it was given"
            return Outcome.failed(task, "resources", text, cause="memory")
        if self.ended is None:
            return Outcome.failed(task, "lost", "the process that computed it is gone", cause="lost")
        if self.ended == -signal.SIGKILL and self.peak_gb > MUCH * limit:
            text = f"the system ended it at {self.peak_gb:.1f} GB of memory, most likely for want of more"
            return Outcome.failed(task, "resources", text, cause="memory")
        name = {-int(number): number.name for number in signal.Signals}.get(self.ended, f"exit code {self.ended}")
        if self.ended in (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGHUP, -signal.SIGINT):
            return Outcome.failed(task, "lost", f"something ended the process that computed it ({name})", cause="lost")
        return Outcome.failed(task, "crash", f"the process that computed it crashed ({name}); its log.txt may tell why")
