"""A table of scenes with known answers: how they are computed, combined and written.

Scenes are computed in parts. A ledger keeps every finished part, so that an interrupted run continues where it stopped.
Parts that need the same meshes and factorisations are one job, which one process computes. A worker process has one
thread of linear algebra: two processes on two cores are faster than one process with two threads.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from palpate.body import software_versions
from palpate.errors import ResourceError
from palpate.parallel import processors
from palpate.progress import Line
from palpate.study import OutputFolder, make_folder, own_file, write_json

__all__ = ["Found", "Job", "Ledger", "Part", "Progress", "Scenes", "compute"]

Part = Any  # of JSON
Progress = Callable[[str], None]

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Found(Protocol):
    """What all scenes say together."""

    def to_dict(self) -> dict[str, Any]:
        """What `--json` prints, and what is written beside the page."""
        ...

    def text(self) -> list[list[str]]:
        """The rows of the printed table, its heads first."""
        ...


FoundT = TypeVar("FoundT", bound=Found)


@dataclass(frozen=True, slots=True)
class Job:
    """Parts (by their keys in the ledger) that one process makes one after the other, by `make(key, progress)`.

    `make` travels to the process: a function of a module, or a `functools.partial` of one with plain arguments.
    """

    keys: tuple[str, ...]
    make: Callable[[str, Progress], Part]


@dataclass(frozen=True, slots=True)
class Scenes(Generic[FoundT]):
    """A table of scenes: its name, its settings, its jobs, how their parts are combined, and its page.

    `draw` writes the page, a file with that ending. again: the next run computes all parts anew.
    """

    name: str
    settings: object
    jobs: Sequence[Job]
    conclude: Callable[[Mapping[str, Part]], FoundT]
    draw: Callable[[FoundT, Path], None]
    ending: str = ".svg"
    again: bool = False

    def found(self, ledger: Ledger, *, progress: Progress, workers: int = 1) -> FoundT:
        """The combined parts, those of the ledger and those computed now; raises what a part raises."""
        return self.conclude(compute(self.jobs, ledger, workers=workers, progress=progress))

    def written(self, folder: Path, *, progress: Progress, workers: int = 1) -> FoundT:
        """Compute the missing parts, write NAME.json and its page to `folder`, and return the result.

        NAME.parts.jsonl there keeps finished parts, which are used for the same settings and software only. `workers`:
        processes that share the parts; a script that asks for more than one needs `if __name__ == "__main__"`.
        Raises `PalpateError`s of meshing, solving and writing.
        """
        parts = f"{self.name}.parts.jsonl"
        made_under = sha256(repr((self.settings, software_versions())).encode()).hexdigest()[:16]
        result = self.found(Ledger(folder / parts, made_under), progress=progress, workers=workers)
        with OutputFolder(folder).new_files() as area:
            write_json(area / f"{self.name}.json", result.to_dict())
            self.draw(result, area / f"{self.name}{self.ending}")
        if self.again:
            (folder / parts).unlink(missing_ok=True)
        return result


@dataclass(frozen=True, slots=True)
class Ledger:
    """A file of JSON lines, one a finished part; `settings` tells parts of other settings from these.

    `path` None: nothing is kept.
    """

    path: Path | None
    settings: str

    def keep(self, key: str, value: Part) -> Part:
        """Add a finished part; raises `ResourceError` on a full disk."""
        if self.path is None:
            return value
        line = json.dumps({"settings": self.settings, "key": key, "value": value}, allow_nan=False)
        make_folder(self.path.parent)
        cut = self.path.exists() and not self.path.read_bytes().endswith(b"\n")  # an earlier run was killed here
        try:
            with os.fdopen(own_file(self.path), "ab") as file:
                file.write((("\n" if cut else "") + line + "\n").encode("utf-8"))
        except OSError as error:
            raise ResourceError(
                f"cannot write {self.path}: {error.strerror}; choose another --output folder"
            ) from error
        return value

    def finished(self) -> dict[str, Part]:
        """The finished parts by their keys."""
        if self.path is None or not self.path.exists():
            return {}
        parts: dict[str, Part] = {}
        for line in self.path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                entry = json.loads(line)
            except ValueError:  # the line at which an earlier run was killed
                continue
            if isinstance(entry, dict) and entry.get("settings") == self.settings:
                parts[str(entry.get("key"))] = entry["value"]
        return parts


def compute(jobs: Sequence[Job], ledger: Ledger, *, workers: int, progress: Progress) -> dict[str, Part]:
    """All parts by key: from the ledger, or made by `workers` processes (1: by this one) and written into it.

    What a process says comes when its job is done. Raises what a part raises, and `ResourceError` when a process ends
    without a word.
    """
    parts = ledger.finished()
    left = [Job(keys, job.make) for job in jobs if (keys := tuple(key for key in job.keys if key not in parts))]
    total, count = sum(len(job.keys) for job in jobs), sum(len(job.keys) for job in left)
    if count < total:
        progress(Line(f"{total - count} of {total} parts are already computed"))
    made: Iterator[tuple[str, Part]] = ((key, _kept(job, key, ledger, progress)) for job in left for key in job.keys)
    if min(workers, len(left)) > 1:
        made = _made_by(left, ledger, min(workers, len(left)), progress)
    for done, (key, part) in enumerate(made, start=total - count + 1):
        parts[key] = part
        progress(Line(f"part {done} of {total} done: {key}"))
    return parts


def _kept(job: Job, key: str, ledger: Ledger, progress: Progress) -> Part:
    return ledger.keep(key, job.make(key, progress))


def _made_by(jobs: Sequence[Job], ledger: Ledger, workers: int, progress: Progress) -> Iterator[tuple[str, Part]]:
    with _threads(max(1, processors() // workers)), ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        waiting = [pool.submit(_job, job, ledger) for job in jobs]
        try:
            for future in as_completed(waiting):
                said, parts = future.result()
                for text in said:
                    progress(text)
                yield from parts.items()
        except BrokenProcessPool as error:
            raise ResourceError(
                "a process of the experiment ended before its part was done, most likely for want of memory; the same"
                " command goes on with the parts that are left"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)


def _job(job: Job, ledger: Ledger) -> tuple[list[str], dict[str, Part]]:
    """In a process of its own: what was said, and the parts of a job, each kept as soon as it is made."""
    said = list[str]()
    return said, {key: _kept(job, key, ledger, said.append) for key in job.keys}


@contextmanager
def _threads(number: int) -> Iterator[None]:
    """Processes started meanwhile have that many threads of linear algebra each."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, str(number)))
    try:
        yield
    finally:
        for name in THREADS:
            del os.environ[name]
        os.environ.update({name: value for name, value in before.items() if value is not None})
