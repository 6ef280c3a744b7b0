"""The files that a run writes: made out of sight in the output folder, put in place together or not at all.

New files are made in `.writing-outputs`. When all are on the disk, the files that give way get a second name in a
folder `earlier-...`. They then leave, documents first, and the new ones take their places, documents last. So a
document never tells of files that are not beside it, and no new file stands beside one that gives way. Then the folder
`earlier-...` goes. A kill in between leaves it, with the earlier files whole.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
import signal
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from palpate.errors import InputDataError, ResourceError
from palpate.images.input_file import similar_names
from palpate.study.lock import folder_lock

AREA = ".writing-outputs"  # the hidden folder for new files in an output folder
EARLIER = "earlier-"  # begins the name of the folder that keeps what gives way
LARGEST_DOCUMENT = 2**26  # bytes of a JSON document that is read
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
RESULT, PAGE, DATA = "result.json", "report.html", "report-data.npz"  # the document of an estimate, and its report
DOCUMENTS = (RESULT, "mesh.json", "simulation.json", "sensitivity.json")  # each lists the files of its run
KNOWN_IMAGES = "known-images.npz"  # what its images tell, for others that are added
MAPS = ("stiffness.nii.gz", "stiffness_sd.nii.gz")
RESULT_FILES = (DATA, PAGE, KNOWN_IMAGES, *MAPS, "labels.csv", "labels.nii.gz", "mesh.vtu", "model.npz", "posterior.nc")


@dataclass(frozen=True, slots=True)
class OutputFolder:
    """The folder that a run writes into; `written`: the names of what the run has put in place there.

    overwrite: whether the result of another case there may be replaced.
    """

    path: Path
    written: list[str] = field(default_factory=list)
    overwrite: bool = False

    @contextmanager
    def held(self) -> Iterator[bool]:
        """Make the folder and keep other runs out of it; one that was made and is left empty vanishes again.

        Gives False where the file system knows no locks. Raises as `folder_lock` does.
        """
        try:
            made = [path for path in (self.path, *self.path.parents) if not path.exists()]  # the deepest first
        except OSError:  # a name too long, a folder that may not be searched: making it says so
            made = []
        make_folder(self.path)
        try:
            with folder_lock(self.path) as locked:
                self._clear()
                yield locked
        finally:
            for path in made:
                with suppress(OSError):  # not empty: something was written
                    path.rmdir()

    def require(self, names: Iterable[str]) -> None:
        """Raise `ResourceError` where something that no file can replace has one of the names.

        A file may be replaced; a folder, a link, a pipe or a device may not, nor may a sub-folder be reached through a
        link or be something else.
        """
        for name in names:
            path = self.path / name
            try:
                if not is_inside(self.path, name):
                    raise ResourceError(f"{path} leads out of the folder through a link: remove the link")
                if path.parent.exists() and not path.parent.is_dir():
                    raise ResourceError(
                        f"{path.parent} is no folder, so the new {path.name} cannot lie there: remove it, or choose"
                        " another --output folder"
                    )
                if os.path.lexists(path) and not stat.S_ISREG(path.lstat().st_mode):
                    raise ResourceError(
                        f"{path} is no regular file (a folder, a link, a pipe ...), so the new {path.name} cannot take"
                        " its place: remove it, or choose another --output folder"
                    )
            except OSError as error:
                raise _refused(path, error) from error

    @contextmanager
    def new_files(self) -> Iterator[Path]:
        """A hidden folder for new files, which take their places at the end of the block, unless that was left early.

        A sub-folder of it becomes one of the output folder. With one of the DOCUMENTS, the files leave that the
        document before it tells of. Raises `ResourceError` when the disk refuses, with everything as it was.
        """
        make_folder(self.path)
        area = self.path / AREA
        self._clear()
        try:
            area.mkdir()
            yield area
            self._put_in_place(area)
        except OSError as error:
            raise _refused(self.path, error) from error
        finally:
            shutil.rmtree(area, ignore_errors=True)

    def _clear(self) -> None:
        """Remove the hidden folder of a run that was killed."""
        area = self.path / AREA
        if area.is_dir() and not area.is_symlink():
            shutil.rmtree(area, ignore_errors=True)
        if os.path.lexists(area):
            raise ResourceError(f"{area} is no folder of Palpate's: remove it, or choose another --output folder")

    def _put_in_place(self, area: Path) -> None:
        names = files_in(area)
        self.require(names)
        for name in names:  # to the disk
            with (area / name).open("rb+") as file:
                os.fsync(file.fileno())
        replaced = [document for document in DOCUMENTS if document in names]
        before = {name for document in replaced for name in listed(self.path, document)}
        told = {name for of in DOCUMENTS for name in listed(area if of in names else self.path, of)}
        retired = {name for document in replaced for name in vouched(self.path, document)} - told - {*names}
        with _signals_wait():
            if len(names) == 1 and not retired:  # a rename is whole in itself
                _move(area / names[0], self.path / names[0])
                _sync((self.path / names[0]).parent)
            else:
                self._exchange(area, names, retired, before)
            self.written.extend(names)

    def _exchange(self, area: Path, names: Sequence[str], retired: Iterable[str], before: Iterable[str]) -> None:
        """Let the files of the area take their places and those `retired` leave; before: all of the earlier run."""
        leaving = [name for name in (*retired, *names) if (self.path / name).exists()]
        aside, moved = self.path / f"{EARLIER}{secrets.token_hex(4)}", list[str]()
        try:
            for name in dict.fromkeys([*leaving, *before]):
                _name_twice(self.path / name, aside / name)
            _sync(*{(aside / name).parent for name in leaving})
        except BaseException:
            shutil.rmtree(aside, ignore_errors=True)
            raise
        try:
            for name in reversed(leaving):  # documents first
                (self.path / name).unlink()
            _sync(self.path)
            for name in names:  # documents last
                if name in DOCUMENTS:
                    _sync(*{(self.path / other).parent for other in names})
                moved.append(name)
                _move(area / name, self.path / name)
            _sync(*{(self.path / name).parent for name in names})
        except BaseException as error:
            self._put_back(aside, moved, error)
            raise
        shutil.rmtree(aside, ignore_errors=True)

    def _put_back(self, aside: Path, moved: Iterable[str], cause: BaseException) -> None:
        """Undo an exchange that was broken off; moved: names of new files that may be in their places."""
        try:
            for name in moved:
                (self.path / name).unlink(missing_ok=True)
            for name in files_in(aside):
                if not (self.path / name).exists():
                    _name_twice(aside / name, self.path / name)
        except OSError as error:
            raise ResourceError(
                f"cannot write in {self.path} ({error.strerror or error}): the files that were there are whole in"
                f" {aside}; move them back"
            ) from cause
        shutil.rmtree(aside, ignore_errors=True)


@contextmanager
def _signals_wait() -> Iterator[None]:
    """Signals that end a run come after the block, where the system can hold them back."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _move(path: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    path.replace(place)


