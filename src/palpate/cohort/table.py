"""The rows of a cohort: from the lines of a table, or from a folder of BIDS derivatives."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from palpate.case.schema import nearest, shortened
from palpate.cohort.tables import COLUMNS
from palpate.cohort.task import Row
from palpate.errors import ConfigurationError
from palpate.images.input_file import read_input
from palpate.images.named_labels import MAX_NAME, computed_by_spreadsheets

LARGEST_FILE = 2**26  # bytes
MOST_ROWS = 100_000
MOST_COLUMNS = 500
KNOWN = ("id", "patient", "session", "stage", "case", "before", "after")
IDENTIFIER = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
STAGE = re.compile(r"[0-9]{1,4}")
LATER = ";"  # between several later images in one cell
OUR_OWN = ("id", "patient", "session", "names", "case")  # which participants.tsv does not tell
IMAGES, TABLE, PARTICIPANTS = "*_dseg.nii.gz", "dseg.tsv", "participants.tsv"


def read_table(path: Path, template: Path | None) -> tuple[Row, ...]:
    """The rows of the CSV file at `path`, whose paths are relative to it.

    Raises `ConfigurationError` for a table that cannot be read as a whole: columns, ids. What is wrong with a single
    line is its row's `problem`.
    """
    rows = [row_of(cells, path.absolute().parent, template) for cells in separated_cells(path, delimiter=",")]
    return checked_rows(rows, path)


def separated_cells(path: Path, *, delimiter: str) -> list[dict[str, str]]:
    """Each line of a table after the first: name of the column -> cell; empty lines are passed over.

    Raises `ConfigurationError` as `read_table` does; which columns there must be, only for tables of commas.
    """
    try:
        lines = list(csv.reader(io.StringIO(_text(path)), delimiter=delimiter, strict=True))
    except csv.Error as error:
        raise ConfigurationError(f"{path} is no CSV file ({error}); export it again") from error
    if not lines:
        raise ConfigurationError(f"{path} is empty: its first line must name the columns: {', '.join(KNOWN)}")
    names = [name.strip() for name in lines[0]]
    twice = sorted({name for name in names if names.count(name) > 1}) if len(names) <= MOST_COLUMNS else ["..."]
    if twice:
        raise ConfigurationError(f"{path} has {len(names)} columns, of them '{shortened(twice[0])}' twice; rename one")
    for name in set(names) - set(KNOWN):
        if not name or not name.isprintable() or len(name) > MAX_NAME or computed_by_spreadsheets(name):
            raise ConfigurationError(f"{path}: '{shortened(name)}' cannot be the name of a column; give it another")
        if name in COLUMNS:
            raise ConfigurationError(f"{path}: the column '{name}' is one of the outcome's; rename it")
    complete = "id" in names and {"case", "before"} & set(names) and ("before" in names) == ("after" in names)
    if delimiter == "," and not complete:
        missing = next(name for name in ("id", "before", "after") if name not in names)
        raise ConfigurationError(
            f"{path} lacks the column '{missing}': a table has id, and either case (a case file) or before and after"
            f" (images, with --template); {nearest(missing, names)}"
        )
    for number, line in enumerate(lines[1:], start=2):
        if any(cell.strip() for cell in line) and len(line) != len(names):
            raise ConfigurationError(
                f"{path}, line {number}, has {len(line)} cells, and the first line names {len(names)} columns: quote a"
                " cell that has a comma in it"
            )
    filled = [line for line in lines[1:] if any(cell.strip() for cell in line)]
    return [dict(zip(names, (cell.strip() for cell in line), strict=True)) for line in filled]


def checked_rows(rows: Sequence[Row], path: Path) -> tuple[Row, ...]:
    """The rows, each with an id of its own that is a folder's name on every system; `ConfigurationError`."""
    if not 0 < len(rows) <= MOST_ROWS:
        raise ConfigurationError(f"{path} has {len(rows)} rows; a cohort has 1 to {MOST_ROWS}")
    seen: set[str] = set()
    for row in rows:
        if not IDENTIFIER.fullmatch(row.id) or RESERVED.fullmatch(row.id) or row.id.endswith("."):
            raise ConfigurationError(
                f"{path}: the id '{shortened(row.id)}' cannot name a folder; take 1 to 100 letters, digits, '.', '_' or"
                " '-', a letter or digit first"
            )
        if row.id.lower() in seen:
            raise ConfigurationError(
                f"{path}: the id '{row.id}' stands there twice (small and large letters count as the same); each row"
                " needs its own"
            )
        seen.add(row.id.lower())
    return tuple(rows)


