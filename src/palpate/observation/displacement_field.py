"""A measured displacement field: a vector image, a transform of ITK, or a table of points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.errors import ConfigurationError, InputDataError
from palpate.findings import Finding
from palpate.images.input_file import open_input
from palpate.images.label_image import LPS_TO_RAS
from palpate.images.tissue import Role
from palpate.mesh.locate import located
from palpate.mesh.space import LagrangeSpace
from palpate.observation.contract import DataFile, ReactionOf
from palpate.observation.measured_points import MeasuredPoints, PointTable, read_point_table, refuse_slips
from palpate.observation.point_displacement import PointDisplacement, point_displacement

FEWEST = 4  # points that tell a motion which is not the same everywhere
MOST_VECTORS = 2**26  # 1.6 GB as they are read
ROUNDING = 1e-6  # of a voxel
COARSER = 2  # times the edge of a cell is doubled, at the most
OF_LENGTH, OF_EDGE = 0.5, 0.6  # edge of a cell, over the correlation length and over an edge of the mesh


@dataclass(frozen=True, slots=True)
class DisplacementField(MeasuredPoints):
    """Points that are many, whose errors may be alike; implements `DataSource`."""

    def on(self, space: LagrangeSpace, reaction_of: ReactionOf) -> tuple[PointDisplacement, tuple[Finding, ...]]:
        """The term of the points in the mesh, in means of some that are near each other; raises `InputDataError`.

        What is nearer than half a correlation length, or six tenths of an edge, says the same. How an organ's stiffness
        moves what lies outside varies over as much as lies between (Saint-Venant): there means are of twice as much at
        each twofold distance.
        """
        del reaction_of
        places = located(space.mesh, self.table.before)
        inside = places.inside
        if self.file.paths[0].suffix.lower() == ".csv":
            refuse_slips(space, self.table.before, inside, self.file.paths[0])
        if not inside.any():
            raise InputDataError(
                f"no vector of '{self.file.paths[0]}' lies in the meshed body; give a field of this patient, in the"
                " world of the first image"
            )
        points, moved = self.table.before[inside], self.table.moved[inside]
        size = max(OF_LENGTH * self.file.correlation_mm, OF_EDGE * space.mesh.usual_edge_mm)
        mesh, sought = space.mesh, [n for n, t in enumerate(space.mesh.tissues) if t.role is Role.ESTIMATE]
        nodes = np.unique(mesh.tets[np.isin(mesh.region, sought)])
        away = np.asarray(cKDTree(mesh.nodes[nodes]).query(points)[0])
        level = np.minimum(np.floor(np.log2(np.maximum(away / size, 1.0))), COARSER)[:, None]
        term = point_displacement(
            space,
            points,
            moved,
            places.of(inside),
            file=self.file,
            description="the difference between the model's displacement and a measured field",
            cells=np.floor(np.hstack([(points - points.min(axis=0)) / (size * 2.0**level), level])).astype(np.int64),
        )
        return term, ()


def read_displacement_field(file: DataFile) -> DisplacementField:
    """Read a field that maps the first state to the later one, mm.

    .csv as landmarks have it; .nii, .nii.gz (intent 1006 or 1007); .nrrd, .mha, .mhd and transforms .h5, .tfm, .xfm,
    .mat, composites of several grids too, by SimpleITK, which the extra `itk` brings. Voxels without a finite vector,
    or whose vector is exactly 0, are taken for empty. Raises `InputDataError`.
    """
    path = file.paths[0]
    if len(file.paths) != 1:
        raise InputDataError(f"a displacement field is one file; {len(file.paths)} are named; leave out file_after")
    if path.suffix.lower() == ".csv":
        table = read_point_table(path)
        if len(table.before) < FEWEST:
            raise InputDataError(
                f"'{path}' holds {len(table.before)} of the {FEWEST} points or more that a displacement field has; give"
                ' all of them, or state single ones as kind = "landmarks"'
            )
        return DisplacementField(file, table)
    reader = next((read for endings, read in READERS.items() if path.name.lower().endswith(endings)), None)
    if reader is None:
        known = ", ".join(ending for endings in READERS for ending in endings)
        raise InputDataError(f"'{path}' is no kind of displacement field that is read; export one of .csv, {known}")
    try:
        with open_input(path) as stream:
            digest = stream.sha256()
    except (OSError, ValueError) as error:
        raise InputDataError(f"'{path}' cannot be read: {error}; check the path") from error
    vectors, affine = reader(path)
    flat = vectors.reshape(-1, 3) * (LPS_TO_RAS if file.axes == "LPS" else np.ones(3))
    given = np.isfinite(flat).all(axis=1) & flat.any(axis=1)
    if not given.any():
        raise InputDataError(f"'{path}' holds no vector but zeros; give a field that moves something")
    index = np.stack(np.unravel_index(np.flatnonzero(given), vectors.shape[:3]), axis=1).astype(np.float64)
    before = index @ affine[:3, :3].T + affine[:3, 3]
    table = PointTable(before, before + flat[given], ("",) * len(before), (digest,))
    return DisplacementField(file, table)


def _nifti(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    nibabel = import_module("nibabel")
    try:
        image = nibabel.load(path)
        shape = tuple(int(n) for n in image.shape)
    except Exception as error:  # nibabel raises what its formats raise
        raise InputDataError(f"'{path}' cannot be read as NIfTI: {error}; export it again") from error
    flat = (*shape[:3], *(n for n in shape[3:] if n != 1))
    if len(shape) < 4 or len(flat) != 4 or flat[3] != 3:
        raise InputDataError(f"'{path}' has the sizes {list(shape)}; export three axes and three components")
    _refuse_many(flat[:3], path)
    try:
        values = np.asarray(image.dataobj, dtype=np.float64)
    except Exception as error:
        raise InputDataError(f"'{path}' is damaged: {error}; export it again") from error
    return values.reshape(flat), np.asarray(image.affine, dtype=np.float64)


def _itk(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    sitk = _simpleitk(path)
    try:
        reader = sitk.ImageFileReader()
        reader.SetFileName(str(path))
        reader.ReadImageInformation()
        if reader.GetDimension() != 3 or reader.GetNumberOfComponents() != 3:
            raise InputDataError(
                f"'{path}' has {reader.GetDimension()} axes and {reader.GetNumberOfComponents()} components; a"
                " displacement field has three of both: export it so"
            )
        _refuse_many(reader.GetSize(), path)
        return _of_itk(sitk, reader.Execute())
    except RuntimeError as error:
        raise InputDataError(f"'{path}' cannot be read by SimpleITK: {str(error).splitlines()[-1]}") from error


def _transform(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The displacement of a transform on the finest grid of the fields that it holds.

    Others are maps without a grid, which a field must have. No number stands where a point's way leaves the grid of a
    field: beyond it ITK takes its displacement for none.
    """
    sitk = _simpleitk(path)
    try:
        transform = sitk.ReadTransform(str(path))
        parts = [transform]
        if transform.GetName() == "CompositeTransform":  # a file holds none within another
            composite = sitk.CompositeTransform(transform)
            parts = [composite.GetNthTransform(n) for n in range(composite.GetNumberOfTransforms())]
        images = {
            n: sitk.DisplacementFieldTransform(part).GetDisplacementField()
            for n, part in enumerate(parts)
            if part.GetName() == "DisplacementFieldTransform"
        }
        if not images:
            raise InputDataError(
                f"'{path}' holds no displacement field ({transform.GetName()}); write the transform as a field on the"
                " first image's grid"
            )
        grid = min(reversed(images.values()), key=lambda image: float(np.prod(image.GetSpacing())))
        _refuse_many(grid.GetSize(), path)
        whole, affine = _of_itk(sitk, _on(sitk, transform, grid))
        index = np.moveaxis(np.indices(whole.shape[:3]), 0, -1)
        points = (index @ affine[:3, :3].T + affine[:3, 3]) * LPS_TO_RAS
        for n, image in images.items():
            first = [sitk.Transform(3, sitk.sitkIdentity), *parts[n + 1 :]]  # the last one is applied first
            moved, _ = _of_itk(sitk, _on(sitk, sitk.CompositeTransform(first), grid))
            axes = np.array(image.GetDirection()).reshape(3, 3) * np.array(image.GetSpacing())
            place = (points + moved - np.array(image.GetOrigin())) @ np.linalg.inv(axes).T
            inside = np.all((place > -ROUNDING) & (place < np.array(image.GetSize()) - 1.0 + ROUNDING), axis=-1)
            whole[~inside] = np.nan
        if np.isnan(whole).all():
            raise InputDataError(
                f"the {len(images)} fields of '{path}' have grids that no point's way keeps to; write the transform as"
                " one field on the first image's grid"
            )
        return whole, affine
    except RuntimeError as error:
        raise InputDataError(f"'{path}' cannot be read by SimpleITK: {str(error).splitlines()[-1]}") from error


