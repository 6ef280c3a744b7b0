"""The plan of a cohort in its folder: its rows, the digests of what each depends on, and the done mark of each."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from uuid import uuid4

from palpate.cohort.resolve import row_key
from palpate.cohort.task import FAILURE_CLASSES, Limits, Outcome, Row, Task
from palpate.errors import InputDataError, ResourceError
from palpate.images.input_file import similar_names
from palpate.parallel import mapped
from palpate.study.outputs import RESULT, read_json, sha256_of, write_json

MARK = "done.json"
DONE_SCHEMA = "palpate.done/1"
WITH_RESULT = ("", "solver")  # failure classes of rows whose estimate has written its result.json
PLAN, CASES = "plan.json", "cases"
SCHEMA = "palpate.plan/1"
KEY = re.compile("[0-9a-f]{64}")


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Where the file at `path` is written anew, which it replaces when the block has ended well.

    Another run may do the same at the same time. Raises `ResourceError` when the disk refuses.
    """
    place = path.with_name(f".{path.name}.{uuid4().hex}")
    try:
        yield place
        place.replace(path)
    except OSError as error:
        raise ResourceError(f"cannot write {path}: {error.strerror or error}; free some space") from error
    finally:
        with suppress(OSError):
            place.unlink(missing_ok=True)


def write_mark(folder: Path, outcome: Outcome) -> Outcome:
    """Write the mark of a row's folder, beside the result.json that it vouches for; `ResourceError`."""
    result = folder / RESULT
    written = outcome.failure_class in WITH_RESULT and result.is_file()
    outcome = replace(outcome, result=sha256_of(result) if written else "")
    with replaced(folder / MARK) as place:
        write_json(place, {"schema": DONE_SCHEMA} | outcome.to_dict())
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


@dataclass(frozen=True, slots=True)
class Plan:
    """What a cohort computes: rows, the digest of each, --set of all, rows at a time, when it began (ISO 8601)."""

    rows: tuple[Row, ...]
    keys: tuple[str, ...]
    overrides: tuple[str, ...] = ()
    workers: int | None = None
    began: str = ""

    def mark(self, folder: Path, number: int, *, checked: bool = True) -> Outcome | None:
        """What row `number` came to; None while it is waiting. `checked`: its result was not changed since."""
        found = read_mark(folder / CASES / self.rows[number].id, checked=checked)
        return found if found is not None and found.key == self.keys[number] else None

    def marks(self, folder: Path, *, checked: bool = True) -> list[Outcome | None]:
        """What each row came to."""
        return mapped(partial(self.mark, folder, checked=checked), range(len(self.rows)))

    def task(self, folder: Path, number: int, limits: Limits) -> Task:
        """Row `number` as a task of the cohort's folder."""
        row = self.rows[number]
        return Task(row, str((folder / CASES / row.id).absolute()), self.keys[number], self.overrides, limits)


def make_plan(rows: Sequence[Row], overrides: Sequence[str], *, workers: int | None, began: str) -> Plan:
    """The plan of the rows, all their inputs digested as they are at the moment."""
    keys = mapped(partial(row_key, overrides=overrides), rows)
    return Plan(tuple(rows), tuple(keys), tuple(overrides), workers, began)


def write_plan(plan: Plan, folder: Path) -> None:
    """Put plan.json in place; raises `ResourceError` when the disk refuses."""
    with replaced(folder / PLAN) as place:
        write_json(place, {"schema": SCHEMA} | asdict(plan))


def read_plan(folder: Path) -> Plan:
    """The plan that `write_plan` wrote; raises `InputDataError` when there is none."""
    if not (folder / PLAN).is_file():
        advice = similar_names(folder / PLAN) or "; name the --output folder of palpate cohort"
        raise InputDataError(f"there is no {folder / PLAN}, so no cohort{advice}")
    content = read_json(folder / PLAN)
    try:
        content.pop("schema")
        rows = tuple(Row(**{**row, "after": tuple(row["after"])}) for row in content.pop("rows"))
        keys, overrides = tuple(content.pop("keys")), tuple(content.pop("overrides"))
        if len(keys) != len(rows) or not all(KEY.fullmatch(key) for key in keys):
            raise ValueError("its keys are none")
        return Plan(rows, keys, overrides, **content)
    except (KeyError, TypeError, ValueError) as error:
        raise InputDataError(f"{folder / PLAN} is not what Palpate writes ({error}): run the cohort again") from error
