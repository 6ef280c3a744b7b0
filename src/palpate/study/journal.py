"""Renames that all happen or none: a journal on the disk says what is left to do, or to undo, after a kill.

A file cannot be exchanged for another in one step together with others. So the new files lie complete in a hidden
folder before the first rename, the list of all renames lies beside them on the disk, and whoever finds such a list
carries it out to its end. Old files step aside before the first new one appears: at no moment do both stand there.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from types import FrameType

from palpate.errors import InputDataError, ResourceError

__all__ = [
    "STAGING",
    "Renames",
    "carry_out",
    "clear",
    "interrupts_deferred",
    "is_inside",
    "is_unfinished",
    "recover",
    "sync_folder",
]

Renames = Sequence[tuple[str, str]]  # (from, to), relative to the folder, with slashes

STAGING = ".writing-outputs"  # the hidden folder in an output folder
STALE = ".writing-*"
JOURNAL = "journal.json"
UNDO = "undo.json"
MOST_BYTES = 2**24  # of a journal
SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")


def carry_out(folder: Path, renames: Renames) -> None:
    """Do all `renames` in `folder`; what a kill cuts short, a later `recover` completes.

    Raises `OSError` when one is refused, after those before it were undone; `ResourceError` when that failed, too.
    """
    area = folder / STAGING
    _keep_journal(area, renames)
    try:
        _forwards(folder, renames)
    except OSError:
        _undo(folder, renames)
        raise
    with suppress(OSError):  # one that stays is carried out again, which changes nothing
        (area / JOURNAL).unlink()


def recover(folder: Path) -> None:
    """Complete or undo what a killed run left in `folder`, which this process holds, and remove its hidden files.

    Raises `InputDataError` on a journal that is none, `ResourceError` when the renames are refused again.
    """
    area = folder / STAGING
    if area.is_symlink() or (area.exists() and not area.is_dir()):
        raise ResourceError(f"{area} is no folder of Palpate's: remove it, or choose another --output folder")
    try:
        if (renames := _read_journal(folder, UNDO)) is not None:
            _backwards(folder, renames)
            (area / UNDO).unlink()
        elif (renames := _read_journal(folder, JOURNAL)) is not None:
            with interrupts_deferred():
                _forwards(folder, renames)
                (area / JOURNAL).unlink()
        clear(folder)
        for stale in folder.glob(STALE):
            if stale.is_symlink() or not stale.is_dir():
                stale.unlink()
    except OSError as error:
        raise ResourceError(
            f"{area} holds what an interrupted run left, and it cannot be completed ({error.strerror or error}): give"
            " the right to write there, or choose another --output folder"
        ) from error


def is_unfinished(folder: Path) -> bool:
    """Whether there are renames to complete or to undo."""
    return any((folder / STAGING / name).exists() for name in (JOURNAL, UNDO))


def clear(folder: Path) -> None:
    """Remove the hidden folder, unless it still holds a journal."""
    if not is_unfinished(folder):
        shutil.rmtree(folder / STAGING, ignore_errors=True)


def is_inside(folder: Path, name: str) -> bool:
    """Whether `name` is the relative path of something in `folder`, reached through no link and no `..`."""
    path = PurePosixPath(name)
    if not path.parts or path.is_absolute() or ".." in path.parts or "\0" in name or str(path) != name:
        return False
    return not any((folder / parent).is_symlink() for parent in path.parents if parent.parts)


def sync_folder(folder: Path) -> None:
    """Bring a folder's names to the disk, where the system lets us."""
    with suppress(OSError):
        file = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(file)
        finally:
            os.close(file)


@contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Keep signals that end a run until the block has ended; then they reach the handlers that were there before."""
    if threading.current_thread() is not threading.main_thread():  # signals interrupt the main thread only
        yield
        return
    came: list[int] = []

    def keep(number: int, frame: FrameType | None) -> None:
        """Remember the signal."""
        del frame
        came.append(number)

    numbers = [getattr(signal, name) for name in SIGNALS if hasattr(signal, name)]
    earlier = {number: signal.getsignal(number) for number in numbers}
    ours = {number: handler for number, handler in earlier.items() if handler not in (signal.SIG_IGN, None)}
    try:
        for number in ours:
            signal.signal(number, keep)
        yield
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)
        for number in came:
            signal.raise_signal(number)


def _undo(folder: Path, renames: Renames) -> None:
    area = folder / STAGING
    try:
        (area / JOURNAL).replace(area / UNDO)
        _backwards(folder, renames)
        (area / UNDO).unlink()
    except OSError as error:
        raise ResourceError(
            f"cannot write in {folder} ({error.strerror or error}), neither the new files nor the earlier ones: all are"
            f" whole in {area}, from which the next command with this folder completes them"
        ) from error


def _keep_journal(area: Path, renames: Renames) -> None:
    """Write the journal, which is there as a whole or not at all."""
    part = area / f"{JOURNAL}.part"
    try:
        with part.open("wb") as file:
            file.write(json.dumps([list(pair) for pair in renames]).encode("ascii"))
            file.flush()
            os.fsync(file.fileno())
        part.replace(area / JOURNAL)
        sync_folder(area)
    except OSError:
        with suppress(OSError):
            (area / JOURNAL).unlink(missing_ok=True)
        raise


def _read_journal(folder: Path, name: str) -> Renames | None:
    path = folder / STAGING / name
    if not path.is_file() or path.is_symlink():
        return None
    try:
        with path.open("rb") as file:
            pairs = [(source, target) for source, target in json.loads(file.read(MOST_BYTES))]
    except (ValueError, TypeError, RecursionError):
        pairs = [("", "")]
    if not all(isinstance(place, str) and is_inside(folder, place) for pair in pairs for place in pair):
        raise InputDataError(f"{path} is not what Palpate writes: remove {path.parent}, or choose another folder")
    return pairs


def _forwards(folder: Path, renames: Renames) -> None:
    """Do the renames that are not done yet; each is to a name that is free when its turn comes."""
    for source, target in renames:
        before, after = folder / source, folder / target
        done = os.path.lexists(after) and not (_staged(source) and os.path.lexists(before))
        if not done:
            before.replace(after)
    _sync_around(folder, renames)


def _backwards(folder: Path, renames: Renames) -> None:
    """Undo the renames that are done."""
    for source, target in reversed(renames):
        before, after = folder / source, folder / target
        if os.path.lexists(after) and not os.path.lexists(before):
            after.replace(before)
    _sync_around(folder, renames)


def _staged(name: str) -> bool:
    return PurePosixPath(name).parts[0] == STAGING


def _sync_around(folder: Path, renames: Renames) -> None:
    """Bring the names to the disk, and remove sub-folders that the renames have emptied."""
    parents = {(folder / name).parent for pair in renames for name in pair if not _staged(name)}
    for parent in parents:
        with suppress(OSError):
            if parent != folder:
                parent.rmdir()
        sync_folder(parent)
