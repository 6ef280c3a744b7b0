"""Nothing is written outside of the output folder, whatever lies in it under the names of lock and log."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path

import pytest

from children import in_a_child
from palpate.errors import ResourceError
from palpate.study.outputs import staged, write_bytes

NAMES = (".palpate.lock", "log.txt", ".writing-outputs")


@pytest.mark.parametrize("name", NAMES[:2])
@pytest.mark.parametrize("kind", ["link", "dangling", "hard link", "pipe", "folder"])
def test_lock_and_log_are_regular_files_of_the_folder_or_the_run_is_refused(
    estimate, out, tmp_path, capsys, name, kind
):
    out.mkdir()
    other = tmp_path / "other"
    if kind != "dangling":
        other.write_text("mine")
    {
        "link": lambda path: path.symlink_to(other),
        "dangling": lambda path: path.symlink_to(other),
        "hard link": lambda path: path.hardlink_to(other),
        "pipe": os.mkfifo,
        "folder": lambda path: path.mkdir(),
    }[kind](out / name)
    assert estimate("anna", "--quiet") == 6
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert str(out / name) in line
    assert other.read_text() == "mine" if kind != "dangling" else not other.exists()
    assert [path.name for path in out.iterdir()] == [name]


def test_the_hidden_folder_is_no_link_to_another(estimate, out, tmp_path, capsys):
    out.mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine").write_text("mine")
    (out / ".writing-outputs").symlink_to(tmp_path / "other")
    assert estimate("anna", "--quiet") == 6
    assert ".writing-outputs" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["mine"]


def test_a_sub_folder_is_no_link_to_another(tmp_path):
    (tmp_path / "other").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "surfaces").symlink_to(tmp_path / "other")
    with staged(tmp_path / "out") as staging:
        (staging.area / "surfaces").mkdir()
        write_bytes(staging.area / "surfaces" / "a.vtp", b"new")
        with pytest.raises(ResourceError, match=r"surfaces/a\.vtp leads out of the folder through a link"):
            staging.commit()
    assert list((tmp_path / "other").iterdir()) == []


def test_a_file_system_without_locks_is_warned_of_and_works(estimate, out, capfd):
    def unknown(*_):
        raise OSError(errno.ENOSYS, "Function not implemented")

    def work() -> int:
        fcntl.flock = unknown
        return estimate("anna", "--quiet")

    assert in_a_child(work) == 0
    assert "knows no locks" in capfd.readouterr().err
    assert (out / "result.json").exists()


def test_a_disk_full_from_the_start_ends_with_6(estimate, out, capfd):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    def work() -> int:
        os.write = Path.write_bytes = os.fsync = full
        return estimate("anna", "--quiet")

    assert in_a_child(work) == 6
    assert "No space left on device; free some space" in capfd.readouterr().err
    assert {path.name for path in out.iterdir()} == {"log.txt"}
