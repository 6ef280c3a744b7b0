"""The sub-commands of many cases: cohort, status, statistics."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from palpate.cli.outcome import Outcome, columns
from palpate.errors import ConfigurationError, ResourceError
from palpate.findings import some
from palpate.progress import Line, Progress, counted

if TYPE_CHECKING:
    from pathlib import Path

    from palpate.cohort.records import Record
    from palpate.study.outputs import OutputFolder


INTERRUPTED = "the plan and the finished rows; --resume goes on from there"
MOST_TOLD = 20  # failed rows
MOST_NAMED = 5  # rows that are left out for one reason
TARGETS = ("cohort.csv", "cohort.parquet", "cohort.html", "statistics.json", "plan.json")


def cohort(arguments: argparse.Namespace, _: None, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Compute the rows of a table, or every n-th of them, on workers of Dask."""
    from palpate.cohort.tables import require_libraries

    require_libraries("distributed")
    from palpate.cohort.cluster import outcomes
    from palpate.cohort.run import Options, run_cohort
    from palpate.cohort.table import read_derivatives, read_table
    from palpate.cohort.task import Limits
    from palpate.images.input_file import similar_names
    from palpate.parallel import processors

    table, template = arguments.table, arguments.template
    if arguments.scheduler is not None and arguments.workers is not None:
        raise ConfigurationError("--workers goes without --scheduler, whose cluster has workers of its own")
    if template is not None and not template.is_file():
        raise ConfigurationError(
            f"there is no template {template}{similar_names(template) or '; give the path of a case.toml'}"
        )
    if table.is_dir():
        rows = read_derivatives(table, template, reference=arguments.reference)
    elif arguments.reference is not None:
        raise ConfigurationError("--reference goes with BIDS derivatives; in a table, 'before' names the rest state")
    else:
        rows = read_table(table, template)
    workers = min(arguments.workers or processors(), len(rows))
    options = Options(
        overrides=tuple(arguments.set),
        limits=Limits(arguments.memory_limit, arguments.time_limit),
        resume=arguments.resume,
        only_failed=arguments.only_failed,
        overwrite=arguments.overwrite,
        shard=arguments.shard,
        workers=None if arguments.scheduler else workers,
    )
    compute = partial(outcomes, scheduler=arguments.scheduler, workers=workers)
    try:
        records = run_cohort(rows, outputs.path, compute, options, progress=progress)
    except KeyboardInterrupt:
        outputs.written.append(INTERRUPTED)
        raise
    return _told(records, outputs.path, arguments.shard)


def status(arguments: argparse.Namespace, _: None, outputs: None, progress: Progress) -> Outcome:
    """Say where a cohort stands, from its files."""
    from palpate.cohort.progress import status_of

    del outputs, progress
    found = status_of(arguments.folder)
    return Outcome(found.to_dict(), found.text())


def statistics(_: argparse.Namespace, case: None, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Compute the statistics of a cohort from its files."""
    from palpate.cohort.tables import require_libraries

    require_libraries()
    from palpate.cohort.plan import read_plan
    from palpate.cohort.records import records_of
    from palpate.cohort.run import write_all
    from palpate.study.outputs import read_json

    del case
    plan = read_plan(outputs.path)
    progress(Line("computing the statistics"))
    write_all(plan, records_of(plan, outputs.path), outputs.path)
    document = read_json(outputs.path / "statistics.json")
    files = f"written to {outputs.path}: {', '.join(TARGETS[:-1])}"
    opening = f"open {outputs.path / 'cohort.html'}"
    return Outcome(document, "\n".join([_associations(document), *left_out_rows(document), files, opening]))


def _told(records: Sequence[Record], folder: Path, shard: tuple[int, int] | None) -> Outcome:
    """The outcome of the rows; an exit code above 0 when any of them, or of the shard, is still waiting."""
    from palpate.study.outputs import read_json

    states = [record.state for record in records]
    counts = {state: states.count(state) for state in ("done", "failed", "waiting")}
    document: dict[str, Any] = {"schema": "palpate.cohort/1", "rows": len(records), **counts}
    failed = [record for record in records if record.failure_class]
    document["failures"] = [
        {"id": record.row.id, "failure_class": record.failure_class, "message": record.message} for record in failed
    ]
    lines = [f"{record.row.id} failed ({record.failure_class}): {record.message}" for record in failed[:MOST_TOLD]]
    if len(failed) > MOST_TOLD:
        lines.append(f"and {len(failed) - MOST_TOLD} more, see cohort.csv")
    summary = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    if shard is not None and counts["waiting"]:  # the run that finds no row waiting writes the tables
        waits = "waiting" in states[shard[0] - 1 :: shard[1]]
        text = "\n".join([*lines, f"{summary}; the tables follow when no row is waiting"])
    else:
        waits = bool(counts["waiting"])
        found = document["statistics"] = read_json(folder / "statistics.json")
        files = f"written to {folder}: {', '.join(TARGETS[:-1])}, cases/"
        opening = f"open {folder / 'cohort.html'}"
        text = "\n".join([*lines, _associations(found), *left_out_rows(found), summary, files, opening])
    left = f"{counts['waiting']} rows are waiting: --resume goes on with them" if waits else ""
    return Outcome(document, text, ResourceError.exit_code if left else 0, left)


def left_out_rows(document: dict[str, Any]) -> list[str]:
    """The rows that are done and do not enter the statistics, one line for each reason; empty where all enter."""
    unfit, unknown = dict[str, dict[str, None]](), list[str]()
    for tissue, organ in document["organs"].items():
        rows = organ["left_out_rows"]
        for row, codes in rows["unfit"].items():
            unfit.setdefault(", ".join(codes), {})[row] = None
        if rows["not identified"]:
            unknown.append(_of_rows(rows["not identified"], f"{tissue} is not identified"))
    return [*(_of_rows(list(rows), codes) for codes, rows in unfit.items()), *unknown]


def _of_rows(rows: Sequence[str], reason: str) -> str:
    more = f" and {len(rows) - MOST_NAMED} more" if len(rows) > MOST_NAMED else ""
    return f"{counted(len(rows), 'row')} left out: {reason} ({', '.join(rows[:MOST_NAMED])}{more})"


def _associations(document: dict[str, Any]) -> str:
    """How the modulus of each tissue depends on the stage, one line each, and images that patients share."""
    from palpate.report.rows import interval_text, number

    rows = [["tissue", "patients", "scans", "without a value", "factor per stage", "95 %", "p"]]
    for tissue, organ in document["organs"].items():
        found, used = organ["regression"], organ["used"]
        cells = [found.get("undefined", ""), "", ""]
        if "p" in found:
            low, high = found["interval95"]
            cells = [number(found["factor_per_stage"]), interval_text((low, high)), number(found["p"], digits=2)]
        rows.append([tissue, *(str(used[name]) for name in ("patients", "scans", "censored")), *cells])
    shared = [", ".join(row["id"] for row in image["rows"]) for image in document["identical_images"]]
    same = [
        f"the same image, byte for byte, in several patients: {some(list(dict.fromkeys(shared)))}; correct the table"
    ] * bool(shared)
    return "\n".join([columns(rows), *same])
