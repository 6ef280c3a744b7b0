"""What images show before anything is computed: shifts, volumes, distances and shares in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from palpate.case.case import Case, CaseTissue, Domain, Images
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.mesh.anatomy import domain_box
from palpate.study.first_look import frame_look, tissue_looks

IMAGES = Images(Path("before.nii.gz"), (Path("after.nii.gz"),))
TISSUES_OF_CASE = (CaseTissue("gland", (1,), Role.ESTIMATE),)
TISSUES = (Tissue("gland", Role.ESTIMATE, (1,)), Tissue("rest", Role.KNOWN, (), youngs_modulus_kpa=1.0))


def block(start, size, *, shape=(40, 30, 20), spacing=2.0, origin=(0.0, 0.0, 0.0)):
    """A block of the gland in the rest, by voxels."""
    index = np.ones(shape, dtype=np.int16)
    index[tuple(slice(a, a + n) for a, n in zip(start, size, strict=True))] = 0
    affine = np.diag([spacing, spacing, spacing, 1.0])
    affine[:3, 3] = origin
    return Segmentation(index, VoxelGrid(shape, affine), TISSUES)


def test_shifts_volumes_and_the_way_to_the_frame_are_those_of_a_block():
    before, after = block((10, 5, 6), (6, 8, 4)), block((12, 4, 6), (6, 8, 6))
    gland, rest = tissue_looks(before, [after], domain_box([before.grid]))
    assert gland.volumes_ml == pytest.approx((192 * 8e-3, 288 * 8e-3))
    assert gland.shifts_mm[0] == pytest.approx([4.0, -2.0, 2.0])
    assert (gland.frame_mm, gland.towards) == (pytest.approx(10.0), "back")  # five voxels of 2 mm lie behind it
    assert (rest.middle, rest.frame_mm) == (None, None)


def test_an_organ_at_the_cut_lies_no_way_from_the_frame():
    before = block((10, 5, 16), (6, 8, 4))
    gland, _ = tissue_looks(before, [before], domain_box([before.grid]))
    assert (gland.frame_mm, gland.towards) == (0.0, "head")


@pytest.mark.parametrize(("boundary", "word"), [("fixed", "held still"), ("free", "is free"), ("moving", "may move")])
def test_what_holds_the_frame_is_told(boundary, word):
    tissues = (CaseTissue("gland", (1,), Role.ESTIMATE), CaseTissue("wall", (2,), Role.RIGID))
    case = Case("a", images=IMAGES, tissues=tissues, domain=Domain("margin", 6.0, boundary))
    before = block((10, 5, 6), (6, 8, 4))
    found = frame_look(case, before, [])
    assert found.box.lengths == pytest.approx([22.0, 26.0, 18.0])  # 6 mm beyond the middles of the outermost voxels
    assert "6 mm around organs" in found.held[0]
    assert word in found.held[1]
    assert "Rigid: wall" in found.held[2]


def test_a_later_image_of_half_the_field_shows_half_of_it():
    before, after = block((5, 5, 6), (6, 8, 4)), block((5, 5, 6), (6, 8, 4), shape=(20, 30, 20))
    first, second = frame_look(Case("a", images=IMAGES, tissues=TISSUES_OF_CASE), before, [after]).shared[0]
    assert first == pytest.approx(0.5, abs=0.02)
    assert second == 1.0
