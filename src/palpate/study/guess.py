"""Who is who: labels without names named, and the roles of labels guessed from names, else from places."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from palpate.errors import InputDataError
from palpate.images.checks import OBSERVED
from palpate.images.distance import window_around
from palpate.images.label_image import LabelImage
from palpate.images.label_table import CLASSES
from palpate.images.named_labels import MAX_NAME
from palpate.images.tissue import Role
from palpate.study.case_tissue import is_tissue_name
from palpate.study.plausibility import TABLE, usual_stiffness

SURROUNDINGS = "surroundings"
BORDER_SHARE = 0.1  # of the image's border that the body, or the air around it, covers
STILL_SHARE = 0.005  # of a label's voxels
NEAR_MM = 15.0  # between the colon and an organ that it may move
HOLLOW_CHANGE = 0.10  # of a volume: no solid organ changes so much between two scans
BONE = "is bone"
ENOUGH = 2  # pairs of left and right; one may lie right by chance


@dataclass(frozen=True, slots=True)
class GuessedTissue:
    """A tissue of a case to be: its labels (none: the rest), its role and why; `role` None must be asked for.

    `question`: what the user is to confirm.
    """

    name: str
    labels: tuple[int, ...]
    role: Role | None
    reason: str
    youngs_modulus_kpa: float | None = None
    question: str = ""


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


RULES = tuple(  # words of a name, a role, what the words mean, whether the label goes to the surroundings
    (_words(entry["words"]), Role(entry["role"]) if "role" in entry else None, entry["meaning"], "rest" in entry)
    for entry in TABLE["role"]
)

UNLABELLED = _words("background clear label unlabelled unlabeled none")
PELVIC = _words("prostate prostatic bladder uterus cervix ovary vesicle vesicles")
LARGE_BOWEL = _words("colon sigmoid")


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
    guesses = _with_driver(_with_one_skeleton(guesses), before, after)
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
    tumours = [g for g in organs if g.role is Role.ESTIMATE and "tumour" in g.reason]
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
    words = _words_of(name)
    if label == 0 and words <= UNLABELLED:  # as tables call what no organ is, inside the body and outside
        return _by_place(label, before, after, border)
    for known, role, meaning, rest in RULES:
        found = sorted(words & known)
        if found:
            reason = f"'{found[0]}' {meaning}"
            if rest:
                return GuessedTissue(SURROUNDINGS, (label,), Role.KNOWN, f"'{name}' {meaning}")
            usual = usual_stiffness(name) if role is Role.KNOWN else None
            return GuessedTissue(
                name,
                (label,),
                role,
                reason if usual is None else f"{reason}: {usual.reference}",
                None if usual is None else usual.usual_kpa,
            )
    return GuessedTissue(name, (label,), None, f"no rule knows the name '{name}'")


def _words_of(name: str) -> frozenset[str]:
    return _words(re.sub(r"[^a-z]+", " ", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower()))


def _with_driver(guesses: list[GuessedTissue], before: LabelImage, after: Sequence[LabelImage]) -> list[GuessedTissue]:
    """Without a driver the colon is offered as one, where it comes near an organ of the pelvis."""
    organs = [g for g in guesses if g.role is Role.ESTIMATE and _words_of(g.name) & PELVIC]
    if not organs or any(g.role is Role.DRIVER for g in guesses):
        return guesses
    offered = list(guesses)
    for i, guess in enumerate(guesses):
        names = [before.names.get(label, "") for label in guess.labels]
        if len(names) != 1 or not _words_of(names[0]) & LARGE_BOWEL:
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
    words = _words("body surroundings surrounding other rest soft")
    named = any(_words_of(name) & words for other, name in before.names.items() if other in border)
    if label == 0 and (bodies or named):
        return GuessedTissue("outside", (0,), Role.VOID, "label 0 lies outside of the body's own label")
    if label == 0 or label == max(bodies, key=lambda other: border[other], default=0):
        reason = f"label {label} covers {border.get(label, 0.0):.0%} of the image's border"
        return GuessedTissue(SURROUNDINGS, (label,), Role.KNOWN, reason)
    name, mask = f"label {label}", before.labels == label
    start = np.count_nonzero(mask) * before.grid.voxel_volume
    ends = [np.count_nonzero(image.labels == label) * image.grid.voxel_volume for image in after]
    change = max((float(end / start - 1.0) for end in ends), key=abs, default=0.0)
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


def _with_one_skeleton(guesses: list[GuessedTissue]) -> list[GuessedTissue]:
    """All that is called bone as one tissue: between two that touch there is no gap to mesh, and they hold together."""
    bones = [guess for guess in guesses if guess.role is Role.RIGID and guess.reason.endswith(BONE)]
    if len(bones) < 2:
        return guesses
    labels = tuple(sorted(label for bone in bones for label in bone.labels))
    reason = (
        f"one rigid piece: {', '.join(bone.name for bone in bones)}; give a tissue of its own to a bone that moves"
        " against the others"
    )
    whole = GuessedTissue("bones", labels, Role.RIGID, reason)
    return [whole if guess is bones[0] else guess for guess in guesses if guess not in bones[1:]]


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
