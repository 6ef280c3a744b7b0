"""NIfTI-1 and NIfTI-2 files (.nii, .nii.gz): read with every size checked before memory is taken, and written.

Layout of the header: https://nifti.nimh.nih.gov/pub/dist/src/niftilib/nifti1.h and nifti2.h. nibabel decodes the
header; the voxels are read here, because a header or a gzip stream may promise far more than the file holds.
"""

from __future__ import annotations

import contextlib
import gzip
import math
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError, InputDataError, ResourceError
from palpate.images.label_image import LPS_TO_RAS, LabelImage, VoxelGrid, corners_apart
from palpate.images.readers.nifti_extension import extension_names
from palpate.images.readers.registry import ImageFormat, StoredImage, register
from palpate.images.readers.voxel_stream import (
    MAX_OFFSET,
    STREAMS,
    VoxelBlock,
    check_size,
    opened,
    read_exactly,
    read_voxels,
)

MILLIMETRES = {0: 1.0, 1: 1000.0, 2: 1.0, 3: 0.001}  # xyzt_units: unknown, metre, millimetre, micrometre
HEADERS = {  # by the first four bytes: nibabel's class, which is imported when an image comes, length, byte order
    struct.pack(f"{order}i", n_bytes): (name, n_bytes, order)
    for name, n_bytes in (("Nifti1Header", 348), ("Nifti2Header", 540))
    for order in "<>"
}
MAGIC = (b"n+1\0", b"n+2\0\r\n\032\n")
LONGEST = 1.001  # of a quaternion, whose length is 1 but for rounding
NO_ROOT = 1e-7  # nifti1_io.c: less than this of 1 - b^2 - c^2 - d^2 is rounding, and the turn is by 180 degrees


@dataclass(frozen=True, slots=True)
class NiftiContent:
    """What a NIfTI file holds.

    `header`: nibabel's, as the file has it. `values`: as the header scales them, of as many axes as it has sizes.
    `scale`: its slope and intercept. `extensions`: the bytes between header and voxels. `sha256`: of the whole file.
    """

    header: Any
    values: NDArray[Any]
    scale: tuple[float, float]
    extensions: bytes
    sha256: str


def read_nifti(path: Path) -> StoredImage:
    """Read one image of three axes from `path`; raises `InputDataError` with a sentence for whatever is wrong."""
    content = nifti_content(path, _three_axes)
    affine = nifti_affine(content.header, path)
    names = extension_names(content.extensions, content.header.endianness, path)
    values = content.values.reshape(content.values.shape[:3])
    return StoredImage(values, affine, names, {"": content.sha256}, scale=content.scale)


def nifti_content(path: Path, check: Callable[[Any, tuple[int, ...], Path], None]) -> NiftiContent:
    """Read header and voxels of the file at `path`.

    `check` gets the header, the sizes of its axes and `path` before memory is taken, and raises where they are not what
    is read. Raises `InputDataError` for a file that is damaged, or is no NIfTI file in one piece.
    """
    with opened(path) as file:
        zipped = file.peek(2)[:2] == b"\x1f\x8b"
        if zipped != path.name.lower().endswith(".gz"):
            flaw, ending = ("is compressed", ".nii.gz") if zipped else ("is not compressed by gzip", ".nii")
            raise InputDataError(f"'{path}' {flaw}, against its ending; rename it to {ending}")
        unpacked, ratio = STREAMS["gzip" if zipped else "raw"]
        stream = unpacked(file)
        content = read_exactly(stream, 348, path).tobytes()
        if content[:4] not in HEADERS:
            raise InputDataError(f"'{path}' does not begin as a NIfTI file does; export the image as NIfTI (.nii.gz)")
        name, used, order = HEADERS[content[:4]]
        content += read_exactly(stream, used - len(content), path).tobytes()
        header = getattr(import_module("nibabel"), name)(content, endianness=order, check=False)
        magic = content[344:348] if used == 348 else content[4:12]
        if magic not in MAGIC:
            advice = "convert Analyze and .hdr/.img pairs to .nii.gz"
            raise InputDataError(f"'{path}' has the mark {magic!r}, not of a NIfTI file in one piece; {advice}")
        block, (slope, intercept) = _block(header, path)
        check(header, block.shape, path)
        check_size(block.shape, path, needed=block.skip + block.n_bytes, available=file.n_bytes * ratio)
        between = read_exactly(stream, block.skip - used, path).tobytes()
        values = read_voxels(stream, block, path)
        sha256 = file.sha256()
    if (slope, intercept) != (1.0, 0.0):
        with np.errstate(over="ignore", invalid="ignore"):
            values = np.asarray(values * slope + intercept)
    return NiftiContent(header, values, (slope, intercept), between, sha256)


