"""One run at a time in an output folder, and files there that are opened only if they are the folder's own."""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from palpate.errors import FolderInUse, ResourceError

if sys.platform != "win32":
    import fcntl


NAME = ".palpate.lock"
FLAGS = ("O_CREAT", "O_APPEND", "O_NOFOLLOW", "O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC")  # Windows lacks some
NO_FILE = "is not a regular file of that folder (but a link, a pipe or a folder): remove it"


@contextmanager
def folder_lock(folder: Path) -> Iterator[bool]:
    """Hold `folder`, which exists, for this process; the lock dies with the process, however that ends.

    Gives False where the file system knows no locks: another run would not be noticed. Raises `FolderInUse` when
    another run works in the folder, `ResourceError` when nothing can be written there, or the lock's name is taken by
    something else.
    """
    if sys.platform == "win32":  # no POSIX locks: two runs in a folder are not noticed there
        yield False
        return
    path, same = folder / NAME, False
    while not same:  # a file that its last owner has removed meanwhile is left alone
        file, locked = own_file(path), True
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno != errno.EWOULDBLOCK:
                locked = False
                break
            owner = os.pread(file, 20, 0).decode("ascii", errors="replace").strip()
            os.close(file)
            raise FolderInUse(
                f"another run of palpate{f' (process {owner})' if owner.isdigit() else ''} works in {path.parent}: wait"
                " until it has ended, or choose another --output folder"
            ) from error
        with suppress(OSError):
            same = path.stat().st_ino == os.fstat(file).st_ino
        if not same:
            os.close(file)
    if locked:
        with suppress(OSError):  # the owner's name is for information only; a full disk must not end the run here
            os.ftruncate(file, 0)
            os.write(file, str(os.getpid()).encode())
    try:
        yield locked
    finally:
        with suppress(OSError):
            path.unlink()
        os.close(file)


def is_held(folder: Path) -> bool:
    """Whether a run works in `folder` at the moment; False where the file system knows no locks."""
    if sys.platform == "win32":
        return False
    try:
        file = os.open(folder / NAME, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:  # no lock, or no folder
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno == errno.EWOULDBLOCK
    finally:
        os.close(file)
    return False


def own_file(path: Path) -> int:
    """A descriptor to read `path` and to append to it; the file is made when it is missing.

    Raises `ResourceError` for anything but a regular file with one name: what is written must stay in its folder.
    """
    flags = os.O_RDWR
    for name in FLAGS:
        flags |= getattr(os, name, 0)
    try:
        file = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise _refused(path, NO_FILE) from error
        raise _refused(path, f"cannot be written ({error.strerror or error})") from error
    status = os.fstat(file)
    if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
        os.close(file)
        raise _refused(path, NO_FILE)
    return file


def _refused(path: Path, why: str) -> ResourceError:
    return ResourceError(f"{path} {why}, or choose another --output folder")
