"""Displacement fields as files have them, images of vectors and transforms: turned to RAS mm as each file says."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError, InputDataError
from palpate.images.input_file import beside, whole_input
from palpate.images.label_image import LPS_TO_RAS, VoxelGrid
from palpate.images.named_labels import printable
from palpate.images.readers.metaimage import metaimage_content
from palpate.images.readers.nifti import nifti_affine, nifti_content, nifti_millimetres
from palpate.images.readers.nrrd import MILLIMETRES, RAS_SIGNS, nrrd_content
from palpate.images.readers.text_header import StoredArray
from palpate.observation.point_table import read_text

Field = tuple[NDArray[np.float64], VoxelGrid, tuple[str, ...]]
MOST_VECTORS = 8 * 2**30 // 144  # 8 GiB in all, for a vector takes 144 bytes while it is read
MOST_BYTES = 24 * MOST_VECTORS  # of a file of transforms, where a vector mostly has 24 bytes
SIGNS = {"RAS": np.ones(3), "LPS": LPS_TO_RAS}
DISPVECT, VECTOR = 1006, 1007  # intents of NIfTI, which ITK has in RAS and LPS; Workbench writes the second in RAS, too
NAMES = {"Mapping": True, "NREG_TRANS 0": True, "NREG_TRANS 1": False}  # of SPM and NiftyReg: whether of positions
OF_FSL = (2006, 2007, 2008, 2009, 2016, 2017, 2018)
ONE_TRANSFORM = re.compile(rb"_(?:double|float)_[23]_[23]\b")  # stands once for each in a file that ITK wrote
VOLUME = r'Displacement_Volume["\s]*=["\s]*([^;"]*?)["\s]*;'  # of an .xfm: the file of a grid
ROUNDING = 1e-6  # of a voxel


def read_field(path: Path, axes: str) -> Field:
    """Displacements (n_x, n_y, n_z, 3) RAS mm, their grid, and the SHA-256 of each file.

    axes: of the vectors, "RAS" or "LPS", where the case states them, else "". Vectors are not finite, or 0, where there
    is none. Raises `InputDataError`, too where file and case contradict each other, or neither tells the axes.
    """
    reader = next((read for ending, read in READERS.items() if path.name.lower().endswith(ending)), None)
    if reader is None:
        raise InputDataError(
            f"'{path}' has an ending that is not read as a field; export it as .csv, {', '.join(READERS)}"
        )
    try:
        return reader(path, axes)
    except ImportError as error:
        advice = "pip install 'palpate[itk]', or write the field as .nii.gz"
        raise ConfigurationError(f"'{path}' is read by SimpleITK: {advice}") from error
    except (RuntimeError, ValueError) as error:
        flaw = " ".join(str(error).splitlines()[-1:])
        raise InputDataError(f"'{path}' cannot be read: {flaw}; export it again") from error


def _signs(told: str, axes: str, path: Path) -> NDArray[np.float64]:
    """The signs that turn vectors to RAS, by the file's axes ("": none) and those that the case states."""
    if told and axes not in ("", told):
        raise InputDataError(
            f"the vectors of '{path}' are in {told}, by its header, but the case states {axes}; remove the key axes"
            " from [[data]]"
        )
    if not told and not axes:
        raise InputDataError(
            f"'{path}' does not say whether its vectors are in RAS or LPS; state in [[data]] axes = \"RAS\" (MRtrix,"
            ' MNI tools, Connectome Workbench) or axes = "LPS" (ITK, AFNI)'
        )
    return SIGNS[told or axes]


def _refuse_many(sizes: Sequence[int], path: Path) -> None:
    if np.prod([float(n) for n in sizes]) > MOST_VECTORS:
        raise InputDataError(f"'{path}' has {' x '.join(map(str, sizes))} vectors; resample it to {MOST_VECTORS}")


def _nifti(path: Path, axes: str) -> Field:
    content = nifti_content(path, _three_components)
    signs, positions = _nifti_kind(content.header, axes, path)
    n_x, n_y, n_z = content.values.shape[:3]
    grid = VoxelGrid((n_x, n_y, n_z), nifti_affine(content.header, path))
    with np.errstate(all="ignore"):  # values that are not finite count as missing
        vectors = content.values.reshape(n_x, n_y, n_z, 3) * signs * nifti_millimetres(content.header, path)
    if positions:
        vectors[~vectors.any(axis=-1)] = np.nan
        vectors -= _centres(grid)
    return vectors, grid, (content.sha256,)


