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
from palpate.images.readers.nifti import nifti_affine, nifti_content, nifti_millimetres
from palpate.images.readers.text_header import beside
from palpate.images.readers.voxel_stream import opened
from palpate.observation.measured_points import read_text

Field = tuple[NDArray[np.float64], NDArray[np.float64], tuple[str, ...]]
MEMORY = 8 * 2**30  # bytes that a field may take
OF_VECTOR, OF_PART = 144, 32  # bytes, until it is a pair of points; and for each transform of a file
IN_FILE = 24  # bytes of a vector, in most files of transforms
MAX_HEADER = 2**20
SIGNS = {"RAS": np.ones(3), "LPS": LPS_TO_RAS, "LAS": np.array([-1.0, 1.0, 1.0])}
UNITS = {"mm": 1.0, "millimeter": 1.0, "millimeters": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3, "microns": 1e-3}
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
        raise ConfigurationError(f"'{path}' is read by SimpleITK: pip install simpleitk, or write .nii.gz") from error
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
    vectors = content.values.reshape(*content.values.shape[:3], 3) * (signs * nifti_millimetres(content.header, path))
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
    told = {DISPVECT: "RAS", VECTOR: axes or "LPS"}.get(intent, "")
    return _signs(told, axes, path), False


def _image(path: Path, axes: str) -> Field:
    """An image of vectors, NRRD or MetaImage; of the latter ITK takes the vectors for LPS."""
    with opened(path) as file:
        head, digests = file.read(MAX_HEADER).decode("latin-1"), [file.sha256()]
    pairs = re.findall(r"(?m)^([\w ]{1,40}?)[ \t]*[:=](?!=)[ \t]*(.*?)\s*$", head)
    fields = {name.lower(): value for name, value in reversed(pairs)}  # the first of a name: behind them are voxels
    voxels = fields.get("data file") or fields.get("datafile") or fields.get("elementdatafile", "LOCAL")
    if voxels.upper() != "LOCAL":
        digests.append(_sha256(beside(path, voxels)))
    units = set(re.findall(r"\w+", fields.get("space units", fields.get("distanceunits", "")).lower())) or {"mm"}
    if len(units) != 1 or not units <= set(UNITS):
        raise InputDataError(f"'{path}' has lengths in {printable(str(sorted(units))[:60])}; export it in mm")
    turn = _of_nrrd(fields, axes, path) if head.startswith("NRRD") else np.diag(SIGNS[axes or "LPS"])
    reader, unit = import_module("SimpleITK").ImageFileReader(), UNITS[units.pop()]
    reader.SetFileName(str(path))
    reader.ReadImageInformation()
    n_axes, n_components = reader.GetDimension(), reader.GetNumberOfComponents()
    if (n_axes, n_components) != (3, 3):
        raise InputDataError(f"'{path}' has {n_axes} axes and {n_components} components; export three of both")
    _refuse_many(reader.GetSize(), path)
    vectors, affine = _of_itk(reader.Execute())
    affine[:3] *= unit
    return vectors @ (unit * turn.T), affine, tuple(digests)


def _of_nrrd(fields: dict[str, str], axes: str, path: Path) -> NDArray[np.float64]:
    """What turns the vectors of an NRRD file to RAS, (3, 3): its measurement frame, else its space where that is LPS.

    ITK takes vectors for LPS in every space; the format itself leaves them open where there is no frame.
    """
    words = fields.get("space", "").upper().split("-")
    space = "".join(word[:1] for word in words) if len(words) > 1 else words[0]
    if space not in SIGNS:
        raise InputDataError(
            f"'{path}' does not say where right, front and head are; export it in the space LPS or RAS"
        )
    if "measurement frame" not in fields:
        return np.diag(_signs(axes or ("LPS" if space == "LPS" else ""), axes, path))
    if axes:
        _signs("its measurement frame", axes, path)  # which refuses both
    columns = np.array([float(x) for x in re.findall(r"[^(),\s]+", fields["measurement frame"])]).reshape(3, 3)
    return np.asarray(SIGNS[space][:, None] * columns.T)


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
    parts = []
    with TemporaryDirectory() as folder:
        for n, text in enumerate(re.split(r"(?m)^(?=Transform_Type)", read_text(path)[0])[1:]):
            part, grid = Path(folder, f"{n}.xfm"), re.search(r"Displacement_Volume\s*=\s*([^;]*?)\s*;", text)
            volume = beside(path, grid[1]) if grid else path
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
    (".nrrd", ".nhdr", ".mha", ".mhd"): _image,
    (".h5", ".hdf5", ".tfm", ".txt", ".xfm", ".mat"): _transform,
}
