"""Run by the tests of bad input: a warm process that forks one with limits for each command line it is given.

Reads a JSON line {"argv", "cwd", "memory_mb", "seconds", "wall_seconds", "file_mb", "env", "interrupt",
"append_after_reading"} and answers with one {"code", "out", "err", "seconds"}; a command that a signal
ended has a negative code.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import tempfile
import time

# Whatever a command imports, so that a fork costs nothing.
import nibabel  # noqa: F401

import palpate.cli
import palpate.cli.entry
import palpate.cli.written
import palpate.demo
import palpate.export.case_files
import palpate.report.case_report
import palpate.steps.commands
import palpate.steps.previewing
import palpate.steps.saving
import palpate.study.check
import palpate.study.new_case
import palpate.study.run
from palpate.images.readers import read as readers
from palpate.report import render

render.FINE = 1  # as in conftest.py: no picture is looked at here


def main() -> None:
    for line in sys.stdin:
        request = json.loads(line)
        with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
            began = time.monotonic()
            pid = os.fork()
            if pid == 0:
                _child(request, out.fileno(), err.fileno())
            if request.get("interrupt"):
                number, delay = request["interrupt"]
                time.sleep(delay)
                os.kill(pid, number)
            _, status = os.waitpid(pid, 0)
            answer = {"code": os.waitstatus_to_exitcode(status), "seconds": time.monotonic() - began}
            for name, file in (("out", out), ("err", err)):
                file.seek(0)
                answer[name] = file.read().decode("utf-8", errors="replace")
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


def _child(request: dict, out: int, err: int) -> None:
    code = 99
    try:
        os.dup2(out, 1)
        os.dup2(err, 2)
        os.chdir(request["cwd"])
        os.environ.update(request.get("env") or {})
        for name in ("DISPLAY", "WAYLAND_DISPLAY", "CUDA_VISIBLE_DEVICES"):
            os.environ.pop(name, None)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        memory = request["memory_mb"] << 20
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        resource.setrlimit(resource.RLIMIT_CPU, (request["seconds"], request["seconds"]))
        signal.alarm(request["wall_seconds"])
        if request.get("file_mb") is not None:
            size = int(request["file_mb"] * 2**20)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        if request.get("append_after_reading"):
            _append_after_reading()
        try:
            code = palpate.cli.main(request["argv"])
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 98
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def _append_after_reading() -> None:
    """Every image is changed as soon as it was read."""
    real = readers.read_stored

    def changing(path, *arguments):
        stored = real(path, *arguments)
        with path.open("ab") as file:
            file.write(b"changed")
        return stored

    readers.read_stored = changing


if __name__ == "__main__":
    main()
