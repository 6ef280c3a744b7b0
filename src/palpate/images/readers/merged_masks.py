"""Masks of several organs made one label image: a voxel that several masks claim goes to the smallest of the organs."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.findings import Finding, listing
from palpate.images.named_labels import NamedLabel, printable

BODY = frozenset(("body", "external", "outline", "skin"))  # words of a name: all organs lie in that mask


@dataclass(frozen=True, slots=True)
class Mask:
    """The voxels `inside` (n_1, n_2, n_3) bool of one organ, its label from 1, name and colour."""

    row: NamedLabel
    inside: NDArray[np.bool_]


def merged(masks: Iterable[Mask], shape: tuple[int, ...]) -> tuple[NDArray[np.uint16], tuple[Finding, ...]]:
    """Labels (n_1, n_2, n_3) of masks of that shape, of which one at a time is held, and a finding on overlaps.

    A contested voxel goes to the mask of the fewest voxels, then of the smallest label, so that a tumour stays whole in
    its gland; the order of the masks does not matter. That organs lie in the mask of the whole body is no overlap that
    anyone should correct.
    """
    labels = np.zeros(shape, dtype=np.uint16)
    contested = np.zeros(shape, dtype=bool)
    sizes: dict[int, tuple[int, int]] = {}
    names: dict[int, str] = {}
    overlaps: dict[tuple[int, int], int] = {}
    for mask in masks:
        new = mask.row.label
        sizes[new], names[new] = (int(np.count_nonzero(mask.inside)), new), mask.row.name
        shared = mask.inside & (labels > 0)
        labels[mask.inside & ~shared] = new
        there = labels[shared]
        for rival, count in zip(*np.unique(there, return_counts=True), strict=True):
            smaller, larger = sorted((int(rival), new), key=sizes.__getitem__)
            if not BODY & set(re.split(r"[^a-z]+", names[larger].lower())):
                overlaps[smaller, larger] = int(count)
                contested |= shared & (labels == rival)
            there[there == rival] = smaller
        labels[shared] = there
    if not overlaps:
        return labels, ()
    ranked = sorted(overlaps, key=lambda pair: (-overlaps[pair], pair))
    pairs = [f"'{printable(names[a])}' in '{printable(names[b])}' ({overlaps[a, b]})" for a, b in ranked]
    lead = f"{np.count_nonzero(contested)} voxels belong to several masks, and each went to the smallest organ: "
    text = listing(lead, pairs, ". Correct masks that may not overlap.")
    return labels, (Finding("overlap", text),)
