"""A small anatomy in two images, and the many ways to spoil it."""

from __future__ import annotations

import gzip
import shutil
import struct
import zlib
from pathlib import Path

import nibabel
import numpy as np

from case_texts import LINEAR, ORGAN, REST, case_text

SPACING = 1.5
AFFINE = np.diag([SPACING, SPACING, SPACING, 1.0])
CASE = case_text(
    {"prostate": ORGAN, "rectum": {"label": 2, "role": "driver"}, "surroundings": REST},
    mechanics=LINEAR,
    mesh={"edge_length_mm": 6.0},
    driver={"modes": 6},
    estimate={"start_ratios": [1.0]},
)


def ball(centre, radius: float) -> np.ndarray:
    places = np.stack(np.meshgrid(*[np.arange(26) * SPACING] * 3, indexing="ij"), axis=-1)
    return np.linalg.norm(places - centre, axis=-1) < radius


def anatomy(*, shift: float = 0.0, radius: float = 4.0, organ: float = 10.0) -> np.ndarray:
    """Labels (26, 26, 26): 1 a ball behind 2, a tube that fills."""
    places = np.stack(np.meshgrid(*[np.arange(26) * SPACING] * 3, indexing="ij"), axis=-1)
    labels = ball([19.0, 25.0 + shift, 19.0], organ).astype(np.uint8)
    labels[np.linalg.norm(places[..., :2] - [19.0, 9.0], axis=-1) < radius] = 2
    return labels


def save(path: Path, labels: np.ndarray, affine: np.ndarray = AFFINE) -> None:
    values = labels.astype(np.uint8) if labels.dtype.kind != "f" else labels
    nibabel.save(nibabel.Nifti1Image(values, affine), path)


def sentence(done: dict, code: int) -> str:
    """The one sentence of a refusal, with its exit code and no traceback."""
    assert done["code"] == code, (done["code"], done["err"], done["out"][-500:])
    assert done["out"] == ""
    assert "Traceback" not in done["err"]
    (line,) = done["err"].strip().splitlines()
    return line


def header(folder: Path, **fields) -> None:
    """Rewrite fields of the later image's header as they stand in the file, whatever a library would say."""
    content = bytearray(gzip.decompress((folder / "after.nii.gz").read_bytes()))
    places = {"dim": (40, "8h"), "pixdim": (76, "8f"), "vox_offset": (108, "f"), "qform_code": (252, "h")}
    places |= {"sform_code": (254, "h"), "srow_x": (280, "4f"), "datatype": (70, "2h"), "quatern_b": (256, "f")}
    for name, value in fields.items():
        offset, kind = places[name]
        struct.pack_into("<" + kind, content, offset, *np.atleast_1d(value).tolist())
    (folder / "after.nii.gz").write_bytes(gzip.compress(bytes(content), 1))


def as_floats(folder: Path, value: float) -> None:
    labels = anatomy(shift=0.8, radius=6.0).astype(np.float32)
    labels[labels == 1] = value
    save(folder / "after.nii.gz", labels)


def nrrd(folder: Path, name: str, text: str, voxels: bytes = b"") -> None:
    (folder / name).write_bytes(text.encode() + b"\n\n" + voxels)
    replace_after(folder, name)


def replace_after(folder: Path, name: str) -> None:
    path = folder / "case.toml"
    path.write_text(path.read_text().replace("after.nii.gz", name))


NRRD = "NRRD0004\ntype: uchar\ndimension: 3\nspace: RAS\nsizes: 26 26 26\nencoding: raw\n"
NRRD += "space directions: (1.5,0,0) (0,1.5,0) (0,0,1.5)\nspace origin: (0,0,0)"
LAYERS = (
    NRRD.replace("dimension: 3", "dimension: 4")
    .replace("sizes: ", "sizes: 2 ")
    .replace("directions: ", "directions: none ")
)
LAYERS += "\nkinds: list domain domain domain"
for number, name, layer in ((0, "prostate", 0), (1, "rectum", 1)):
    LAYERS += f"\nSegment{number}_ID:={name}\nSegment{number}_Name:={name}\nSegment{number}_LabelValue:=1"
    LAYERS += f"\nSegment{number}_Layer:={layer}"


def layers(*masks: np.ndarray) -> bytes:
    return np.stack(masks).astype(np.uint8).ravel(order="F").tobytes()


def bomb(folder: Path) -> None:
    packer = zlib.compressobj(1, wbits=31)  # a gzip stream
    content = packer.compress(gzip.decompress((folder / "after.nii.gz").read_bytes()))
    content += packer.flush(zlib.Z_FULL_FLUSH)
    zeros = packer.compress(bytes(2**24)) + packer.flush(zlib.Z_FULL_FLUSH)  # which refer to nothing before them
    (folder / "after.nii.gz").write_bytes(content + 64 * zeros + packer.flush())  # a gigabyte


