"""Files that others made, opened for reading: regular files only, without waiting, with the digest of what was read."""

from __future__ import annotations

import difflib
import errno
import hashlib
import io
import os
import stat
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

from palpate.errors import InputDataError
from palpate.images.named_labels import printable

CHUNK = 2**20  # bytes
ALIKE = 0.6  # share of letters that a name has in common with a mistyped one
MOST_COMPARED = 10_000  # names in a folder
# O_NONBLOCK: a pipe without a writer does not block
FLAGS = sum(getattr(os, name, 0) for name in ("O_RDONLY", "O_NONBLOCK", "O_NOCTTY", "O_BINARY"))


class _Digested(io.FileIO):
    """A file whose SHA-256 is computed while it is read from its start."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor, "rb")
        self.digest = hashlib.sha256()

    def readinto(self, buffer: Any, /) -> int:
        """Fill `buffer` from where the file stands."""
        count = super().readinto(buffer) or 0
        self.digest.update(memoryview(buffer).cast("B")[:count])
        return count

    def readall(self) -> bytes:
        """What is left."""
        content = super().readall() or b""
        self.digest.update(content)
        return content

    def seekable(self) -> bool:
        """False, because skipped bytes would not be in the digest."""
        return False


class InputFile(io.BufferedReader):
    """A regular file, which is read from its start on; `n_bytes` is its size when it was opened."""

    def __init__(self, descriptor: int) -> None:
        self._digested = _Digested(descriptor)
        self.n_bytes = os.fstat(descriptor).st_size
        super().__init__(self._digested)

    def sha256(self) -> str:
        """SHA-256 (hexadecimal) of the whole file: of its bytes as they were read, and of the rest, read for it."""
        while self.read(CHUNK):
            pass
        return self._digested.digest.hexdigest()


def similar_names(path: Path) -> str:
    """A hint where nothing is at `path` and a file or folder beside it has a similar name; else empty.

    It is compared where the path ends to exist: for `caes/case.toml` beside a folder `case` that is `case/case.toml`.
    """
    with suppress(OSError, ValueError):  # a folder that may not be read, a zero byte
        parts = [*reversed(path.parents), path]
        missing = next((part for part in parts if not os.path.lexists(part)), None)
        if missing is None:
            return ""
        names = sorted(islice((entry.name for entry in os.scandir(missing.parent)), MOST_COMPARED))
        close = difflib.get_close_matches(missing.name, names, cutoff=ALIKE)
        # the ending alone makes 'after.nii.gz' and 'before.nii.gz' similar
        found = [name for name in close if _alike(missing.name.partition(".")[0], name.partition(".")[0])]
        if found:
            meant = missing.with_name(found[0])
            whole = meant / path.relative_to(missing)
            return f", did you mean '{printable(str(whole if whole.exists() else meant))}'?"
    return ""


def _alike(one: str, other: str) -> bool:
    return difflib.SequenceMatcher(None, one, other).ratio() >= ALIKE


def open_input(path: Path) -> InputFile:
    """Open the regular file at `path`, links followed; nothing is waited for.

    Raises `OSError` when it cannot be opened, or is a folder, a pipe, a socket or a device; `ValueError` for a path
    with a zero byte.
    """
    try:
        descriptor = os.open(path, FLAGS)
    except FileNotFoundError as error:
        raise FileNotFoundError(errno.ENOENT, f"there is no such file{similar_names(Path(path))}", str(path)) from error
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, f"it is {_kind(Path(path))}", str(path))
        return InputFile(descriptor)
    except BaseException:
        os.close(descriptor)
        raise


def _kind(path: Path) -> str:
    """What is not a regular file, in words; of a folder with a case, the file that is meant."""
    if not path.is_dir():
        return "a pipe, a socket or a device, not a file"
    case = path / "case.toml"
    return "a folder, not a file" + (f", did you mean '{printable(str(case))}'?" if case.is_file() else "")


def followed(path: Path, folder: Path) -> Path | None:
    """The file that `path` leads to, links followed; None where that lies outside of `folder`."""
    with suppress(OSError, ValueError, RuntimeError):  # a loop of links, a zero byte, a name too long
        path = path.resolve()
        return path if path.is_relative_to(folder.resolve()) else None
    return path


def whole_input(path: Path, limit: int) -> tuple[bytes, str]:
    """All bytes of the file at `path`, and their SHA-256.

    Raises `InputDataError` for a file that cannot be read or has more than `limit` bytes, before it takes memory.
    """
    try:
        with open_input(path) as file:
            if file.n_bytes > limit:
                raise InputDataError(f"'{path}' is larger than {limit} bytes; check that it is the right file")
            content = file.read(limit)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputDataError(f"'{path}' cannot be read ({reason}); check the path") from error
    return content, hashlib.sha256(content).hexdigest()


def beside(path: Path, name: str) -> Path:
    """Where the file `name` lies that the file at `path` names: in the same folder, or below it, links followed.

    Raises `InputDataError` where it leads elsewhere.
    """
    target = followed(path.parent / name, path.parent)
    if target is None:
        raise InputDataError(
            f"'{path}' names a file outside its own folder, which is not read; put both into one folder"
        )
    return target


def read_input(path: Path, limit: int) -> tuple[bytes, str]:
    """The first `limit` + 1 bytes of the file at `path`, so that a longer file is seen, and their SHA-256.

    Raises as `open_input` does.
    """
    with open_input(path) as file:
        content = file.read(limit + 1)
    return content, hashlib.sha256(content).hexdigest()
