"""The files that a run writes: made out of sight in the output folder, put in place all together or not at all."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import stat
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate.errors import InputDataError, ResourceError
from palpate.study.journal import (
    STAGING,
    carry_out,
    clear,
    interrupts_deferred,
    is_inside,
    is_unfinished,
    recover,
    sync_folder,
)

__all__ = [
    "Digests",
    "OutputFolder",
    "Staging",
    "make_folder",
    "read_json",
    "read_regular",
    "sha256_of",
    "staged",
    "write_bytes",
    "write_json",
    "write_text",
]

Digests = Mapping[str, Mapping[str, str]]  # name of a file in the folder -> {"sha256": hexadecimal}

NEW = "new"  # in the hidden folder: what takes its place
OLD = "old"  # what gave way
ASIDE = ".earlier"  # behind the name of a file that is set aside
LARGEST_DOCUMENT = 2**26  # bytes of a JSON document that is read


@dataclass(frozen=True, slots=True)
class Staging:
    """New files of an output folder, out of sight in `area` until `commit` puts all of them in place.

    `written` gets the names of what took its place.
    """

    folder: Path
    written: list[str] = field(default_factory=list)

    @property
    def area(self) -> Path:
        """The folder to write into; a sub-folder of it becomes one of the output folder."""
        return self.folder / STAGING / NEW

    @property
    def unfinished(self) -> bool:
        """Whether a `commit` that failed is left to the next run in the folder, for it could not be undone either."""
        return is_unfinished(self.folder)

    def names(self) -> tuple[str, ...]:
        """The staged files, relative to the folder, with slashes; sorted, documents that list others last."""
        names = [path.relative_to(self.area).as_posix() for path in self.area.rglob("*") if path.is_file()]
        return tuple(sorted(names, key=lambda name: (name.endswith(".json"), name)))

    def digests(self) -> dict[str, dict[str, str]]:
        """SHA-256 of each staged file, which tells a run's own files from an earlier run's."""
        return {name: {"sha256": sha256_of(self.area / name)} for name in self.names()}

    def discard(self, *names: str) -> None:
        """Leave files out after all."""
        for name in names:
            (self.area / name).unlink(missing_ok=True)

    def commit(self, *, retired: Collection[str] = (), aside: Collection[str] = ()) -> None:
        """Put all staged files in place at once; `retired` files vanish, those `aside` get another name.

        Killed in between, the next run in the folder completes it. Raises `ResourceError` when the disk refuses, with
        everything as it was, unless it is left `unfinished`: else it may be tried again.
        """
        names = self.names()
        _refuse_improper(self.folder, (*names, *(f"{name}{ASIDE}" for name in aside)))
        leaving = [name for name in (*reversed(names), *retired) if (self.folder / name).exists()]
        renames = [(name, f"{STAGING}/{OLD}/{name}") for name in leaving]
        for name in aside:
            if (self.folder / f"{name}{ASIDE}").exists():
                renames.append((f"{name}{ASIDE}", f"{STAGING}/{OLD}/{name}{ASIDE}"))
            renames.append((name, f"{name}{ASIDE}"))
        renames += [(f"{STAGING}/{NEW}/{name}", name) for name in names]
        try:
            for name in names:  # to the disk
                with (self.area / name).open("rb+") as file:
                    os.fsync(file.fileno())
            for _, target in renames:
                (self.folder / target).parent.mkdir(parents=True, exist_ok=True)
            for place in (self.area, *(path for path in self.area.rglob("*") if path.is_dir())):
                sync_folder(place)
            with interrupts_deferred():
                carry_out(self.folder, renames)
                self.written.extend(names)
        except OSError as error:
            raise _refused(self.folder, error) from error


@dataclass(frozen=True, slots=True)
class OutputFolder:
    """A folder that this run holds; `written`: the names of what this run has put in place there."""

    path: Path
    written: list[str] = field(default_factory=list)

    def require(self, names: Iterable[str]) -> None:
        """Raise `ResourceError` where one of the files `names` could not be put in place; before they are computed."""
        _refuse_improper(self.path, names)

    def same_files(self, names: Iterable[str], files: Iterable[Path]) -> list[str]:
        """Those of `names` in the folder that are one of `files`, of which some may not exist."""
        others = list(files)
        return [name for name in names if any(_is_same(self.path / name, file) for file in others)]

    @contextmanager
    def staged(self) -> Iterator[Staging]:
        """Where files are written until they take their places; what was not committed is gone after the block."""
        make_folder(self.path)
        recover(self.path)
        try:
            for part in (NEW, OLD):
                (self.path / STAGING / part).mkdir(parents=True)
            yield Staging(self.path, self.written)
        except OSError as error:
            raise _refused(self.path, error) from error
        finally:
            clear(self.path)


def staged(folder: Path) -> AbstractContextManager[Staging]:
    """`OutputFolder.staged` of a folder that nobody else writes to."""
    return OutputFolder(folder).staged()


def make_folder(folder: Path) -> Path:
    """Make `folder` with its parents; raises `ResourceError` when that cannot be done."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _refused(folder, error) from error
    return folder


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file; raises `ResourceError` when the disk refuses."""
    try:
        path.write_bytes(content)
    except OSError as error:
        raise _refused(path, error) from error


def write_text(path: Path, content: str) -> None:
    """Write `content` as UTF-8; raises as `write_bytes` does."""
    write_bytes(path, content.encode("utf-8", errors="replace"))


def write_json(path: Path, document: Mapping[str, object]) -> None:
    """Write a JSON document; raises as `write_bytes` does, `ValueError` on a NaN."""
    write_text(path, json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_regular(path: Path, *, most_bytes: int) -> bytes:
    """The bytes of a regular file; raises `InputDataError` when it is missing, something else or too large."""
    try:
        file = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0))
        with os.fdopen(file, "rb") as stream:
            status = os.fstat(file)
            if not stat.S_ISREG(status.st_mode):
                raise InputDataError(f"{path} is no regular file; run the estimate again, into another folder")
            if status.st_size > most_bytes:
                raise InputDataError(f"{path} has {status.st_size} bytes, more than Palpate writes; estimate again")
            return stream.read(most_bytes)
    except FileNotFoundError as error:
        raise InputDataError(f"there is no {path}; run the estimate first, which writes it") from error
    except OSError as error:
        raise InputDataError(
            f"cannot read {path}: {error.strerror or error}; is this the output folder of an estimate?"
        ) from error


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in the file at `path`, whose `files` are digests if there are any.

    Raises `InputDataError` when there is none, or it is something else.
    """
    try:
        content = json.loads(read_regular(path, most_bytes=LARGEST_DOCUMENT), parse_constant=_no_constant)
        json.dumps(content, allow_nan=False)  # 1e999 is read as infinite
    except (ValueError, RecursionError) as error:
        raise InputDataError(f"{path} is no result of Palpate ({str(error)[:200]}); run the estimate again") from error
    if not isinstance(content, dict):
        raise InputDataError(f"{path} is no result of Palpate: it does not hold a JSON object")
    files = content.get("files", {})
    if not isinstance(files, dict) or not all(
        isinstance(entry, dict) and isinstance(entry.get("sha256"), str) for entry in files.values()
    ):
        raise InputDataError(f"{path} is no result of Palpate: its 'files' are not names with their SHA-256")
    return content


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal; raises `ResourceError` when it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise _refused(path, error) from error