def _three_components(_: Any, sizes: tuple[int, ...], path: Path) -> None:
    if len(sizes) < 4 or [n for n in sizes[3:] if n != 1] != [3]:
        raise InputDataError(f"'{path}' has the sizes {list(sizes)}; export three axes and three components")
    _refuse_many(sizes[:3], path)


def _nifti_kind(header: Any, axes: str, path: Path) -> tuple[NDArray[np.float64], bool]:
    """The signs that turn vectors to RAS, and whether they are positions, by what programs write as intent."""
    intent, name = int(header["intent_code"]), header["intent_name"].item().decode("latin-1")
    name = f"{name} {float(header['intent_p1']):g}" if name.startswith("NREG") else name
    if name in NAMES:
        return _signs("RAS", axes, path), NAMES[name]
    if intent in OF_FSL or name.startswith("NREG"):
        raise InputDataError(
            f"'{path}' holds no displacements in mm (intent {intent}, {printable(name)!r}); convert it by reg_transform"
            " -disp of NiftyReg, a warp of FSL by wb_command -convert-warpfield -from-fnirt ... -to-world"
        )
    return _signs({DISPVECT: "RAS", VECTOR: axes or "LPS"}.get(intent, ""), axes, path), False


def _nrrd(path: Path, axes: str) -> Field:
    """Vectors in the measurement frame; without one in LPS as in ITK, because the format does not say."""
    array, header = nrrd_content(path)
    space, unit = str(header["space"]).lower(), MILLIMETRES[header.get("space units", ["mm"])[0]]
    if space not in RAS_SIGNS:
        raise InputDataError(f"'{path}' has a time axis ({printable(space)}); extract one volume")
    if "measurement frame" not in header:
        told = "LPS" if RAS_SIGNS[space] == RAS_SIGNS["lps"] else ""
        return _field(array, unit * np.diag(_signs(axes or told, axes, path)), path)
    if axes:
        _signs("its measurement frame", axes, path)  # which refuses both
    columns = np.asarray(header["measurement frame"], dtype=np.float64)
    return _field(array, unit * np.array(RAS_SIGNS[space])[:, None] * columns.T, path)


def _metaimage(path: Path, axes: str) -> Field:
    """Vectors that ITK takes for LPS, where the case does not say otherwise."""
    return _field(metaimage_content(path), np.diag(SIGNS[axes or "LPS"]), path)


def _field(array: StoredArray, turn: NDArray[np.float64], path: Path) -> Field:
    """The field of an image whose vectors `turn` (3, 3) brings to RAS mm."""
    components = array.layers(path)
    n, *sizes = components.shape
    if n != 3:
        raise InputDataError(f"'{path}' has {n} components; export three")
    _refuse_many(sizes, path)
    grid = VoxelGrid((sizes[0], sizes[1], sizes[2]), array.affine)
    return np.moveaxis(components, 0, -1) @ turn.T, grid, tuple(array.digests.values())


def _transform(path: Path, axes: str) -> Field:
    """The displacement of a transform on the finest grid of the fields that it holds.

    Transforms without such a field are refused, because a field needs a grid. Where a point leaves the grid of a field
    the displacement is NaN: ITK would take it for zero there.
    """
    sitk, xfm = import_module("SimpleITK"), path.name.lower().endswith(".xfm")
    signs = _signs("" if xfm else "LPS", axes, path)  # SimpleITK takes the numbers of MNI tools for LPS, too
    parts, digests = _of_xfm(path) if xfm else _of_file(path)
    images = {
        n: image
        for n, part in enumerate(parts)
        if part.GetName() == "DisplacementFieldTransform"
        and all((image := sitk.DisplacementFieldTransform(part).GetDisplacementField()).GetSize())
    }
    if not images:
        raise InputDataError(
            f"'{path}' holds no displacement field, or an inverted one; write it as a field on the grid of the first"
            " image"
        )
    finest = min(reversed(images.values()), key=lambda image: float(np.prod(image.GetSpacing())))
    _refuse_many(finest.GetSize(), path)
    whole, grid = _of_itk(finest if len(parts) == 1 else _on(parts, finest))
    for n, image in images.items():
        moved, (_, own) = _of_itk(_on(parts[n + 1 :], finest))[0], _of_itk(image)  # by those applied before it
        place = own.index(_centres(grid) + moved * LPS_TO_RAS)
        inside = np.all((place > -ROUNDING) & (place < np.array(own.shape) - 1.0 + ROUNDING), axis=-1)
        whole[~inside] = np.nan
    if np.isnan(whole).all():
        raise InputDataError(
            f"the {len(images)} fields of '{path}' have grids that do not fit together; write the transform as one"
            " field"
        )
    turn = np.diag([*(signs * LPS_TO_RAS), 1.0])
    return whole * signs, VoxelGrid(grid.shape, turn @ grid.affine), tuple(digests)


