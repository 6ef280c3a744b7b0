"""The process that runs command lines under limits, and the folder of a good case to be spoilt."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # tests are no package; bad_inputs.py lies here

from bad_inputs import CASE, anatomy, save

MEMORY_MB = 3000  # of address space
SECONDS = 60  # of processor time
WALL_SECONDS = 1800  # a hang, not a busy machine

ONE_THREAD = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


class Limited:
    """A process that forks one with limits for each command line."""

    def __init__(self) -> None:
        script = Path(__file__).with_name("limited.py")
        self._process = subprocess.Popen(
            [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=ONE_THREAD
        )

    def __call__(self, *argv: str, cwd: Path, **limits) -> dict:
        request = {
            "argv": argv,
            "cwd": str(cwd),
            "memory_mb": MEMORY_MB,
            "seconds": SECONDS,
            "wall_seconds": WALL_SECONDS,
        } | limits
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


@pytest.fixture(scope="session")
def palpate():
    process = Limited()
    yield process
    process.close()


@pytest.fixture(scope="session")
def good(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    save(folder / "before.nii.gz", anatomy())
    save(folder / "after.nii.gz", anatomy(shift=0.8, radius=6.0))
    (folder / "case.toml").write_text(CASE)
    return folder


@pytest.fixture
def folder(good, tmp_path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "case"))
