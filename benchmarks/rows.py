"""The runner of all campaigns: jobs with a key each, their results as JSON lines, tables, and another commit's lines.

A result is kept as soon as it is there; a job whose line is in the file is not run again. A campaign's own file says
which jobs there are, what one of them does, and what is told of the results.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from palpate.errors import PalpateError

Result = dict[str, Any]  # a line of JSON
CLOSE = 1e-6  # relative difference of two numbers that are the same


class Job(NamedTuple):
    """The entries of a line that tell it from all others; and what makes the other entries."""

    key: Mapping[str, Any]
    work: Callable[[], Mapping[str, Any]]


def parser_of(
    text: str, *, output: str, first_seed: int, seeds: int | None, name: str = "--bodies"
) -> argparse.ArgumentParser:
    """The options that campaigns share; `name`: of the option for the number of seeds."""
    summary, _, rest = text.partition("\n")
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=summary, epilog=rest, formatter_class=raw)
    parser.add_argument(name, "--seeds", type=int, default=seeds, dest="seeds", metavar="N", help="how many seeds")
    parser.add_argument("--first-seed", type=int, default=first_seed)
    parser.add_argument("--share", default="0/1", help="k/n, k from 0: every n-th seed from the k-th, to run n at once")
    parser.add_argument("--minutes", type=float, default=np.inf, help="after which no other job is begun")
    parser.add_argument("--output", type=Path, default=Path(output), help="file of JSON lines, read and added to")
    parser.add_argument("--against", type=Path, metavar="FILE", help="lines of another commit, compared with these")
    parser.add_argument("--summary", action="store_true", help="of what the output has; nothing is run")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    return parser


def seeds_of(asked: argparse.Namespace) -> range:
    """The seeds of this process."""
    number, of = (int(part) for part in asked.share.split("/"))
    if not 0 <= number < of:
        raise SystemExit(f"--share {asked.share}: the first number must be 0 to {of - 1}, or seeds are left out")
    return range(asked.first_seed, asked.first_seed + asked.seeds)[number::of]


def collected(
    jobs: Iterable[Job],
    asked: argparse.Namespace,
    keys: Sequence[str],
    says: Callable[[Result], str] = json.dumps,
) -> list[Result]:
    """All lines of the output, after the jobs that it did not have; `keys`: the entries that tell lines apart."""
    found, began = {key_of(line, keys): line for line in read_lines(asked.output)}, time.monotonic()
    for job in () if asked.summary else jobs:
        if key_of(job.key, keys) in found:
            continue
        if time.monotonic() - began > 60.0 * asked.minutes:
            break
        try:
            line = {**job.key, **job.work()}
        except PalpateError as error:  # of a body that cannot be made; the next one can
            said(f"{key_of(job.key, keys)}: {error}")
            continue
        append_line(asked.output, line)
        found[key_of(line, keys)] = line
        said(says(line))
    if asked.against:
        for difference in differences(list(found.values()), read_lines(asked.against), keys):
            said(difference)
    return list(found.values())


def key_of(line: Mapping[str, Any], keys: Sequence[str]) -> str:
    """What tells a line from all others."""
    return json.dumps([line.get(name) for name in keys])


def read_lines(path: Path) -> list[Result]:
    """The lines that are there; one that a killed run left unfinished is left out, and computed anew."""
    found = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            said(f"{path}: an unfinished line is left out")
    return found


def append_line(path: Path, line: Mapping[str, Any]) -> None:
    """Append a line; a broken last line of a killed run is ended first."""
    unfinished = path.exists() and path.read_bytes()[-1:] not in (b"", b"\n")
    with path.open("a", encoding="utf-8") as file:
        file.write("\n" * unfinished + json.dumps(line) + "\n")


def differences(lines: Sequence[Result], others: Sequence[Result], keys: Sequence[str]) -> Iterator[str]:
    """In words, where lines differ from those of the same key of another commit; times are not compared."""
    known = {key_of(line, keys): line for line in others}
    for line in lines:
        if (other := known.get(key_of(line, keys))) is None:
            continue
        before, now = dict(_leaves(other)), dict(_leaves(line))
        for name in before.keys() & now.keys():
            if "second" not in name and name != "commit" and not _same(before[name], now[name]):
                yield f"{key_of(line, keys)} {name}: {before[name]} -> {now[name]}"


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if items is None:
        yield name, value
        return
    for key, item in items:
        yield from _leaves(item, f"{name}.{key}".lstrip("."))


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return bool(np.isclose(one, other, rtol=CLOSE, atol=0.0, equal_nan=True))
    return bool(one == other)


def printed(
    rows: Mapping[str, Result], asked: argparse.Namespace, columns: Mapping[str, Callable[[Result], str]]
) -> None:
    """The rows as one JSON document, or as a table with these columns; a cell whose entry is not there is empty."""
    if asked.json:
        print(json.dumps({"simulated": True, "rows": rows}, indent=1))
        return
    print(
        table_of(["", *columns], [[name, *(_cell(of, row) for of in columns.values())] for name, row in rows.items()])
    )


def _cell(of: Callable[[Result], str], row: Result) -> str:
    try:
        return of(row)
    except (KeyError, TypeError):  # there is no such entry, or it is None
        return "-"


def table_of(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table as pages have it."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows))


def rms(values: Iterable[float | None], digits: int | None = None) -> float | None:
    """Root mean square of those that are there; None without one."""
    return _of(values, lambda found: np.sqrt(np.mean(np.square(found))), digits)


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of those that are there; None without one."""
    return _of(values, np.mean)


def median(values: Iterable[float | None], digits: int | None = None) -> float | None:
    """Median of those that are there; None without one, and where it is infinite."""
    return _of(values, np.median, digits)


def _of(values: Iterable[float | None], what: Callable[[Any], Any], digits: int | None = None) -> float | None:
    found = [value for value in values if value is not None]
    result = float(what(found)) if found else np.inf
    return None if not np.isfinite(result) else result if digits is None else round(result, digits)


def holds(interval: Sequence[float | None], truth: float = 0.0) -> bool:
    """Whether an interval holds the truth; an open end does."""
    low, high = interval
    return (low is None or low <= truth) and (high is None or truth <= high)


def peak_gb() -> float:
    """The largest memory of this process, GB. That of getrusage begins with what the process had that started it."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1024.0 / 1e9


def said(message: str) -> None:
    """Tell what happens."""
    print(message, file=sys.stderr, flush=True)


def silent(message: str) -> None:
    """Say nothing of an estimate's progress."""
    del message
