"""A folder of masks is the label image that its files make up, whatever their order, overlap and mistakes."""

from __future__ import annotations

import hashlib
import os
from functools import partial
from itertools import permutations
from pathlib import Path

import nibabel
import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images import readers
from palpate.images.label_image import LabelImage
from palpate.images.label_table import CLASSES
from palpate.images.readers import mask_folder

read_label_image = partial(readers.read_label_image, limits=None)

SHAPE = (6, 5, 4)
AFFINE = np.array([[-2.0, 0, 0, 10], [0, -2.0, 0, 20], [0, 0, 3.0, 30], [0, 0, 0, 1]])


def box(low: int, high: int) -> NDArray[np.uint8]:
    """A slab of the first axis."""
    values = np.zeros(SHAPE, dtype=np.uint8)
    values[low:high] = 1
    return values


def save(folder: Path, affine: NDArray[np.float64] = AFFINE, **masks: NDArray[np.generic]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, values in masks.items():
        nibabel.save(nibabel.Nifti1Image(values, affine), folder / f"{name}.nii.gz")
    return folder


def by_name(image: LabelImage) -> dict[str, int]:
    return {name: int(np.count_nonzero(image.labels == label)) for label, name in image.names.items()}


def test_names_come_from_the_files_and_numbers_from_totalsegmentator(tmp_path: Path) -> None:
    folder = save(tmp_path / "masks", prostate=box(0, 2), urinary_bladder=box(3, 4), rectum=box(5, 6))
    (folder / "statistics.json").write_text("{}")
    (folder / ".hidden.nii.gz").write_bytes(b"")
    image = read_label_image(folder)
    assert image.names == {21: "urinary_bladder", 22: "prostate", 118: "rectum"}
    assert by_name(image) == {"urinary_bladder": 20, "prostate": 40, "rectum": 20}
    assert image.findings == ()
    np.testing.assert_allclose(image.grid.affine, [[2, 0, 0, 0], [0, 2, 0, 12], [0, 0, 3, 30], [0, 0, 0, 1]])


def test_names_of_total_mr_alone_get_its_numbers_and_unknown_ones_count_from_one(tmp_path: Path) -> None:
    both = save(tmp_path / "mr", vertebrae=box(0, 1), prostate=box(1, 2), lung_left=box(2, 3))
    assert read_label_image(both).names == {10: "lung_left", 17: "prostate", 19: "vertebrae"}
    assert read_label_image(save(tmp_path / "own", b=box(0, 1), a=box(1, 2))).names == {1: "a", 2: "b"}


def test_the_classes_have_the_numbers_of_both_tasks() -> None:
    assert (len(CLASSES["total"]), len(CLASSES["total_mr"])) == (117, 50)
    pelvis = {"urinary_bladder": (21, 16), "prostate": (22, 17), "colon": (20, 15), "sacrum": (25, 18)}
    pelvis |= {"femur_left": (75, 36), "femur_right": (76, 37), "hip_left": (77, 38), "hip_right": (78, 39)}
    assert {name: tuple(task[name] for task in CLASSES.values()) for name in pelvis} == pelvis
    assert CLASSES["total"]["costal_cartilages"] == 117
    assert CLASSES["total_mr"]["brain"] == 50


@pytest.mark.parametrize("order", list(permutations(("gland", "tumour", "body"))))
def test_a_contested_voxel_goes_to_the_smaller_organ_and_is_counted(tmp_path: Path, order) -> None:
    """That both lie in the body's mask is no overlap."""
    masks = {"gland": box(0, 4), "tumour": box(1, 2), "body": box(0, 6)}
    named = {f"{'abc'[i]}_{name}": masks[name] for i, name in enumerate(order)}
    image = read_label_image(save(tmp_path / "masks", **named))
    assert {name[2:]: n for name, n in by_name(image).items()} == {"tumour": 20, "gland": 60, "body": 40}
    (finding,) = image.findings
    assert finding.code == "overlap"
    assert finding.message.startswith("20 voxels belong to several masks")
    assert "body" not in finding.message


def test_digests_are_of_every_file_and_come_through_the_pipe(tmp_path: Path) -> None:
    folder = save(tmp_path / "masks", a=box(0, 3), b=box(2, 4))
    here, there = read_label_image(folder), readers.read_label_image(folder)
    expected = {n: hashlib.sha256((folder / n).read_bytes()).hexdigest() for n in ("a.nii.gz", "b.nii.gz")}
    assert here.digests == there.digests == expected
    assert here.findings == there.findings
    assert here.names == there.names
    assert np.array_equal(here.labels, there.labels)


def test_masks_may_be_empty_floats_or_of_another_single_value(tmp_path: Path) -> None:
    masks = {"a": box(0, 1) * np.uint8(255), "b": box(1, 3) * np.float32(0.9999), "c": box(0, 0)}
    assert by_name(read_label_image(save(tmp_path / "masks", **masks))) == {"a": 20, "b": 40, "c": 0}


def test_masks_that_cannot_be_are_refused_with_their_names_and_numbers(tmp_path: Path) -> None:
    folder = save(tmp_path / "values", prostate=box(0, 2) + box(1, 2))
    with pytest.raises(
        InputDataError, match=r"prostate\.nii\.gz' is no mask of one organ: of its 40 .* 20 have another"
    ):
        read_label_image(folder)
    folder = save(tmp_path / "sizes", a=box(0, 2), b=box(0, 2)[:5])
    with pytest.raises(InputDataError, match=r"'a\.nii\.gz' and 'b\.nii\.gz' .* \[6, 5, 4\] and \[5, 5, 4\] voxels"):
        read_label_image(folder)
    folder = save(save(tmp_path / "places", a=box(0, 2)), AFFINE + np.eye(4)[:, ::-1] * 0.5, b=box(0, 2))
    with pytest.raises(InputDataError, match="not on one grid: their corners lie up to"):
        read_label_image(folder)
    nibabel.save(nibabel.Nifti1Image(box(0, 1), AFFINE), save(tmp_path / "twice", a=box(0, 1)) / "a.nii")
    with pytest.raises(InputDataError, match="two masks of 'a'"):
        read_label_image(tmp_path / "twice")
    (tmp_path / "none").mkdir()
    with pytest.raises(InputDataError, match="holds 0 masks"):
        read_label_image(tmp_path / "none")


def test_counts_are_limited(tmp_path: Path) -> None:
    folder = save(tmp_path / "masks", a=box(0, 1))
    for number in range(mask_folder.MOST_MASKS):
        os.link(folder / "a.nii.gz", folder / f"{number}.nii.gz")
    with pytest.raises(InputDataError, match="holds 501 masks"):
        read_label_image(folder)
    for number in range(mask_folder.MOST_FILES - mask_folder.MOST_MASKS):
        (folder / f"{number}.txt").touch()
    with pytest.raises(InputDataError, match="over 10000 files"):
        read_label_image(folder)


def test_no_link_is_followed_out_of_the_folder(tmp_path: Path) -> None:
    other, folder = save(tmp_path / "other", a=box(0, 1)), save(tmp_path / "masks", a=box(0, 1))
    (folder / "b.nii.gz").symlink_to(folder / "a.nii.gz")
    assert by_name(read_label_image(folder))["b"] == 0  # all of its voxels are a's, too
    (folder / "c.nii.gz").symlink_to(other / "a.nii.gz")
    with pytest.raises(InputDataError, match=r"c\.nii\.gz' is a link to a file outside its folder"):
        read_label_image(folder)
    (folder / "c.nii.gz").unlink()
    os.mkfifo(folder / "d.nii.gz")
    with pytest.raises(InputDataError, match=r"d\.nii\.gz' cannot be read"):
        read_label_image(folder)


def test_a_segmentation_among_masks_and_a_folder_of_grey_images_are_refused(tmp_path: Path) -> None:
    folder = save(tmp_path / "masks", a=box(0, 1))
    head = "NRRD0004\ntype: uchar\ndimension: 3\nspace: RAS\nsizes: 2 2 2\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n"
    (folder / "b.seg.nrrd").write_bytes(f"{head}encoding: raw\nSegment0_Name:=x\n\n".encode() + b"\1" * 8)
    with pytest.raises(InputDataError, match="has 1 named segments"):
        read_label_image(folder)
    with pytest.raises(InputDataError, match="is a folder, not a grey image"):
        readers.read_intensities(folder)
