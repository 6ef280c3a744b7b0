"""Displacement fields as files have them, images of vectors and transforms: turned to RAS mm as each file says."""

from __future__ import annotations

import mmap
import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError, InputDataError
from palpate.images.label_image import LPS_TO_RAS
from palpate.images.named_labels import printable
from palpate.images.readers.metaimage import metaimage_content
from palpate.images.readers.nifti import nifti_affine, nifti_content, nifti_millimetres
from palpate.images.readers.nrrd import MILLIMETRES, RAS_SIGNS, nrrd_content
from palpate.images.readers.text_header import StoredArray
from palpate.images.readers.voxel_stream import opened
from palpate.observation.measured_points import read_text

Field = tuple[NDArray[np.float64], NDArray[np.float64], tuple[str, ...]]
MEMORY = 8 * 2**30  # bytes that a field may take
OF_VECTOR, OF_PART = 144, 32  # bytes, until it is a pair of points; and for each transform of a file
IN_FILE = 24  # bytes of a vector, in most files of transforms
SIGNS = {"RAS": np.ones(3), "LPS": LPS_TO_RAS}
DISPVECT, VECTOR = 1006, 1007  # intents of NIfTI, which ITK has in RAS and LPS; Workbench writes the second in RAS, too
NAMES = {"Mapping": True, "NREG_TRANS 0": True, "NREG_TRANS 1": False}  # of SPM and NiftyReg: whether of positions
OF_FSL = (2006, 2007, 2008, 2009, 2016, 2017, 2018)
ONE_TRANSFORM = re.compile(rb"_(?:double|float)_[23]_[23]\b")  # stands once for each in a file that ITK wrote
ROUNDING = 1e-6  # of a voxel


def read_field(path: Path, axes: str) -> Field:
    """Displacements (n_x, n_y, n_z, 3) RAS mm, the affine (4, 4) index -> RAS mm of their grid, SHA-256 of each file.

    axes: of the vectors, "RAS" or "LPS", where the case states them, else "". Vectors are not finite, or 0, where there
    is none. Raises `InputDataError`, too where file and case contradict each other, or neither tells the axes.
    """
    reader = next((read for endings, read in READERS.items() if path.name.lower().endswith(endings)), None)
    if reader is None:
        known = ", ".join(ending for endings in READERS for ending in endings)
        raise InputDataError(f"'{path}' is no kind of displacement field that is read; export one of .csv, {known}")
    try:
        return reader(path, axes)
    except ImportError as error:
        advice = "pip install 'palpate[itk]', or write the field as .nii.gz"
        raise ConfigurationError(f"'{path}' is read by SimpleITK: {advice}") from error
    except (RuntimeError, ValueError) as error:
        flaw = " ".join(str(error).splitlines()[-1:])
        raise InputDataError(f"'{path}' cannot be read: {flaw}; export it again") from error


def _signs(told: str, axes: str, path: Path) -> NDArray[np.float64]:
    """What turns vectors to RAS, by the axes that the file tells ("": none) and those that the case states."""
    if told and axes not in ("", told):
        raise InputDataError(
            f"the vectors of '{path}' are in {told}, as it says, and the case states axes = \"{axes}\"; take the key"
            " out, or correct the file, where it is wrong"
        )
    if not told and not axes:
        raise InputDataError(
            f"'{path}' does not say whether its vectors are in RAS or LPS; state in [[data]] axes = \"RAS\" (MRtrix,"
            ' MNI tools, Connectome Workbench) or axes = "LPS" (ITK, AFNI)'
        )
    return SIGNS[told or axes]


def _sha256(path: Path) -> str:
    with opened(path) as file:
        return file.sha256()


def _refuse_many(sizes: tuple[int, ...], path: Path, of_each: int = OF_VECTOR) -> None:
    if np.prod([float(n) for n in sizes]) > MEMORY / of_each:
        raise InputDataError(
            f"'{path}' has {' x '.join(map(str, sizes))} vectors; resample it to {MEMORY // of_each} at most"
        )


