"""Files that others made, opened for reading: regular files only, without waiting, with the digest of what was read."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import stat
from pathlib import Path
from typing import Any

CHUNK = 2**20  # bytes
NO_WAIT = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)  # a pipe that nobody writes to does not hold us
FLAGS = os.O_RDONLY | NO_WAIT | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)


class _Digested(io.RawIOBase):
    """Digests a file in its order while it is read here and there: what is read again was digested before."""

    def __init__(self, descriptor: int) -> None:
        self._file = io.FileIO(descriptor, "rb")
        self._hash = hashlib.sha256()
        self._done = 0  # bytes from the start that were digested

    def readable(self) -> bool:
        """Always: `io.BufferedReader` asks before it reads."""
        return True

    def seekable(self) -> bool:
        """Always: a regular file is."""
        return True

    def fileno(self) -> int:
        """The descriptor."""
        return self._file.fileno()

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()

    def tell(self) -> int:
        """Where the file stands, bytes from its start."""
        return self._file.tell()

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Go elsewhere; what is passed over is digested when something behind it is read."""
        return self._file.seek(offset, whence)

    def readinto(self, buffer: Any) -> int:
        """Fill `buffer` from where the file stands."""
        begin = self._file.tell()
        self._digest_to(begin)
        count = self._file.readinto(buffer) or 0
        self._hash.update(memoryview(buffer).cast("B")[max(self._done - begin, 0) : count])
        self._done = max(self._done, begin + count)
        return count

    def sha256(self) -> str:
        """The digest, after the rest of the file was read for it."""
        self._digest_to(None)
        return self._hash.hexdigest()

    def _digest_to(self, end: int | None) -> None:
        """Digest what lies before `end`, None: all, and was never read; the file then stands where it stood."""
        place = self._file.tell()
        self._file.seek(self._done)
        while end is None or self._done < end:
            content = self._file.read(CHUNK if end is None else min(CHUNK, end - self._done))
            if not content:
                break
            self._hash.update(content)
            self._done += len(content)
        self._file.seek(place)


class InputFile(io.BufferedReader):
    """A regular file; `n_bytes` is its size when it was opened."""

    def __init__(self, descriptor: int) -> None:
        self._digested = _Digested(descriptor)
        self.n_bytes = os.fstat(descriptor).st_size
        super().__init__(self._digested)

    def sha256(self) -> str:
        """SHA-256 (hexadecimal) of the whole file: of its bytes as they were first read, and of the rest as it is."""
        return self._digested.sha256()


def open_input(path: Path) -> InputFile:
    """Open the regular file at `path`, links followed; nothing is waited for.

    Raises `OSError` when it cannot be opened, or is a folder, a pipe, a socket or a device; `ValueError` for a path
    with a zero byte.
    """
    descriptor = os.open(path, FLAGS)
    try:
        mode = os.fstat(descriptor).st_mode
        if not stat.S_ISREG(mode):
            kind = "a folder" if stat.S_ISDIR(mode) else "a pipe, a socket or a device"
            raise OSError(errno.EINVAL, f"it is {kind}, not a file", str(path))
        return InputFile(descriptor)
    except BaseException:
        os.close(descriptor)
        raise


def read_input(path: Path, limit: int) -> tuple[bytes, str]:
    """The first `limit` + 1 bytes of the file at `path`, so that a longer file is seen, and their SHA-256.

    Raises as `open_input` does.
    """
    with open_input(path) as file:
        content = file.read(limit + 1)
    return content, hashlib.sha256(content).hexdigest()
