"""A request to end is answered with one sentence and 130 from the first line of Palpate to its last."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")
IMPORTS = """
import os, signal, sys
class Finder:
    def find_spec(self, name, *_):
        if name == "{module}":
            os.kill(os.getpid(), signal.{signal})
sys.meta_path.insert(0, Finder())
sys.argv = ["palpate", "check", "nowhere.toml"]
from palpate.cli import main
sys.exit(main())
"""

ENDING = """
import atexit, os, signal, sys
atexit.register(lambda: os.kill(os.getpid(), signal.{signal}))
sys.argv = ["palpate", "--version"]
from palpate.cli import main
sys.exit(main())
"""

THREADS = """
import sys
from palpate.cli import entry, main
from palpate.cli.outcome import Outcome
def run(*_):
    import pathlib, signal, palpate.study.run
    from palpate.mesh.remeshing import _others_take_none
    threads = len(list(pathlib.Path("/proc/self/task").iterdir()))
    own = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    return Outcome({{}}, f"{{threads > 1}} {{_others_take_none((signal.SIGINT, signal.SIGTERM))}} {{sorted(own)}}")
entry._run = run
sys.argv = ["palpate", "check", "x.toml"]
sys.exit(main())
"""


def script(text: str, **words: str) -> subprocess.CompletedProcess[str]:
    threads = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "2")
    command = [sys.executable, "-c", text.format(**words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=threads)


@pytest.mark.parametrize(
    ("module", "signal"),
    [
        *((module, name) for module in ("argparse", "palpate.cli.console", "numpy") for name in SIGNALS),
        ("palpate.study.check", "SIGHUP"),  # as late, after many others
    ],
)
def test_a_signal_while_modules_are_imported_ends_with_130_and_a_sentence(module, signal):
    done = script(IMPORTS, module=module, signal=signal)
    assert (done.returncode, done.stdout) == (130, ""), done.stderr
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("palpate: interrupted; no file was changed")


def test_a_signal_that_something_makes_another_exception_of_is_still_one():
    """A class body wraps what its descriptors raise; so does a library."""
    wrapped = THREADS.replace(
        "    import pathlib",
        "    import os, signal\n    try:\n        os.kill(os.getpid(), signal.SIGTERM)\n"
        "    except KeyboardInterrupt as stop:\n        raise RuntimeError('Error calling __set_name__') from stop\n"
        "    import pathlib",
    )
    done = script(wrapped)
    assert (done.returncode, "interrupted" in done.stderr, "bug" in done.stderr) == (130, True, False)


@pytest.mark.parametrize("signal", SIGNALS)
def test_a_signal_after_the_last_word_changes_nothing(signal):
    done = script(ENDING, signal=signal)
    assert (done.returncode, done.stderr) == (0, "")


def test_what_the_process_was_told_to_ignore_it_ignores():
    done = script(IMPORTS.replace("sys.meta_path", "signal.signal(signal.SIGHUP, signal.SIG_IGN)\nsys.meta_path"),
                  module="palpate.study.check", signal="SIGHUP")  # fmt: skip
    assert done.returncode == 2
    assert "nowhere.toml" in done.stdout + done.stderr


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are told of in /proc")
def test_no_thread_but_the_main_one_takes_the_signals():
    done = script(THREADS)
    assert done.stdout == "True True []\n", done.stderr
