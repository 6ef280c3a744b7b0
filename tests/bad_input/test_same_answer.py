"""A check is the front half of an estimate: what one refuses the other refuses, with the same words and exit code."""

from __future__ import annotations

import numpy as np
import pytest
from bad_inputs import anatomy, changed, masks, other_grid, replace_after, save

PRESSURE = '[[loads]]\nkind = "pressure"\nsurface = "rectum"\npressure_kpa = 0.5\n[estimate]'
FIXED = '[mechanics]\nlaw = "linear"', '[domain]\nouter_boundary = "fixed"\n[mechanics]\nlaw = "linear"'


def as_bone(folder):
    """All that could move is one bone, on which the images are aligned."""
    save(folder / "after.nii.gz", anatomy(shift=0.8))
    changed(folder, '"driver"', '"rigid"')


def under_pressure(folder):
    """The rectum is a cavity, whose pressure is known."""
    changed(folder, '"driver"', '"void"')
    changed(folder, "[estimate]", PRESSURE)
    changed(folder, *FIXED)


def second_pair(folder):
    """Whose later image is not there."""
    text = '[[pairs]]\nbefore = "after.nii.gz"\nafter = ["none.nii.gz"]\n[tissues.prostate]'
    changed(folder, "[tissues.prostate]", text)


def damaged_grey(folder):
    """A grey image that only the report would show."""
    (folder / "grey.nii.gz").write_bytes(b"these are words")
    changed(folder, '["after.nii.gz"]', '["after.nii.gz"]\nintensities_before = "grey.nii.gz"')


CASES = {
    "good": (lambda _: None, 0, ""),
    "on another grid": (other_grid, 0, ""),
    "masks": (masks, 0, ""),
    "a cavity under pressure": (under_pressure, 0, ""),
    "a load on nothing": (
        lambda f: changed(f, "[estimate]", PRESSURE.replace('"rectum"', '"rektum"')),
        2,
        "no surface of the mesh is called 'rektum'",
    ),
    "a damaged grey image": (damaged_grey, 0, ""),
    "one bone": (as_bone, 2, "nothing moves this body"),
    "a second pair without its image": (second_pair, 3, "there is no file"),
    "an unknown solver": (lambda f: changed(f, *FIXED[:1], FIXED[0] + '\nsolver = "best"'), 2, "solver"),
    "a folder of nothing": (lambda f: [(f / "none").mkdir(), replace_after(f, "none")], 3, "0 masks"),
    "an organ in neither image": (lambda f: changed(f, "label = 1", "label = 7"), 3, "in 'before' and 'after'"),
    "a wall that is gone": (lambda f: save(f / "after.nii.gz", (anatomy() == 1).astype(np.uint8)), 3, "'rectum'"),
}


@pytest.mark.parametrize("name", CASES)
def test_a_check_answers_as_an_estimate_does(name, folder, answer):
    spoil, code, words = CASES[name]
    spoil(folder)
    found, sentence = answer(folder / "case.toml")
    assert (found, words in sentence) == (code, True), sentence
