"""What another package brings by its entry points is a reader, a kind of data and a command like our own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest

TOY = """
import numpy as np

from palpate.cli.outcome import Outcome
from palpate.images.readers import ImageFormat, StoredImage
from palpate.observation.registry import SourceKind


def read(path):
    side = int(path.read_text())
    labels = np.zeros((side, side, side), dtype=np.uint8)
    labels[1, 1, 1] = 7
    return StoredImage(labels, np.diag([2.0, 2.0, 2.0, 1.0]))


def add(command):
    toys = Outcome({"toys": 3}, "three toys")
    command("toy", lambda *_: toys, what="count toys", folder=None, examples=("palpate toy",))


FORMAT = ImageFormat("toy", (".toy",), read)
DATA = SourceKind(lambda file: None, needs=("file",), may_have=())
"""
READ = """
from pathlib import Path
from palpate.images import read_label_image
from palpate.case.data import SOURCES
print(read_label_image(Path("a.toy")).labels.sum(), "toy" in SOURCES, "landmarks" in SOURCES)
"""
REFUSED = """
from palpate.entry_points import brought
from palpate.errors import ConfigurationError
from types import FunctionType
for group in ("toys.missing", "toys.other", "toys.taken"):
    try:
        brought(group, FunctionType, taken=("demo",))
    except ConfigurationError as error:
        print(error)
"""
ENTRY_POINTS = """
[palpate.readers]
toy = toy:FORMAT
[palpate.data]
toy = toy:DATA
[palpate.commands]
toy = toy:add
[toys.missing]
toy = toy:missing
[toys.other]
toy = toy:DATA
[toys.taken]
demo = toy:add
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder in which a package `toy` with these entry points is installed."""
    folder = tmp_path_factory.mktemp("toy")
    (folder / "toy.py").write_text(TOY)
    (folder / "a.toy").write_text("4")
    distribution = folder / "toy-1.0.dist-info"
    distribution.mkdir()
    (distribution / "METADATA").write_text("Metadata-Version: 2.1\nName: toy\nVersion: 1.0\n")
    (distribution / "entry_points.txt").write_text(ENTRY_POINTS)
    return folder


def run(folder, *arguments):
    """Run Python where that package is installed."""
    command, environment = [sys.executable, *arguments], os.environ | {"PYTHONPATH": str(folder)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_a_reader_reads_its_files_and_a_kind_of_data_stands_beside_our_own(installed):
    done = run(installed, "-c", READ)
    assert (done.stdout.strip(), done.stderr) == ("7 True True", "")


def test_a_command_is_run_like_our_own(installed):
    done = run(installed, "-m", "palpate", "toy")
    assert (done.returncode, done.stdout.strip()) == (0, "three toys")


def test_one_that_cannot_be_used_is_refused_with_its_package(installed):
    missing, other, taken = run(installed, "-c", REFUSED).stdout.splitlines()
    assert missing.startswith("toy brings toy (toys.missing), but toy:missing cannot be imported: AttributeError")
    assert "toy:DATA is no function" in other
    assert "brings demo (toys.taken), but that name is taken" in taken


def test_a_command_that_cannot_be_imported_is_a_matter_of_usage(installed, tmp_path):
    shutil.copytree(installed, tmp_path / "broken")
    (tmp_path / "broken" / "toy.py").unlink()
    done = run(tmp_path / "broken", "-m", "palpate", "--version")
    assert done.returncode == 2
    assert "toy brings toy (palpate.commands)" in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
