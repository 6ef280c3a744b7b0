"""What is refused before any computation, and what is only told; each check can pass and can fail."""

from __future__ import annotations

import re
from dataclasses import replace
from importlib.resources import as_file, files

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.checks import (
    check_headers,
    check_images,
    check_pair,
    check_segmentation,
    refuse_absent,
    refuse_unit,
)
from palpate.images.label_image import VoxelGrid
from palpate.images.readers import read_label_image
from palpate.images.segmentation import Segmentation, segment
from palpate.images.tissue import Role, Tissue

TISSUES = (
    Tissue("surroundings", Role.KNOWN, (), youngs_modulus_kpa=10.0),
    Tissue("prostate", Role.ESTIMATE, (1,)),
    Tissue("bladder", Role.ESTIMATE, (2,)),
    Tissue("rectum", Role.DRIVER, (3,)),
    Tissue("hip", Role.RIGID, (4,)),
)
SHAPE = (60, 56, 48)
AFFINE = np.diag([1.0, 1.0, 1.5, 1.0])


def balls(
    grid: VoxelGrid, centres: dict[int, tuple[float, float, float]], radii: dict[int, float]
) -> NDArray[np.int16]:
    index = np.zeros(grid.shape, dtype=np.int16)
    places = grid.world(np.argwhere(index == 0).astype(float)).reshape(*grid.shape, 3)
    for number, centre in centres.items():
        index[((places - centre) ** 2).sum(axis=-1) < radii[number] ** 2] = number
    return index


CENTRES = {1: (20.0, 20.0, 30.0), 2: (24.0, 24.0, 50.0), 3: (22.0, 40.0, 34.0), 4: (48.0, 30.0, 40.0)}
RADII = {1: 8.0, 2: 10.0, 3: 8.0, 4: 8.0}


def body(
    *, shift: dict[int, tuple[float, float, float]] | None = None, radii: dict[int, float] | None = None
) -> Segmentation:
    grid = VoxelGrid(SHAPE, AFFINE)
    moved = {n: tuple(np.add(c, (shift or {}).get(n, (0.0, 0.0, 0.0)))) for n, c in CENTRES.items()}
    return Segmentation(balls(grid, moved, RADII | (radii or {})), grid, TISSUES)


BEFORE = body()
AFTER = body(shift={1: (0.0, -2.0, 1.0), 2: (0.0, -1.0, 1.0), 3: (0.0, 1.0, 0.0)}, radii={3: 9.0})


def codes(findings: tuple[Finding, ...]) -> list[str]:
    return [finding.code for finding in findings]


SPARE = (*TISSUES, Tissue("fat", Role.KNOWN, (9,), youngs_modulus_kpa=3.0))
SHIFTED = AFFINE + np.array([[0, 0, 0, 9.0], [0, 0, 0, -12.0], [0, 0, 0, 15.0], [0, 0, 0, 0]])
SOUND = {
    "as it is": (BEFORE, AFTER),
    "a known tissue is absent": (replace(BEFORE, tissues=SPARE), replace(AFTER, tissues=SPARE)),
    "the image lies elsewhere": (BEFORE, replace(AFTER, grid=VoxelGrid(SHAPE, SHIFTED))),
    "the driver has filled": (BEFORE, body(radii={3: 10.0})),
}


@pytest.mark.parametrize("name", SOUND)
def test_a_sound_pair_has_no_findings(name: str) -> None:
    before, after = SOUND[name]
    assert check_images(before, [after]) == ()


@pytest.mark.parametrize("offset", [0.0, 5.0])
def test_identical_images_are_refused_wherever_they_lie(offset: float) -> None:
    affine = AFFINE.copy()
    affine[0, 3] = offset
    with pytest.raises(InputDataError, match="the same label image"):
        check_pair(BEFORE, replace(BEFORE, grid=VoxelGrid(SHAPE, affine)))


@pytest.mark.parametrize("number", [1, 3, 4])
@pytest.mark.parametrize("where", ["before", "after"])
def test_an_absent_organ_is_refused_by_name_label_and_image(number: int, where: str) -> None:
    images = {"before": BEFORE, "after": AFTER}
    index = np.where(images[where].index == number, 0, images[where].index)
    images[where] = replace(images[where], index=index)
    with pytest.raises(InputDataError, match=rf"'{TISSUES[number].name}' \(label {number}, .*in '{where}'"):
        refuse_absent(images["before"], (images["after"],))


def test_images_without_a_common_part_are_refused_and_little_is_told() -> None:
    def beside(mm: float) -> Segmentation:
        affine = AFFINE.copy()
        affine[0, 3] = mm
        return replace(AFTER, grid=VoxelGrid(SHAPE, affine))

    with pytest.raises(InputDataError, match="do not overlap in space"):
        check_pair(BEFORE, beside(61.0))
    assert "little-in-common" in codes(check_pair(BEFORE, beside(40.0)))
    assert "little-in-common" not in codes(check_pair(BEFORE, beside(10.0)))


