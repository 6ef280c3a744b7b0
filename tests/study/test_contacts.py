"""What organs do to each other in the images: contact, motion, sides; and what is refused for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.body.contacts import contact_findings, front_findings, motion_findings, sides_findings
from palpate.body.refusals import refuse_lost, refuse_unmeshable
from palpate.errors import GeometryError, InputDataError
from palpate.images.checks import wall_motion
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.segmentation import Segmentation, segment
from palpate.images.tissue import Role, Tissue

TISSUES = (
    Tissue("organ", Role.ESTIMATE, (1,)),
    Tissue("tube", Role.DRIVER, (2,)),
    Tissue("rest", Role.KNOWN, (), 0.45, 10.0),
)


def scene(*boxes, spacing: float = 1.0, tissues=TISSUES, shift: float = 0.0) -> Segmentation:
    """Boxes (tissue, (x0, x1), (y0, y1), (z0, z1)) in the rest, 24 voxels a side."""
    index = np.full((24, 24, 24), 2)
    for tissue, *spans in boxes:
        index[tuple(slice(*span) for span in spans)] = tissue
    affine = np.diag([spacing, spacing, spacing, 1.0])
    affine[:3, 3] = shift
    return Segmentation(index, VoxelGrid((24, 24, 24), affine), tissues)


ORGAN = (0, (6, 16), (6, 16), (6, 16))
TUBE = (1, (6, 16), (18, 22), (0, 24))


def test_a_free_organ_touches_nothing():
    assert contact_findings(scene(ORGAN, TUBE)) == ()


def test_one_face_of_a_cube_on_a_driver_is_a_sixth_of_its_surface():
    (finding,) = contact_findings(scene(ORGAN, (1, (6, 16), (16, 20), (6, 16))))
    assert finding.code == "touching"
    assert "'tube' (17%)" in finding.message
    assert "83%" in finding.message


def test_of_an_organ_that_a_driver_encloses_nothing_is_left_to_observe():
    (finding,) = contact_findings(scene((1, (4, 18), (4, 18), (4, 18)), ORGAN))
    assert finding.code == "touching"
    assert "so 0% of its surface is observed" in finding.message


def test_the_surface_of_a_void_is_free_and_observed():
    inside = scene((1, (4, 18), (4, 18), (4, 18)), ORGAN)
    void = [replace(tissue, role=Role.VOID) if i == 1 else tissue for i, tissue in enumerate(inside.tissues)]
    assert contact_findings(replace(inside, tissues=tuple(void))) == ()


@pytest.mark.parametrize("spacing", [1.0, 2.5])
def test_a_wall_that_moves_by_a_voxel_is_found_on_either_grid(spacing):
    before = scene((0, (6, 16), (6, 16), (2, 6)), (1, (2, 22), (8, 16), (8, 16)), spacing=spacing)
    after = scene((0, (6, 16), (6, 16), (2, 6)), (1, (2, 22), (7, 17), (7, 17)), spacing=spacing)
    assert wall_motion(before, after, 1) == pytest.approx(1.5 * spacing, rel=0.25)  # Cauchy's 2/3 is of round bodies
    assert motion_findings(before, after, "after") == ()


def test_a_wall_that_stands_still_is_below_the_noise():
    before = scene(ORGAN, TUBE)
    (finding,) = motion_findings(before, scene(ORGAN, TUBE, (1, (6, 8), (17, 18), (4, 8))), "after[2]")
    assert finding.code == "motion-below-noise"
    assert "after[2]" in finding.message


def test_a_load_moves_organs_so_that_nothing_else_has_to():
    before, after = scene(ORGAN, TUBE), scene((0, (7, 17), (6, 16), (6, 16)), TUBE)
    assert [finding.code for finding in motion_findings(before, after, "after")] == ["motion-below-noise"]
    assert motion_findings(before, after, "after", loaded=True) == ()
    (finding,) = motion_findings(before, before, "after", loaded=True)
    assert "'organ' 0 mm" in finding.message


def test_sides_that_are_exchanged_are_named():
    bones = (Tissue("left hip", Role.RIGID, (1,)), Tissue("right hip", Role.RIGID, (2,)), TISSUES[2])
    apart = [((2, 6), (18, 22)), ((18, 22), (2, 6))]  # +x is the patient's right
    images = [scene((0, one, (4, 8), (4, 8)), (1, other, (4, 8), (4, 8)), tissues=bones) for one, other in apart]
    assert sides_findings(images[0], "before") == ()
    assert [finding.code for finding in sides_findings(images[1], "before")] == ["sides-exchanged"]


def test_sides_of_bones_that_are_one_tissue_are_told_by_their_labels():
    tissues = (Tissue("bones", Role.RIGID, (1, 2)), Tissue("surroundings", Role.KNOWN, (), 0.45, 10.0))
    for one, other, found in ((1, 2, []), (2, 1, ["sides-exchanged"])):
        labels = np.zeros((24, 12, 12), dtype=np.int32)
        labels[2:6, 4:8, 4:8], labels[18:22, 4:8, 4:8] = one, other
        image = LabelImage(labels, VoxelGrid((24, 12, 12), np.eye(4)), {1: "hip_left", 2: "hip_right"})
        assert [finding.code for finding in sides_findings(segment(image, tissues), "before")] == found


def test_a_sacrum_in_front_of_the_bladder_is_named():
    tissues = (Tissue("Sacrum", Role.RIGID, (1,)), Tissue("urinary_bladder", Role.ESTIMATE, (2,)), TISSUES[2])
    apart = [((2, 6), (18, 22)), ((18, 22), (2, 6))]  # +y is the patient's front
    images = [scene((0, (4, 8), one, (4, 8)), (1, (4, 8), other, (4, 8)), tissues=tissues) for one, other in apart]
    assert front_findings(images[0], "before") == ()
    (finding,) = front_findings(images[1], "before")
    assert finding.code == "front-exchanged"
    assert "'Sacrum' lies in front of 'urinary_bladder'" in finding.message


@pytest.mark.parametrize(
    ("box", "words"),
    [((0, (6, 9), (6, 9), (6, 9)), "only 27 voxels"), ((0, (6, 16), (6, 16), (6, 7)), "nowhere two voxels thick")],
)
def test_what_has_no_inside_cannot_be_meshed(box, words):
    with pytest.raises(GeometryError, match=words):
        refuse_unmeshable(scene(box, TUBE), "before")


def test_an_organ_cannot_lose_half_its_volume_unless_the_border_cuts_it():
    before = scene(ORGAN, TUBE)
    with pytest.raises(InputDataError, match=r"volume of 'organ' changes by -50\.0%"):
        refuse_lost(before, scene((0, (6, 16), (6, 16), (6, 11)), TUBE), "after")
    refuse_lost(scene((0, (0, 10), (6, 16), (6, 16)), TUBE), scene((0, (0, 5), (6, 16), (6, 16)), TUBE), "after")


def test_an_organ_cannot_move_by_more_than_its_size():
    before = scene(ORGAN, TUBE)
    refuse_lost(before, scene(ORGAN, TUBE, shift=5.0), "after")
    with pytest.raises(InputDataError, match="moves by"):
        refuse_lost(before, scene(ORGAN, TUBE, shift=10.0), "after")
