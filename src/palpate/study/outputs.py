"""Files written whole or not at all."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from palpate.errors import ResourceError

__all__ = ["make_folder", "whole_file", "write_bytes", "write_json", "write_text"]


def make_folder(folder: Path) -> Path:
    """Make `folder` with its parents; raises `ResourceError` when that cannot be done."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _refused(folder, error) from error
    return folder


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`, with the same ending, that takes its name when the block ends without error.

    An earlier file of that name stays as it was until then, and for good when the block fails. Raises `ResourceError`
    when the disk is full or the folder cannot be written.
    """
    make_folder(path.parent)
    temporary: Path | None = None
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=".writing-", suffix=f"-{path.name}")
        os.close(handle)
        temporary = Path(name)
        yield temporary
        _flush(temporary)
        temporary.replace(path)
    except OSError as error:
        raise _refused(path, error) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write `content` to `path`, whole or not at all; raises as `whole_file` does."""
    with whole_file(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, content: str) -> None:
    """Write `content` as UTF-8 to `path`, whole or not at all; raises as `whole_file` does."""
    write_bytes(path, content.encode("utf-8", errors="replace"))


def write_json(path: Path, document: Mapping[str, object]) -> None:
    """Write a JSON document to `path`, whole or not at all; raises as `whole_file` does, `ValueError` on a NaN."""
    write_text(path, json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def _flush(path: Path) -> None:
    """Bring the file to the disk, readable by whom the process's mask allows."""
    mask = os.umask(0)
    os.umask(mask)
    path.chmod(0o666 & ~mask)
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _refused(path: Path, error: OSError) -> ResourceError:
    return ResourceError(
        f"cannot write {path}: {error.strerror or error}; free some space or choose another --output folder"
    )
