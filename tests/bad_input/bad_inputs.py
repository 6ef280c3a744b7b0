"""A small anatomy in two images, and the many ways to spoil it."""

from __future__ import annotations

import gzip
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
