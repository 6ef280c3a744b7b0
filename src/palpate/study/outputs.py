"""The files that a run writes: made out of sight in the output folder, put in place all together or not at all.

New files are made in `.writing-outputs/new`. When all are on the disk, those that give way step aside into `old`; then
`new` is renamed to `ready`, which decides: from here on the new files move to their places, before it the old ones
would move back. Either is done by whoever finds such a folder, so a kill is completed or undone by the next command.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import signal
import stat
import threading
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from types import FrameType
from typing import Any

from palpate.errors import InputDataError, ResourceError
from palpate.images.input_file import like

Digests = Mapping[str, Mapping[str, str]]  # name of a file in the folder -> {"sha256": hexadecimal}

STAGING = ".writing-outputs"  # the hidden folder in an output folder
NEW, READY, OLD = "new", "ready", "old"  # in it: being made; about to take their places; what gives way
ASIDE = ".earlier"  # behind the name of a file that is set aside
LARGEST_DOCUMENT = 2**26  # bytes of a JSON document that is read
SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")
RESULT, PAGE, DATA = "result.json", "report.html", "report-data.npz"  # the document of an estimate, and its report
KNOWN_IMAGES = "known-images.npz"  # what its images tell, for others that are added
RESULT_FILES = (  # what else an estimate writes, with its case
    DATA,
    PAGE,
    KNOWN_IMAGES,
    "labels.csv",
    "labels.nii.gz",
    "mesh.vtu",
    "model.npz",
    "posterior.nc",
    "stiffness.nii.gz",
    "stiffness_sd.nii.gz",
)


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
        return _is_unfinished(self.folder)

    def names(self) -> tuple[str, ...]:
        """The staged files, relative to the folder, with slashes; sorted, documents that list others last."""
        return _files(self.area)

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
        names, renamed = self.names(), [f"{name}{ASIDE}" for name in aside]
        _refuse_improper(self.folder, (*names, *renamed, *aside))
        try:
            for name in aside:
                shutil.copy2(self.folder / name, self.area / f"{name}{ASIDE}")
            for name in (*names, *renamed):  # to the disk
                with (self.area / name).open("rb+") as file:
                    os.fsync(file.fileno())
            _sync_folders(self.area)
            # documents that list others leave first
            leaving = [*reversed(names), *renamed, *retired, *(name for name in aside if name not in names)]
            with _interrupts_deferred():
                _exchange(self.folder, [name for name in leaving if (self.folder / name).exists()])
                self.written.extend(names)
        except OSError as error:
            with suppress(OSError):
                self.discard(*renamed)
            raise _refused(self.folder, error) from error


@dataclass(frozen=True, slots=True)
class OutputFolder:
    """A folder that this run holds; `written`: the names of what this run has put in place there.

    overwrite: whether the result of another case there may be replaced.
    """

    path: Path
    written: list[str] = field(default_factory=list)
    overwrite: bool = False

    def require(self, names: Iterable[str]) -> None:
        """Raise `ResourceError` where one of the files `names` could not be put in place; before they are computed."""
        _refuse_improper(self.path, names)

    def same_files(self, names: Iterable[str], files: Iterable[Path]) -> list[str]:
        """Those of `names` in the folder that are one of `files`, of which some may not exist."""

        def same(path: Path, other: Path) -> bool:
            """Whether both are one file."""
            try:
                return path.samefile(other)
            except (OSError, ValueError):
                return False

        others = list(files)
        return [name for name in names if any(same(self.path / name, file) for file in others)]

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
            _clear(self.path)


def recover(folder: Path) -> None:
    """Complete or undo what a killed run left in `folder`, which this process holds, and remove its hidden files.

    Raises `ResourceError` when the renames are refused again, or the hidden folder is not one of Palpate's.
    """
    area = folder / STAGING
    if any(path.is_symlink() or (path.exists() and not path.is_dir()) for path in (area, area / READY, area / OLD)):
        raise ResourceError(f"{area} is no folder of Palpate's: remove it, or choose another --output folder")
    try:
        with _interrupts_deferred():
            _settle(folder)
    except OSError as error:
        raise ResourceError(
            f"{area} holds what an interrupted run left, and it cannot be completed ({error.strerror or error}): give"
            " the right to write there, or choose another --output folder"
        ) from error
    _clear(folder)


def _exchange(folder: Path, leaving: Sequence[str]) -> None:
    """Move the `leaving` files aside and the staged ones to their places; an `OSError` leaves everything as it was."""
    area = folder / STAGING
    try:
        for name in leaving:
            _move(folder / name, area / OLD / name)
        _sync_folders(area / OLD, *{(folder / name).parent for name in leaving})
        (area / NEW).replace(area / READY)  # it is decided
        _sync_folders(area)
        _settle(folder)
    except OSError as error:
        try:
            decided = _settle(folder)
        except OSError as again:
            whose = "new files" if (area / READY).exists() else "files that were there"
            raise ResourceError(
                f"cannot write in {folder} ({again.strerror or again}): the {whose} are whole in {area}, from which the"
                " next command with this folder completes them"
            ) from error
        if not decided:
            raise


def _settle(folder: Path) -> bool:
    """Move files that are ready to their places, or else back what has stepped aside; whether it were those ready."""
    area = folder / STAGING
    decided = (area / READY).is_dir()
    source = area / (READY if decided else OLD)
    names = _files(source)
    for name in names:
        if not is_inside(folder, name):
            raise ResourceError(f"{folder / name} leads out of the folder through a link: remove the link")
        if decided or not os.path.lexists(folder / name):
            _move(source / name, folder / name)
    _sync_folders(*{(folder / name).parent for name in names})
    if decided:  # what stepped aside must not come back
        for name in _files(area / OLD):
            if (folder / name).parent != folder:
                with suppress(OSError):  # not empty
                    (folder / name).parent.rmdir()
        shutil.rmtree(area / OLD, ignore_errors=True)
        if not _files(area / OLD):
            shutil.rmtree(area / READY)
    return decided


def _is_unfinished(folder: Path) -> bool:
    return (folder / STAGING / READY).exists() or bool(_files(folder / STAGING / OLD))


def _clear(folder: Path) -> None:
    """Remove the hidden folder, unless there is something to complete or to undo."""
    if not _is_unfinished(folder):
        shutil.rmtree(folder / STAGING, ignore_errors=True)


def _files(folder: Path) -> tuple[str, ...]:
    """Regular files below `folder`, relative to it, with slashes; sorted, documents that list others last."""
    paths = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    names = [path.relative_to(folder).as_posix() for path in paths]
    return tuple(sorted(names, key=lambda name: (name.endswith(".json"), name)))


def _move(path: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    path.replace(place)


def _sync_folders(*folders: Path) -> None:
    """Bring the names in folders, and in those below a hidden one, to the disk, where the system lets us."""
    for folder in folders:
        below = [path for path in folder.rglob("*") if path.is_dir()] if STAGING in folder.parts else []
        for place in (folder, *below):
            with suppress(OSError):
                file = os.open(place, os.O_RDONLY)
                try:
                    os.fsync(file)
                finally:
                    os.close(file)


@contextmanager
def _interrupts_deferred() -> Iterator[None]:
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
    handlers = {number: signal.getsignal(number) for number in numbers}
    ours = {number: handler for number, handler in handlers.items() if handler not in (signal.SIG_IGN, None)}
    try:
        for number in ours:
            signal.signal(number, keep)
        yield
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)
        for number in came:
            signal.raise_signal(number)


def is_inside(folder: Path, name: str) -> bool:
    """Whether `name` is the relative path of something in `folder`, reached through no link and no `..`."""
    path = PurePosixPath(name)
    if not path.parts or path.is_absolute() or ".." in path.parts or "\0" in name or str(path) != name:
        return False
    return not any((folder / parent).is_symlink() for parent in path.parents if parent.parts)


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
        advice = like(path) or "; run the estimate first, which writes it"
        raise InputDataError(f"there is no {path}{advice}") from error
    except OSError as error:
        raise InputDataError(
            f"cannot read {path}: {error.strerror or error}; is this the output folder of an estimate?"
        ) from error


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in the file at `path`, whose `files` are digests if there are any.

    Raises `InputDataError` when there is none, or it is something else.
    """
    try:
        content = json.loads(read_regular(path, most_bytes=LARGEST_DOCUMENT), parse_constant=no_constant)
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


