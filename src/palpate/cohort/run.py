"""A cohort from its rows to its tables: what is done stays, what is not is computed, whoever computes."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from palpate.cohort.engines.packing import Engine
from palpate.cohort.page import cohort_page
from palpate.cohort.plan import CASES, MARK, PLAN, Plan, make_plan, read_plan, write_plan
from palpate.cohort.progress import Tally
from palpate.cohort.records import Record, records_of
from palpate.cohort.statistics.document import statistics_document
from palpate.cohort.tables import CSV, PARQUET, write_csv, write_parquet
from palpate.cohort.task import Limits, Outcome, Row
from palpate.errors import ConfigurationError, InputDataError, PalpateError
from palpate.progress import Line, Progress, counted
from palpate.study.outputs import OutputFolder, make_folder, write_json, write_text
from palpate.study.provenance import software_versions

LOGGER = logging.getLogger(__name__)
STATISTICS, PAGE = "statistics.json", "cohort.html"


@dataclass(frozen=True, slots=True)
class Options:
    """How a cohort is computed: --set of all rows, limits of each, and which rows.

    resume: go on in a folder that has a cohort: rows that are waiting, changed or lost; only_failed: of its rows those
    that failed, and no others; overwrite: compute all rows, whatever cohort the folder has.
    """

    overrides: tuple[str, ...] = ()
    limits: Limits = field(default_factory=Limits)
    resume: bool = False
    only_failed: bool = False
    overwrite: bool = False
    workers: int | None = None


def run_cohort(
    rows: Sequence[Row], folder: Path, engine: Engine, options: Options, *, progress: Progress
) -> tuple[Record, ...]:
    """Compute the rows into `folder`, which this process holds, and write the cohort's tables, statistics and page.

    A row that fails is a row that failed. Raises `ConfigurationError` when the folder has a cohort and nobody asked to
    go on with it, `ResourceError` when the engine is gone or the disk refuses: what is done stays done, and tables tell
    of that.
    """
    if (folder / PLAN).exists() and not options.overwrite:
        if not (options.resume or options.only_failed):
            raise ConfigurationError(
                f"{folder} has a cohort already: --resume goes on with it, --only-failed computes its failed rows"
                " again, --overwrite computes all rows again; or choose another --output folder"
            )
        _refuse_other_cohort(rows, folder)
    foreign = [name for name in (CSV, PARQUET) if not (folder / PLAN).exists() and (folder / name).exists()]
    if foreign:
        raise ConfigurationError(f"{folder / foreign[0]} is of no cohort of Palpate's, and would be replaced: move it")
    progress(Line(f"{counted(len(rows), 'row')}: reading the files of each"))
    began = datetime.now(UTC).isoformat(timespec="seconds")
    plan = make_plan(rows, options.overrides, engine=engine.name, workers=options.workers, began=began)
    make_folder(folder / CASES)
    marks = plan.marks(folder)
    wanted = [number for number, mark in enumerate(marks) if _is_wanted(mark, options)]
    for number in wanted:
        (folder / CASES / rows[number].id / MARK).unlink(missing_ok=True)
    write_plan(plan, folder)
    kept = Counter(mark.state for mark in marks if mark is not None and not _is_wanted(mark, options))
    if kept:
        progress(Line(f"{kept['done']} done and {kept['failed']} failed before; {len(wanted)} to compute"))
    tally = Tally(len(rows), len(wanted), kept)
    try:
        for outcome in engine.outcomes([plan.task(folder, number, options.limits) for number in wanted]):
            progress(Line(tally.add(outcome)))
    except BaseException:  # the tables tell of what is done by then
        with suppress(PalpateError):
            close_cohort(plan, folder, tables_only=True)
        raise
    progress(Line("writing the tables, the statistics and the page of the cohort"))
    return close_cohort(plan, folder)


def _refuse_other_cohort(rows: Sequence[Row], folder: Path) -> None:
    """Raise `ConfigurationError` where no row of the cohort in the folder is in this table."""
    try:
        there = [row.id for row in read_plan(folder).rows]
    except InputDataError:  # damaged, or of another version: it is written again
        return
    if not {row.id for row in rows} & set(there):
        raise ConfigurationError(
            f"{folder} has another cohort: none of its {counted(len(there), 'row')} ('{there[0]}' ...) is in this table"
            f" ('{rows[0].id}' ...); choose another --output folder, or replace that cohort with --overwrite"
        )


def _is_wanted(mark: Outcome | None, options: Options) -> bool:
    """Whether a row is computed in this run: `mark` is what it came to before, of the same inputs and options."""
    if options.overwrite:
        return True
    if mark is None:
        return not options.only_failed or options.resume
    return mark.state == "failed" and (options.only_failed or mark.failure_class == "lost")


def close_cohort(plan: Plan, folder: Path, *, tables_only: bool = False) -> tuple[Record, ...]:
    """Write cohort.csv, cohort.parquet, statistics.json and cohort.html, all or none, from the rows' files.

    tables_only: the first two alone. Raises `ResourceError` when the disk refuses, or a library is missing.
    """
    records = records_of(plan, folder)
    with OutputFolder(folder).new_files() as area:
        write_csv(records, area / CSV)
        write_parquet(records, area / PARQUET)
        if not tables_only:
            document = statistics_document(records)
            write_json(area / STATISTICS, document)
            version = software_versions().get("palpate", "")
            page = cohort_page(records, document, created=plan.began, version=version)
            write_text(area / PAGE, page)
    return records
