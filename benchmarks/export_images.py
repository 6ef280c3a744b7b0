"""SimpleITK, nibabel, pydicom, highdicom and dcmqi read our images: every voxel's value, at its place."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
from export_rows import LPS, Results, Row, any_of, installed, missing, ran
from numpy.typing import NDArray

import palpate
from palpate.export import write_estimate_files
from palpate.images import VoxelGrid
from palpate.mesh import modulus_image, tissue_surface

Array = NDArray[np.float64]

WARP_MM = 0.05
OFF_GRID = 1e-3  # voxels, by which a place may lie off ours
SAME = 1e-6  # of a modulus, relative


def nifti(results: Results, folder: Path) -> Iterator[Row]:
    """Stiffness and labels by SimpleITK and nibabel; voxels outside the mesh are NaN."""
    sitk = importlib.import_module("SimpleITK")
    for (_, kind), result in results.items():
        if kind == "auto":
            continue
        write_estimate_files(result, folder / f"files-{kind}")
        for name in ("stiffness", "labels"):
            path = folder / f"files-{kind}" / f"{name}.nii.gz"
            ours = nibabel.load(path)
            expected = np.asarray(ours.dataobj, dtype=float)
            image = sitk.ReadImage(str(path), sitk.sitkFloat64)
            affine = np.eye(4)
            turn = np.reshape(image.GetDirection(), (3, 3)) * np.array(image.GetSpacing())
            affine[:3, :3], affine[:3, 3] = LPS[:, None] * turn, LPS * np.array(image.GetOrigin())
            found = sitk.GetArrayFromImage(image).transpose(2, 1, 0)
            known = np.isfinite(expected)
            wrong = int(np.count_nonzero(~np.isclose(found[known], expected[known], rtol=SAME)))
            wrong += misplaced(result.before.grid, found.shape, affine)
            part = f"SimpleITK {sitk.Version_VersionString()}"
            yield Row(part, f"{kind}, {name}.nii.gz: voxels of another value or place", wrong, 0)
            if not known.all():
                zeros = int(np.count_nonzero(found[~known] == 0.0))
                yield Row(
                    part,
                    f"{kind}, {name}.nii.gz: voxels of NaN that are read as other than 0",
                    (~known).sum() - zeros,
                    0,
                )


def misplaced(grid: VoxelGrid, shape: tuple[int, ...], affine: Array) -> int:
    """How many of the corners of an image of that affine, RAS mm, are not those of our grid."""
    ends = np.stack(np.meshgrid(*[[0.0, n - 1.0] for n in shape], indexing="ij"), axis=-1).reshape(-1, 3)
    off = np.abs(grid.index(ends @ affine[:3, :3].T + affine[:3, 3]) - ends)
    return int((off.max(axis=1) > OFF_GRID).sum()) if shape == grid.shape else len(ends)


def warp(results: Results, folder: Path) -> Iterator[Row]:
    """Points of before's surfaces through SimpleITK's transform to where the model has them, and back."""
    result, sitk = any_of(results), importlib.import_module("SimpleITK")
    palpate.export(result, folder / "warp", format="warp")
    space, displacement = result.space, result.estimation.displacements[-1]
    meshed = [i for i, tissue in enumerate(result.tissues) if tissue.meshed]
    faces = np.concatenate([tissue_surface(space.mesh, i).triangles for i in meshed])
    points = np.unique(space.facets(faces))
    before = space.points[points]
    after = before + displacement[points]
    if alignment := result.pairs[0].later[-1].alignment:
        after = alignment.motion.apply(after)
    for name, start, goal in (("warp", before, after), ("inverse_warp", after, before)):
        image = sitk.ReadImage(str(folder / "warp" / f"{name}.nii.gz"), sitk.sitkVectorFloat64)
        transform = sitk.DisplacementFieldTransform(image)
        found = np.array([transform.TransformPoint(p) for p in (start * LPS).tolist()]) * LPS
        rms = float(np.sqrt(((found - goal) ** 2).sum(axis=1).mean()))
        yield Row("SimpleITK", f"{name}: RMS distance of all surfaces' nodes to the model's", rms, WARP_MM, "mm")


def dicom(results: Results, folder: Path) -> Iterator[Row]:
    """Voxels of each modulus by pydicom, of each tissue by highdicom, both at their places by dcmqi."""
    highdicom, pydicom = importlib.import_module("highdicom"), importlib.import_module("pydicom")
    for (_, kind), result in results.items():
        if kind == "auto":
            continue
        place = folder / f"dicom-{kind}"
        palpate.export(result, place, format="dicom")
        stiffness = pydicom.dcmread(place / "stiffness.dcm")
        values = np.frombuffer(stiffness.FloatPixelData, dtype="<f4")
        moduli = [m for m in result.stiffness if np.isfinite(m)]
        found = sorted(set(np.unique(values).tolist()) - {0.0})
        off = max(abs(a / b - 1.0) for a, b in zip(found, sorted(set(moduli)), strict=True))
        yield Row("pydicom", f"{kind}, stiffness.dcm: relative difference of a modulus", off, SAME)
        segmentation = highdicom.seg.segread(place / "segmentation.dcm")
        names = {int(item.SegmentNumber): str(item.SegmentLabel) for item in segmentation.SegmentSequence}
        wrong = 0
        for number, name in names.items():
            volume = segmentation.get_volume(segment_numbers=[number], combine_segments=True)
            wrong += abs(int(np.count_nonzero(volume.array)) - int(np.count_nonzero(of_tissue(result, name))))
        yield Row("highdicom", f"{kind}, segmentation.dcm: voxels of a tissue lost or gained", wrong, 0)
        yield from by_dcmqi(result, place, kind, names)


def of_tissue(result: palpate.CaseResult, name: str) -> NDArray[np.bool_]:
    """Voxels (n_x, n_y, n_z) of a tissue in the first image."""
    return np.asarray(result.before.index == [tissue.name for tissue in result.tissues].index(name))


def by_dcmqi(result: palpate.CaseResult, place: Path, kind: str, names: dict[int, str]) -> Iterator[Row]:
    """Both objects as dcmqi's converters turn them into NIfTI, voxel by voxel at its place in our image."""
    program, other = (Path(sys.executable).parent / name for name in ("paramap2itkimage", "segimage2itkimage"))
    if installed("dcmqi") is None:
        yield from missing("dcmqi", f"{kind}: values and places")
        return
    ran([program, "--inputDICOM", place / "stiffness.dcm", "--outputDirectory", place, "-t", "nii"], place)
    expected = modulus_image(result.space.mesh, result.before.grid, result.stiffness)
    wrong = differing(result.before.grid, expected, place / "pmap.nii.gz")  # the name that dcmqi gives it
    yield Row("dcmqi", f"{kind}, stiffness.dcm: voxels of another value or place, of {expected.size}", wrong, 0)
    ran([other, "--inputDICOM", place / "segmentation.dcm", "--outputDirectory", place, "-t", "nii"], place)
    for number, name in names.items():
        wrong = differing(result.before.grid, number * of_tissue(result, name), place / f"{number}.nii.gz")
        yield Row("dcmqi", f"{kind}, segmentation.dcm, {name}: voxels lost, gained or displaced", wrong, 0)


def differing(grid: VoxelGrid, expected: NDArray[Any], path: Path) -> int:
    """How many voxels of `expected` (n_x, n_y, n_z) on our grid a NIfTI file has otherwise; all of an image off it."""
    image = nibabel.load(path)
    values = np.asarray(image.dataobj, dtype=float)
    index = np.argwhere(np.ones(values.shape, dtype=bool)).astype(float)
    places = grid.index(index @ image.affine[:3, :3].T + image.affine[:3, 3])
    near = np.rint(places).astype(int)
    if np.abs(places - near).max() > OFF_GRID or (near < 0).any() or (near >= np.array(grid.shape)).any():
        return expected.size
    found = np.zeros(expected.shape)
    found[tuple(near.T)] = values.ravel()
    return int(np.count_nonzero(~np.isclose(found, expected, rtol=SAME)))