def _name_twice(path: Path, second: Path) -> None:
    """Give a file a second name; a copy where the file system has no hard links."""
    if path.is_file() and not path.is_symlink():
        second.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(path, second)
        except OSError:
            shutil.copy2(path, second)


def _sync(*folders: Path) -> None:
    """Bring the names in folders to the disk, where the system lets us."""
    for folder in folders:
        with suppress(OSError):
            file = os.open(folder, os.O_RDONLY)
            try:
                os.fsync(file)
            finally:
                os.close(file)


def files_in(folder: Path) -> tuple[str, ...]:
    """Regular files below `folder`, relative to it, with slashes; sorted, documents that list others last."""
    paths = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    names = [path.relative_to(folder).as_posix() for path in paths]
    return tuple(sorted(names, key=lambda name: (name in DOCUMENTS, name)))


def digests_of(folder: Path) -> dict[str, dict[str, str]]:
    """SHA-256 of each file below `folder`, as documents list them: name -> {"sha256": hexadecimal}."""
    return {name: {"sha256": sha256_of(folder / name)} for name in files_in(folder)}


def listed(folder: Path, document: str) -> dict[str, str]:
    """Name -> SHA-256 of the files that a document lists; nothing when there is none that could be read."""
    try:
        files: dict[str, Any] = read_json(folder / document).get("files", {})
    except InputDataError:
        return {}
    return {name: entry["sha256"] for name, entry in files.items() if is_inside(folder, name)}


def vouched(folder: Path, document: str) -> set[str]:
    """Names of the files in `folder` that are, byte by byte, those of the run that `document` there tells of.

    Or of one whose files a killed run has left in a folder `earlier-...`.
    """
    told = [of for place in (folder, *folder.glob(f"{EARLIER}*")) for of in listed(place, document).items()]
    return {name for name, sha256 in told if is_inside(folder, name) and has_digest(folder / name, sha256)}


def has_digest(path: Path, sha256: str | None) -> bool:
    """Whether there is a regular file with that SHA-256."""
    return path.is_file() and not path.is_symlink() and sha256 == sha256_of(path)


def is_inside(folder: Path, name: str) -> bool:
    """Whether `name` is the relative path of something in `folder`, reached through no link and no `..`."""
    path = PurePosixPath(name)
    if not path.parts or path.is_absolute() or ".." in path.parts or "\0" in name or str(path) != name:
        return False
    return not any((folder / parent).is_symlink() for parent in path.parents if parent.parts)


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
        kept = [str(place) for place in path.parent.glob(f"{EARLIER}*/{path.name}")]
        advice = f"; a run that was killed left the earlier one: {kept[0]}" if kept else similar_names(path)
        advice = advice or "; run the estimate first, which writes it"
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


def no_constant(name: str) -> float:
    """Raise `ValueError` for what JSON does not know and Python's reader takes all the same: NaN, Infinity."""
    raise ValueError(f"{name} is no number")


def _refused(path: Path, error: OSError) -> ResourceError:
    hidden = path.parts.index(AREA) if AREA in path.parts else len(path.parts)
    shown = Path(*path.parts[:hidden], *path.parts[hidden + 1 :])  # where it would have come to stand
    return ResourceError(
        f"cannot write {shown}: {error.strerror or error}; free some space or choose another --output folder"
    )
