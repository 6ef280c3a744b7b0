"""NIfTI-1 and NIfTI-2 files (.nii, .nii.gz): read with every size checked before memory is taken, and written.

Layout of the header: https://nifti.nimh.nih.gov/pub/dist/src/niftilib/nifti1.h and nifti2.h. nibabel decodes the
header; the voxels are read here, because a header or a gzip stream may promise far more than the file holds.
"""

from __future__ import annotations

import contextlib
import gzip
import math
import os
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
    VoxelBlock,
    check_size,
    gzip_stream,
    opened,
    read_exactly,
    read_voxels,
)

MILLIMETRES = {0: 1.0, 1: 1000.0, 2: 1.0, 3: 0.001}  # xyzt_units: unknown, metre, millimetre, micrometre
HEADERS = {348: "Nifti1Header", 540: "Nifti2Header"}  # by nibabel, which is imported when an image comes
MAGIC = {348: b"n+1\0", 540: b"n+2\0\r\n\032\n"}


def read_nifti(path: Path) -> StoredImage:
    """Read one image of three axes from `path`; raises `InputDataError` with a sentence for whatever is wrong."""
    with opened(path) as file:
        zipped = file.peek(2)[:2] == b"\x1f\x8b"
        if zipped != path.name.lower().endswith(".gz"):
            is_and_should = ("is compressed", ".nii.gz") if zipped else ("is not compressed by gzip", ".nii")
            raise InputDataError(f"'{path}' {is_and_should[0]}, against its ending; rename it to {is_and_should[1]}")
        stream = gzip_stream(file) if zipped else file
        content = read_exactly(stream, 348, path).tobytes()
        lengths = {sign: int(np.frombuffer(content[:4], dtype=f"{sign}i4")[0]) for sign in ("<", ">")}
        sign = next((sign for sign, length in lengths.items() if length in HEADERS), None)
        if sign is None:
            raise InputDataError(f"'{path}' does not begin as a NIfTI file does; export the image as NIfTI (.nii.gz)")
        used = lengths[sign]
        content += read_exactly(stream, used - len(content), path).tobytes()
        magic = content[344:348] if used == 348 else content[4:12]
        if magic != MAGIC[used]:
            raise InputDataError(
                f"'{path}' has the mark {magic!r}, which is not that of a NIfTI file in one piece; convert Analyze and"
                " .hdr/.img pairs to .nii.gz"
            )
        header = getattr(import_module("nibabel"), HEADERS[used])(content, endianness=sign, check=False)
        block, slope, intercept = _block(header, path)
        affine = _affine(header, path)
        check_size(block.shape, block.skip + block.n_bytes, path, available=file.n_bytes, packed=zipped)
        between = read_exactly(stream, block.skip - used, path).tobytes()
        values = read_voxels(stream, block, path)
        digests = {"": file.sha256()}
    if (slope, intercept) != (1.0, 0.0):
        with np.errstate(over="ignore", invalid="ignore"):
            values = np.asarray(values * slope + intercept)
    names = extension_names(between, header.endianness, path)
    return StoredImage(values, affine, names, digests)


def _block(header: Any, path: Path) -> tuple[VoxelBlock, float, float]:
    """What the header says of the voxels, and the slope and intercept of their scale."""
    header_error = import_module("nibabel.spatialimages").HeaderDataError
    try:
        dtype = np.dtype(header.get_data_dtype())
        slope, intercept = header.get_slope_inter()
    except (header_error, KeyError, ValueError) as error:
        raise InputDataError(f"the header of '{path}' is damaged: {error}; export the image again") from error
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise InputDataError(
            f"the voxels of '{path}' are of the type {dtype}; only integers and floats of up to 64 bits are read:"
            " export one grey or label channel"
        )
    dim = [int(n) for n in header["dim"]]
    sizes = dim[1 : 1 + dim[0]] if 1 <= dim[0] <= 7 else []
    if not sizes or min(sizes) < 1:
        raise InputDataError(f"the header of '{path}' gives the sizes {dim}, not positive counts; export it again")
    if len(sizes) < 3 or any(n > 1 for n in sizes[3:]):
        raise InputDataError(
            f"'{path}' has the sizes {sizes}, but an image of three axes is needed; extract one volume (a time point,"
            " a channel) or stack the slices"
        )
    first = int(header["sizeof_hdr"]) + 4  # four bytes announce extensions; 0 is written by old programs for this
    offset = float(header["vox_offset"]) or float(first)
    if not math.isfinite(offset) or not first <= offset <= MAX_OFFSET:
        raise InputDataError(
            f"the header of '{path}' puts the first voxel at byte {offset:g}, not between {first} and {MAX_OFFSET};"
            " export the image again"
        )
    block = VoxelBlock((sizes[0], sizes[1], sizes[2]), dtype, skip=int(offset))
    return block, 1.0 if slope is None else float(slope), 0.0 if intercept is None else float(intercept)


def _affine(header: Any, path: Path) -> NDArray[np.float64]:
    """Index -> RAS mm by the sform or the qform; where both are set, they must agree."""
    header_error = import_module("nibabel.spatialimages").HeaderDataError
    try:
        with np.errstate(all="ignore"):  # what is not finite is refused later, with its numbers
            affine = header.get_sform(coded=True)[0]
            qform = header.get_qform(coded=True)[0]
    except (header_error, ValueError) as error:
        raise InputDataError(f"the qform in the header of '{path}' is damaged: {error}; set an sform") from error
    if affine is not None and qform is not None:
        # which of two places is right, nobody can tell here; half a voxel is more than rounding
        apart, voxel = corners_apart([float(n) for n in header["dim"][1:4]], affine, qform)
        if apart > 0.5 * voxel:
            raise InputDataError(
                f"sform and qform in the header of '{path}' place its corners up to {apart:.3g} mm apart; delete the"
                " wrong one (set its code to 0), or export the image again"
            )
    affine = qform if affine is None else affine
    if affine is None:
        raise InputDataError(
            f"the header of '{path}' has neither sform nor qform, so left and right are unknown; export the image with"
            " its orientation, or set the sform yourself"
        )
    unit = int(header["xyzt_units"]) & 7
    if unit not in MILLIMETRES:
        raise InputDataError(f"the header of '{path}' has the unit of length {unit}, unknown; set it to 2 (millimetre)")
    scaled = np.array(affine, dtype=np.float64)
    with np.errstate(all="ignore"):
        scaled[:3] *= MILLIMETRES[unit]
    return scaled


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
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise ResourceError(
            f"'{path}' cannot be written ({error}); check that the folder exists, is writable and not full"
        ) from error


# half of nibabel's import and more
register(ImageFormat("NIfTI", (".nii", ".nii.gz"), read_nifti, needless=("pydicom", "scipy")))
