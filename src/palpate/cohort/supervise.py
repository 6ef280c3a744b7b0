"""One attempt of one task: in a process of its own, watched for memory, time and sudden ends."""

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
from pathlib import Path
from typing import Any, BinaryIO, cast

from palpate.cohort.task import Outcome, Task
from palpate.errors import ResourceError
from palpate.processes import environment_of_child, name_of_end

ESTIMATE = "palpate.cohort.work:estimate_row"
LOOK_S = 0.1  # how often memory is looked at
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
    _running: set[int] = field(default_factory=set)  # process groups
    _closed: bool = False

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
        watch = _Watch(task, process)
        self._running.add(process.pid)
        try:
            if not self._closed:
                tasks, answers, rest = cast("BinaryIO", process.stdin), cast("BinaryIO", process.stdout).fileno(), b""
                with suppress(BrokenPipeError):  # it has ended already
                    tasks.write(task.to_json().encode("ascii") + b"\n")
                    tasks.flush()
                while watch.ended is None:
                    watch.look()
                    patience = LOOK_S if watch.ended is None else 0.0
                    while select.select([answers], [], [], patience)[0] and (part := os.read(answers, READ_SIZE)):
                        *lines, rest = (rest + part).split(b"\n")
                        for line in lines:
                            watch.hear(json.loads(line))
        finally:
            _end_group(process.pid)  # and what it has started
            watch.reap()
            self._running.discard(process.pid)
            for pipe in (process.stdin, process.stdout):
                with suppress(OSError):
                    cast("BinaryIO", pipe).close()
        return watch.verdict()

    def close(self) -> None:
        """End all processes; from any thread."""
        self._closed = True
        for group in tuple(self._running):
            _end_group(group)


def _end_group(group: int) -> None:
    with suppress(OSError):  # it has ended
        os.killpg(group, signal.SIGKILL)


@dataclass(slots=True)
class _Watch:
    """What is known of the process that works on a task, and the verdict when it has ended."""

    task: Task
    process: subprocess.Popen[bytes]
    began: float = field(default_factory=time.monotonic)  # the process, then its work
    working: bool = False
    before_gb: float = 0.0  # the most memory that was held by then, in part by whoever started it: that counts along
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
        if "begun" in message:
            self.working, self.began, self.before_gb = True, time.monotonic(), float(message["begun"])
        elif "expected" in message:
            self.expected_gb, seconds = map(float, message["expected"])
            self.memory_gb = self.task.limits.memory_for(self.expected_gb)
            self.seconds = self.task.limits.seconds_for(seconds)
        else:
            self.outcome = Outcome(**message["outcome"])

    def look(self) -> None:
        """Whether the process has ended; it is ended when it runs over a limit."""
        self.reap(os.WNOHANG)
        if self.ended is not None or self.outcome is not None or self.stopped:
            return
        seconds = time.monotonic() - self.began
        try:
            pages = int(Path(f"/proc/{self.process.pid}/statm").read_text(encoding="ascii").split()[1])
        except (OSError, IndexError, ValueError):  # it has ended, or the system does not tell
            pages = 0
        self.peak_gb = max(self.peak_gb, pages * self.page / 1e9)
        if self.working and pages * self.page / 1e9 > self.memory_gb:
            self.stopped = "memory"
        elif seconds > (self.seconds if self.working else START_S):
            self.stopped = "time" if self.working else "start"
        if self.stopped:
            _end_group(self.process.pid)

    def reap(self, options: int = 0) -> None:
        """Take in how the process ended; waits for it unless the options say otherwise."""
        if self.ended is None:
            pid, status, usage = os.wait4(self.process.pid, options)
            if pid:
                self.ended = self.process.returncode = os.waitstatus_to_exitcode(status)
                most = round(usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9, 3)
                if self.working and most > self.before_gb:
                    self.peak_gb = max(self.peak_gb, most)

    def verdict(self) -> Outcome:
        """The outcome that the child told, or what its end means."""
        seconds = time.monotonic() - self.began
        told = self.outcome if self.outcome is not None and not self.stopped else self._sudden_end()
        expected = told.expected_gb if self.expected_gb is None else self.expected_gb
        return told.took(seconds, expected_gb=expected, peak_gb=round(max(self.peak_gb, told.peak_gb or 0.0), 3))

    def _sudden_end(self) -> Outcome:
        task, limit = self.task, self.memory_gb
        if self.stopped == "time":
            return Outcome.failed(task, "timeout", f"it took more than the {self.seconds:g} s that it was given")
        if self.stopped == "memory":
            text = f"it took more than the {limit:.1f} GB of memory that it was given"
            return Outcome.failed(task, "resources", text, cause="memory")
        if self.ended == -signal.SIGKILL and self.peak_gb > MUCH * limit:
            text = f"the system ended it at {self.peak_gb:.1f} GB of memory, most likely for want of more"
            return Outcome.failed(task, "resources", text, cause="memory")
        code = self.ended or 0
        name = name_of_end(code)
        if code in (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGHUP, -signal.SIGINT):
            return Outcome.failed(task, "lost", f"something ended the process that computed it ({name})", cause="lost")
        return Outcome.failed(task, "crash", f"the process that computed it crashed ({name}); its log.txt may tell why")