def _nifti(path: Path, axes: str) -> Field:
    def check(header: Any, sizes: tuple[int, ...], path: Path) -> None:
        if len(sizes) < 4 or [n for n in sizes[3:] if n != 1] != [3]:
            raise InputDataError(f"'{path}' has the sizes {list(sizes)}; export three axes and three components")
        _refuse_many(sizes[:3], path)
        _nifti_kind(header, axes, path)

    content = nifti_content(path, check)
    affine, (signs, positions) = nifti_affine(content.header, path), _nifti_kind(content.header, axes, path)
    with np.errstate(all="ignore"):  # what is not finite is none
        vectors = content.values.reshape(*content.values.shape[:3], 3) * signs * nifti_millimetres(content.header, path)
    if positions:
        vectors[~vectors.any(axis=-1)] = np.nan
        vectors -= _centres(vectors, affine)
    return vectors, affine, (content.sha256,)


def _nifti_kind(header: Any, axes: str, path: Path) -> tuple[NDArray[np.float64], bool]:
    """The signs that turn vectors to RAS, and whether they are positions, by what programs write as intent."""
    intent, name = int(header["intent_code"]), header["intent_name"].item().decode("latin-1")
    name = f"{name} {float(header['intent_p1']):g}" if name.startswith("NREG") else name
    if name in NAMES:
        return _signs("RAS", axes, path), NAMES[name]
    if intent in OF_FSL or name.startswith("NREG"):
        raise InputDataError(
            f"'{path}' holds no displacements in mm (intent {intent}, {printable(name)!r}); convert splines or"
            " velocities of NiftyReg by reg_transform -disp, a warp of FSL by wb_command -convert-warpfield -from-fnirt"
            ' ... -to-world, and state axes = "RAS"'
        )
    return _signs({DISPVECT: "RAS", VECTOR: axes or "LPS"}.get(intent, ""), axes, path), False


def _nrrd(path: Path, axes: str) -> Field:
    """Vectors in the measurement frame; where there is none, as ITK has them in LPS: the format leaves them open."""
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
    if len(components) != 3:
        raise InputDataError(f"'{path}' has {len(components)} components; export three")
    _refuse_many(components.shape[1:], path)
    return np.moveaxis(components, 0, -1) @ turn.T, array.affine, tuple(array.digests.values())


