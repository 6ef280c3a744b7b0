"""What another package brings by its entry points is a reader, a kind of data and a command like our own."""

from __future__ import annotations

import os
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
print(read_label_image(Path("a.toy")).labels.sum())
"""
KINDS = "from palpate.study.case_data import SOURCES; print('toy' in SOURCES, 'landmarks' in SOURCES)"


@pytest.fixture
def run(tmp_path):
    """Run Python where a package `toy` with these entry points is installed; what it prints, and its exit code."""
    (tmp_path / "toy.py").write_text(TOY)
    (tmp_path / "a.toy").write_text("4")
    installed = tmp_path / "toy-1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: toy\nVersion: 1.0\n")

    def run_with(entry_points: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        (installed / "entry_points.txt").write_text(entry_points)
        environment = os.environ | {"PYTHONPATH": str(tmp_path)}
        command = [sys.executable, *arguments]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)

    return run_with


def test_a_reader_reads_its_files(run):
    done = run("[palpate.readers]\ntoy = toy:FORMAT\n", "-c", READ)
    assert (done.stdout.strip(), done.stderr) == ("7", "")


def test_a_kind_of_data_stands_beside_our_own(run):
    done = run("[palpate.data]\ntoy = toy:DATA\n", "-c", KINDS)
    assert (done.stdout.strip(), done.stderr) == ("True True", "")


def test_a_command_is_run_and_helped(run):
    done = run("[palpate.commands]\ntoy = toy:add\n", "-m", "palpate", "toy")
    assert (done.returncode, done.stdout.strip()) == (0, "three toys")
    assert "count toys" in run("[palpate.commands]\ntoy = toy:add\n", "-m", "palpate", "--help").stdout


@pytest.mark.parametrize(
    ("entry_points", "said"),
    [
        ("[palpate.commands]\ntoy = toy:missing\n", "toy brings toy (palpate.commands), but toy:missing cannot be"),
        ("[palpate.commands]\ntoy = toy:DATA\n", "is no function"),
        ("[palpate.commands]\ndemo = toy:add\n", "that name is taken"),
    ],
)
def test_one_that_cannot_be_used_is_refused_with_its_package(run, entry_points, said):
    done = run(entry_points, "-m", "palpate", "toy")
    assert done.returncode == 2
    assert said in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
