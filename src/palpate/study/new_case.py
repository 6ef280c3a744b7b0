"""A first case.toml for images: who is who with the reasons as comments, paths relative to the file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np

from palpate.case.file import relative_path, toml_key, toml_text
from palpate.case.tissue import REMAINING
from palpate.errors import ConfigurationError, InputDataError
from palpate.images.checks import EMPTIED, later_names, refuse_unit
from palpate.images.label_image import LabelImage
from palpate.images.label_table import read_label_table
from palpate.images.named_labels import MAX_NAME, printable
from palpate.images.readers import read_intensities, read_label_image
from palpate.images.tissue import Role
from palpate.study.earlier import CASE_NAME
from palpate.study.guess import GuessedTissue, class_names, guess_tissues, movers_of
from palpate.study.outputs import OutputFolder, read_regular, write_bytes, write_text
from palpate.study.proposed_mesh import MARGIN_MM, background_of, proposed_edge, proposed_window

LARGEST_CASE = 1_000_000  # bytes
ASIDE = ".earlier"  # behind the name of a case.toml that makes room
WIDE_MM = 250.0  # of an image: more than the body of many, so that it must show what lies around, too
GUESSED_WITHIN = 2.0  # times and by what a known modulus is guessed: measured ones of one tissue differ so
LEAST_NAME = 3  # letters that images' names share, to be a case's name
ROLES = (
    "  estimate: the stiffness of this tissue is wanted; its surface is compared in all images",
    "  known:    you give the stiffness (youngs_modulus_kpa); the first known tissue sets the scale of all results",
    "  driver:   a hollow organ; the motion of its wall between the images moves the other tissues",
    "  rigid:    bone; it stands still, or moves as one body as the images show",
    "  void:     air, and what lies outside the body; its surface is free",
)


@dataclass(frozen=True, slots=True)
class CaseImages:
    """The files of a case to be: label images, a label table if there is one, CTs of the first or of all states."""

    before: Path
    after: tuple[Path, ...]
    table: Path | None = None
    cts: tuple[Path, ...] = ()


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


def write_new_case(
    images: Sequence[Path], table: Path | None, outputs: OutputFolder, *, cts: Sequence[Path] = ()
) -> NewCase:
    """Write case.toml for label images (before, after ...), unless it is there and says something else.

    In a folder that is to be overwritten the other one is kept as case.toml.earlier.

    Raises `ConfigurationError` when fewer than two images are given, more CTs than images, or another case.toml is in
    the way, else as `new_case` does.
    """
    if len(images) < 2:
        raise ConfigurationError("name the label image before, then one or more after")
    if len(cts) > len(images):
        raise ConfigurationError(
            f"{len(cts)} CTs were given for {len(images)} label images: name that of before, then those of after"
        )
    outputs.require([CASE_NAME])
    case = new_case(CaseImages(images[0], tuple(images[1:]), table, tuple(cts)), outputs.path)
    earlier = b""
    if case.path.exists():
        try:
            content = read_regular(case.path, most_bytes=LARGEST_CASE)
        except InputDataError:  # too large to be one, say
            content = b""
        if content != case.text.encode("utf-8"):
            if not outputs.overwrite:
                raise ConfigurationError(
                    f"there is a case already, {case.path}, and it is not replaced: estimate it with 'palpate estimate"
                    f" {case.path}', or choose another --output; 'palpate estimate ... --overwrite' takes the new"
                    f" images and keeps that file as {CASE_NAME}{ASIDE}"
                )
            earlier = content
    with outputs.new_files() as area:
        write_text(area / CASE_NAME, case.text)
        if earlier:
            write_bytes(area / f"{CASE_NAME}{ASIDE}", earlier)
    return case


def new_case(images: CaseImages, folder: Path) -> NewCase:
    """The case of these images for a file in `folder`; what cannot be guessed is left out and asked for.

    Raises `InputDataError` for images or a table that cannot be read, `ConfigurationError` for a path that TOML cannot
    hold.
    """
    before, after = _read(images)
    known = class_names(before)
    named = replace(before, names=known.names) if known.names else before
    tissues = guess_tissues(named, after)
    window = proposed_window(before, tissues)
    background = None  # label 0 where it is taken for surroundings
    if not any(0 in tissue.labels for tissue in tissues) and any(not tissue.labels for tissue in tissues):
        background = background_of(before, window, read_intensities(images.cts[0]) if images.cts else None)
    guessed = tissues
    if background is not None and background.has_air:
        name = next(name for name in ("air", "air around", "label 0") if name not in {t.name for t in guessed})
        tissues = (*guessed, GuessedTissue(name, (0,), Role.VOID, background.in_words))
    questions = _questions(tissues, named, after)
    read = zip((images.before, *images.after), (before, *after), strict=True)
    notes = [f"'{path.name}': {finding.message}" for path, image in read for finding in image.findings]
    if known.names:
        notes.append(
            "the labels have no names; their numbers were taken for those of TotalSegmentator's task"
            f" '{known.task}', for {known.pairs} pairs of left and right lie as its names say"
        )
    width = (np.array(before.labels.shape) * before.grid.spacing)[:2].max()
    if background is not None and not background.seen and width > WIDE_MM:
        questions = (*questions, background.in_words)
    elif background is not None:
        notes.append(background.in_words)
    from_ct = background is not None and background.has_air
    # called by what the images' names begin with alike; else by their folder's
    letters = zip(*(path.name.split(".")[0] for path in (images.before, *images.after)), strict=False)
    alike = "".join(same[0] for same in takewhile(lambda same: len(set(same)) == 1, letters)).strip("-_ ")
    called = alike if len(alike) >= LEAST_NAME else images.before.absolute().parent.name or alike
    heading = ["# Made by `palpate init`. Every role is a guess: read the reasons, correct what is wrong."]
    heading += [f"# {line}" for line in ROLES]
    heading += [_comment(f"QUESTION: {question}") for question in questions]
    heading += [_comment(f"NOTE: {note}") for note in notes]
    heading.append(f"id = {toml_text(printable(called)[:MAX_NAME] or 'case')}")
    blocks = ["\n".join(heading), _images(images, folder, from_ct=from_ct)]
    share = float(np.prod([s.stop - s.start for s in window]) / before.labels.size)
    if share < 1.0:
        blocks.append(f'[domain]\nextent = "margin"  # {MARGIN_MM:g} mm around the organs: {share:.0%} of the image')
    proposed = proposed_edge(before, after, guessed, cropped=share < 1.0)
    if proposed:
        blocks.append(f"[mesh]\nedge_length_mm = {proposed[0]:g}  # {proposed[1]}")
    blocks += [_tissue(tissue, before) for tissue in tissues]
    return NewCase(folder / CASE_NAME, "\n\n".join(blocks) + "\n", tissues, questions)


def _read(images: CaseImages) -> tuple[LabelImage, tuple[LabelImage, ...]]:
    """The label images; raises `InputDataError` where their unit of length seems wrong, or two are the same."""
    names = read_label_table(images.table) if images.table else None
    before = read_label_image(images.before, names=names)
    after = tuple(read_label_image(path, names=names) for path in images.after)
    refuse_unit(before.grid, str(images.before))
    for path, image in zip(images.after, after, strict=True):
        refuse_unit(image.grid, str(path))
        if np.array_equal(before.labels, image.labels):
            raise InputDataError(
                f"'{images.before}' and '{path}' are the same label image, voxel by voxel; without a deformation"
                " nothing can be estimated: check the two paths"
            )
    return before, after


def _questions(tissues: Sequence[GuessedTissue], before: LabelImage, after: Sequence[LabelImage]) -> tuple[str, ...]:
    """Every role that could not be guessed, all in one question, then the guesses that the user is to confirm."""
    roles = {tissue.role for tissue in tissues}
    without = [tissue for tissue in tissues if tissue.role is None]
    asked = []
    if without:
        names = ", ".join(f"[tissues.{toml_key(tissue.name)}]" for tissue in without)
        reason = f" ({without[0].reason})" if len(without) == 1 else ""
        asked.append(f'which role has {names}{reason}? Write role = "estimate", "known", "driver", "rigid" or "void"')
    asked += [f"[tissues.{toml_key(t.name)}] role: {t.question}" for t in tissues if t.question]
    asked += _emptied(tissues, before, after)
    if Role.ESTIMATE not in roles:
        asked.append('no organ was found to estimate; give role = "estimate" to the tissues whose stiffness you want')
    if Role.DRIVER not in roles:
        asked.append(
            'nothing was found that moves the organs; give role = "driver" to what moves them, for example'
            f" {movers_of(before, after)}"
        )
    if Role.KNOWN not in roles:
        asked.append(
            'no surroundings were found, so results will be ratios; give a tissue role = "known" and its'
            " youngs_modulus_kpa to get kPa"
        )
    return tuple(asked)


def _emptied(tissues: Sequence[GuessedTissue], before: LabelImage, after: Sequence[LabelImage]) -> list[str]:
    """A question about `before` where all drivers together are smaller later, and one of them by much."""
    drivers = [tissue for tissue in tissues if tissue.role is Role.DRIVER]
    start, *later = (
        np.array([np.count_nonzero(np.isin(image.labels, t.labels)) * image.grid.voxel_volume for t in drivers])
        for image in (before, *after)
    )
    for name, end in zip(later_names(len(later)), later, strict=True):
        if not drivers or end.sum() >= start.sum() or (end / start).min() > 1.0 - EMPTIED:
            continue
        most = int(np.argmin(end / start))
        loss = f"'{drivers[most].name}' shrinks by {1.0 - end[most] / start[most]:.0%} from 'before' to '{name}'"
        return [f"{loss}: is 'before' the relaxed state? If '{name}' is, exchange the two images"]
    return []


def _images(images: CaseImages, folder: Path, *, from_ct: bool) -> str:
    lines = ["[images]", f"before = {toml_text(relative_path(images.before, folder))}"]
    lines.append(f"after = [{', '.join(toml_text(relative_path(path, folder)) for path in images.after)}]")
    if images.table:
        lines.append(f"names = {toml_text(relative_path(images.table, folder))}")
    if images.cts:
        lines.append(f"intensities_before = {toml_text(relative_path(images.cts[0], folder))}")
    if images.cts[1:]:
        later = ", ".join(toml_text(relative_path(path, folder)) for path in images.cts[1:])
        lines.append(f"intensities_after = [{later}]")
    if from_ct:
        lines.append("body_from_ct = true  # label 0 inside the body is of the remaining tissue, outside it is void")
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
            low, high = value / GUESSED_WITHIN, value * GUESSED_WITHIN
            lines.append(
                f"youngs_modulus_kpa = [{low:g}, {high:g}]  # a guess: the 95 % range about {value:g} kPa. It widens"
                " every interval in kPa, and no ratio. Write one number here if you measured it"
            )
    return "\n".join(lines)


def _comment(text: str) -> str:
    return f"# {printable(text)}"