def _transform(path: Path, axes: str) -> Field:
    """The displacement of a transform on the finest grid of the fields that it holds.

    Others are maps without a grid, which a field must have. No number stands where a point's way leaves the grid of a
    field: beyond it ITK takes its displacement for none.
    """
    sitk = import_module("SimpleITK")
    digests = [_sha256(path)]
    _refuse_many((path.stat().st_size // IN_FILE,), path)
    xfm = path.name.lower().endswith(".xfm")
    signs = _signs("" if xfm else "LPS", axes, path)  # SimpleITK takes the numbers of MNI tools for LPS, too
    parts = _of_xfm(path, digests) if xfm else _of_file(path)
    images = {
        n: image
        for n, part in enumerate(parts)
        if part.GetName() == "DisplacementFieldTransform"
        and all((image := sitk.DisplacementFieldTransform(part).GetDisplacementField()).GetSize())
    }
    if not images:
        raise InputDataError(
            f"'{path}' holds no displacement field, or an inverted one ({', '.join(part.GetName() for part in parts)});"
            " write the transform as a field on the first image's grid"
        )
    grid = min(reversed(images.values()), key=lambda image: float(np.prod(image.GetSpacing())))
    _refuse_many(grid.GetSize(), path, OF_VECTOR + OF_PART * len(parts))
    whole, affine = _of_itk(grid if len(parts) == 1 else _on(parts, grid))
    for n, image in images.items() if len(parts) > 1 else ():
        moved, _ = _of_itk(_on(parts[n + 1 :], grid))  # by those that are applied before it
        own = np.linalg.inv(_of_itk(image)[1])
        place = (_centres(whole, affine) + moved * LPS_TO_RAS) @ own[:3, :3].T + own[:3, 3]
        inside = np.all((place > -ROUNDING) & (place < np.array(image.GetSize()) - 1.0 + ROUNDING), axis=-1)
        whole[~inside] = np.nan
    if np.isnan(whole).all():
        raise InputDataError(
            f"the {len(images)} fields of '{path}' have grids that no point's way keeps to; write the transform as one"
            " field on the first image's grid"
        )
    affine[:3] *= (signs * LPS_TO_RAS)[:, None]
    return whole * signs, affine, tuple(digests)


def _of_file(path: Path) -> list[Any]:
    """The transforms of a composite, of which the last one is applied first, or the one that a file of ITK holds."""
    sitk = import_module("SimpleITK")
    transform = sitk.ReadTransform(str(path))
    if transform.GetName() == "CompositeTransform":  # a file holds none within another
        composite = sitk.CompositeTransform(transform)
        return [composite.GetNthTransform(n) for n in range(composite.GetNumberOfTransforms())]
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        n = len(ONE_TRANSFORM.findall(content))
    if n > 1:  # of which SimpleITK gives the first
        raise InputDataError(f"'{path}' lists {n} transforms without their order; write them as one CompositeTransform")
    return [transform]


def _of_xfm(path: Path, digests: list[str]) -> list[Any]:
    """The transforms of an MNI file, which applies them in its order, the last one first; adds the digests of grids.

    SimpleITK gives one of several: it gets each in a file of its own.
    """
    parts = list[Any]()
    with TemporaryDirectory() as folder:
        for n, text in enumerate(re.split(r"(?m)^(?=Transform_Type)", read_text(path)[0])[1:]):
            part, grid = Path(folder, f"{n}.xfm"), re.search(r"Displacement_Volume\s*=\s*([^;]*?)\s*;", text)
            volume = (path.parent / (grid[1] if grid else path.name)).resolve()
            if not volume.is_relative_to(path.parent.resolve()):
                raise InputDataError(f"'{path}' names a grid outside its own folder, which is not read; put it there")
            digests += [_sha256(volume)] if grid else []
            own = text.replace(grid[1], str(volume)) if grid else text
            part.write_text(f"MNI Transform File\n{own}", encoding="utf-8")
            parts.insert(0, import_module("SimpleITK").ReadTransform(str(part)))
    return parts


def _on(parts: list[Any], grid: Any) -> Any:
    """The displacement of transforms, of which the last one is applied first, as an image on the grid of another."""
    sitk = import_module("SimpleITK")
    place = (grid.GetSize(), grid.GetOrigin(), grid.GetSpacing(), grid.GetDirection())
    whole = sitk.CompositeTransform([sitk.Transform(3, sitk.sitkIdentity), *parts])
    return sitk.TransformToDisplacementField(whole, sitk.sitkVectorFloat64, *place)


def _of_itk(image: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vectors (n_x, n_y, n_z, 3) as they are, and the affine from index to RAS mm, of an image that lies in LPS."""
    values = import_module("SimpleITK").GetArrayFromImage(image)
    affine = np.eye(4)
    affine[:3, :3] = LPS_TO_RAS[:, None] * np.array(image.GetDirection()).reshape(3, 3) * np.array(image.GetSpacing())
    affine[:3, 3] = LPS_TO_RAS * image.GetOrigin()
    return np.moveaxis(values, (0, 1, 2), (2, 1, 0)).astype(np.float64, copy=False), affine


def _centres(vectors: NDArray[np.float64], affine: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (n_x, n_y, n_z, 3) RAS mm of vectors on a grid."""
    return np.moveaxis(np.indices(vectors.shape[:3]), 0, -1) @ affine[:3, :3].T + affine[:3, 3]


READERS: dict[tuple[str, ...], Callable[[Path, str], Field]] = {
    (".nii", ".nii.gz"): _nifti,
    (".nrrd", ".nhdr"): _nrrd,
    (".mha", ".mhd"): _metaimage,
    (".h5", ".hdf5", ".tfm", ".txt", ".xfm", ".mat"): _transform,
}
