"""Rows from a folder of BIDS derivatives: sub-*/ses-*/*_dseg.nii.gz, one session of each patient the rest state."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from palpate.cohort.table import checked_rows, row_of, separated_cells
from palpate.cohort.task import Row
from palpate.errors import ConfigurationError

IMAGES, TABLE, PARTICIPANTS = "*_dseg.nii.gz", "dseg.tsv", "participants.tsv"


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
        rows += [_row(rest[0], session, folder, template, people.get(patient.name, {})) for session in later]
    if not rows:
        wanted = "two sessions (sub-*/ses-*/*_dseg.nii.gz)"
        raise ConfigurationError(
            f"{folder} has no patient with {wanted}{f', one of them {_session(reference)}' if reference else ''}"
        )
    return checked_rows(rows, folder)


def _row(rest: Path, session: Path, root: Path, template: Path, person: Mapping[str, str]) -> Row:
    cells = {
        **{name: text for name, text in person.items() if name not in ("id", "patient", "session", "names", "case")},
        "id": f"{session.parent.name}_{session.name}",
        "patient": session.parent.name,
        "session": session.name,
    }
    found = [sorted(path.rglob(IMAGES)) for path in (rest, session)]
    images = {"before": str(found[0][0].absolute()), "after": str(found[1][0].absolute())}
    row = row_of(cells | images, root, template)
    if any(len(paths) > 1 for paths in found):
        return replace(row, problem=f"{rest.name} or {session.name} has several images {IMAGES}; leave one in each")
    image = found[0][0]  # whose label table has its own name, or is dseg.tsv in its folder or one above
    own = image.with_name(image.name.removesuffix(".nii.gz") + ".tsv")
    above = [folder / TABLE for folder in image.parents if folder == root or root in folder.parents]
    return replace(row, names=str(next((path.absolute() for path in (own, *above) if path.is_file()), "")))


def _sorted(folder: Path, pattern: str) -> list[Path]:
    """Folders of a pattern, numbers in their names in their order."""

    def order(path: Path) -> list[tuple[int, str]]:
        """Text and numbers in turn."""
        return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]{1,9})", path.name)]

    return sorted((path for path in folder.glob(pattern) if path.is_dir()), key=order)


def _session(name: str) -> str:
    return name if name.startswith("ses-") else f"ses-{name}"
