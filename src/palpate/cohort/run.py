"""A cohort from its rows to its tables: what is done stays, what is not is computed, whoever computes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from palpate.body.provenance import software_versions
from palpate.cohort.page import cohort_page
from palpate.cohort.plan import CASES, MARK, PLAN, Plan, make_plan, read_plan, replaced, write_plan
from palpate.cohort.progress import Tally
from palpate.cohort.records import Record, records_of
from palpate.cohort.statistics.document import statistics_document
from palpate.cohort.tables import CSV, PARQUET, write_csv, write_parquet
from palpate.cohort.task import Limits, Outcome, Row, Task
from palpate.errors import ConfigurationError, InputDataError, PalpateError
from palpate.progress import Line, Progress, counted
from palpate.study.outputs import make_folder, write_json, write_text

STATISTICS, PAGE = "statistics.json", "cohort.html"

Compute = Callable[[Sequence[Task]], Iterable[Outcome]]  # the outcome of each task, its mark written by then


@dataclass(frozen=True, slots=True)
class Options:
    """How a cohort is computed: --set of all rows, limits of each, and which rows.

    resume: go on in a folder that has a cohort: rows that are waiting, changed or lost; only_failed: of its rows those
    that failed, and no others; overwrite: compute all rows, whatever cohort the folder has; shard: (k, n) for every
    n-th row from the k-th, while other runs compute the others into the same folder; workers: rows at a time, where
    that is known.
    """

    overrides: tuple[str, ...] = ()
    limits: Limits = field(default_factory=Limits)
    resume: bool = False
    only_failed: bool = False
    overwrite: bool = False
    shard: tuple[int, int] | None = None
    workers: int | None = None


def run_cohort(
    rows: Sequence[Row], folder: Path, compute: Compute, options: Options, *, progress: Progress
) -> tuple[Record, ...]:
    """Compute the rows into `folder`, and write the cohort's tables, statistics and page.

    A row that fails is a row that failed. A shard writes the tables only if no row is waiting any more. Raises
    `ConfigurationError` when the folder has a cohort and nobody asked to go on with it, `ResourceError` when the
    workers are gone or the disk refuses: what is done stays done, and tables tell of that.
    """
    if (folder / PLAN).exists() and not options.overwrite:
        if not (options.resume or options.only_failed or options.shard):
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
    plan = make_plan(rows, options.overrides, workers=options.workers, began=began)
    make_folder(folder / CASES)
    marks = plan.marks(folder)
    first, step = options.shard or (1, 1)
    ours = range(first - 1, len(rows), step)
    wanted = [number for number in ours if _is_wanted(marks[number], options)]
    for number in wanted:
        (folder / CASES / rows[number].id / MARK).unlink(missing_ok=True)
    write_plan(plan, folder)
    kept = Counter(mark.state for number in set(ours) - set(wanted) if (mark := marks[number]) is not None)
    if kept:
        progress(Line(f"{kept['done']} done and {kept['failed']} failed before; {len(wanted)} to compute"))
    tally = Tally(len(ours), len(wanted), kept)
    try:
        for outcome in compute([plan.task(folder, number, options.limits) for number in wanted]):
            progress(Line(tally.add(outcome)))
    except BaseException:  # the tables tell of what is done by then
        with suppress(PalpateError):
            write_tables(records_of(plan, folder), folder)
        raise
    records = records_of(plan, folder)
    if options.shard and any(record.state == "waiting" for record in records):
        return records
    progress(Line("writing the tables, the statistics and the page of the cohort"))
    write_all(plan, records, folder)
    return records


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


def write_tables(records: Sequence[Record], folder: Path) -> None:
    """Write cohort.csv and cohort.parquet; raises `ResourceError` when the disk refuses, or a library is missing."""
    for name, write in ((CSV, write_csv), (PARQUET, write_parquet)):
        with replaced(folder / name) as place:
            write(records, place)


def write_all(plan: Plan, records: Sequence[Record], folder: Path) -> None:
    """Write the tables, statistics.json and cohort.html; raises as `write_tables` does."""
    document = statistics_document(records)
    page = cohort_page(records, document, created=plan.began, version=software_versions().get("palpate", ""))
    write_tables(records, folder)
    with replaced(folder / STATISTICS) as place:
        write_json(place, document)
    with replaced(folder / PAGE) as place:
        write_text(place, page)
