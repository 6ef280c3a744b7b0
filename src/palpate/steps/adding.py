"""Later images added to the finished estimate in a folder."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.case.case import Case
from palpate.case.file import case_tables, read_case
from palpate.errors import ConfigurationError, InputDataError, PalpateError
from palpate.export.model_file import read_model
from palpate.findings import Finding
from palpate.progress import Line, Progress
from palpate.statement.known_images import FORMAT, TOGETHER, Added, BuiltOn, KnownImages, why_together
from palpate.statement.result import SCHEMA, CaseResult, json_object
from palpate.study import run
from palpate.study.archive import read_archive
from palpate.study.earlier import CASE_NAME, seal_of
from palpate.study.outputs import KNOWN_IMAGES, RESULT, read_json

FREE = ("id", "patient", "stage", "seed")  # what the case of added images may have otherwise
OF_IMAGES = ("before", "after", "intensities_before", "intensities_after")


def estimate_added(
    case: Case,
    images: Sequence[Path],
    folder: Path,
    *,
    progress: Progress,
    truth: Mapping[str, float] | None = None,
) -> CaseResult:
    """The estimate of a case whose result lies in the folder, with later images that are added to it.

    Where what its images tell cannot be used, all images are estimated together, as a warning says then. Raises
    `ConfigurationError` for another case, `InputDataError` where no result, or a changed one, lies there, and as
    `palpate.study.run.estimate` does.
    """
    document = read_json(folder / RESULT)
    if document.get("schema") != SCHEMA:
        raise InputDataError(
            f"{folder / RESULT} is no result of an estimate (its schema is {document.get('schema')!r})"
        )
    _refuse_other_settings(case, document, folder)
    earlier = (document.get("built_on") or {}).get("images", 0)
    whole, n_images = _whole_case(case, images, folder, earlier + len(document["fit"]))
    why = why_together(case, n_images)
    if document["status"] != "converged":
        why = f"the earlier estimate has the status '{document['status']}'"
    elif not why and KNOWN_IMAGES not in document["files"]:
        why = f"the earlier result has no {KNOWN_IMAGES}, as one that leaves a modulus open has none"
    if why:
        progress(Line(f"all {n_images + len(images)} later images are estimated together: {why}"))
        text = f"All {n_images + len(images)} later images were estimated together: {why}. It only takes longer."
        found = run.estimate(whole, progress=progress, truth=truth)
        return replace(found, remarks=(*found.remarks, Finding("added-together", text)))
    mesh, digest = read_model(folder).bodies[0].mesh, document["files"][KNOWN_IMAGES]["sha256"]
    known = read_archive(KnownImages, folder / KNOWN_IMAGES, version=FORMAT, sha256=digest, finite=True)
    inputs = {key: of["sha256"] for key, of in document["inputs"].items()}
    built_on = BuiltOn(known.images.n_images, folder.resolve().name, seal_of(document), whole, inputs)
    assert case.images is not None
    own = replace(case, images=replace(case.images, after=tuple(images), intensities_after=()))
    return run.estimate(own, progress=progress, truth=truth, added=Added(known, mesh, built_on))


def _whole_case(case: Case, images: Sequence[Path], folder: Path, n_images: int) -> tuple[Case, int]:
    """The case with all later images, and the number of those in the folder's result.

    They are those of the case there, which has images that were added before, or of the case itself.
    """
    if case.images is None:
        raise ConfigurationError(f"case '{case.id}' has no [images], to which later images could be added")
    n_images -= sum(len(pair.after) for pair in case.pairs)
    try:
        there = read_case(folder / CASE_NAME).images
    except PalpateError:  # it was moved
        there = None
    for of in (there, case.images):
        if of is not None and len(of.after) == n_images:
            return replace(case, images=replace(case.images, after=(*of.after, *images))), n_images
    raise ConfigurationError(
        f"case '{case.id}' has {len(case.images.after)} later images, and the result in {folder} is of {n_images}; give"
        f" the case.toml of that folder, or {TOGETHER}"
    )


def _refuse_other_settings(case: Case, document: Mapping[str, Any], folder: Path) -> None:
    """Raise `ConfigurationError` where the case has other settings than that of the result."""

    def settings(tables: Mapping[str, Any]) -> dict[str, Any]:
        """All that the two must have in common."""
        found = {key: of for key, of in tables.items() if key not in FREE}
        found["images"] = {key: of for key, of in found.get("images", {}).items() if key not in OF_IMAGES}
        found["estimate"] = {key: of for key, of in found.get("estimate", {}).items() if key != "samples"}
        return found

    own = json.loads(json.dumps(json_object(case_tables(case, lambda path: path.name))))
    here, there = settings(own), settings(document["case"])
    differ = sorted(key for key in here.keys() | there.keys() if here.get(key) != there.get(key))
    if differ:
        raise ConfigurationError(
            f"the case differs from that of the result in {folder} in [{'], ['.join(differ)}]; give the case.toml of"
            f" that folder, or {TOGETHER}"
        )