def _refuse_improper(folder: Path, names: Iterable[str]) -> None:
    """Raise `ResourceError` where something that no file can replace has a name that is to be written in `folder`.

    A file may be replaced; a folder, a link, a pipe, a device or a file protected by the system may not, nor may a
    sub-folder be reached through a link or be something else.
    """
    for name in names:
        path = folder / name
        try:
            if not is_inside(folder, name):
                raise ResourceError(f"{path} leads out of the folder through a link: remove the link")
            if path.parent.exists() and not path.parent.is_dir():
                raise ResourceError(
                    f"{path.parent} is no folder, so the new {path.name} cannot lie there: remove it, or choose another"
                    " --output folder"
                )
            if not os.path.lexists(path):
                continue
            if not stat.S_ISREG(path.lstat().st_mode):
                raise ResourceError(
                    f"{path} is no regular file (a folder, a link, a pipe ...), so the new {path.name} cannot take its"
                    " place: remove it, or choose another --output folder"
                )
            os.close(os.open(path, os.O_WRONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)))
        except OSError as error:
            if error.errno != errno.EACCES:  # no hindrance to replacing; EPERM: protected by the file system
                raise _refused(path, error) from error


def no_constant(name: str) -> float:
    """Raise `ValueError` for what JSON does not know and Python's reader takes all the same: NaN, Infinity."""
    raise ValueError(f"{name} is no number")


def _refused(path: Path, error: OSError) -> ResourceError:
    hidden = path.parts.index(STAGING) if STAGING in path.parts else len(path.parts)
    shown = Path(*path.parts[:hidden], *path.parts[hidden + 2 :])  # where it would have come to stand
    return ResourceError(
        f"cannot write {shown}: {error.strerror or error}; free some space or choose another --output folder"
    )