def overlapping(folder: Path) -> None:
    labels = anatomy(shift=0.8, radius=6.0)
    wide = ball([19.0, 14.0, 19.0], 9.0)
    nrrd(folder, "after.seg.nrrd", LAYERS, layers(labels == 1, wide))


def cut(path: Path, size: int) -> None:
    path.write_bytes(path.read_bytes()[:size])


def masks(folder: Path, *, affine: np.ndarray = AFFINE, value: int = 1, wide: float = 0.0) -> None:
    """The later image as a folder of masks; `affine` and `value` are those of the rectum's, `wide` widens it (mm)."""
    labels = anatomy(shift=0.8, radius=6.0)
    (folder / "after").mkdir()
    save(folder / "after" / "prostate.nii.gz", labels == 1)
    rectum = (anatomy(radius=6.0 + wide) == 2).astype(np.uint8)
    rectum[:12] *= value
    save(folder / "after" / "rectum.nii.gz", rectum, affine)
    replace_after(folder, "after")
    changed(folder, "[images]", '[images]\nnames = "names.json"')
    (folder / "names.json").write_text('{"prostate": 1, "rectum": 2}')
    changed(folder, "label = 1", 'label = "prostate"')
    changed(folder, "label = 2", 'label = "rectum"')


def named(folder: Path, text: str) -> None:
    """Label names in the later image's header."""
    image = nibabel.Nifti1Image(anatomy(shift=0.8, radius=6.0), AFFINE)
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, text.encode()))
    nibabel.save(image, folder / "after.nii.gz")


def dicom(folder: Path, name: str) -> None:
    """The later image as one file of a class that holds no segmentation, alone or in a folder."""
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    uid = b"1.2.840.10008.5.1.4.1.1.2"
    path.write_bytes(bytes(128) + b"DICM" + b"\x02\x00\x02\x00UI\x1a\x00" + uid + bytes(400))
    replace_after(folder, name.split("/", maxsplit=1)[0])


def flipped(folder: Path) -> None:
    labels = anatomy(shift=0.8, radius=6.0)
    labels[ball([30.0, 30.0, 30.0], 5.0)] = 3
    save(folder / "after.nii.gz", labels[:, :, ::-1])
    labels = anatomy()
    labels[ball([30.0, 30.0, 30.0], 5.0)] = 3
    save(folder / "before.nii.gz", labels)
    path = folder / "case.toml"
    path.write_text(path.read_text() + '[tissues.bladder]\nlabel = 3\nrole = "estimate"\n')


def changed(folder: Path, old: str, new: str) -> None:
    text = (folder / "case.toml").read_text()
    assert old in text
    (folder / "case.toml").write_text(text.replace(old, new))


def both(folder: Path, change) -> None:
    """Change the labels of both images in the same way."""
    for name, options in (("before", {}), ("after", {"shift": 0.8, "radius": 6.0})):
        save(folder / f"{name}.nii.gz", change(anatomy(**options)))


def speck(labels: np.ndarray) -> np.ndarray:
    labels[labels == 1] = 0
    labels[12:15, 14:17, 12:15] = 1
    return labels


def sheet(labels: np.ndarray) -> np.ndarray:
    labels[labels == 1] = 0
    labels[5:20, 15, 5:20] = 1
    return labels


def other_grid(folder: Path) -> None:
    labels = anatomy(shift=0.8, radius=6.0)
    coarse = np.array(AFFINE)
    coarse[:3, 3] = 25 * SPACING * np.array([1.0, 0.0, 0.0])
    coarse[0, 0] = -SPACING
    save(folder / "after.nii.gz", labels[::-1], coarse)


def to_the_border(labels: np.ndarray) -> np.ndarray:
    labels[8:16, 12:20, 0:8] = 1
    return labels


def islands(labels: np.ndarray) -> np.ndarray:
    labels[2:4, 22:24, 2:4] = 1
    return labels


def touching(labels: np.ndarray) -> np.ndarray:
    labels[ball([19.0, 12.0, 19.0], 8.0) & (labels == 0)] = 1
    return labels


def two_cubes(labels: np.ndarray) -> np.ndarray:
    labels[labels == 1] = 0
    labels[8:13, 13:18, 8:18] = 1
    labels[13:18, 18:23, 8:18] = 1
    return labels


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
ACCEPTED = {
    "good": lambda _: None,
    "on another grid": other_grid,
    "masks": masks,
    "a cavity under pressure": under_pressure,
    "a damaged grey image": damaged_grey,
}