def _on(sitk: Any, transform: Any, grid: Any) -> Any:
    """The displacement of a transform as an image on the grid of another."""
    size, origin, spacing, direction = grid.GetSize(), grid.GetOrigin(), grid.GetSpacing(), grid.GetDirection()
    return sitk.TransformToDisplacementField(transform, sitk.sitkVectorFloat64, size, origin, spacing, direction)


def _of_itk(sitk: Any, image: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    values = np.moveaxis(sitk.GetArrayFromImage(image), (0, 1, 2), (2, 1, 0)).astype(np.float64)
    affine = np.eye(4)
    affine[:3, :3] = np.array(image.GetDirection()).reshape(3, 3) * np.array(image.GetSpacing())
    affine[:3, 3] = image.GetOrigin()
    return values, np.diag([*LPS_TO_RAS, 1.0]) @ affine


def _simpleitk(path: Path) -> Any:
    try:
        return import_module("SimpleITK")
    except ImportError as error:
        raise ConfigurationError(
            f"'{path}' is read by SimpleITK: pip install 'palpate[itk]', or write .nii.gz"
        ) from error


def _refuse_many(sizes: tuple[int, ...], path: Path) -> None:
    if np.prod([float(n) for n in sizes]) > MOST_VECTORS:
        raise InputDataError(
            f"'{path}' has {' x '.join(map(str, sizes))} vectors; resample it to {MOST_VECTORS} at most"
        )


READERS: dict[tuple[str, ...], Callable[[Path], tuple[NDArray[np.float64], NDArray[np.float64]]]] = {
    (".nii", ".nii.gz"): _nifti,
    (".nrrd", ".mha", ".mhd"): _itk,
    (".h5", ".tfm", ".xfm", ".mat"): _transform,
}
