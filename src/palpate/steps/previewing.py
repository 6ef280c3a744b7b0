"""The preview of a case: a page that shows what will be estimated, before it is."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from palpate.body.provenance import software_versions
from palpate.case.case import Case
from palpate.case.file import toml_key
from palpate.errors import ConfigurationError, InputDataError, PalpateError, ResourceError
from palpate.images.tissue import Role
from palpate.progress import Line, Progress, details, silent
from palpate.report.preview import GENERATOR, preview_page
from palpate.study.check import Checked, CheckReport, Problem, checked_case
from palpate.study.new_case import NewCase, write_new_case
from palpate.study.outputs import OutputFolder, read_regular, write_text
from palpate.study.prediction import predicted_intervals

LOGGER = logging.getLogger(__name__)
PREVIEW = "preview.html"
LARGEST_PAGE = 2**28  # bytes
HEAD = 2000  # bytes, in which a page says whose it is
ENDINGS = (".html", ".htm")
AFTER_PROBLEMS = "There is no prediction: the problems come first."
NOT_YET = "There is no prediction yet: it needs a mesh, which palpate check --html makes."
SOME_KPA = 1.0  # a modulus, on which nothing that is drawn depends


def checked_with_page(
    source: Path | Case, overrides: Sequence[str] = (), *, progress: Progress = silent
) -> tuple[CheckReport, str]:
    """The report of a case with its predicted intervals, and its preview as a page; raises nothing for a bad case."""
    checked = checked_case(source, overrides, progress=progress)
    missing = AFTER_PROBLEMS
    if checked.case is not None and checked.bodies:
        try:
            own = checked.bodies, checked.case
            predicted = predicted_intervals(*own, progress=progress, grey=checked.report.grey)
            checked = replace(checked, report=replace(checked.report, predicted=predicted))
        except PalpateError as error:
            missing = f"There is no prediction: {error}"
    progress(Line("drawing the preview"))
    return checked.report, _page(checked, missing)


def write_page(case: Case, outputs: OutputFolder, *, progress: Progress = silent) -> None:
    """Write preview.html of a case into its output folder, which this process holds; raises as `place_page` does."""
    refuse_other_page(outputs.path / PREVIEW)
    _put(checked_with_page(case, progress=progress)[1], outputs, PREVIEW)


def new_case_with_page(
    images: Sequence[Path],
    table: Path | None,
    outputs: OutputFolder,
    *,
    cts: Sequence[Path] = (),
    progress: Progress = silent,
) -> NewCase:
    """Write case.toml for label images as `write_new_case` does, and beside it its preview.

    The case stands without one where none can be made; raises `ResourceError` where the disk refuses it.
    """
    refuse_other_page(outputs.path / PREVIEW)
    new = write_new_case(images, table, outputs, cts=cts)
    try:
        # the preview of a case that `init` has written, not meshed
        overrides = [f'tissues.{toml_key(t.name)}.role="void"' for t in new.tissues if t.role is None]
        overrides += [
            f"tissues.{toml_key(t.name)}.youngs_modulus_kpa={SOME_KPA}"
            for t in new.tissues
            if t.role is Role.KNOWN and t.youngs_modulus_kpa is None
        ]
        checked = checked_case(new.path, overrides, progress=details(progress), meshed=False)
        asked = tuple(Problem("question", question, ConfigurationError.exit_code) for question in new.questions)
        report = replace(checked.report, problems=(*asked, *checked.report.problems))
        progress(Line("drawing the preview"))
        page = _page(replace(checked, report=report), NOT_YET)
    except Exception:  # a drawing never costs the case
        LOGGER.exception("the preview could not be drawn")
    else:
        try:
            _put(page, outputs, PREVIEW)
        except ResourceError as error:
            raise ResourceError(f"{new.path} is written, but not what shows it: {error}") from error
    return new


def place_page(page: str, path: Path) -> None:
    """Put a page in its place; raises as `refuse_other_page`, and `ResourceError` where the disk refuses."""
    refuse_other_page(path)
    outputs = OutputFolder(path.parent)
    with outputs.held():
        _put(page, outputs, path.name)


def _put(page: str, outputs: OutputFolder, name: str) -> None:
    with outputs.new_files() as area:
        write_text(area / name, page)


def refuse_other_page(path: Path) -> None:
    """Raise `ConfigurationError` where a file that is no preview of ours has the name, or the name is no page's."""
    if path.suffix.lower() not in ENDINGS:
        raise ConfigurationError(f"{path} is no name of a page: give one that ends in .html")
    OutputFolder(path.parent).require([path.name])
    if not path.exists():
        return
    try:
        ours = GENERATOR.encode() in read_regular(path, most_bytes=LARGEST_PAGE)[:HEAD]
    except InputDataError:
        ours = False
    if not ours:
        raise ConfigurationError(f"{path} is no preview that Palpate wrote, and is not replaced: choose another name")


def _page(checked: Checked, missing: str) -> str:
    created, version = f"{datetime.now(UTC):%Y-%m-%d %H:%M UTC}", software_versions().get("palpate", "")
    return preview_page(checked, created=created, version=version, no_prediction=missing)