def _block(header: Any, path: Path) -> tuple[VoxelBlock, tuple[float, float]]:
    """What the header says of the voxels, and the slope and intercept of their scale."""
    try:
        dtype = np.dtype(header.get_data_dtype())
        slope, intercept = header.get_slope_inter()
    except Exception as error:  # nibabel raises its own, and what numpy and Python raise
        raise InputDataError(f"the header of '{path}' is damaged: {error}; export the image again") from error
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        flaw = f"are of the type {dtype}; only integers and floats of up to 64 bits are read"
        raise InputDataError(f"the voxels of '{path}' {flaw}: export one channel")
    dim = [int(n) for n in header["dim"]]
    sizes = dim[1 : 1 + dim[0]] if 1 <= dim[0] <= 7 else []
    if not sizes or min(sizes) < 1:
        raise InputDataError(f"the header of '{path}' gives the sizes {dim}, not positive counts; export it again")
    first = int(header["sizeof_hdr"]) + 4  # four bytes announce extensions; 0 is written by old programs for this
    offset = float(header["vox_offset"]) or float(first)
    if not first <= offset <= MAX_OFFSET:
        flaw = f"puts the first voxel at byte {offset:g}, not between {first} and {MAX_OFFSET}"
        raise InputDataError(f"the header of '{path}' {flaw}; export the image again")
    scale = (1.0, 0.0) if slope is None else (float(slope), float(intercept))
    return VoxelBlock(tuple(sizes), dtype, skip=int(offset)), scale


def _three_axes(header: Any, sizes: tuple[int, ...], path: Path) -> None:
    if len(sizes) < 3 or any(n > 1 for n in sizes[3:]):
        intent = header.get_intent()[0]  # "displacement vector", "none"
        advice = "an image of three axes is needed; extract one volume (a time point, a channel) or stack the slices"
        raise InputDataError(f"'{path}' has the sizes {list(sizes)} (intent: {intent}), but {advice}")


def nifti_affine(header: Any, path: Path) -> NDArray[np.float64]:
    """The affine (4, 4), index -> RAS mm, of nibabel's NIfTI header: its sform, else its qform, in its unit of length.

    Where both are set, they must agree; a damaged qform does not matter beside a sform. `path` is for messages.
    Raises `InputDataError`; that the affine is finite and upright is not checked.
    """
    with np.errstate(all="ignore"):  # what is not finite is refused later, with its numbers
        sform = np.asarray(header.get_sform()) if int(header["sform_code"]) > 0 else None
    qform, flaw = _qform(header) if int(header["qform_code"]) > 0 else (None, "")
    affine = qform if sform is None else sform
    if affine is None:
        flaw = f"a damaged qform: {flaw}" if flaw else "neither sform nor qform, so left and right are unknown"
        raise InputDataError(f"the header of '{path}' has {flaw}; set an sform, or export the image with one")
    if sform is not None and qform is not None:
        # either place may be right; half a voxel is more than rounding
        apart, voxel = corners_apart([float(n) for n in header["dim"][1:4]], sform, qform)
        if apart > 0.5 * voxel:
            flaw = f"place its corners up to {apart:.3g} mm apart; delete the wrong one (set its code to 0)"
            raise InputDataError(f"sform and qform in the header of '{path}' {flaw}")
    with np.errstate(all="ignore"):
        affine[:3] *= nifti_millimetres(header, path)
    return affine


def nifti_millimetres(header: Any, path: Path) -> float:
    """How many mm the unit of length in nibabel's NIfTI header is; one that is not stated is taken for mm.

    Raises `InputDataError` for a unit that does not exist.
    """
    unit = int(header["xyzt_units"]) & 7
    if unit not in MILLIMETRES:
        raise InputDataError(f"the header of '{path}' has the unit of length {unit}, unknown; set it to 2 (millimetre)")
    return MILLIMETRES[unit]


