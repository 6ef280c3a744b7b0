"""The case.toml beside a result, from which the same numbers come again; a case of somebody's own is never replaced."""

from __future__ import annotations

from pathlib import Path

from palpate.errors import ConfigurationError, PalpateError
from palpate.findings import Finding
from palpate.study.case import Case
from palpate.study.case_file import case_tables, case_text, read_case, relative_path
from palpate.study.earlier import RESULT, vouched
from palpate.study.outputs import OutputFolder, Staging, write_text

CASE_NAME = "case.toml"


def refuse_other_case(case: Case, outputs: OutputFolder) -> None:
    """Raise `ConfigurationError` where the folder has a case.toml of somebody's own that says something else.

    One that this run or an earlier one has written may be replaced.
    """
    path = outputs.path / CASE_NAME
    if CASE_NAME in outputs.written or not path.exists():
        return
    if not _says(path, case) and CASE_NAME not in vouched(outputs.path, RESULT):
        raise ConfigurationError(
            f"{path} is another case than that of this run, whose own case.toml would come to stand there: choose"
            " another --output folder, or move that file"
        )


def stage_case(case: Case, staging: Staging) -> tuple[Finding, ...]:
    """Stage case.toml as it was run, unless one of somebody's own in the folder says the same.

    Gives the warnings of a result without it: it was changed meanwhile, or a path cannot be written in TOML.
    """
    path = staging.folder / CASE_NAME
    own = not path.exists() or CASE_NAME in vouched(staging.folder, RESULT)
    if not own and _says(path, case):
        return ()
    if not own and not (case.overrides and CASE_NAME in staging.written):  # by `palpate init`, in the same run
        text = f"{path.name} in the output folder was changed during the run and is not the case of it"
        return (Finding("case-file", text),)
    try:
        write_text(staging.area / CASE_NAME, case_text(case, staging.folder))
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
