"""Who is who: labels without names named, and the roles of labels guessed from names, else from places."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import ndimage

from palpate.case.tissue import is_tissue_name
from palpate.case.tissue_names import found_word
from palpate.errors import InputDataError
from palpate.images.checks import OBSERVED
from palpate.images.distance import window_around
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.label_table import CLASSES
from palpate.images.named_labels import MAX_NAME
from palpate.images.tissue import Role
from palpate.statement.plausibility import TABLE, TUMOURS, usual_stiffness

SURROUNDINGS = "surroundings"
BORDER_SHARE = 0.1  # of the image's border that the body, or the air around it, covers
STILL_SHARE = 0.005  # of a label's voxels
NEAR_MM = 15.0  # between the colon and an organ that it may move
HOLLOW_CHANGE = 0.10  # of a volume: no solid organ changes so much between two scans
ENCLOSED = 0.9  # of the voxels next to a tumour, from where on an organ holds it
ENOUGH = 2  # pairs of left and right; one may lie right by chance


@dataclass(frozen=True, slots=True)
class GuessedTissue:
    """A tissue of a case to be: its labels (none: the rest), its role and why; `role` None must be asked for.

    `question`: what the user is to confirm; `joined`: the name of the tissue that all such labels make together;
    `alone`: the role where nothing else is to be estimated.
    """

    name: str
    labels: tuple[int, ...]
    role: Role | None
    reason: str
    youngs_modulus_kpa: float | None = None
    question: str = ""
    joined: str = ""
    alone: Role | None = None


@dataclass(frozen=True, slots=True)
class NameRule:
    """What a label is by the `words` of its name, between blanks, and what these mean.

    role: None where it is asked for; rest: whether the label goes to the surroundings; fills: whether it is a driver
    where its volume changes; joined, alone: as of `GuessedTissue`; tumour: whether the words mean one.
    """

    words: str
    meaning: str
    role: Role | None = None
    rest: bool = False
    fills: bool = False
    joined: str = ""
    alone: Role | None = None
    tumour: bool = False

    @classmethod
    def of_entry(cls, entry: Mapping[str, Any]) -> NameRule:
        """The rule of an entry of tissues.toml."""
        roles = {key: Role(entry[key]) for key in ("role", "alone") if key in entry}
        return cls(**{**entry, **roles})


RULES = tuple(NameRule.of_entry(entry) for entry in TABLE["role"])
UNLABELLED = frozenset(("background", "clear", "label", "unlabelled", "unlabeled", "none", "unknown"))
PELVIC = ("prostate", "prostatic", "bladder", "uterus", "cervix", "ovary", "vesicle")
LARGE_BOWEL = ("colon", "sigmoid")
AROUND = ("body", "surroundings", "surrounding", "other", "rest", "soft")


def guess_tissues(before: LabelImage, after: Sequence[LabelImage] = ()) -> tuple[GuessedTissue, ...]:
    """Tissues for a case on these images, in the order in which a case should list them.

    A tumour stands before the organ around it and a small organ before a large one, for the first keeps what two claim;
    the surroundings before other known tissues, for they set the scale.
    Labels that belong to no organ of interest are left to the surroundings. Raises `InputDataError` when the image
    shows a single label.
    """
    present, counts = np.unique(before.labels, return_counts=True)
    if len(present) < 2:
        raise InputDataError(
            f"the reference image shows the label {int(present[0])} only: there is no organ in it; check the file"
        )
    sizes = {int(label): int(count) for label, count in zip(present, counts, strict=True)}
    layers = [np.take(before.labels, end, axis).ravel() for axis in range(3) for end in (0, -1)]
    at_border, n = np.unique(np.concatenate(layers), return_counts=True)
    border = {int(label): float(share) for label, share in zip(at_border, n / n.sum(), strict=True)}
    guesses = [_guess(label, before, after, border) for label in sizes]
    for i, guess in enumerate(guesses):
        if guess.role in OBSERVED and any(not np.isin(image.labels, guess.labels).any() for image in after):
            reason = f"'{guess.name}' is absent in a later image"
            guesses[i] = replace(guess, name=SURROUNDINGS, role=Role.KNOWN, reason=reason)
    guesses = _with_drivers_that_hold_no_tumour(guesses, before)
    if not any(guess.role is Role.ESTIMATE for guess in guesses):
        guesses = [replace(guess, role=guess.alone or guess.role) for guess in guesses]
    guesses = _with_driver(_joined(guesses), before, after)
    outside = [g for g in guesses if g.role is Role.VOID]
    surroundings = list[GuessedTissue]()
    rest = [before.names.get(g.labels[0], f"label {g.labels[0]}") for g in guesses if g.name == SURROUNDINGS]
    fat, muscle = usual_stiffness("fat"), usual_stiffness("muscle")
    if rest and fat is not None and muscle is not None:  # both names are in the table
        value = round(float(np.sqrt(fat.usual_kpa * muscle.usual_kpa)), 2)
        reason = (
            f"all that no other tissue names ({', '.join(rest)}); {value:g} kPa lies between fat and muscle"
            f" ({muscle.reference})"
        )
        surroundings = [GuessedTissue(SURROUNDINGS, (), Role.KNOWN, reason, value)]
    organs = [g for g in guesses if g.role is not Role.VOID and g.name != SURROUNDINGS]
    roles = (Role.ESTIMATE, Role.DRIVER, Role.RIGID, None, Role.KNOWN)
    tumours = [g for g in organs if g.role is Role.ESTIMATE and found_word(g.name, TUMOURS)]
    organs.sort(key=lambda g: (g not in tumours, roles.index(g.role), sum(sizes[label] for label in g.labels)))
    known = [g for g in organs if g.role is Role.KNOWN]
    others = [g for g in organs if g.role is not Role.KNOWN]
    # every name once, and none that a case file does not take for a tissue
    found: list[GuessedTissue] = []
    taken: set[str] = set()
    for guess in [*others, *surroundings, *known, *outside]:
        number = guess.labels[0] if guess.labels else "rest"
        name = guess.name if is_tissue_name(guess.name) else f"label {number}"
        name = name if name not in taken else f"{name[: MAX_NAME - 10]} {number}"
        taken.add(name)
        found.append(replace(guess, name=name))
    return tuple(found)


def _guess(label: int, before: LabelImage, after: Sequence[LabelImage], border: dict[int, float]) -> GuessedTissue:
    name = before.names.get(label, "")
    if not name:
        return _by_place(label, before, after, border)
    if label == 0 and frozenset(name.lower().split()) <= UNLABELLED:
        return _by_place(label, before, after, border)  # as tables call what no organ is, inside the body and outside
    rule, word = next(((r, w) for r in RULES if (w := found_word(name, r.words.split()))), (None, ""))
    change = volume_change(label, before, after) if rule is None or rule.fills else 0.0
    if rule is None:
        hint = f"; its volume changes by {change:+.0%}, as a hollow organ's does" if abs(change) > HOLLOW_CHANGE else ""
        return GuessedTissue(name, (label,), None, f"no rule knows the name '{name}'{hint}")
    return _by_rule(rule, name, label, f"'{word}' {rule.meaning}", change)


def _by_rule(rule: NameRule, name: str, label: int, reason: str, change: float) -> GuessedTissue:
    """A label by the rule that knows its name; change: of its volume, relative."""
    filled = f"its volume changes by {change:+.0%}"
    if rule.fills and abs(change) > HOLLOW_CHANGE:
        return GuessedTissue(name, (label,), Role.DRIVER, f"{reason}, and {filled}")
    if rule.rest:
        still = f", and {filled} only" if rule.fills else ""
        return GuessedTissue(SURROUNDINGS, (label,), Role.KNOWN, f"'{name}' {rule.meaning}{still}")
    usual = usual_stiffness(name) if rule.role is Role.KNOWN else None
    guess = GuessedTissue(name, (label,), rule.role, reason, joined=rule.joined, alone=rule.alone)
    if usual is None:
        return guess
    return replace(guess, reason=f"{reason}: {usual.reference}", youngs_modulus_kpa=usual.usual_kpa)


def volume_change(label: int, before: LabelImage, after: Sequence[LabelImage]) -> float:
    """The largest change of a label's volume to a later image, by its volume before; of what both images show."""
    found = [0.0]
    for image in after:
        start, end = _shown_mm3(label, before, image.grid), _shown_mm3(label, image, before.grid)
        found.append(end / start - 1.0 if start else 0.0)
    return max(found, key=abs)