def _qform(header: Any) -> tuple[NDArray[np.float64] | None, str]:
    """The qform (4, 4) in the header's unit of length, or what is wrong with it.

    As nifti1_io.c has it: a quaternion longer than 1 by rounding is normalised, and qfac is the sign of pixdim[0].
    """
    b, c, d = (float(header[f"quatern_{part}"]) for part in "bcd")
    offset = [float(header[f"qoffset_{axis}"]) for axis in "xyz"]
    qfac, *edges = (float(n) for n in header["pixdim"][:4])
    rest = 1.0 - (b * b + c * c + d * d)
    if not rest >= 1.0 - LONGEST**2:
        return None, f"its quaternion ({b:.6g}, {c:.6g}, {d:.6g}) is longer than 1"
    if not np.isfinite([qfac, *edges, *offset]).all() or min(edges) <= 0.0:
        return None, f"its pixdim is {[qfac, *edges]}, its offset {offset}"
    affine = np.eye(4)
    turn = import_module("nibabel.quaternions").quat2mat([math.sqrt(rest) if rest > NO_ROOT else 0.0, b, c, d])
    affine[:3, :3] = turn * np.array([edges[0], edges[1], edges[2] * (-1.0 if qfac < 0.0 else 1.0)])
    affine[:3, 3] = offset
    return affine, ""


def write_label_image(path: Path | str, image: LabelImage) -> None:
    """Write labels as NIfTI (.nii or .nii.gz) in the smallest of uint8, uint16, int32; sform and qform in mm.

    The file appears whole or not at all. Raises `ConfigurationError` for another ending, `ResourceError` when the disk
    refuses.
    """
    low, high = int(image.labels.min()), int(image.labels.max())
    narrow = np.uint8 if high <= 255 else np.uint16 if high <= 65535 else np.int32
    _write(Path(path), image.labels.astype(narrow if low >= 0 else np.int32), image.grid)


def write_scalar_image(path: Path | str, array: NDArray[np.floating[Any]], grid: VoxelGrid) -> None:
    """Write a scalar field (n_x, n_y, n_z), in kPa, mm or any other unit, as float32 NIfTI on `grid`; NaN stays NaN.

    Raises `InputDataError` when shape and grid disagree, else as `write_label_image` does.
    """
    if array.shape != grid.shape:
        raise InputDataError(f"an image of shape {array.shape} cannot be written on a grid of shape {grid.shape}")
    with np.errstate(over="ignore"):
        _write(Path(path), np.asarray(array, dtype=np.float32), grid)


def write_displacement_field(path: Path | str, field: NDArray[np.float64], grid: VoxelGrid) -> None:
    """Write displacements (n_x, n_y, n_z, 3) RAS mm at the voxel centres of `grid` as ITK's transforms have them.

    The file holds LPS mm, a vector image (NIfTI intent 1007): SimpleITK, ANTs and 3D Slicer read it as a displacement
    field. Raises as `write_scalar_image` does.
    """
    if field.shape != (*grid.shape, 3):
        raise InputDataError(f"a field of shape {field.shape} cannot be written on a grid of shape {grid.shape}")
    lps = (field * LPS_TO_RAS).astype(np.float32)
    _write(Path(path), lps[:, :, :, None, :], grid, intent="vector")


def _write(path: Path, values: NDArray[Any], grid: VoxelGrid, *, intent: str = "none") -> None:
    if not path.name.lower().endswith((".nii", ".nii.gz")):
        raise ConfigurationError(f"'{path}' cannot be written: images are written as .nii or .nii.gz; choose one")
    image = import_module("nibabel").Nifti1Image(values, grid.affine)
    image.set_sform(grid.affine, code="scanner")
    image.set_qform(grid.affine, code="scanner")
    image.header.set_xyzt_units("mm")
    image.header.set_intent(intent)
    content: bytes = image.to_bytes()
    if path.name.lower().endswith(".gz"):
        content = gzip.compress(content, compresslevel=6, mtime=0)  # no time stamp: equal images give equal files
    # in one step, so that a crash never leaves half a file there
    temporary = path.with_name(f".{path.name[:50]}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        advice = "check that the folder exists, is writable and not full"
        raise ResourceError(f"'{path}' cannot be written ({error}); {advice}") from error


# half of nibabel's import and more
register(ImageFormat("NIfTI", (".nii", ".nii.gz"), read_nifti, needless=("pydicom", "scipy")))
