"""Every one of the 48 ways to store an image gives the same body, in every format, as other programs see it."""

from __future__ import annotations

import itertools
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK
from numpy.typing import NDArray

from palpate.images.label_image import LabelImage
from palpate.images.readers import read_label_image

ORIENTATIONS = list(itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)))
SPACING = np.array([0.5, 1.0, 2.5])  # along right, front, head
ORIGIN_LPS = np.array([12.0, -7.0, 33.5])
LPS_TO_RAS = np.array([-1.0, -1.0, 1.0])


def stored(order: tuple[int, ...], signs: tuple[int, ...]) -> SimpleITK.Image:
    """Two unequal organs, stored with the axes in that order and direction (in LPS)."""
    values = np.zeros((6, 7, 8), dtype=np.uint8)  # right-left, ...: the order of SPACING
    values[1:3, 1:5, 2:6] = 1
    values[4:, 5:, 3:] = 2
    image = SimpleITK.GetImageFromArray(values.transpose(order)[tuple(slice(None, None, s) for s in signs)].T)
    direction = np.zeros((3, 3))
    direction[list(order), range(3)] = signs
    image.SetDirection(direction.ravel().tolist())
    image.SetSpacing(SPACING[list(order)].tolist())
    corner = np.zeros(3)
    for axis, sign in zip(order, signs, strict=True):
        corner[axis] = 0 if sign > 0 else (values.shape[axis] - 1) * SPACING[axis]
    image.SetOrigin((ORIGIN_LPS + corner).tolist())
    return image


def centroids_here(image: LabelImage) -> NDArray[np.float64]:
    return np.array([image.grid.world(np.argwhere(image.labels == k).astype(float)).mean(axis=0) for k in (1, 2)])


def centroids_by_itk(path: Path) -> NDArray[np.float64]:
    statistics = SimpleITK.LabelShapeStatisticsImageFilter()
    statistics.Execute(SimpleITK.ReadImage(str(path)))
    return np.array([statistics.GetCentroid(k) for k in (1, 2)]) * LPS_TO_RAS


def centroids_by_nibabel(path: Path) -> NDArray[np.float64]:
    image = nibabel.load(path)
    values = np.asarray(image.dataobj)
    return np.array([nibabel.affines.apply_affine(image.affine, np.argwhere(values == k).mean(axis=0)) for k in (1, 2)])


@pytest.mark.parametrize(("order", "signs"), ORIENTATIONS)
def test_all_formats_and_programs_see_the_organs_at_one_place(
    tmp_path: Path, order: tuple[int, ...], signs: tuple[int, ...]
) -> None:
    reference = stored((0, 1, 2), (1, 1, 1))
    SimpleITK.WriteImage(reference, str(tmp_path / "reference.nrrd"))
    wanted = read_label_image(tmp_path / "reference.nrrd", limits=None)
    for ending, packed in ((".nrrd", True), (".nhdr", False), (".mha", True), (".mhd", False), (".nii.gz", True)):
        path = tmp_path / f"a{ending}"
        SimpleITK.WriteImage(stored(order, signs), str(path), packed)
        image = read_label_image(path, limits=None)
        assert np.array_equal(image.labels, wanted.labels)
        assert np.array_equal(image.grid.affine, wanted.grid.affine)  # so estimates are the same to the last digit
        np.testing.assert_allclose(centroids_here(image), centroids_by_itk(path), atol=1e-5)
        np.testing.assert_allclose(centroids_here(image), centroids_here(wanted), atol=1e-5)
    np.testing.assert_allclose(centroids_here(wanted), centroids_by_nibabel(tmp_path / "a.nii.gz"), atol=1e-5)


@pytest.mark.parametrize("ending", [".nrrd", ".mha", ".nii.gz"])
def test_oblique_axes_and_slices_are_those_of_itk(tmp_path: Path, ending: str) -> None:
    image = stored((2, 0, 1), (-1, 1, 1))
    turn = SimpleITK.Euler3DTransform((0, 0, 0), 0.2, -0.1, 0.3).GetMatrix()
    direction = np.reshape(turn, (3, 3)) @ np.reshape(image.GetDirection(), (3, 3))
    image.SetDirection(direction.ravel().tolist())
    path = tmp_path / f"a{ending}"
    SimpleITK.WriteImage(image, str(path), True)
    ours = read_label_image(path, limits=None)
    for index in itertools.product((0, 5), (0, 4), (0, 3)):
        point = np.array(image.TransformIndexToPhysicalPoint(index)) * LPS_TO_RAS
        voxel = np.rint(ours.grid.index(point[None])[0]).astype(int)
        np.testing.assert_allclose(ours.grid.world(voxel[None].astype(float))[0], point, atol=1e-5)
        assert ours.labels[tuple(voxel)] == image[index]