def _text(path: Path) -> str:
    try:
        content, _ = read_input(path, LARGEST_FILE)
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path} is not UTF-8 text (byte {error.start}); save it as UTF-8") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigurationError(f"cannot read the table {path}: {reason}; check its path") from error
    if len(content) > LARGEST_FILE or "\0" in text:
        raise ConfigurationError(f"{path} is no table of a cohort: too long, or with zero bytes; give a CSV file")
    return text


def row_of(cells: Mapping[str, str], folder: Path, template: Path | None) -> Row:
    """The row that a line's cells (column -> text) make; paths are relative to `folder`."""
    case, before, after = (cells.get(name, "") for name in ("case", "before", "after"))
    stage = cells.get("stage", "")
    problem = ""
    if stage and not (STAGE.fullmatch(stage) and int(stage) <= 1000):
        problem = f"its stage is '{shortened(stage)}'; write a whole number from 0 to 1000, or nothing"
    elif bool(case) == bool(before or after):
        problem = "it must name either a case file (case) or images (before and after)"
    elif not case and not (before and after):
        problem = f"it has no image '{'after' if before else 'before'}'"
    elif not case and template is None:
        problem = "it names images, and there is no --template case.toml that says who is who in them"
    later = [place for part in after.split(LATER) if (place := part.strip())]
    return Row(
        id=cells["id"],
        patient=cells.get("patient", "") or cells["id"],
        session=cells.get("session", ""),
        stage=int(stage) if stage and not problem.startswith("its stage") else None,
        case=_place(case, folder),
        before=_place(before, folder),
        after=tuple(_place(place, folder) for place in later),
        template="" if template is None or case else str(template.absolute()),
        covariates={name: cell for name, cell in cells.items() if name not in KNOWN},
        problem=problem,
    )


def _place(text: str, folder: Path) -> str:
    return str(folder / os.path.expanduser(text)) if text else ""  # noqa: PTH111 - as the paths of a case are read


def read_derivatives(folder: Path, template: Path | None, *, reference: str | None = None) -> tuple[Row, ...]:
    """A row for each session of each patient but the reference, whose image is the rest state of them all.

    reference: "ses-X" or "X"; None: each patient's first session, numbers in their order. Labels are named by the
    dseg.tsv beside the image or above it; stage and covariates come from participants.tsv, where it has them. Raises
    `ConfigurationError` where there is no patient with two sessions, or the template is missing.
    """
    if template is None:
        raise ConfigurationError(f"{folder} is a folder of images: --template case.toml must say who is who in them")
    people: dict[str, dict[str, str]] = {}  # patient -> the columns of participants.tsv; "n/a" is nothing
    if (folder / PARTICIPANTS).is_file():
        for cells in separated_cells(folder / PARTICIPANTS, delimiter="\t"):
            plain = {name: "" if text == "n/a" else text for name, text in cells.items()}
            people[plain.pop("participant_id", "")] = plain
    rows: list[Row] = []
    for patient in _sorted(folder, "sub-*"):
        sessions = [path for path in _sorted(patient, "ses-*") if any(path.rglob(IMAGES))]
        rest = sessions[:1] if reference is None else [path for path in sessions if path.name == _session(reference)]
        later = [session for session in sessions if rest and session != rest[0]]
        person = people.get(patient.name, {})
        stated = {name: text for name, text in person.items() if name not in OUR_OWN}
        for session in later:
            own = {"id": f"{patient.name}_{session.name}", "patient": patient.name, "session": session.name}
            found = [sorted(path.rglob(IMAGES)) for path in (rest[0], session)]
            images = {"before": str(found[0][0].absolute()), "after": str(found[1][0].absolute())}
            row = row_of(stated | own | images, folder, template)
            image = found[0][0]  # whose label table has its own name, or is dseg.tsv in its folder or one above
            table = image.with_name(image.name.removesuffix(".nii.gz") + ".tsv")
            above = [place / TABLE for place in image.parents if place == folder or folder in place.parents]
            names = str(next((path.absolute() for path in (table, *above) if path.is_file()), ""))
            several = any(len(paths) > 1 for paths in found)
            problem = f"{rest[0].name} or {session.name} has several images {IMAGES}; leave one in each"
            rows.append(replace(row, problem=problem) if several else replace(row, names=names))
    if not rows:
        wanted = "two sessions (sub-*/ses-*/*_dseg.nii.gz)"
        raise ConfigurationError(
            f"{folder} has no patient with {wanted}{f', one of them {_session(reference)}' if reference else ''}"
        )
    return checked_rows(rows, folder)


def _sorted(folder: Path, pattern: str) -> list[Path]:
    """Folders of a pattern, numbers in their names in their order."""

    def order(path: Path) -> list[tuple[int, str]]:
        """Text and numbers in turn."""
        return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]{1,9})", path.name)]

    return sorted((path for path in folder.glob(pattern) if path.is_dir()), key=order)


def _session(name: str) -> str:
    return name if name.startswith("ses-") else f"ses-{name}"
