"""Names for a label image without any: TotalSegmentator's, where left and right confirm that the numbers are its."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from palpate.images.label_image import LabelImage
from palpate.images.totalsegmentator import CLASSES

__all__ = ["ClassNames", "class_names"]

ENOUGH = 2  # pairs of left and right; one may lie right by chance


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
