"""What is said to a person never decides a run; each case here is a process of its own with a stream that fails."""

from __future__ import annotations

import json
import os
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
        np.save(folder / f"{name}.npy", labels)
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


ONE_BY_ONE = """
import gc, json, os, pty, sys
import numpy as np
from palpate.cli import main
from palpate.images.readers import ImageFormat, StoredImage
from palpate.images.readers.registry import register

NAMES = ("stdin", "stdout", "stderr")
register(ImageFormat("Numpy", (".npy",), lambda path: StoredImage(np.load(path), np.eye(4))))

def init(number, *flags):
    images = ["before.npy", "after.npy", "--labels", "names.json"]
    return main(["init", *images, "--output", str(number), *flags])

def run(number, redirections, flags, encoding):
    reader, gone = os.pipe()
    ours, theirs = pty.openpty()
    places = {"gone": gone, "tty": theirs, "&1": 1}
    os.dup2(os.open(f"words-{number}", os.O_WRONLY | os.O_CREAT), 1)
    os.dup2(1, 2)
    for redirection in redirections.split():
        file, place = redirection.split(">")
        if place == "&-":
            os.close(int(file))
        else:
            os.dup2(places[place] if place in places else os.open(place, os.O_RDWR | os.O_CREAT), int(file))
    os.closerange(3, 100)
    for file, name in enumerate(NAMES):
        letters = {"encoding": encoding, "errors": "backslashreplace" if name == "stderr" else "strict"}
        stream = None if f"{file}>&-" in redirections else open(file, "w" if file else "r", **letters)
        setattr(sys, name, stream)
    sys.exit(init(number, *flags.split()))

init("first", "--quiet")
gc.collect()
gc.freeze()  # or each would look through all of it at its end
codes = []
for number, command in enumerate(json.loads(sys.argv[1])):
    child = os.fork()
    if not child:
        run(number, *command)
    codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
print(codes)
"""
NO_DOCUMENT = {
    "1>/dev/full 2>err-full": "No space left on device",
    "1>&- 2>err-closed": "it is closed",
}
FAILING = (
    *("1>/dev/full", "2>/dev/full", "1>/dev/full 2>&1", "1>gone 2>&1", "1>gone"),
    *("1>&-", "2>&-", "1>&- 2>&-", "0>&- 1>&- 2>&-", "0>tty 1>tty 2>tty"),
)
RUNS = (
    *((redirections, "", "utf-8") for redirections in FAILING),
    *((f"1>said-{encoding}", "", encoding) for encoding in ("ascii", "utf-16")),
    *((f"1>document-{encoding}", "--json", encoding) for encoding in ("ascii", "utf-16")),
    ("1>gone 2>err-gone", "--json --quiet", "utf-8"),
    *((redirections, "--json --quiet", "utf-8") for redirections in NO_DOCUMENT),
)


@pytest.fixture(scope="module")
def ran(images, tmp_path_factory) -> tuple[Path, list[int]]:
    """A folder in which `palpate init` ran once with each of RUNS, into the folder of its number; and their codes.

    Each in a process of its own, forked from one that has run once and reads the images itself; `gone` is a pipe that
    nobody reads, `tty` a terminal that was closed.
    """
    folder = tmp_path_factory.mktemp("ran")
    shutil.copytree(images, folder, dirs_exist_ok=True)
    command = [sys.executable, "-c", ONE_BY_ONE, json.dumps(RUNS)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return folder, json.loads(done.stdout)


@pytest.mark.parametrize("number", range(len(RUNS)))
def test_a_stream_that_fails_costs_no_run(ran, number):
    """All files are written, whatever a stream does."""
    folder, codes = ran
    redirections, _, encoding = RUNS[number]
    assert codes[number] == (6 if redirections in NO_DOCUMENT else 0)
    words = (folder / f"words-{number}").read_text(encoding=encoding)
    assert "Traceback" not in words
    assert "Exception" not in words
    assert ("case.toml" in words) == ("1>" not in redirections)
    out = folder / str(number)
    assert "größe" in (out / "case.toml").read_text(encoding="utf-8")
    assert sorted(path.name for path in out.iterdir()) == ["case.toml", "preview.html"]


@pytest.mark.parametrize("after", ["2>&1 | head -0", "<&- >&- 2>&-"])
def test_a_stream_that_fails_from_the_start_costs_no_run(images, tmp_path, after):
    done = init(images, tmp_path / "out", after=after)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "case.toml").exists()


@pytest.mark.parametrize("encoding", ["ascii", "utf-16"])
def test_letters_that_a_stream_lacks_are_escaped(ran, encoding):
    folder, _ = ran
    said = (folder / f"said-{encoding}").read_bytes().decode(encoding)
    assert ("größe 前立腺" if encoding == "utf-16" else r"gr\xf6\xdfe \u524d\u7acb\u817a") in said
    document = json.loads((folder / f"document-{encoding}").read_bytes().decode(encoding))
    assert "größe 前立腺" in [tissue["tissue"] for tissue in document["tissues"]]


def test_a_document_whose_reader_has_left_is_no_failure(ran):
    folder, _ = ran
    assert (folder / "err-gone").read_text() == ""


@pytest.mark.parametrize("redirections", NO_DOCUMENT)
def test_a_document_that_cannot_be_written_is_told_after_all_else_is_done(ran, redirections):
    folder, _ = ran
    (line,) = (folder / redirections.split("2>")[1]).read_text(encoding="utf-8").strip().splitlines()
    reason = NO_DOCUMENT[redirections]
    assert f"could not be written to standard output ({reason}); all files are written in" in line


@pytest.mark.parametrize(
    ("arguments", "after"),
    [("--help", ">/dev/full"), ("--help", "| true"), ("--version", ">&-"), ("estimate", "2>/dev/full")],
)
def test_help_and_usage_need_no_stream_either(arguments, after):
    command = ["bash", "-c", f"{PALPATE} {arguments} {after}; exit ${{PIPESTATUS[0]}}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == (0 if arguments.startswith("--") else 2)
    assert "Traceback" not in done.stderr  # argparse itself turns to the other stream where one is closed
