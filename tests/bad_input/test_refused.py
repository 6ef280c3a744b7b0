"""What is refused, of docs/bad-input.md: the exit code of its class, one sentence, nothing written."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from bad_inputs import (
    AFFINE,
    LAYERS,
    NRRD,
    anatomy,
    as_floats,
    ball,
    bomb,
    both,
    changed,
    cut,
    dicom,
    flipped,
    header,
    layers,
    masks,
    named,
    nrrd,
    other_grid,
    overlapping,
    replace_after,
    save,
    sentence,
    sheet,
    speck,
)

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


REFUSED = {
    "1 an empty file": (
        lambda f: (f / "after.nii.gz").write_bytes(b""),
        3,
        "is empty (0 bytes); export or copy the image again",
    ),
    "1 a file of ten bytes": (lambda f: cut(f / "after.nii.gz", 10), 3, "after.nii.gz"),
    "2 no gzip inside": (lambda f: (f / "after.nii.gz").write_bytes(b"these are words" * 99), 3, "gzip"),
    "3 a stream cut short": (lambda f: cut(f / "after.nii.gz", 200), 3, "cut short"),
    "4 a bomb": (bomb, 3, "has more than"),
    "5 negative sizes": (lambda f: header(f, dim=[3, -26, 26, 26, 1, 1, 1, 1]), 3, "not positive"),
    "5 zero sizes": (lambda f: header(f, dim=[3, 26, 0, 26, 1, 1, 1, 1]), 3, "not positive"),
    "5 sizes beyond all": (lambda f: header(f, dim=[3, 32767, 32767, 32767, 1, 1, 1, 1]), 3, " states "),
    "6 no number as offset": (lambda f: header(f, vox_offset=np.nan), 3, "first voxel at byte nan"),
    "6 an infinite offset": (lambda f: header(f, vox_offset=np.inf), 3, "first voxel at byte inf"),
    "6 an offset in the header": (lambda f: header(f, vox_offset=16.0), 3, "first voxel at byte 16"),
    "7 sform against qform": (lambda f: header(f, qform_code=1, pixdim=[1, 3, 3, 3, 1, 1, 1, 1]), 3, "sform and qform"),
    "7 neither": (lambda f: header(f, sform_code=0, qform_code=0), 3, "neither sform nor qform"),
    "7 a sheared sform": (lambda f: header(f, qform_code=0, srow_x=[1.5, 0.4, 0, 0]), 3, "not at right angles"),
    "8 a flat affine": (lambda f: header(f, qform_code=0, srow_x=[0, 0, 0, 0]), 3, "flattens the image"),
    "8 no number in the affine": (lambda f: header(f, qform_code=0, srow_x=[np.nan, 0, 0, 0]), 3, "not finite"),
    "9 fractions": (lambda f: as_floats(f, 0.5), 3, "no label image"),
    "9 no numbers": (lambda f: as_floats(f, np.nan), 3, "NaN or infinite"),
    "9 negative labels": (lambda f: as_floats(f, -1.0), 3, "run from -1"),
    "9 labels too large": (lambda f: as_floats(f, 70000.0), 3, "to 70000"),
    "10 four axes": (lambda f: save(f / "after.nii.gz", np.stack([anatomy()] * 3, axis=-1)), 3, "three axes"),
    "10 colours": (lambda f: header(f, datatype=[128, 24]), 3, "type"),
    "10 one slice": (lambda f: save(f / "after.nii.gz", anatomy()[:, :, 5]), 3, "three axes"),
    "11 data outside the folder": (lambda f: nrrd(f, "a.nhdr", NRRD + "\ndata file: ../../x.raw"), 3, "a.nhdr"),
    "12 sizes against data": (lambda f: nrrd(f, "a.nrrd", NRRD, bytes(1000)), 3, "a.nrrd"),
    "13 layers that overlap": (overlapping, 3, "overlap"),
    "13 one value twice in a layer": (
        lambda f: nrrd(f, "a.seg.nrrd", LAYERS.replace("Layer:=1", "Layer:=0"), layers(anatomy() == 1, anatomy() == 2)),
        3,
        "a.seg.nrrd",
    ),
    "13 names with a document type": (
        lambda f: named(f, '<!DOCTYPE a [<!ENTITY b "c">]><CaretExtension>&b;</CaretExtension>'),
        3,
        "declare a document type",
    ),
    "13 names that are no XML": (lambda f: named(f, "<CaretExtension><a>"), 3, "are no XML"),
    "13 masks on two grids": (lambda f: masks(f, affine=AFFINE * 2.0), 3, "are not on one grid"),
    "13 masks with several values": (lambda f: masks(f, value=3), 3, "is no mask of one organ"),
    "13 a folder without masks": (
        lambda f: [(f / "after").mkdir(), (f / "after" / "notes.txt").write_text("x"), replace_after(f, "after")],
        3,
        "holds 0 masks",
    ),
    "16 a DICOM slice": (lambda f: dicom(f, "IM0001"), 3, "dcm2niix or 3D Slicer"),
    "16 a DICOM series": (lambda f: dicom(f, "ct/IM0001.dcm"), 3, "dcm2niix or 3D Slicer"),
    "14 what only is called DICOM": (
        lambda f: [(f / "a.dcm").write_bytes(b"words" * 99), replace_after(f, "a.dcm")],
        3,
        "does not begin as a DICOM file does",
    ),
    "18 mirrored": (flipped, 3, "looks mirrored"),
    "19 a label in one image only": (
        lambda f: save(f / "after.nii.gz", np.where(anatomy(radius=6.0) == 1, 0, anatomy(radius=6.0))),
        3,
        "check its label in the images",
    ),
    "21 a speck": (lambda f: both(f, speck), 4, "has only 27 voxels"),
    "21 a sheet": (lambda f: both(f, sheet), 4, "nowhere two voxels thick"),
    "25 elements too coarse": (
        lambda f: changed(f, "edge_length_mm = 6.0", "edge_length_mm = 38.0"),
        4,
        "edge_length_mm",
    ),
    "25 an edge longer than the body": (
        lambda f: changed(f, "edge_length_mm = 6.0", "edge_length_mm = 500.0"),
        4,
        "less than the smallest side",
    ),
    "26 identical images": (lambda f: shutil.copy(f / "before.nii.gz", f / "after.nii.gz"), 3, "check the two paths"),
    "27 a volume that cannot be": (lambda f: save(f / "after.nii.gz", anatomy(radius=6.0, organ=8.5)), 3, "volume of"),
    "27 a motion that cannot be": (
        lambda f: [
            save(f / f"{name}.nii.gz", np.where(anatomy(radius=radius) == 2, 2, ball([x, y, 19.0], 5.0)))
            for name, radius, x, y in (("before", 4.0, 19.0, 25.0), ("after", 6.0, 32.0, 10.0))
        ],
        4,
        "field of view",  # laid on each other by the ball, the images share no rectum
    ),
    "29 incompressible": (
        lambda f: changed(f, '"estimate"', '"estimate"\npoisson_ratio = 0.5'),
        2,
        "-1 < nu < 0.5; soft tissue usually has 0.40 to 0.49",
    ),
    "29 beyond all ratios": (
        lambda f: changed(f, '"estimate"', '"estimate"\npoisson_ratio = -1.0'),
        2,
        "-1 < nu < 0.5",
    ),
    "30 no stiffness": (lambda f: changed(f, "kpa = 10.0", "kpa = 0.0"), 2, "positive number in kPa"),
    "30 bounds reversed": (lambda f: changed(f, "[1.0]", "[1.0]\nbounds_ratio = [9.0, 0.1]"), 2, "low < high"),
    "30 a start at a bound": (
        lambda f: changed(f, "[1.0]", "[1.0]\nbounds_ratio = [1.0, 9.0]"),
        2,
        "between the bounds",
    ),
    "36 a mistyped key": (lambda f: changed(f, "edge_length_mm", "edge_lenght_mm"), 2, "did you mean 'edge_length_mm'"),
    "36 a wrong type": (lambda f: changed(f, "modes = 6", 'modes = "six"'), 2, "whole number"),
    "36 keys in conflict": (lambda f: changed(f, "[1.0]", "[1.0]\nstarts_kpa = [9.0]"), 2, "say the same thing"),
    "36 a missing file": (lambda f: (f / "after.nii.gz").unlink(), 3, "check the path"),
    "36 a path of 300 characters": (lambda f: replace_after(f, "x" * 300 + ".nii.gz"), 3, "cannot be opened"),
    "36 a case in another encoding": (lambda f: (f / "case.toml").write_bytes(b"\xff\xfei\x00"), 2, "UTF-8"),
    "a label in neither image": (lambda f: changed(f, "label = 1", "label = 7"), 3, "in 'before' and 'after'"),
    "a wall that is gone": (lambda f: save(f / "after.nii.gz", (anatomy() == 1).astype(np.uint8)), 3, "'rectum'"),
    "a load on nothing": (
        lambda f: changed(f, "[estimate]", PRESSURE.replace('"rectum"', '"rektum"')),
        2,
        "no surface of the mesh is called 'rektum'",
    ),
    "one bone": (as_bone, 2, "nothing moves this body"),
    "a second pair without its image": (second_pair, 3, "there is no file"),
    "an unknown solver": (lambda f: changed(f, *FIXED[:1], FIXED[0] + '\nsolver = "best"'), 2, "solver"),
    "one label for two tissues": (
        lambda f: changed(f, "label = 2", "label = 1"),
        2,
        "a voxel can belong to one tissue only",
    ),
    "nothing that moves": (lambda f: changed(f, '"driver"', '"void"'), 2, "Give the role driver"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_has_its_code_and_a_sentence_and_leaves_nothing(name, folder, palpate):
    spoil, code, words = REFUSED[name]
    spoil(folder)
    done = palpate("estimate", "case.toml", "--output", "out", "--quiet", cwd=folder)
    assert words in sentence(done, code)
    assert code == 4 or not (folder / "out").exists()
    assert code != 4 or [path.name for path in (folder / "out").iterdir()] == ["log.txt"]


ACCEPTED = {
    "good": lambda _: None,
    "on another grid": other_grid,
    "masks": masks,
    "a cavity under pressure": under_pressure,
    "a damaged grey image": damaged_grey,
}


@pytest.mark.parametrize("name", [*REFUSED, *ACCEPTED])
def test_a_check_answers_first_what_an_estimate_ends_with(name, folder, answer):
    spoil, code, words = REFUSED.get(name) or (ACCEPTED[name], 0, "")
    spoil(folder)
    found, sentence = answer(folder / "case.toml")
    assert found == code
    assert words in sentence


def test_no_image_is_written_among_the_masks_of_a_run(folder, palpate):
    masks(folder)
    done = palpate("estimate", "case.toml", "--output", "after", "--quiet", cwd=folder)
    assert "a folder of masks" in sentence(done, 2)
    assert sorted(path.name for path in (folder / "after").iterdir()) == ["prostate.nii.gz", "rectum.nii.gz"]
