"""The segments of a 3D Slicer segmentation: their names, colours, values and layers, made one label image.

Keys: https://slicer.readthedocs.io/en/latest/developer_guide/modules/segmentations.html (Segment0_Name and so on).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.images.named_labels import MAX_LABEL, NamedLabel, given_name, hex_colour, printable
from palpate.images.readers.text_header import numbers_in

KEY = re.compile(r"Segment([0-9]{1,5})_(ID|Name|Color|LabelValue|Layer)")


def segments_of(keys: Mapping[str, str]) -> list[tuple[int, NamedLabel]]:
    """The segments that an NRRD header's key-values describe: layer, then value there, name and colour.

    None when it is no segmentation.

    Files of before 2020 have neither values nor layers: there each segment is one layer of zeros and ones.
    Raises `ValueError` for numbers that cannot be used or two segments of the same value in one layer.
    """
    found: dict[int, dict[str, str]] = {}
    for key, value in keys.items():
        if match := KEY.fullmatch(key):
            found.setdefault(int(match[1]), {})[match[2]] = value
    described = [(number, entry) for number, entry in sorted(found.items()) if {"ID", "Name", "LabelValue"} & {*entry}]
    old = not any("Layer" in entry or "LabelValue" in entry for _, entry in described)
    segments = []
    for number, entry in described:
        name = given_name(entry.get("Name", ""), f"segment {number + 1}")
        layer = number if old else _whole(entry.get("Layer", "0"), low=0)
        label = _whole(entry.get("LabelValue", "1"), low=1)
        segments.append((layer, NamedLabel(label, name, unit_colour(entry.get("Color", "").split()))))
    if len({(layer, row.label) for layer, row in segments}) < len(segments):
        raise ValueError("has two segments with the same label value in one layer")
    return segments


def unit_colour(words: Sequence[str]) -> str | None:
    """Colour #rrggbb of three numbers from 0 to 1; None where they are anything else."""
    return hex_colour(numbers_in(words), top=1.0)


def _whole(text: str, *, low: int) -> int:
    text = text.strip()
    if not (text.isascii() and text.isdigit() and len(text) <= 6 and low <= int(text) <= MAX_LABEL):
        flaw = f"label value or layer '{printable(text[:30])}', not a whole number from {low} to {MAX_LABEL}"
        raise ValueError(f"has a segment with the {flaw}")
    return int(text)


def flattened(
    layers: NDArray[Any], segments: Sequence[tuple[int, NamedLabel]]
) -> tuple[NDArray[Any], tuple[NamedLabel, ...]]:
    """Labels (n_1, n_2, n_3) of `layers` (n_layers, n_1, n_2, n_3), and the names of the labels.

    Values that are unique stay; where two layers use the same one, segments are numbered from 1 as the file has them.
    Raises `ValueError` when segments overlap or are in no layer, or a voxel of several layers is in no segment.
    """
    if beyond := [row.name for layer, row in segments if layer >= len(layers)]:
        raise ValueError(f"has {len(layers)} layers, but the segments {beyond[:5]} are in others")
    unique = len({row.label for _, row in segments}) == len(segments)
    names = tuple(row if unique else replace(row, label=k) for k, (_, row) in enumerate(segments, start=1))
    if len(layers) == 1:
        return layers[0], names
    merged = np.zeros(layers.shape[1:], dtype=np.uint16)
    for k, layer in enumerate(layers):
        if layer.dtype.kind not in "iu" or layer.min() < 0 or layer.max() > MAX_LABEL:
            raise ValueError(f"has layers with values that are not labels from 0 to {MAX_LABEL}")
        table = np.zeros(MAX_LABEL + 1, dtype=np.uint16)
        for (place, row), named in zip(segments, names, strict=True):
            if place == k:
                table[row.label] = named.label
        mapped = table[layer]
        if lost := np.count_nonzero((mapped == 0) & (layer > 0)):
            raise ValueError(f"has {lost} voxels that belong to no segment")
        both = (merged > 0) & (mapped > 0)
        if both.any():
            of = {row.label: row.name for row in names}
            first, second = (of[int(labels[both][0])] for labels in (merged, mapped))
            many = np.count_nonzero(both)
            raise ValueError(
                f"has segments that overlap in {many} voxels, such as '{first}' and '{second}'; erase one there"
            )
        merged += mapped
    return merged, names
