"""Files written whole or not at all."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from palpate.errors import InputDataError, ResourceError

__all__ = [
    "digests",
    "make_folder",
    "read_json",
    "strange_files",
    "whole_file",
    "write_bytes",
    "write_json",
    "write_text",
]

RESULT_FILES = ("labels.csv", "mesh.vtu", "stiffness.nii.gz")  # what other programs read of an estimate


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


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in the file at `path`; raises `InputDataError` when there is none, or it is something else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputDataError(f"cannot read {path}: {reason}; is this the output folder of an estimate?") from error
    if not isinstance(content, dict):
        raise InputDataError(f"{path} is no result of Palpate: it does not hold a JSON object")
    return content


def digests(paths: Iterable[Path]) -> dict[str, dict[str, str]]:
    """File name -> {"sha256": hexadecimal} of files just written, which tell a run's own files from an earlier run's.

    Raises `ResourceError` when one cannot be read again.
    """
    return {path.name: {"sha256": _sha256(path)} for path in paths}


def strange_files(folder: Path, files: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Names of result files in `folder` that are not those of `files`, as `digests` gives them; sorted."""
    present = sorted({*folder.glob("mesh*.vtu"), *(folder / name for name in RESULT_FILES)})
    return [p.name for p in present if p.is_file() and files.get(p.name, {}).get("sha256") != _sha256(p)]


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise _refused(path, error) from error


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
