"""What stands behind the lines: every state's own picture, or none; and like over like where both are compared."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate.images.alignment import RigidMotion, moved
from palpate.images.label_image import VoxelGrid
from palpate.images.readers import write_scalar_image
from palpate.images.registration import Registration
from palpate.report.collect import collect
from palpate.report.section import cut_image
from palpate.report.slices import first_planes
from palpate.report.volume import grey_of, whole_box, whole_images


@pytest.fixture(scope="module")
def with_grey(case_result, tmp_path_factory):
    """The result with grey images of some states: the earlier one of the values 40, the later one of 90."""
    tmp_path = tmp_path_factory.mktemp("grey")

    @cache
    def given(*, before, after):
        grid = case_result.before.grid
        for name, value in (("before", 40.0), ("after", 90.0)):
            values = np.full(grid.shape, value)
            values[:2], values[2:4] = -900.0, 1500.0
            write_scalar_image(tmp_path / f"{name}.nii.gz", values, grid)
        images = dataclasses.replace(
            case_result.case.images,
            intensities_before=tmp_path / "before.nii.gz" if before else None,
            intensities_after=(tmp_path / "after.nii.gz",) if after else (),
        )
        return collect(dataclasses.replace(case_result, case=dataclasses.replace(case_result.case, images=images)))

    return given


def middle(volume):
    """The image's value in the middle of a grey volume."""
    step = volume.values[tuple(n // 2 for n in volume.values.shape)]
    return volume.span[0] + step * (volume.span[1] - volume.span[0]) / 1023


def test_every_state_shows_its_own_grey_image(with_grey):
    data = with_grey(before=True, after=True)
    assert middle(data.references[0].background) == pytest.approx(40.0, abs=2.1)
    assert middle(data.later[0].background) == pytest.approx(90.0, abs=2.1)
    assert [middle(volume) for volume in data.later[0].both] == pytest.approx([40.0, 90.0], abs=2.1)


def test_a_state_without_a_grey_image_shows_none_of_another_state(with_grey):
    data = with_grey(before=True, after=False)
    assert data.references[0].background.kind == "grey"
    assert data.later[0].background is None
    data = with_grey(before=False, after=True)
    assert data.references[0].background is None
    assert data.later[0].background.kind == "grey"


@pytest.mark.parametrize(("before", "after"), [(True, False), (False, True), (False, False)])
def test_the_alignment_lays_labels_over_labels_where_a_grey_image_is_missing(with_grey, before, after):
    assert [volume.kind for volume in with_grey(before=before, after=after).later[0].both] == ["labels", "labels"]


def test_without_any_grey_image_both_states_show_their_labels(case_result):
    data = collect(case_result)
    assert data.references[0].background.kind == data.later[0].background.kind == "labels"


def test_a_ct_opens_with_soft_tissue_in_its_window_and_keeps_the_rest(with_grey):
    volume = with_grey(before=True, after=False).references[0].background
    assert (volume.window, volume.unit) == ((-160.0, 240.0), "HU")
    assert volume.shade(np.array([0.0, 1023.0])).tolist() == [0.0, 1.0]
    step = (volume.span[1] - volume.span[0]) / 1023
    assert float(volume.shade(np.array((40.0 - volume.span[0]) / step))) == pytest.approx(0.5)
    assert volume.span[0] <= -900.0
    assert volume.span[1] >= 1500.0


def test_images_that_lie_on_each_other_but_for_rounding_look_the_same(case_result):
    image = case_result.before
    for step in (0.0, 1e-3, -1e-3):
        affine = image.grid.affine.copy()
        affine[:3, 3] += step
        nudged = dataclasses.replace(image, grid=VoxelGrid(image.grid.shape, affine))
        first, second = whole_images(whole_box(image), (image, None), (nudged, None))
        for plane in first_planes(whole_box(image)):
            shown = [cut_image(volume.values, volume.grid, plane, order=0) for volume in (first, second)]
            np.testing.assert_array_equal(*shown)


def test_a_grey_image_lies_where_the_label_image_beside_it_was_brought_to(case_result, tmp_path):
    """On whatever grid: a point that both show is one point afterwards."""
    motion = RigidMotion(Rotation.from_euler("z", 5.0, degrees=True).as_matrix(), np.array([4.0, -2.0, 1.0]))
    label = case_result.before
    grid = VoxelGrid((9, 8, 7), label.grid.affine @ np.diag([2.0, 2.0, 3.0, 1.0]))
    write_scalar_image(tmp_path / "grey.nii.gz", np.zeros(grid.shape), grid)
    grey = grey_of(tmp_path / "grey.nii.gz", Registration("surfaces", motion, np.zeros(3), 0.1))
    brought = moved(label, motion.inverse())
    places = np.array([[0.0, 0.0, 0.0], [3.0, 1.0, 2.0]])
    same = places * np.array([2.0, 2.0, 3.0])
    assert grey.grid.world(places) == pytest.approx(brought.grid.world(same), abs=1e-5)