def _shown_mm3(label: int, image: LabelImage, other: VoxelGrid) -> float:
    """Volume (mm^3) of those of a label's voxels whose centres lie inside the other grid."""
    grid = image.grid
    if grid.shape == other.shape and np.allclose(grid.affine, other.affine):
        return float(np.count_nonzero(image.labels == label)) * grid.voxel_volume
    count = 0
    for number, plane in enumerate(image.labels):
        places = np.argwhere(plane == label)
        index = other.index(grid.world(np.column_stack([np.full(len(places), float(number)), places])))
        count += int(((index >= -0.5) & (index <= np.array(other.shape) - 0.5)).all(axis=1).sum())
    return count * grid.voxel_volume


def _with_drivers_that_hold_no_tumour(guesses: list[GuessedTissue], before: LabelImage) -> list[GuessedTissue]:
    """The guesses without a driver round a tumour, which would leave nothing of the tumour's surface to observe."""
    found = list(guesses)
    tumours = [g for g in guesses if g.role is Role.ESTIMATE and found_word(g.name, TUMOURS)]
    for i, guess in enumerate(guesses):
        inner = [t.name for t in tumours if guess.role is Role.DRIVER and _encloses(before, guess.labels, t.labels)]
        if inner:
            reason = f"{guess.reason}, but it holds '{inner[0]}'"
            question = f"{reason}, and no stiffness explains a change of volume: are there images that differ less?"
            found[i] = replace(guess, role=Role.ESTIMATE, reason=reason, question=question)
    return found


