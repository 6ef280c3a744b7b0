"""One attempt of one task: in a process of its own, with a limit of time, whose sudden end is an outcome, too."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, BinaryIO, cast

from palpate.cohort.task import Outcome, Task
from palpate.errors import ResourceError
from palpate.parallel import environment_of_child, name_of_end

ESTIMATE = "palpate.cohort.work:estimate_row"
START_S = 600.0  # for the process to import what it needs
BEFORE_PREDICTION_S = 3600.0  # for the images, each of which has limits of its own
MUCH = 0.5  # of the limit on memory: a child that the system kills beyond that was most likely too large
READ_SIZE = 65536


@dataclass(slots=True)
class Supervisor:
    """Runs tasks with the function `work` ("module:function"), each in a new process and on one thread.

    Several may run side by side, one a thread of the caller's; `close` ends them all.
    """

    work: str = ESTIMATE
    closed: bool = False
    _running: set[int] = field(default_factory=set)  # process groups

    def attempt(self, task: Task) -> Outcome:
        """What one attempt of a task comes to; whatever happens to its process is an outcome.

        Raises `ResourceError` where no process can be started.
        """
        command = [sys.executable, "-P", "-W", "ignore", "-m", "palpate.cohort.child", self.work]
        # On one thread: several would sum in another order, and the numbers would tell in their last digits how many
        # workers there were, and where.
        environment = environment_of_child()
        try:
            process = subprocess.Popen(  # noqa: S603 - our own interpreter and module, no shell
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, process_group=0
            )
        except OSError as error:
            raise ResourceError(
                f"no process could be started ({error.strerror}): is memory left, and a process for this user?"
            ) from error
        tasks, answers = cast("BinaryIO", process.stdin), cast("BinaryIO", process.stdout)
        watch = _Watch(task)
        self._running.add(process.pid)
        try:
            if not self.closed:
                with suppress(BrokenPipeError):  # it has ended already
                    tasks.write(task.to_json().encode("ascii") + b"\n")
                    tasks.flush()
                watch.listen(answers.fileno())
        finally:
            _end_group(process.pid)  # and what it has started
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            self._running.discard(process.pid)
            for pipe in (tasks, answers):
                with suppress(OSError):
                    pipe.close()
        peak_gb = round(usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9, 3)
        return watch.verdict(process.returncode, peak_gb)

    def close(self) -> None:
        """End all processes; from any thread."""
        self.closed = True
        for group in tuple(self._running):
            _end_group(group)


def _end_group(group: int) -> None:
    with suppress(OSError):  # it has ended
        os.killpg(group, signal.SIGKILL)


@dataclass(slots=True)
class _Watch:
    """What is known of the process that works on a task, and the verdict when it has ended."""

    task: Task
    began: float = field(default_factory=time.monotonic)  # the process, then its work
    before_gb: float | None = None  # the most memory when its work began, in part of whoever started it; None: not yet
    expected: tuple[float, float] | None = None  # memory (GB) and time (s)
    outcome: Outcome | None = None
    late: bool = False

    @property
    def seconds(self) -> float:
        """How long it may take from `began` on."""
        if self.before_gb is None:
            return START_S
        limits = self.task.limits
        return limits.seconds_for(self.expected[1]) if self.expected else limits.seconds or BEFORE_PREDICTION_S

    def listen(self, answers: int) -> None:
        """Hear what it says until it has told its outcome, has ended, or is late."""
        rest = b""
        while self.outcome is None:
            left = max(self.began + self.seconds - time.monotonic(), 0.0)
            if not select.select([answers], [], [], left)[0]:
                self.late = True
                return
            if not (part := os.read(answers, READ_SIZE)):
                return
            *lines, rest = (rest + part).split(b"\n")
            for line in lines:
                self._hear(json.loads(line))

    def _hear(self, message: dict[str, Any]) -> None:
        if "begun" in message:
            self.began, self.before_gb = time.monotonic(), float(message["begun"])
        elif "expected" in message:
            memory_gb, seconds = map(float, message["expected"])
            self.expected = memory_gb, seconds
        elif self.outcome is None:  # the first that it told
            self.outcome = Outcome(**message["outcome"])

    def verdict(self, code: int, most_gb: float) -> Outcome:
        """The outcome that the child told, or what its exit code means; most_gb: the most memory that it held."""
        peak_gb = most_gb if self.before_gb is not None and most_gb > self.before_gb else 0.0
        told = self.outcome or self._sudden_end(code, peak_gb)
        expected_gb = self.expected[0] if self.expected else told.expected_gb
        peak_gb = round(max(peak_gb, told.peak_gb or 0.0), 3)
        return told.took(time.monotonic() - self.began, expected_gb=expected_gb, peak_gb=peak_gb)

    def _sudden_end(self, code: int, peak_gb: float) -> Outcome:
        task, limits = self.task, self.task.limits
        if self.late and self.before_gb is not None:
            return Outcome.failed(task, "timeout", f"it took more than the {self.seconds:g} s that it was given")
        limit_gb = limits.memory_for(self.expected[0]) if self.expected else limits.memory_gb or float("inf")
        if code == -signal.SIGKILL and peak_gb > MUCH * limit_gb:
            text = f"the system ended it at {peak_gb:.1f} GB of memory, most likely for want of more"
            return Outcome.failed(task, "resources", text, cause="memory")
        name = name_of_end(code)
        if code in (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGHUP, -signal.SIGINT):
            return Outcome.failed(task, "lost", f"something ended the process that computed it ({name})", cause="lost")
        return Outcome.failed(task, "crash", f"the process that computed it crashed ({name}); its log.txt may tell why")