@pytest.mark.parametrize(("axes", "words"), [((0,), "left-right"), ((1,), "front-back"), ((0, 1), "left-right and fr")])
def test_a_mirrored_image_is_refused_with_its_axis(axes: tuple[int, ...], words: str) -> None:
    with pytest.raises(InputDataError, match=f"mirrored {words}"):
        check_pair(BEFORE, replace(AFTER, index=np.flip(AFTER.index, axes)))


def test_two_organs_that_exchanged_their_labels_are_named() -> None:
    index = AFTER.index.copy()
    index[AFTER.index == 1], index[AFTER.index == 2] = 2, 1
    with pytest.raises(InputDataError, match=r"'prostate' and 'bladder' look exchanged in 'after': .* which label is"):
        check_pair(BEFORE, replace(AFTER, index=index))


def test_a_void_inside_the_body_whose_wall_moves_is_told() -> None:
    tissues = tuple(replace(t, role=Role.VOID) if t.role is Role.DRIVER else t for t in TISSUES)
    before, after = (replace(image, tissues=tissues) for image in (BEFORE, body(radii={3: 10.0})))
    (finding,) = check_pair(before, after)
    assert finding.code == "void-moves"
    assert "role driver" in finding.message
    assert "void-moves" not in codes(check_pair(before, replace(body(shift={1: (0.0, -2.0, 1.0)}), tissues=tissues)))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_flip_of_a_real_nearly_symmetric_pelvis_is_noticed(axis: int) -> None:
    with as_file(files("palpate.demo") / "data" / "labels.nii.gz") as path:
        image = read_label_image(path)
    organs = (
        Tissue("prostate", Role.ESTIMATE, (1,)),
        Tissue("bladder", Role.ESTIMATE, (2,)),
        Tissue("rectum", Role.DRIVER, (3,)),
        Tissue("bones", Role.RIGID, (6, 7, 8, 9, 10)),
        Tissue("rest", Role.KNOWN, (), youngs_modulus_kpa=10.0),
    )
    before = segment(image, organs)
    flipped = replace(before, index=np.flip(before.index, axis))
    try:
        told = " ".join(finding.message for finding in check_pair(before, flipped))
    except InputDataError as error:
        told = str(error)
    assert f"mirrored {('left-right', 'front-back', 'head-foot')[axis]} against" in told


@pytest.mark.parametrize(
    ("radius", "code"), [(8.05, None), (8.5, "volume-change"), (7.5, "volume-change"), (9.2, "volume-implausible")]
)
def test_a_change_of_volume_is_told_by_its_size(radius: float, code: str | None) -> None:
    findings = check_pair(BEFORE, body(shift={3: (0.0, 1.0, 0.0)}, radii={1: radius}))
    assert codes(findings) == ([code] if code else [])
    assert all("prostate" in finding.message and "driver" in finding.message for finding in findings)
    for finding in findings:
        drawn = re.search(r"drawn ([0-9.]+) mm .* further (in|out)", finding.message)
        assert float(drawn[1]) == pytest.approx(abs(radius - 8.0), abs=0.05)
        assert (drawn[2] == "out") == (radius > 8.0)


@pytest.mark.parametrize(("radius", "asked"), [(9.0, False), (7.5, False), (6.0, True)])
def test_a_driver_that_empties_by_much_is_asked_about(radius: float, asked: bool) -> None:
    found = [f for f in check_images(BEFORE, [body(radii={3: radius})]) if f.code == "relaxed-state"]
    assert [("shrinks by" in f.message, "is 'before' the relaxed state?" in f.message) for f in found] == (
        [(True, True)] if asked else []
    )


def test_of_several_drivers_the_sum_tells_whether_they_empty() -> None:
    """A bladder that empties while a stomach fills by more is no sign of exchanged images."""
    drivers = tuple(replace(t, role=Role.DRIVER) if i == 2 else t for i, t in enumerate(TISSUES))
    before, after = (replace(image, tissues=drivers) for image in (BEFORE, body(radii={2: 11.5, 3: 6.0})))
    assert "relaxed-state" not in codes(check_images(before, [after]))


@pytest.mark.parametrize(("scale", "unit"), [(1e-3, "metres"), (1e3, "micrometres")])
def test_an_image_of_the_size_of_another_unit_is_refused(scale: float, unit: str) -> None:
    affine = AFFINE * scale
    affine[3, 3] = 1.0
    with pytest.raises(InputDataError, match=f"seems to be in {unit}"):
        refuse_unit(VoxelGrid(SHAPE, affine), "before")
    refuse_unit(VoxelGrid(SHAPE, AFFINE), "before")


