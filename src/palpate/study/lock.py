"""One run at a time in an output folder."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from palpate.errors import ResourceError

if sys.platform != "win32":
    import fcntl

__all__ = ["folder_lock"]

NAME = ".palpate.lock"


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold `folder`, which exists, for this process; the lock dies with the process, however that ends.

    Raises `ResourceError` when another run works in the folder, or nothing can be written there.
    """
    if sys.platform == "win32":  # no POSIX locks: two runs in a folder are not noticed there
        yield
        return
    path = folder / NAME
    file = _locked(path)
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()
        file.close()


def _locked(path: Path) -> BinaryIO:
    """The lock's file, held; one that its last owner has removed meanwhile is left alone."""
    while True:
        try:
            file = path.open("a+b")
        except OSError as error:
            raise ResourceError(
                f"cannot write in {path.parent}: {error.strerror or error}; choose another --output folder"
            ) from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.seek(0)
            owner = file.read(20).decode("ascii", errors="replace").strip()
            file.close()
            raise ResourceError(
                f"another run of palpate{f' (process {owner})' if owner.isdigit() else ''} works in {path.parent}: wait"
                " until it has ended, or choose another --output folder"
            ) from error
        if _same(file, path):
            with suppress(OSError):  # who holds the lock is a courtesy; a full disk must not cost the run here
                file.truncate(0)
                file.write(str(os.getpid()).encode())
                file.flush()
            return file
        file.close()


def _same(file: BinaryIO, path: Path) -> bool:
    try:
        return path.stat().st_ino == os.fstat(file.fileno()).st_ino
    except OSError:
        return False
