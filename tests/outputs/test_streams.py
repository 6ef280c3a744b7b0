"""What is said to a person never decides a run; each case here is a process of its own with a stream that fails."""

from __future__ import annotations

import json
import os
import pty
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import nibabel
import numpy as np
import pytest

PALPATE = shlex.quote(str(Path(sys.executable).with_name("palpate")))


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    places = np.stack(np.meshgrid(*[np.arange(16.0)] * 3, indexing="ij"), axis=-1)
    for name, radius in (("before", 3.0), ("after", 4.0)):
        labels = (np.linalg.norm(places - 8.0, axis=-1) < radius).astype(np.uint8)
        nibabel.save(nibabel.Nifti1Image(labels, np.eye(4)), folder / f"{name}.nii.gz")
    (folder / "names.json").write_text(json.dumps({"1": "größe 前立腺"}), encoding="utf-8")
    return folder


def init(images: Path, folder: Path, *, flags: str = "", after: str = "", **variables: str):
    """`palpate init`, which talks on both streams, with the code of Palpate itself where it stands in a pipe."""
    arguments = f"init before.nii.gz after.nii.gz --labels names.json --output {shlex.quote(str(folder))} {flags}"
    command = f"{PALPATE} {arguments} {after}; exit ${{PIPESTATUS[0]}}"
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONIOENCODING"} | variables
    return subprocess.run(
        ["bash", "-c", command], cwd=images, capture_output=True, text=True, env=environment, check=False
    )


AT_ONCE = """
import os, sys
import palpate.cli.entry, palpate.steps.commands, palpate.steps.previewing
from palpate.cli import main

NAMES = ("stdin", "stdout", "stderr")
children = []
for number, redirections in enumerate(sys.argv[1:]):
    reader, gone = os.pipe()
    os.close(reader)
    children.append(os.fork())
    if children[-1]:
        os.close(gone)
        continue
    os.dup2(os.open(f"words-{number}", os.O_WRONLY | os.O_CREAT), 1)
    os.dup2(1, 2)
    for redirection in redirections.split():
        file, place = redirection.split(">")
        if place == "&-":
            os.close(int(file))
        elif place == "gone":
            os.dup2(gone, int(file))
        else:
            os.dup2(1 if place == "&1" else os.open(place, os.O_WRONLY), int(file))
    os.closerange(3, 100)
    for file, name in enumerate(NAMES):
        stream = None if f"{file}>&-" in redirections else open(file, "w" if file else "r", encoding="utf-8")
        setattr(sys, name, stream)
    sys.argv = ["palpate", "init", "before.nii.gz", "after.nii.gz", "--labels", "names.json", "--output", str(number)]
    sys.exit(main())
print([os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children])
"""
FAILING = (
    *("1>/dev/full", "2>/dev/full", "1>/dev/full 2>&1", "1>gone 2>&1", "1>gone"),
    *("1>&-", "2>&-", "1>&- 2>&-", "0>&- 1>&- 2>&-"),
)


def test_a_stream_that_fails_costs_no_run(images, tmp_path):
    """Each in a process of its own, of one that has imported what all need; `gone` is a pipe that nobody reads."""
    shutil.copytree(images, tmp_path, dirs_exist_ok=True)
    command = [sys.executable, "-c", AT_ONCE, *FAILING]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert (json.loads(done.stdout), done.stderr) == ([0] * len(FAILING), "")
    for number, redirections in enumerate(FAILING):
        words = (tmp_path / f"words-{number}").read_text(encoding="utf-8")
        assert "Traceback" not in words
        assert "Exception" not in words
        assert ("case.toml" in words) == ("1>" not in redirections)
        out = tmp_path / str(number)
        assert "größe" in (out / "case.toml").read_text(encoding="utf-8")
        assert sorted(path.name for path in out.iterdir()) == ["case.toml", "preview.html"]


@pytest.mark.parametrize("after", ["2>&1 | head -0", "<&- >&- 2>&-"])
def test_a_stream_that_fails_from_the_start_costs_no_run(images, tmp_path, after):
    done = init(images, tmp_path / "out", after=after)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "case.toml").exists()


def test_a_terminal_that_is_closed_costs_no_run(images, tmp_path):
    ours, theirs = pty.openpty()
    command = [PALPATE, "init", "before.nii.gz", "after.nii.gz", "--output", str(tmp_path / "out")]
    process = subprocess.Popen(command, cwd=images, stdout=theirs, stderr=theirs, stdin=theirs)
    os.close(theirs)
    os.close(ours)
    assert process.wait(60) == 0
    assert (tmp_path / "out" / "case.toml").exists()


@pytest.mark.parametrize("encoding", ["ascii", "utf-16"])
def test_letters_that_a_stream_lacks_are_escaped(images, tmp_path, encoding):
    done = init(images, tmp_path / "text", PYTHONIOENCODING=encoding, after="| cat -v")
    assert (done.returncode, "Traceback" in done.stderr) == (0, False)
    with (tmp_path / "document").open("wb") as file:
        command = f"{PALPATE} init before.nii.gz after.nii.gz --labels names.json --output {tmp_path / 'json'} --json"
        variables = os.environ | {"PYTHONIOENCODING": encoding}
        subprocess.run(shlex.split(command), cwd=images, stdout=file, env=variables, check=True)
    document = json.loads((tmp_path / "document").read_bytes().decode(encoding))
    assert "größe 前立腺" in [tissue["tissue"] for tissue in document["tissues"]]


def test_a_document_whose_reader_has_left_is_no_failure(images, tmp_path):
    done = init(images, tmp_path / "out", flags="--json --quiet", after="| true")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "case.toml").exists()


@pytest.mark.parametrize(("after", "reason"), [(">/dev/full", "No space left on device"), (">&-", "it is closed")])
def test_a_document_that_cannot_be_written_ends_with_6_after_all_else_is_done(images, tmp_path, after, reason):
    done = init(images, tmp_path / "out", flags="--json --quiet", after=after)
    assert done.returncode == 6
    (line,) = done.stderr.strip().splitlines()
    assert f"could not be written to standard output ({reason}); what the run had to write is whole in" in line
    assert (tmp_path / "out" / "case.toml").exists()


@pytest.mark.parametrize(
    ("arguments", "after"),
    [("--help", ">/dev/full"), ("--help", "| true"), ("--version", ">&-"), ("estimate", "2>/dev/full")],
)
def test_help_and_usage_need_no_stream_either(arguments, after):
    command = ["bash", "-c", f"{PALPATE} {arguments} {after}; exit ${{PIPESTATUS[0]}}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == (0 if arguments.startswith("--") else 2)
    assert "Traceback" not in done.stderr  # argparse itself turns to the other stream where one is closed
