"""The done mark of a row's folder: what it came to, of which inputs, written last and whole."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.cohort.task import FAILURE_CLASSES, Outcome
from palpate.errors import FolderInUse, InputDataError, ResourceError
from palpate.study.earlier import RESULT
from palpate.study.lock import held_folder
from palpate.study.outputs import read_json, sha256_of, staged, write_json

MARK = "done.json"
SCHEMA = "palpate.done/1"
RETRY_S = 0.1


def write_mark(folder: Path, outcome: Outcome) -> Outcome:
    """Write the mark of a folder that this process holds, beside the result.json that it vouches for.

    Raises `ResourceError` when the disk refuses.
    """
    result = folder / RESULT
    outcome = replace(outcome, result=sha256_of(result) if result.is_file() else "", cause="")
    with staged(folder) as staging:
        write_json(staging.area / MARK, {"schema": SCHEMA} | outcome.to_dict())
        staging.commit()
    return outcome


def read_mark(folder: Path, *, checked: bool = True) -> Outcome | None:
    """The mark of a folder; None without one, and where its result is not there as it was (if that is `checked`)."""
    try:
        content = read_json(folder / MARK)
        content.pop("schema")
        found = Outcome(**content)
        known = found.state == "done" or (found.state == "failed" and found.failure_class in FAILURE_CLASSES)
        if not known or (found.state == "done" and not found.result):
            return None
        if checked and found.result and sha256_of(folder / RESULT) != found.result:
            return None
    except (InputDataError, ResourceError, KeyError, TypeError):
        return None
    return found


def document_of(folder: Path, mark: Outcome) -> dict[str, Any] | None:
    """The result.json that a row's mark vouches for; None where the row is not done, or that file is gone."""
    if mark.state != "done":
        return None
    try:
        return read_json(folder / RESULT)
    except InputDataError:
        return None


@contextmanager
def held_soon(folder: Path, seconds: float = float("inf")) -> Iterator[None]:
    """Hold a row's folder; while another process does, which may be about to end, wait so long.

    Raises `FolderInUse` when that was not long enough, else as `held_folder` does.
    """
    end = time.monotonic() + seconds
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(held_folder(folder))
                break
            except FolderInUse:
                if time.monotonic() > end:
                    raise
            time.sleep(RETRY_S)
        yield
