"""New files take their places together or not at all, and none that was there before is lost, whatever happens."""

from __future__ import annotations

import errno
import itertools
import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from children import in_a_child
from palpate.errors import ResourceError
from palpate.study.outputs import AREA, EARLIER, OutputFolder, sha256_of, write_json

NAMES = {"old": ("mesh.vtu", "report.html", "surfaces/a"), "new": ("mesh.vtu", "report.html", "surfaces/b")}
CHANGES = ((Path, "replace"), (Path, "unlink"), (os, "link"), (os, "fsync"), (os, "rmdir"))  # of names, and to the disk
NO_SUCH_TURN = 98


def lay(folder: Path, run: str) -> None:
    """The files of a run, and the document that lists them."""
    for name in NAMES[run]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(run)
    files = {name: {"sha256": sha256_of(folder / name)} for name in NAMES[run]}
    write_json(folder / "result.json", {"run": run, "files": files})


def replace(folder: Path) -> None:
    with OutputFolder(folder).new_files() as area:
        lay(area, "new")


def content(folder: Path) -> dict[str, str]:
    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    return {name: (folder / name).read_text() for name in names if not name.startswith((AREA, EARLIER))}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, dict[str, str]]:
    """What a folder holds with the files of one run, and with nothing else."""
    found = {}
    for run in NAMES:
        folder = tmp_path_factory.mktemp(run)
        lay(folder, run)
        found[run] = content(folder)
    return found


def state(folder: Path, whole: dict[str, dict[str, str]]) -> str:
    """Whose files are in the folder: `old`, `new`, or `aside`: the old ones are whole in a folder of their own."""
    here = content(folder)
    for run, files in whole.items():
        if here == files:
            return run
    assert "result.json" not in here, "a document tells of files that are not beside it"
    assert len(set(here.values())) <= 1, "files of two runs are mixed"
    assert [content(aside) for aside in folder.glob(f"{EARLIER}*")] == [whole["old"]]
    return "aside"


def changed_but(folder: Path, turn: int, fail: Callable[[], None], work=replace, *, only: bool = True) -> int:
    """The exit code of `work` in the folder, where the change of that number fails, or it and all after it."""
    count = itertools.count()

    def wrapped(function):
        def call(*arguments, **options):
            number = next(count)
            if number == turn or (number > turn and not only):
                fail()
            return function(*arguments, **options)

        return call

    for place, name in CHANGES:
        setattr(place, name, wrapped(getattr(place, name)))  # for this process, which ends soon
    try:
        work(folder)
    except ResourceError as error:
        return error.exit_code
    return 0 if next(count) > turn else NO_SUCH_TURN


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def no_space(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("links", [True, False])
def test_a_kill_leaves_the_old_files_or_the_new_ones_or_the_old_ones_aside(tmp_path, whole, monkeypatch, links):
    if not links:
        monkeypatch.setattr(os, "link", no_space)  # as a file system that has none
    seen, code = [], -signal.SIGKILL
    while code == -signal.SIGKILL:
        folder, turn = tmp_path / str(len(seen)), len(seen)
        lay(folder, "old")
        code = in_a_child(partial(changed_but, folder, turn, kill))
        seen.append(state(folder, whole))
        replace(folder)
        assert state(folder, whole) == "new", "the next run in the folder"
        assert not (folder / AREA).exists()
    assert code == NO_SUCH_TURN
    assert [run for run, _ in itertools.groupby(seen)] == ["old", "aside", "new"]


@pytest.mark.parametrize("only", [True, False])
def test_a_full_disk_leaves_the_old_files_in_their_places_or_aside_or_makes_no_difference(tmp_path, whole, only):
    turn, code, seen = -1, 0, set()
    while code != NO_SUCH_TURN:
        turn += 1
        folder = tmp_path / str(turn)
        lay(folder, "old")
        code = in_a_child(partial(changed_but, folder, turn, no_space, only=only))
        seen.add((code, state(folder, whole)))
    undone, done = {(6, "old")}, {(0, "new"), (NO_SUCH_TURN, "new")}
    assert undone < seen <= undone | done | (set() if only else {(6, "aside")})


def test_an_interrupt_waits_until_all_files_have_their_places(tmp_path, whole, monkeypatch):
    lay(tmp_path, "old")
    first = Path.unlink
    monkeypatch.setattr(Path, "unlink", lambda *a, **o: (signal.raise_signal(signal.SIGINT), first(*a, **o)))
    with pytest.raises(KeyboardInterrupt):
        replace(tmp_path)
    assert state(tmp_path, whole) == "new"


def test_a_file_that_comes_alone_is_there_at_any_moment(tmp_path):
    def replace_plan(folder: Path) -> None:
        with OutputFolder(folder).new_files() as area:
            (area / "plan.json").write_text("new")

    seen, code = [], -signal.SIGKILL
    while code == -signal.SIGKILL:
        (tmp_path / "plan.json").write_text("old")
        code = in_a_child(lambda: changed_but(tmp_path, len(seen), kill, replace_plan))
        seen.append((tmp_path / "plan.json").read_text())
    assert [run for run, _ in itertools.groupby(seen)] == ["old", "new"]


def test_files_of_a_block_that_is_left_early_are_gone(tmp_path, whole):
    lay(tmp_path, "old")

    def broken_off(error: Exception) -> None:
        with OutputFolder(tmp_path).new_files() as area:
            lay(area, "new")
            raise error

    with pytest.raises(ResourceError, match="No space left on device; free some space"):
        broken_off(OSError(errno.ENOSPC, "No space left on device"))
    with pytest.raises(ZeroDivisionError):
        broken_off(ZeroDivisionError())
    assert state(tmp_path, whole) == "old"
    assert not (tmp_path / AREA).exists()


def test_json_refuses_what_is_not_json(tmp_path):
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "x.json", {"value": float("nan")})
    assert list(tmp_path.iterdir()) == []
