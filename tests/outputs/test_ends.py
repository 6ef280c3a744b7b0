"""Signals end a run with one sentence and 130, from its first line to its last; streams that fail end none."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers import write_label_image

PALPATE = shlex.quote(str(Path(sys.executable).with_name("palpate")))
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
atexit.register(lambda: [os.kill(os.getpid(), number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)])
sys.argv = ["palpate", "--version"]
from palpate.cli import main
sys.exit(main())
"""
THREADS = """
import os, pathlib, signal, sys
from palpate.cli import entry, main
from palpate.cli.outcome import Outcome
def run(*_):
    import palpate.study.run
    from palpate.mesh.remeshing import _others_take_none
    threads = len(list(pathlib.Path("/proc/self/task").iterdir()))
    own = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    return Outcome({{}}, f"{{threads > 1}} {{_others_take_none((signal.SIGINT, signal.SIGTERM))}} {{sorted(own)}}")
def wrapped(*_):
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    except KeyboardInterrupt as stop:  # as class bodies and libraries do
        raise RuntimeError('Error calling __set_name__') from stop
entry._run = {work}
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
    done = script(THREADS, work="wrapped")
    assert (done.returncode, "interrupted" in done.stderr, "bug" in done.stderr) == (130, True, False)


def test_signals_after_the_last_word_change_nothing():
    done = script(ENDING)
    assert (done.returncode, done.stderr) == (0, "")


def test_what_the_process_was_told_to_ignore_it_ignores():
    ignoring = IMPORTS.replace("sys.meta_path", "signal.signal(signal.SIGHUP, signal.SIG_IGN)\nsys.meta_path")
    done = script(ignoring, module="palpate.study.check", signal="SIGHUP")
    assert done.returncode == 2
    assert "nowhere.toml" in done.stdout + done.stderr


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are told of in /proc")
def test_no_thread_but_the_main_one_takes_the_signals():
    done = script(THREADS, work="run")
    assert done.stdout == "True True []\n", done.stderr


def shell(folder: Path, arguments: str, **variables: str) -> subprocess.CompletedProcess[bytes]:
    """`palpate` with arguments and redirections; its own code where it stands in a pipe."""
    command = ["bash", "-c", f"{PALPATE} {arguments}; exit ${{PIPESTATUS[0]}}"]
    environment = {key: of for key, of in os.environ.items() if key != "PYTHONIOENCODING"} | variables
    return subprocess.run(command, cwd=folder, capture_output=True, check=False, env=environment)


@pytest.fixture
def images(tmp_path):
    """A folder with what `init` needs."""
    places = np.stack(np.meshgrid(*[np.arange(16.0)] * 3, indexing="ij"), axis=-1)
    for name, radius in (("before", 3.0), ("after", 4.0)):
        labels = (np.linalg.norm(places - 8.0, axis=-1) < radius).astype(int)
        write_label_image(tmp_path / f"{name}.nii.gz", LabelImage(labels, VoxelGrid((16, 16, 16), np.eye(4))))
    (tmp_path / "names.json").write_text(json.dumps({"1": "größe 前立腺"}), encoding="utf-8")
    return tmp_path


INIT = "init before.nii.gz after.nii.gz --labels names.json --output out"


@pytest.mark.parametrize(
    ("after", "code", "said"),
    [
        (">/dev/full", 0, ""),
        ("2>/dev/full", 0, None),
        (">/dev/full 2>&1", 0, ""),
        ("<&- >&- 2>&-", 0, ""),
        ("2>&1 | head -0", 0, ""),
        ("--json --quiet | head -0", 0, ""),
        ("--json --quiet >/dev/full", 6, "could not be written to standard output (No space left on device); all"),
        ("--json --quiet >&-", 6, "could not be written to standard output (it is closed); all files are written in"),
    ],
)
def test_a_stream_that_fails_costs_no_run(images, after, code, said):
    """All files are written, whatever a stream does."""
    done = shell(images, f"{INIT} {after}")
    assert done.returncode == code, done.stderr
    assert "größe" in (images / "out" / "case.toml").read_text(encoding="utf-8")
    assert sorted(path.name for path in (images / "out").iterdir()) == ["case.toml", "preview.html"]
    assert b"Traceback" not in done.stderr
    assert (said or "") in done.stderr.decode()
    assert said is not None or b"case.toml" in done.stdout
    assert code == 0 or len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("encoding", ["ascii", "utf-16"])
def test_letters_that_a_stream_lacks_are_escaped(images, encoding):
    said = shell(images, INIT, PYTHONIOENCODING=encoding).stdout.decode(encoding)
    assert ("größe 前立腺" if encoding == "utf-16" else r"gr\xf6\xdfe \u524d\u7acb\u817a") in said
    document = json.loads(shell(images, f"{INIT} --json", PYTHONIOENCODING=encoding).stdout.decode(encoding))
    assert "größe 前立腺" in [tissue["tissue"] for tissue in document["tissues"]]


@pytest.mark.parametrize("arguments", ["--help >/dev/full", "--help | true", "--version >&-", "estimate 2>/dev/full"])
def test_help_and_usage_need_no_stream_either(tmp_path, arguments):
    done = shell(tmp_path, arguments)
    assert done.returncode == (0 if arguments.startswith("--") else 2)
    assert b"Traceback" not in done.stderr  # argparse itself turns to the other stream where one is closed


def test_modules_of_the_working_folder_are_not_run(tmp_path):
    for name in ("numpy", "argparse", "scipy", "logging", "json", "pathlib", "typing", "dataclasses"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('the working folder was searched')\n")
    command = [sys.executable, "-m", "palpate", "check", "nowhere.toml"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert "nowhere.toml" in done.stdout + done.stderr