def _is_same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except (OSError, ValueError):
        return False


def _refuse_improper(folder: Path, names: Iterable[str]) -> None:
    """Raise `ResourceError` where something that no file can replace has a name that is to be written in `folder`.

    A file may be replaced; a folder, a link, a pipe, a device or a file protected by the system may not, nor may a
    sub-folder be reached through a link.
    """
    for name in names:
        path = folder / name
        try:
            if not is_inside(folder, name):
                raise ResourceError(f"{path} leads out of the folder through a link: remove the link")
            if os.path.lexists(path):
                _refuse_target(path)
        except OSError as error:
            raise _refused(path, error) from error


def _no_constant(name: str) -> float:
    raise ValueError(f"it holds {name}")


def _refuse_target(path: Path) -> None:
    if not stat.S_ISREG(path.lstat().st_mode):
        raise ResourceError(
            f"{path} is no regular file (a folder, a link, a pipe ...), so the new {path.name} cannot take its place:"
            " remove it, or choose another --output folder"
        )
    try:
        os.close(os.open(path, os.O_WRONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)))
    except PermissionError as error:
        if error.errno == errno.EPERM:  # protected by the file system; EACCES is no hindrance to replacing
            raise


def _refused(path: Path, error: OSError) -> ResourceError:
    hidden = path.parts.index(STAGING) if STAGING in path.parts else len(path.parts)
    shown = Path(*path.parts[:hidden], *path.parts[hidden + 2 :])  # where it would have come to stand
    return ResourceError(
        f"cannot write {shown}: {error.strerror or error}; free some space or choose another --output folder"
    )