def test_an_organ_that_moves_further_than_its_size_is_told() -> None:
    findings = check_pair(BEFORE, body(shift={1: (-9.0, -10.0, -12.0)}))
    assert "large-shift" in codes(findings)
    assert "prostate" in findings[-1].message


def test_a_shift_of_the_whole_body_is_no_organs_shift() -> None:
    affine = AFFINE.copy()
    affine[0, 3] = 25.0
    assert "large-shift" not in codes(check_pair(BEFORE, replace(AFTER, grid=VoxelGrid(SHAPE, affine))))


def test_a_cut_organ_is_told_with_the_share_of_the_cut() -> None:
    index = np.zeros((20, 20, 20), dtype=np.int16)
    index[5:15, 5:15, :10] = 1
    (finding,) = check_segmentation(Segmentation(index, VoxelGrid((20, 20, 20), np.eye(4)), TISSUES), "before")
    assert finding.code == "cut-by-border"
    assert "16.7%" in finding.message


@pytest.mark.parametrize(("thickness", "thin"), [(1, True), (3, True), (4, False), (8, False)])
def test_a_part_thinner_than_four_voxels_is_told(thickness: int, thin: bool) -> None:
    index = np.zeros((30, 30, 30), dtype=np.int16)
    index[5:25, 5:25, 10 : 10 + thickness] = 1
    findings = check_segmentation(Segmentation(index, VoxelGrid((30, 30, 30), np.eye(4)), TISSUES), "before")
    assert codes(findings) == (["thin"] if thin else [])


def test_an_organ_that_goes_on_beyond_the_image_is_not_called_thin() -> None:
    index = np.zeros((30, 30, 30), dtype=np.int16)
    index[5:25, 5:25, :3] = 1
    findings = check_segmentation(Segmentation(index, VoxelGrid((30, 30, 30), np.eye(4)), TISSUES), "before")
    assert codes(findings) == ["cut-by-border"]


def test_stray_voxels_and_tiny_organs_are_told() -> None:
    index = BEFORE.index.copy()
    index[1, 1, 1] = 1
    index[index == 3] = 0
    index[10:13, 40:43, 10:13] = 3
    findings = check_segmentation(replace(BEFORE, index=index), "before")
    assert codes(findings) == ["islands", "too-small"]


def test_a_tissue_of_a_left_and_a_right_label_has_two_pieces() -> None:
    index = np.zeros((40, 30, 30), dtype=np.int16)
    index[4:16, 5:25, 5:25] = index[24:36, 5:25, 5:25] = 1
    both = (TISSUES[0], replace(TISSUES[1], labels=(1, 9)), *TISSUES[2:])
    image = Segmentation(index, VoxelGrid((40, 30, 30), np.eye(4)), both)
    assert codes(check_segmentation(image, "before")) == []
    assert codes(check_segmentation(replace(image, tissues=TISSUES), "before")) == ["islands"]
    index[1, 1, 1] = 1
    assert codes(check_segmentation(replace(image, index=index), "before")) == ["islands"]


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_voxels_in_metres_or_micrometres_are_told(scale: float) -> None:
    affine = AFFINE * scale
    affine[3, 3] = 1.0
    assert "voxel-size" in codes(check_segmentation(replace(BEFORE, grid=VoxelGrid(SHAPE, affine)), "before"))


def test_segmentations_into_different_tissues_are_refused() -> None:
    with pytest.raises(InputDataError, match="different tissues"):
        check_pair(BEFORE, replace(AFTER, tissues=TISSUES[:4]))


def test_findings_name_the_later_state_they_are_about() -> None:
    findings = check_images(BEFORE, [AFTER, body(radii={1: 8.6})])
    assert codes(findings) == ["volume-change"]
    assert "'after[2]'" in findings[0].message


@pytest.mark.parametrize(
    ("spacing", "origin", "expected"),
    [
        ((1.0, 1.0, 1.01), (0.0, 0.0, 0.0), ["spacing-nearly-same"]),
        ((1.0, 1.0, 1.0001), (0.0, 0.0, 0.0), []),  # as NIfTI's single precision rounds
        ((1.0, 1.0, 3.0), (0.0, 0.0, 0.0), []),
        ((1.0, 1.0, 1.0), (0.5, 0.5, -0.5), ["half-voxel"]),
        ((1.0, 1.0, 1.0), (0.0, 0.5, 0.0), ["half-voxel"]),
        ((1.0, 1.0, 1.0), (0.2, 0.5, 0.0), []),
        ((1.0, 1.0, 1.0), (7.5, 0.5, 0.0), []),  # another field of view
    ],
)
def test_slips_in_headers_are_named(spacing, origin, expected):
    later = np.diag([*spacing, 1.0])
    later[:3, 3] = origin
    grids = VoxelGrid((40, 40, 40), np.eye(4)), VoxelGrid((40, 40, 40), later)
    assert [finding.code for finding in check_headers(*grids, "after")] == expected
