"""The plan of a cohort in its folder: the rows with the digests of what each depends on, and their states."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from palpate.cohort.mark import read_mark
from palpate.cohort.resolve import row_key
from palpate.cohort.task import Limits, Outcome, Row, Task
from palpate.errors import InputDataError
from palpate.parallel import mapped
from palpate.study.outputs import read_json, staged, write_json

PLAN, CASES = "plan.json", "cases"
SCHEMA = "palpate.plan/1"
KEY = re.compile("[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class Plan:
    """What a cohort computes: rows, the digest of each, --set of all, who computes, when it began (ISO 8601)."""

    rows: tuple[Row, ...]
    keys: tuple[str, ...]
    overrides: tuple[str, ...] = ()
    engine: str = "local"
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


def make_plan(rows: Sequence[Row], overrides: Sequence[str], *, engine: str, workers: int | None, began: str) -> Plan:
    """The plan of the rows, all their inputs digested as they are at the moment."""
    keys = mapped(partial(row_key, overrides=overrides), rows)
    return Plan(tuple(rows), tuple(keys), tuple(overrides), engine, workers, began)


def write_plan(plan: Plan, folder: Path) -> None:
    """Put plan.json in place; raises `ResourceError` when the disk refuses."""
    with staged(folder) as staging:
        write_json(staging.area / PLAN, {"schema": SCHEMA} | asdict(plan))
        staging.commit()


def read_plan(folder: Path) -> Plan:
    """The plan that `write_plan` wrote; raises `InputDataError` when there is none."""
    if not (folder / PLAN).is_file():
        raise InputDataError(f"there is no {folder / PLAN}, so no cohort; name the --output folder of palpate cohort")
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
