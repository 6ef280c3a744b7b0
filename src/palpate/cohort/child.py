"""The process that works on one task: it says what comes to pass, and ends with whoever started it.

Started as `python -m palpate.cohort.child MODULE:FUNCTION` in a process group of its own, it imports the work, takes a
task as a line of JSON on its standard input, and answers on its standard output with lines of JSON: {"begun"}: the most
memory (GB) held by then, {"expected"}: memory (GB) and time (s), {"outcome"}. What it breaks, it breaks for itself
alone.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from palpate.cohort.task import Outcome, Task
from palpate.processes import peak_memory_gb
from palpate.study.lock import own_file

try:
    import resource
except ImportError:  # Windows
    LIMITED = False
else:
    LIMITED = True

Work = Callable[[Task, Callable[[float, float], None]], Outcome]

LOG = "log.txt"
MARGIN_BYTES = 2**30  # of address space for data beyond the limit on memory, whose watcher looks now and then


def main(work: str) -> None:
    """Work on the task of the standard input with the function `work` ("module:function")."""
    module, _, name = work.partition(":")
    function: Work = getattr(import_module(module), name)
    line = sys.stdin.buffer.readline()
    if not line:
        return
    task, answers = Task.from_json(line), os.dup(1)
    # what is logged, and what libraries print, goes to the log of the row's folder
    folder = Path(task.folder)
    folder.mkdir(parents=True, exist_ok=True)
    file = own_file(folder / LOG)
    for standard in (1, 2):
        os.dup2(file, standard)
    layout = "%(asctime)s %(levelname)s %(name)s: %(message)s"
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format=layout, force=True)
    logging.captureWarnings(capture=True)
    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    earlier = signal.pthread_sigmask(signal.SIG_BLOCK, signals)  # for ever in that thread: they reach the main one
    threading.Thread(target=_end_with_standard_input, daemon=True).start()
    signal.pthread_sigmask(signal.SIG_SETMASK, earlier)

    def say(content: dict[str, Any]) -> None:
        """Answer with a line."""
        os.write(answers, json.dumps(content, allow_nan=False).encode("ascii") + b"\n")

    def tell(memory_gb: float, seconds: float) -> None:
        """Pass the prediction on, and do not take more than it allows."""
        say({"expected": [memory_gb, seconds]})
        if LIMITED:
            n_bytes = int(1e9 * task.limits.memory_for(memory_gb)) + MARGIN_BYTES
            _, hard = resource.getrlimit(resource.RLIMIT_DATA)
            resource.setrlimit(resource.RLIMIT_DATA, (n_bytes if hard < 0 else min(n_bytes, hard), hard))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    say({"begun": peak_memory_gb() or 0.0})
    say({"outcome": function(task, tell).to_dict()})


def _end_with_standard_input() -> None:
    """Whoever started this process holds its standard input: when he is gone, it ends with all that it started."""
    os.read(0, 1)
    os.killpg(os.getpgrp(), signal.SIGKILL)


if __name__ == "__main__":
    try:
        main(sys.argv[1])
    except BaseException:
        logging.getLogger(__name__).exception("the task broke off")
        os._exit(1)
    os._exit(0)
