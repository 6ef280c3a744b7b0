"""A warm process that forks a child for each task: what a case breaks, it breaks for itself alone.

Started as `python -m palpate.cohort.warm MODULE:FUNCTION`, it imports the work, then takes tasks as lines of JSON on
its standard input and answers on its standard output with lines of JSON: {"pid"} of the child, {"expected"}: memory
(GB) and time (s), {"outcome"}, and when the child has ended {"ended": exit code, below zero a signal's number,
"peak_gb"}. When whoever started it is gone, its child is ended and so is it.
"""

from __future__ import annotations

import json
import logging
import os
import select
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from palpate.cohort.task import Outcome, Task
from palpate.study.lock import own_file

__all__ = ["main", "reader_of_lines"]

try:
    import resource
except ImportError:  # Windows, where nothing forks either
    LIMITED = False
else:
    LIMITED = True

Work = Callable[[Task, Callable[[float, float], None]], Outcome]

LOG = "log.txt"
MARGIN_BYTES = 2**30  # of address space for data beyond the limit on memory, whose watcher looks now and then
READ_SIZE = 65536


def main(work: str) -> None:
    """Serve tasks with the function `work` ("module:function") until the standard input ends."""
    module, _, name = work.partition(":")
    function: Work = getattr(import_module(module), name)
    answers = os.dup(1)
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 1)
    woken, waker = os.pipe()
    for end in (woken, waker):
        os.set_blocking(end, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal: whoever started this process ends it
    signal.set_wakeup_fd(waker)
    for line in reader_of_lines(0):
        child = os.fork()
        if child == 0:
            _be_child(function, Task.from_json(line), answers)
        try:
            _say(answers, {"pid": child})
            _wait(child, woken, answers)
        except BrokenPipeError:  # nobody listens any more
            _end_group(child)
            os._exit(1)


def reader_of_lines(file: int) -> Any:
    """The lines that come on an open file; what comes after a line is kept in this process alone."""
    rest = b""
    while part := os.read(file, READ_SIZE):
        *lines, rest = (rest + part).split(b"\n")
        yield from lines


def _wait(child: int, woken: int, answers: int) -> None:
    """Until the child has ended; when nobody listens any more, it is ended."""
    poll = select.poll()
    poll.register(woken, select.POLLIN)
    poll.register(0, 0)  # tells of a hang-up alone
    while True:
        pid, status, usage = os.wait4(child, os.WNOHANG)
        if pid == child:
            unit = 1 if sys.platform == "darwin" else 1024
            code = os.waitstatus_to_exitcode(status)
            _end_group(child)
            _say(answers, {"ended": code, "peak_gb": round(usage.ru_maxrss * unit / 1e9, 3)})
            return
        if any(file == 0 for file, _ in poll.poll()):
            _end_group(child)
            os._exit(1)
        with suppress(BlockingIOError):
            os.read(woken, READ_SIZE)


def _be_child(work: Work, task: Task, answers: int) -> None:
    """Work on one task, and end without a word of the interpreter's."""
    code = 1
    try:
        os.setpgid(0, 0)  # its own children end with it
        signal.set_wakeup_fd(-1)
        for number in (signal.SIGCHLD, signal.SIGINT):
            signal.signal(number, signal.SIG_DFL)
        _die_with(os.getppid())
        _open_log(Path(task.folder))

        def tell(memory_gb: float, seconds: float) -> None:
            """Pass the prediction on, and do not take more than it allows."""
            _say(answers, {"expected": [memory_gb, seconds]})
            _limit(int(1e9 * task.limits.memory_for(memory_gb)) + MARGIN_BYTES)

        _say(answers, {"outcome": work(task, tell).to_dict()})
        code = 0
    except BaseException:
        logging.getLogger(__name__).exception("the task broke off")
    finally:
        os._exit(code)


def _open_log(folder: Path) -> None:
    """What is logged, and what libraries print, goes to the log of the row's folder."""
    folder.mkdir(parents=True, exist_ok=True)
    file = own_file(folder / LOG)
    for standard in (1, 2):
        os.dup2(file, standard)
    os.close(file)
    layout = "%(asctime)s %(levelname)s %(name)s: %(message)s"
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format=layout, force=True)
    logging.captureWarnings(capture=True)


def _limit(n_bytes: int) -> None:
    if LIMITED:
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        lowest = n_bytes if hard == resource.RLIM_INFINITY else min(n_bytes, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (lowest, hard))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _die_with(parent: int) -> None:
    """On Linux, be killed when the parent process is; elsewhere the folder's lock alone keeps two from one row."""
    if sys.platform == "linux":
        import ctypes  # noqa: PLC0415 - a third of a second that other systems need not spend

        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() != parent:
            os._exit(1)


def _end_group(child: int) -> None:
    for end in (os.killpg, os.kill):
        with suppress(OSError):
            end(child, signal.SIGKILL)


def _say(answers: int, content: dict[str, Any]) -> None:
    os.write(answers, json.dumps(content, allow_nan=False).encode("ascii") + b"\n")


if __name__ == "__main__":
    main(sys.argv[1])