def _encloses(image: LabelImage, labels: tuple[int, ...], inner: tuple[int, ...]) -> bool:
    """Whether nearly all voxels next to `inner` are of `labels`."""
    inside = np.isin(image.labels, inner)
    window = window_around(inside, image.grid, reach_mm=2.0 * float(image.grid.spacing.max()))
    near = ndimage.binary_dilation(inside[window]) & ~inside[window]
    return float(np.isin(image.labels[window][near], labels).mean()) > ENCLOSED if near.any() else False


def movers_of(before: LabelImage, after: Sequence[LabelImage]) -> str:
    """What may move the organs whose names an image has, and how its hollow ones change, as a sentence's end."""
    names = {label: name for label, name in before.names.items() if label and (before.labels == label).any()}
    regions = [entry for entry in TABLE["region"] if any(found_word(n, entry["words"].split()) for n in names.values())]
    movers = "; or ".join(entry["movers"] for entry in regions[:1])
    hollow = {
        name: volume_change(label, before, after)
        for label, name in names.items()
        if any(rule.fills and found_word(name, rule.words.split()) for rule in RULES)
    }
    seen = ", ".join(f"{name} {change:+.0%}" for name, change in hollow.items())
    return (movers or "the hollow organ whose wall pushes the others") + (f" (volumes: {seen})" if seen else "")


def _with_driver(guesses: list[GuessedTissue], before: LabelImage, after: Sequence[LabelImage]) -> list[GuessedTissue]:
    """Without another driver the colon is offered as one, where it comes near an organ of the pelvis."""
    organs = [g for g in guesses if g.role is Role.ESTIMATE and found_word(g.name, PELVIC)]
    if not organs or any(g.role is Role.DRIVER and not found_word(g.name, LARGE_BOWEL) for g in guesses):
        return guesses
    offered = list(guesses)
    for i, guess in enumerate(guesses):
        names = [before.names.get(label, "") for label in guess.labels]
        if len(names) != 1 or not found_word(names[0], LARGE_BOWEL):
            continue
        if any(not np.isin(image.labels, guess.labels).any() for image in after):
            continue
        gaps = {organ.name: _gap(before, guess.labels, organ.labels) for organ in organs}
        nearest = min(gaps, key=gaps.__getitem__)
        if gaps[nearest] <= NEAR_MM:
            reason = f"no rectum is labelled, and '{names[0]}' comes within {gaps[nearest]:.1f} mm of '{nearest}'"
            question = (
                f"{reason}, so it is taken for the hollow organ that moves the others; is the rectum part of that"
                " label? If not, segment the rectum in all images, as a label of its own"
            )
            offered[i] = GuessedTissue(names[0], guess.labels, Role.DRIVER, reason, question=question)
    return offered