def _of_file(path: Path) -> tuple[list[Any], list[str]]:
    """The transforms of a composite, of which the last one is applied first, or the one that a file of ITK holds."""
    sitk, (content, digest) = import_module("SimpleITK"), whole_input(path, MOST_BYTES)
    transform = sitk.ReadTransform(str(path))
    if transform.GetName() == "CompositeTransform":  # a file holds none within another
        composite = sitk.CompositeTransform(transform)
        return [composite.GetNthTransform(n) for n in range(composite.GetNumberOfTransforms())], [digest]
    if (n := len(ONE_TRANSFORM.findall(content))) > 1:  # of which SimpleITK gives the first
        raise InputDataError(f"'{path}' lists {n} transforms without their order; write them as one CompositeTransform")
    return [transform], [digest]


def _of_xfm(path: Path) -> tuple[list[Any], list[str]]:
    """The transforms of an MNI file in reverse, as it applies its first one first; grids are digested, too.

    SimpleITK reads only one of several transforms, so each is passed to it in a file of its own.
    """
    sitk, (text, digest) = import_module("SimpleITK"), read_text(path)
    parts, digests = list[Any](), [digest]

    def placed(name: re.Match[str]) -> str:
        """The grid by its whole path, after it was found to be in the folder, and small enough."""
        volume, header = beside(path, name[1]), sitk.ImageFileReader()
        digests.append(whole_input(volume, MOST_BYTES)[1])
        header.SetFileName(str(volume))
        header.ReadImageInformation()
        _refuse_many(header.GetSize(), volume)
        return f"Displacement_Volume = {volume};"

    text = re.sub(VOLUME, placed, re.sub("[%#].*", "", text))  # without comments
    with TemporaryDirectory() as folder:
        own = Path(folder, "one.xfm")
        for part in re.split(r"(?=\bTransform_Type\s*=)", text)[1:]:
            own.write_text(f"MNI Transform File\n{part}", encoding="utf-8")
            parts.append(sitk.ReadTransform(str(own)))
    return parts[::-1], digests


def _on(parts: list[Any], grid: Any) -> Any:
    """The displacement of transforms, of which the last one is applied first, as an image on the grid of another."""
    sitk = import_module("SimpleITK")
    place = (grid.GetSize(), grid.GetOrigin(), grid.GetSpacing(), grid.GetDirection())
    whole = sitk.CompositeTransform([sitk.Transform(3, sitk.sitkIdentity), *parts])
    return sitk.TransformToDisplacementField(whole, sitk.sitkVectorFloat64, *place)


def _of_itk(image: Any) -> tuple[NDArray[np.float64], VoxelGrid]:
    """Vectors (n_x, n_y, n_z, 3) as they are, and the grid, of an image that lies in LPS."""
    values = import_module("SimpleITK").GetArrayFromImage(image)
    affine = np.eye(4)
    affine[:3, :3] = LPS_TO_RAS[:, None] * np.array(image.GetDirection()).reshape(3, 3) * np.array(image.GetSpacing())
    affine[:3, 3] = LPS_TO_RAS * image.GetOrigin()
    return np.swapaxes(values, 0, 2).astype(np.float64, copy=False), VoxelGrid(image.GetSize(), affine)


def _centres(grid: VoxelGrid) -> NDArray[np.float64]:
    """The voxel centres (n_x, n_y, n_z, 3) RAS mm."""
    return grid.world(np.moveaxis(np.indices(grid.shape), 0, -1).astype(np.float64))


READERS = {".nii": _nifti, ".nii.gz": _nifti, ".nrrd": _nrrd, ".nhdr": _nrrd, ".mha": _metaimage, ".mhd": _metaimage}
READERS |= dict.fromkeys((".h5", ".hdf5", ".tfm", ".txt", ".xfm", ".mat"), _transform)
