"""What an earlier run left in an output folder: which run a file is of, and what becomes of it."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from palpate.case.case import Case
from palpate.case.file import case_tables, case_text, read_case, relative_path
from palpate.case.schema import shortened
from palpate.errors import ConfigurationError, InputDataError, PalpateError
from palpate.findings import Finding
from palpate.statement.result import SCHEMA
from palpate.study.outputs import (
    DOCUMENTS,
    RESULT,
    RESULT_FILES,
    OutputFolder,
    has_digest,
    listed,
    read_json,
    sha256_of,
    vouched,
    write_text,
)

CASE_NAME = "case.toml"
Digests = Mapping[str, Mapping[str, str]]  # name of a file in the folder -> {"sha256": hexadecimal}
UNSEALED = ("files", "warnings")  # which are added when the files take their places
FURTHER_MESH = re.compile(r"mesh_\d+\.vtu")


def refuse_other_case(case: Case, outputs: OutputFolder) -> None:
    """Raise `ConfigurationError` where the folder holds another case: its result, or a case.toml of somebody's own.

    A result may be replaced where its case has the same id, patient and first image, or the folder is to be
    overwritten. A case.toml may be replaced that this run or an earlier one has written.
    """
    if not outputs.overwrite:
        refuse_other_result(case, outputs.path, ", or replace that result with --overwrite (in Python: overwrite=True)")
    path = outputs.path / CASE_NAME
    if CASE_NAME in outputs.written or not path.exists():
        return
    if not _says(path, case) and CASE_NAME not in vouched(outputs.path, RESULT):
        raise ConfigurationError(
            f"{path} says something else than the case of this run, and is not replaced: choose another --output"
            " folder, or move that file"
        )


def refuse_other_result(case: Case, folder: Path, way_out: str = "") -> None:
    """Raise `ConfigurationError` where the folder holds the result of another case; way_out: what else can be done."""
    if there := _other_result(case, folder):
        raise ConfigurationError(
            f"{folder} holds the result of another case, {there}; this one is {_named(case.id, case.patient, case)}."
            f" Choose another output folder{way_out}"
        )


def refuse_any_result(folder: Path) -> None:
    """Raise `ConfigurationError` where the folder holds a result: what is made from results lies elsewhere.

    Exports and figures have files of the names that a result has, such as labels.nii.gz.
    """
    try:
        document = read_json(folder / RESULT)
    except InputDataError:
        return
    if document.get("schema") == SCHEMA:
        name = shortened(str(document.get("id")))
        raise ConfigurationError(f"{folder} holds the result of '{name}', which stays alone: choose another --output")


def _other_result(case: Case, folder: Path) -> str:
    """The case whose values result.json in the folder holds, in words, where it is another one than `case`.

    The same case, edited, is the folder's own case.toml, or has the same id and patient, and a first image at the same
    place or with the same content.
    """
    try:
        document = read_json(folder / RESULT)
    except InputDataError:
        return ""
    lost = document.get("schema") == SCHEMA and document.get("status") == "converged"
    if not lost or _says(folder / CASE_NAME, case):
        return ""
    try:
        earlier = read_case(folder / CASE_NAME)
    except PalpateError:  # it was moved, or is of a later version
        earlier = None
    name, patient = (shortened(str(document.get(key))) for key in ("id", "patient"))
    if (name, patient) == (case.id, case.patient) and _same_image(case, earlier, document):
        return ""
    return _named(name, patient, earlier)


def _same_image(case: Case, earlier: Case | None, document: Mapping[str, Any]) -> bool:
    """Whether two cases have the same first image, by its place or content, or nobody can tell."""
    if earlier is None or earlier.images is None or case.images is None:
        return True
    first, inputs = case.images.before, document.get("inputs")
    if first.resolve() == earlier.images.before.resolve():
        return True
    digest = inputs.get("before") if isinstance(inputs, dict) else None
    return first.is_file() and digest == {"sha256": sha256_of(first)}


def _named(name: str, patient: str, case: Case | None) -> str:
    """A case in a few words: its id, its patient if that is called otherwise, its first image."""
    of = f" of patient '{patient}'" if patient != name else ""
    image = f" (before: {case.images.before})" if case is not None and case.images is not None else ""
    return f"'{name}'{of}{image}"


def write_case(case: Case, outputs: OutputFolder, area: Path) -> tuple[Finding, ...]:
    """Write case.toml as it was run into `area`, unless one of somebody's own in the output folder says the same.

    Gives the warnings of a result without it: it was changed meanwhile, or a path cannot be written in TOML.
    """
    path = outputs.path / CASE_NAME
    own = not path.exists() or CASE_NAME in vouched(outputs.path, RESULT)
    if not own and _says(path, case):
        return ()
    if not own and not (case.overrides and CASE_NAME in outputs.written):  # by `palpate init`, in the same run
        text = f"{path.name} in the output folder was changed during the run and is not the case of it."
        return (Finding("case-file", text),)
    try:
        write_text(area / CASE_NAME, case_text(case, outputs.path))
    except ConfigurationError as error:
        return (Finding("case-file", f"the case of this run could not be written: {error}"),)
    return ()


def _says(path: Path, case: Case) -> bool:
    """Whether the case file at `path` says what `case` says."""
    try:
        found = read_case(path)
    except PalpateError:
        return False

    def place(file: Path) -> str:
        """A file from the folder of both."""
        return relative_path(file, path.parent)

    return case_tables(found, place) == case_tables(case, place)


def earlier_files(folder: Path, document: str, files: Digests) -> tuple[Finding, ...]:
    """Warnings on what is in `folder` when a run's `document` with its `files` takes its place there.

    They name what stays and could be taken for a file of the new run, and what lists a file that the run replaces.
    """
    gone = vouched(folder, document)
    left = [name for name in strange_files(folder, files) if name not in files and name not in gone]
    warnings = []
    if left and document == RESULT:
        words = "in the output folder are of an earlier run and do not belong to this result"
        warnings.append(f"{', '.join(left)} {words}")
    for other in DOCUMENTS:
        before = {} if other == document else listed(folder, other)
        replaced = [name for name, sha256 in before.items() if name in files and files[name]["sha256"] != sha256]
        if replaced:
            words = f"tells of an earlier run, whose {', '.join(replaced)} this run has replaced"
            warnings.append(f"{other} in the output folder {words}")
    return tuple(Finding("earlier-files", warning) for warning in warnings)


def seal_of(document: Mapping[str, Any]) -> str:
    """SHA-256 (hexadecimal) of what a result.json says, whatever files and warnings stand beside it."""
    sealed = {key: value for key, value in document.items() if key not in UNSEALED}
    return hashlib.sha256(json.dumps(sealed, sort_keys=True, allow_nan=False).encode()).hexdigest()


def strange_files(folder: Path, files: Digests) -> list[str]:
    """Names of result files in `folder` that are not those of `files`, as `digests_of` gives them; sorted."""
    further = [path for path in folder.glob("mesh_*.vtu") if FURTHER_MESH.fullmatch(path.name)]
    present = sorted({*further, *(folder / name for name in RESULT_FILES)})
    digests = {name: entry["sha256"] for name, entry in files.items()}
    return [path.name for path in present if path.is_file() and not has_digest(path, digests.get(path.name))]
