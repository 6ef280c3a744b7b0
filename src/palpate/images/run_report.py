"""How an image was segmented, as TotalSegmentator's report of a run tells it (`--report FILE`, a JSON document).

Facts of version 2.18.0 (totalsegmentator/python_api.py): the report has version, task and speed, but no order of
resampling, whose default was 3 before 2.16 and is 1 since.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.input_file import whole_input
from palpate.images.named_labels import printable

MOST_BYTES = 2**20
MOST_FILES = 20  # documents beside an image that are opened
MARK = "totalsegmentator_version"
LINEAR_SINCE = (2, 16)
ENDINGS = (".nii.gz", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd")
RESAMPLED = "resampled by cubic splines", "resampled linearly"  # by default, before and since


@dataclass(frozen=True, slots=True)
class RunReport:
    """A run of TotalSegmentator: its version, task and speed ("", "fast" or "fastest")."""

    version: str
    task: str
    speed: str

    @property
    def release(self) -> tuple[int, ...]:
        """Its version without corrections, (2, 18) of "2.18.0"; () where it has none."""
        parts = self.version.split(".")[:2]
        return tuple(map(int, parts)) if len(parts) == 2 and all(part.isdecimal() for part in parts) else ()

    @property
    def resampled(self) -> str:
        """How images are resampled by default in this version; "" where that is not known."""
        return RESAMPLED[self.release >= LINEAR_SINCE] if self.release else ""

    def is_like(self, other: RunReport) -> bool:
        """Whether both draw alike: releases, tasks and speeds are the same."""
        mine, theirs = (of.release or (of.version,) for of in (self, other))
        return (mine, self.task, self.speed) == (theirs, other.task, other.speed)

    @property
    def in_words(self) -> str:
        """Version, task, speed, and how it resamples by default."""
        parts = (f"task {self.task}" * bool(self.task), self.speed, self.resampled)
        return f"{self.version} ({', '.join(part for part in parts if part)})"


def segmented_otherwise(before: Path, after: Sequence[Path]) -> tuple[Finding, ...]:
    """A finding for each later image that TotalSegmentator segmented in another way than the first one.

    Where one of the two has no report beside it, nothing is known, and nothing is said.
    """
    first = run_report(before)
    found = list[Finding]()
    for number, path in enumerate(after):
        other = first and run_report(path)
        if first is None or other is None or other.is_like(first):
            continue
        name = "after" if len(after) == 1 else f"after[{number}]"
        text = (
            f"TotalSegmentator {first.in_words} segmented 'before', and {other.in_words} '{name}': what both draw"
            " otherwise passes for motion. Segment both images with one version and the same options."
        )
        found.append(Finding("segmented-otherwise", text, place=f"in '{name}'"))
    return tuple(found)


def run_report(image: Path) -> RunReport | None:
    """The report of the run that made an image, a file or a folder of masks; None where there is none.

    It is a .json in the folder of masks, or one beside folder or file whose name begins with theirs.
    """
    for path in _documents(image):
        try:
            document = json.loads(whole_input(path, MOST_BYTES)[0])
        except (InputDataError, ValueError, RecursionError):  # another document
            continue
        if isinstance(document, dict) and isinstance(document.get(MARK), str):
            speed = next((name for name in ("fastest", "fast") if document.get(name) is True), "")
            return RunReport(_word(document[MARK]), _word(document.get("task")), speed)
    return None


def _word(value: Any) -> str:
    return printable(value.strip()[:40]) if isinstance(value, str) else ""


def _documents(image: Path) -> Iterator[Path]:
    """Files that may be a report, in the order of their names."""
    name = image.name.lower()
    stem = next((image.name[: -len(ending)] for ending in ENDINGS if name.endswith(ending)), image.name)
    for folder, start in ((image, ""), (image.parent, stem)):
        try:
            with os.scandir(folder) as entries:
                names = sorted(e.name for e in entries if e.name.startswith(start) and e.name.lower().endswith(".json"))
        except OSError:  # a file, or no right to read
            continue
        yield from (folder / own for own in islice(names, MOST_FILES))