def _gap(image: LabelImage, labels: tuple[int, ...], organ: tuple[int, ...]) -> float:
    """Least distance of the organ's voxels to those of `labels`, mm; infinite where it is more than NEAR_MM."""
    inside = np.isin(image.labels, organ)
    window = window_around(inside, image.grid, reach_mm=NEAR_MM)
    others = np.isin(image.labels[window], labels)
    if not others.any():
        return float("inf")
    return float(ndimage.distance_transform_edt(~others, sampling=image.grid.spacing)[inside[window]].min())


def _by_place(label: int, before: LabelImage, after: Sequence[LabelImage], border: dict[int, float]) -> GuessedTissue:
    """A label without a name: what reaches the border is the body or what is outside it; the others are organs."""
    bodies = [other for other in border if other != 0 and border[other] > BORDER_SHARE and not before.names.get(other)]
    named = any(found_word(name, AROUND) for other, name in before.names.items() if other in border)
    if label == 0 and (bodies or named):
        return GuessedTissue("outside", (0,), Role.VOID, "label 0 lies outside of the body's own label")
    if label == 0 or label == max(bodies, key=lambda other: border[other], default=0):
        reason = f"label {label} covers {border.get(label, 0.0):.0%} of the image's border"
        return GuessedTissue(SURROUNDINGS, (label,), Role.KNOWN, reason)
    name, mask = f"label {label}", before.labels == label
    change = volume_change(label, before, after)
    alike = [image.labels for image in after if image.labels.shape == mask.shape]
    changed = [int(np.count_nonzero((labels == label) != mask)) for labels in alike]
    still = max(changed, default=np.inf) < STILL_SHARE * int(np.count_nonzero(mask))
    if still and len(alike) == len(after):  # on another grid voxels cannot be compared
        return GuessedTissue(name, (label,), Role.RIGID, "its voxels do not move at all, as only bone's do")
    if abs(change) > HOLLOW_CHANGE:
        return GuessedTissue(
            name, (label,), Role.DRIVER, f"its volume changes by {change:+.0%}, as only a hollow organ's does"
        )
    return GuessedTissue(name, (label,), Role.ESTIMATE, f"without a name; its volume changes by {change:+.1%} only")


def _joined(guesses: list[GuessedTissue]) -> list[GuessedTissue]:
    """All bones as one tissue, for between two that touch there is no gap to mesh, and all that else is one."""
    for name in sorted({guess.joined for guess in guesses} - {""}):
        parts = [guess for guess in guesses if guess.joined == name and guess.name != SURROUNDINGS]
        if len(parts) < 2:
            continue
        labels = tuple(sorted(label for part in parts for label in part.labels))
        names, rigid = ", ".join(part.name for part in parts), parts[0].role is Role.RIGID
        advice = "; give a tissue of its own to a bone that moves against the others" if rigid else ""
        reason = f"one {'rigid piece' if rigid else 'tissue'}: {names}{advice}"
        whole = GuessedTissue(name, labels, parts[0].role, reason)
        guesses = [whole if guess is parts[0] else guess for guess in guesses if guess not in parts[1:]]
    return guesses


@dataclass(frozen=True, slots=True)
class ClassNames:
    """The task whose numbers the labels are, their names, and how many pairs of left and right say so."""

    task: str = ""
    names: Mapping[int, str] = field(default_factory=dict)
    pairs: int = 0


def class_names(image: LabelImage) -> ClassNames:
    """What the labels of an image without names are called, empty where that cannot be told.

    Every label must be a class of the task, and each left one lie to the left of its right one. With fewer than two
    such pairs nothing is assumed.
    """
    present = [int(label) for label in np.unique(image.labels) if label]
    if image.names or not present:
        return ClassNames()
    centres = np.array(ndimage.center_of_mass(image.labels > 0, image.labels, present))
    x = dict(zip(present, image.grid.world(centres)[:, 0], strict=True))
    found = [ClassNames()]
    for task, classes in CLASSES.items():
        names = {number: name for name, number in classes.items() if number in x}
        sides = [(n, classes[name.replace("left", "right")]) for n, name in names.items() if "left" in name]
        pairs = [(left, right) for left, right in sides if right in x]
        if len(names) == len(present) and len(pairs) >= ENOUGH and all(x[left] < x[right] for left, right in pairs):
            found.append(ClassNames(task, names, len(pairs)))
    return max(found, key=lambda known: known.pairs)
