"""A first case.toml for images: who is who with the reasons as comments, paths relative to the file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import ConfigurationError, InputDataError
from palpate.images.label_image import LabelImage
from palpate.images.label_table import read_label_table
from palpate.images.named_labels import printable
from palpate.images.readers import read_label_image
from palpate.images.tissue import Role
from palpate.study.case import REMAINING
from palpate.study.case_as_run import CASE_NAME
from palpate.study.class_names import class_names
from palpate.study.guess import GuessedTissue, guess_tissues
from palpate.study.outputs import OutputFolder, read_regular, write_text
from palpate.study.toml_text import relative_path, toml_key, toml_text

__all__ = ["CaseImages", "NewCase", "new_case", "write_new_case"]

LARGEST_CASE = 1_000_000  # bytes
MARGIN_MM = 40.0
CROP_BELOW = 0.6  # a domain of the margin's box is proposed when it saves so much of the image
EDGES_MM = (3.0, 8.0)
ORGAN_EDGES = 6.0  # edges of tetrahedra across the smallest organ


@dataclass(frozen=True, slots=True)
class CaseImages:
    """The files of a case to be: label images, and a label table if there is one."""

    before: Path
    after: tuple[Path, ...]
    table: Path | None = None


@dataclass(frozen=True, slots=True)
class NewCase:
    """The text of a case.toml for `path`, the tissues in it, and what could not be guessed, as sentences."""

    path: Path
    text: str
    tissues: tuple[GuessedTissue, ...]
    questions: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """A JSON document, schema palpate.init/1."""
        return {
            "schema": "palpate.init/1",
            "tissues": [
                {
                    "tissue": tissue.name,
                    "labels": list(tissue.labels) or REMAINING,
                    "role": tissue.role and str(tissue.role),
                    "youngs_modulus_kpa": tissue.youngs_modulus_kpa,
                    "reason": tissue.reason,
                }
                for tissue in self.tissues
            ],
            "questions": list(self.questions),
        }


def write_new_case(images: Sequence[Path], table: Path | None, outputs: OutputFolder) -> NewCase:
    """Write case.toml for label images (before, after ...), unless it is there and says something else.

    Raises `ConfigurationError` when fewer than two images are given or another case.toml is in the way, else as
    `new_case` does.
    """
    if len(images) < 2:
        raise ConfigurationError("name the label image before, then one or more after")
    outputs.require([CASE_NAME])
    case = new_case(CaseImages(images[0], tuple(images[1:]), table), outputs.path)
    if case.path.exists() and _content(case.path) != case.text.encode("utf-8"):
        raise ConfigurationError(
            f"there is a case already, {case.path}, and it is not replaced: estimate it with 'palpate estimate"
            f" {case.path}', or choose another --output"
        )
    with outputs.staged() as staging:
        write_text(staging.area / CASE_NAME, case.text)
        staging.commit()
    return case


def _content(path: Path) -> bytes:
    """The bytes of a case; nothing of what is too large to be one."""
    try:
        return read_regular(path, most_bytes=LARGEST_CASE)
    except InputDataError:
        return b""


def new_case(images: CaseImages, folder: Path) -> NewCase:
    """The case of these images for a file in `folder`; what cannot be guessed is left out and asked for.

    Raises `InputDataError` for images or a table that cannot be read, `ConfigurationError` for a path that TOML cannot
    hold.
    """
    names = read_label_table(images.table) if images.table else None
    before = read_label_image(images.before, names=names)
    after = tuple(read_label_image(path, names=names) for path in images.after)
    for path, image in zip(images.after, after, strict=True):
        if np.array_equal(before.labels, image.labels):
            raise InputDataError(
                f"'{images.before}' and '{path}' are the same label image, voxel by voxel; without a deformation"
                " nothing can be estimated: check the two paths"
            )
    known = class_names(before)
    tissues = guess_tissues(replace(before, names=known.names) if known.names else before, after)
    questions = _questions(tissues)
    named = zip((images.before, *images.after), (before, *after), strict=True)
    notes = [f"'{path.name}': {finding.message}" for path, image in named for finding in image.findings]
    if known.names:
        notes.append(
            "the labels have no names; their numbers were taken for those of TotalSegmentator's task"
            f" '{known.task}', for {known.pairs} pairs of left and right lie as its names say"
        )
    blocks = [_heading(images, folder, questions, notes), _domain(before, tissues), _mesh(before, tissues)]
    blocks += [_tissue(tissue, before) for tissue in tissues]
    text = "\n\n".join(block for block in blocks if block) + "\n"
    return NewCase(folder / CASE_NAME, text, tissues, questions)


def _questions(tissues: Sequence[GuessedTissue]) -> tuple[str, ...]:
    roles = {tissue.role for tissue in tissues}
    asked = [
        f'[tissues.{toml_key(t.name)}] role: {t.reason}; write role = "estimate", "known", "driver", "rigid" or'
        ' "void" there'
        for t in tissues
        if t.role is None
    ]
    asked += [f"[tissues.{toml_key(t.name)}] role: {t.question}" for t in tissues if t.question]
    if Role.ESTIMATE not in roles:
        asked.append('no organ was found to estimate; give role = "estimate" to the tissues whose stiffness you want')
    if Role.DRIVER not in roles:
        asked.append(
            'nothing was found that moves the organs; give role = "driver" to the hollow organ whose wall deforms the'
            " others (TotalSegmentator has no class for the rectum: segment it in all images, as a label of its own,"
            " or as rectum.nii.gz in a folder of masks)"
        )
    if Role.KNOWN not in roles:
        asked.append(
            'no surroundings were found, so results will be ratios; give a tissue role = "known" and its'
            " youngs_modulus_kpa to get kPa"
        )
    return tuple(asked)


def _heading(images: CaseImages, folder: Path, questions: Sequence[str], notes: Sequence[str]) -> str:
    lines = ["# Made by `palpate init`. Every role is a guess: read the reasons, correct what is wrong."]
    lines += [_comment(f"QUESTION: {question}") for question in questions]
    lines += [_comment(f"NOTE: {note}") for note in notes]
    lines += ["", "[images]", f"before = {toml_text(relative_path(images.before, folder))}"]
    lines.append(f"after = [{', '.join(toml_text(relative_path(path, folder)) for path in images.after)}]")
    if images.table:
        lines.append(f"names = {toml_text(relative_path(images.table, folder))}")
    return "\n".join(lines)


def _tissue(tissue: GuessedTissue, before: LabelImage) -> str:
    named = [before.names.get(label, "") for label in tissue.labels]
    unique = len(named) == 1 and named[0] not in ("", REMAINING) and list(before.names.values()).count(named[0]) == 1
    if not tissue.labels:
        label: str = toml_text(REMAINING)
    elif unique:
        label = toml_text(named[0])
    else:
        label = str(tissue.labels[0]) if len(tissue.labels) == 1 else str(list(tissue.labels))
    lines = [f"[tissues.{toml_key(tissue.name)}]", f"label = {label}"]
    if tissue.role is None:
        return "\n".join([*lines, _comment(f"role = ?  QUESTION: {tissue.reason}; without a role the case is refused")])
    lines.append(f"role = {toml_text(tissue.role)}  {_comment(tissue.reason)}")
    if tissue.role is Role.KNOWN:
        value = tissue.youngs_modulus_kpa
        if value is None:
            lines.append(_comment("youngs_modulus_kpa = ?  QUESTION: no published value is known; give it in kPa"))
        else:
            lines.append(
                f"youngs_modulus_kpa = {value:g}  # every estimate in kPa scales with the first known tissue's"
            )
    return "\n".join(lines)


def _domain(before: LabelImage, tissues: Sequence[GuessedTissue]) -> str:
    """A box around the organs where the image is much larger."""
    shown = [label for t in tissues if t.role in (Role.ESTIMATE, Role.DRIVER) for label in t.labels]
    places = np.argwhere(np.isin(before.labels, shown))
    if not len(places):
        return ""
    margin = MARGIN_MM / before.grid.spacing
    shape = np.array(before.labels.shape)
    low, high = np.maximum(places.min(axis=0) - margin, 0), np.minimum(places.max(axis=0) + 1 + margin, shape)
    share = float(np.prod(high - low) / np.prod(shape))
    if share > CROP_BELOW:
        return ""
    return f'[domain]\nextent = "margin"  # {MARGIN_MM:g} mm around the organs: {share:.0%} of the image'


def _mesh(before: LabelImage, tissues: Sequence[GuessedTissue]) -> str:
    """An edge length by the smallest organ."""
    voxels = [np.count_nonzero(np.isin(before.labels, t.labels)) for t in tissues if t.role is Role.ESTIMATE]
    if not voxels:
        return ""
    diameter = float((6.0 * min(voxels) * before.grid.voxel_volume / np.pi) ** (1.0 / 3.0))
    edge = round(2.0 * min(max(diameter / ORGAN_EDGES, EDGES_MM[0]), EDGES_MM[1])) / 2.0
    return f"[mesh]\nedge_length_mm = {edge:g}  # the smallest organ is as large as a ball of {diameter:.0f} mm"


def _comment(text: str) -> str:
    return f"# {printable(text)}"
