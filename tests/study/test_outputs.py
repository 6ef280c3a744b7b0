"""Outputs take their places all together or not at all, whatever happens in between."""

from __future__ import annotations

import errno
import itertools
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from children import in_a_child
from palpate.errors import ResourceError
from palpate.study.outputs import STAGING, make_folder, recover, staged, write_json, write_text

OLD = {"result.json": "old", "mesh.vtu": "old", "sub/a": "old", "page": "old", "page.earlier": "older", "mine": "mine"}
NO_SUCH_TURN = 98
NEW = {"result.json": "new", "mesh.vtu": "new", "sub/b": "new", "page.earlier": "old", "mine": "mine"}


def put(folder: Path, content: dict[str, str]) -> None:
    for name, text in content.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def content(folder: Path) -> dict[str, str]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


def replace(folder: Path) -> None:
    with staged(folder) as staging:
        put(staging.area, dict.fromkeys(("result.json", "mesh.vtu", "sub/b"), "new"))
        staging.commit(retired=["sub/a"], aside=["page"])


def replace_but(folder: Path, turn: int, fail: Callable[[], None], *, only: bool = True) -> int:
    """Replace the files; the operation of that number (from 0) that changes names fails, or it and all after it.

    Gives the exit code of what came of it, `NO_SUCH_TURN` where there are fewer operations.
    """
    count = itertools.count()

    def wrapped(function):
        def call(*arguments, **options):
            number = next(count)
            if number == turn or (number > turn and not only):
                fail()
            return function(*arguments, **options)

        return call

    for place, name in ((Path, "replace"), (Path, "unlink"), (os, "fsync")):
        setattr(place, name, wrapped(getattr(place, name)))  # for this process, which ends soon
    try:
        replace(folder)
    except ResourceError as error:
        return error.exit_code
    return 0 if next(count) > turn else NO_SUCH_TURN


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def fill() -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_files_take_their_places_together(tmp_path):
    put(tmp_path, OLD)
    replace(tmp_path)
    assert content(tmp_path) == NEW


def test_a_kill_at_any_operation_leaves_what_the_next_run_makes_whole(tmp_path):
    seen, code = [], -signal.SIGKILL
    while code == -signal.SIGKILL:
        turn = len(seen)
        folder = tmp_path / str(turn)
        put(folder, OLD)
        code = in_a_child(lambda folder=folder, turn=turn: replace_but(folder, turn, kill))
        visible = {name: text for name, text in content(folder).items() if not name.startswith(STAGING)}
        assert visible.get("result.json") is None or visible in (OLD, NEW)  # where the document is, its files are
        assert not {"old", "new"} <= {visible.get(name) for name in ("mesh.vtu", "sub/a", "sub/b")}
        recover(folder)
        assert content(folder) in (OLD, NEW), turn
        seen.append(content(folder) == NEW)
    assert code == NO_SUCH_TURN
    assert not seen[0]
    assert seen[-1]
    assert sorted(seen) == seen  # once it is decided, it stays decided
    assert len(seen) > 15


@pytest.mark.parametrize("only", [True, False])
def test_a_refused_operation_leaves_the_old_files_or_the_new_ones(tmp_path, only):
    turn, code = -1, 0
    while code != NO_SUCH_TURN:
        turn += 1
        folder = tmp_path / str(turn)
        put(folder, OLD)
        code = in_a_child(lambda folder=folder, turn=turn: replace_but(folder, turn, fill, only=only))
        assert code in (0, ResourceError.exit_code, NO_SUCH_TURN)
        done = code != ResourceError.exit_code
        if not (folder / STAGING).exists():
            assert content(folder) == (NEW if done else OLD), turn
        recover(folder)
        assert content(folder) in (OLD, NEW), turn
        assert not done or content(folder) == NEW
    assert turn > 15


def test_an_interrupt_waits_until_the_files_have_their_places(tmp_path):
    put(tmp_path, OLD)

    def interrupted() -> int:
        first = Path.replace

        def call(path, target):
            signal.raise_signal(signal.SIGINT)
            return first(path, target)

        Path.replace = call
        try:
            replace(tmp_path)
        except KeyboardInterrupt:
            return 130
        return 0

    assert in_a_child(interrupted) == 130
    assert content(tmp_path) == NEW


def test_what_is_not_committed_is_gone(tmp_path):
    put(tmp_path, OLD)
    with staged(tmp_path) as staging:
        write_text(staging.area / "result.json", "half")
    assert content(tmp_path) == OLD
    assert not (tmp_path / STAGING).exists()


@pytest.mark.parametrize("part", ["ready", "old"])
def test_a_hidden_folder_made_by_others_moves_nothing_into_or_out_of_the_folder(tmp_path, part):
    out, other = tmp_path / "out", tmp_path / "other"
    put(other, {"mine": "mine"})
    (out / STAGING).mkdir(parents=True)
    (out / STAGING / part).symlink_to(other)
    with pytest.raises(ResourceError, match="no folder of Palpate's"):
        recover(out)
    (out / STAGING / part).unlink()
    put(out / STAGING / part, {"sub/taken": "planted"})
    (out / "sub").symlink_to(other)
    with pytest.raises(ResourceError, match="leads out of the folder through a link"):
        recover(out)
    (out / "sub").unlink()
    (out / STAGING / part / "link").symlink_to(other / "mine")
    recover(out)
    assert content(out) == {"sub/taken": "planted"}
    assert content(other) == {"mine": "mine"}


def test_a_full_disk_is_a_resource_error(tmp_path):
    def fill():
        with staged(tmp_path):
            raise OSError(28, "No space left on device")

    with pytest.raises(ResourceError, match="No space left on device; free some space"):
        fill()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_a_resource_error(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(ResourceError, match="choose another --output"):
        make_folder(tmp_path / "file" / "below")


def test_json_refuses_what_is_not_json(tmp_path):
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "x.json", {"value": float("nan")})
    assert list(tmp_path.iterdir()) == []
