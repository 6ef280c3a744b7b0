"""The case that a row of the table means, and the digest of everything that its numbers depend on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from palpate.body.provenance import file_digest, software_versions
from palpate.case.case import Case
from palpate.case.file import case_tables, read_case
from palpate.cohort.task import Row
from palpate.errors import ConfigurationError, InputDataError, PalpateError

KEPT_IMAGES = ("names", "align")  # what a template's [images] says of all rows; its images are another body's
NOT_NUMERICAL = ("python", "matplotlib", "pydicom", "highdicom")  # versions that do not touch a number
HEADERS = (".mhd", ".nhdr", ".dcm", ".ima", "")  # files that are read together with others of their folder


def case_of(row: Row, overrides: Iterable[str] = ()) -> Case:
    """The case of a row: its own case file or the template with the row's images; id, patient, stage are the row's.

    Raises `ConfigurationError` as `read_case` does, and with the row's own problem.
    """
    if row.problem:
        raise ConfigurationError(row.problem)

    def changed(table: dict[str, Any]) -> dict[str, Any]:
        """The file's table with the row's words in it."""
        table = {key: value for key, value in table.items() if key != "stage"} | {"id": row.id, "patient": row.patient}
        if row.stage is not None:
            table["stage"] = row.stage
        if row.case:
            return table
        if table.get("pairs") or "phantom" in table:
            raise ConfigurationError(
                f"the template {Path(row.template).name} has [[pairs]] or a [phantom], which are of one body: take them"
                " out, or give such cases their own file, in the column 'case'"
            )
        given = table.get("images")
        images = {key: given[key] for key in KEPT_IMAGES if key in given} if isinstance(given, dict) else {}
        images |= {"before": row.before, "after": list(row.after)} | ({"names": row.names} if row.names else {})
        return table | {"images": images}

    return read_case(row.case or row.template, tuple(overrides), change=changed)


def row_key(row: Row, overrides: Iterable[str] = ()) -> str:
    """SHA-256 (hexadecimal) of a row's case with its inputs' content, and of the versions that compute it.

    Patient, session, stage and covariates are not in it: they are the table's, and no estimate depends on them. A row
    whose case cannot be read has the digest of what it says.
    """
    try:
        case = case_of(row, overrides)
        tables: Any = case_tables(replace(case, patient=case.id, stage=None), _content)
    except PalpateError as error:
        said = replace(row, patient=row.id, session="", stage=None, covariates={})
        tables = [asdict(said), str(error)]
    versions = {name: found for name, found in _versions().items() if name not in NOT_NUMERICAL}
    text = json.dumps({"case": tables, "versions": versions}, sort_keys=True)
    return hashlib.sha256(text.encode("utf-8", errors="surrogatepass")).hexdigest()


_versions = cache(software_versions)  # to look them up takes longer than to read a case


def _content(path: Path) -> str:
    """Digest of an input: a file, with those of its folder where it may be read with them, or a folder's files."""
    try:
        if path.is_dir():
            return _of_files(path.iterdir())
        beside = path.suffix.lower() in HEADERS and path.exists()  # a DICOM series may be one folder below
        return _of_file(path) + (_of_files([*path.parent.glob("*"), *path.parent.glob("*/*")]) if beside else "")
    except OSError as error:
        return f"unreadable: {error.strerror}"


def _of_files(paths: Iterable[Path]) -> str:
    files = sorted(path for path in paths if path.is_file())
    text = "\n".join(f"{path.name} {_of_file(path)}" for path in files)
    return hashlib.sha256(text.encode("utf-8", errors="surrogateescape")).hexdigest()


def _of_file(path: Path) -> str:
    try:
        status = path.stat()
        return _digest(path, status.st_size, status.st_mtime_ns, status.st_ino)
    except (OSError, InputDataError):
        return "unreadable"


@lru_cache(maxsize=65536)
def _digest(path: Path, *state: int) -> str:
    """Digest of the file as it is in that state: rows that share a template or a folder digest it once."""
    del state
    return file_digest(path)
