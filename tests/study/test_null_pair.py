"""Two drawings of one state: noise, its correlation length and the offset between them are found as they were made."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import palpate
from case_texts import ORGAN, REST, case_text
from palpate.cli import main
from palpate.errors import InputDataError
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers import write_label_image
from palpate.phantoms.motion import smooth_field
from palpate.study.null_pair import noise_of_drawings

GRID = VoxelGrid((56, 56, 56), np.eye(4))
CENTRE, RADIUS_MM = np.array([27.3, 27.6, 27.8]), 24.0
SEEDS = range(6)


@cache
def distances(seed, *, sd_mm, length_mm):
    """From the centre of a ball to the places (nx, ny, nz) of `GRID`, mm, as each of two drawings with noise has it."""
    away = GRID.world(np.argwhere(np.ones(GRID.shape, dtype=bool)).astype(float)) - CENTRE
    exact = np.linalg.norm(away, axis=1)
    near = np.abs(exact - RADIUS_MM) < 4.0 * sd_mm  # the noise moves no place so far
    drawn = []
    for rng in np.random.default_rng(seed).spawn(2):
        field, found = smooth_field(rng, sd_mm=sd_mm, correlation_mm=length_mm, features=500), exact.copy()
        found[near] = np.linalg.norm(field.warp(away[near]), axis=1)
        drawn.append(found.reshape(GRID.shape))
    return drawn


def drawing(distance, *, larger_mm=0.0, label=1) -> LabelImage:
    """A ball, drawn larger than it is."""
    return LabelImage(np.where(distance < RADIUS_MM + larger_mm, label, 0).astype(np.uint8), GRID, {label: "ball"})


def pair(seed, *, sd_mm=0.3, length_mm=6.0, **second):
    """Two drawings of one ball, the second one with options of its own."""
    one, other = distances(seed, sd_mm=sd_mm, length_mm=length_mm)
    return drawing(one), drawing(other, **second)


@pytest.mark.parametrize(("length_mm", "larger_mm"), [(6.0, 0.2), (4.0, 0.0)])
def test_what_was_drawn_with_known_noise_is_found(length_mm, larger_mm):
    found = [noise_of_drawings(*pair(s, length_mm=length_mm, larger_mm=larger_mm)).organs[0] for s in SEEDS]
    assert np.mean([each.surface_sd_mm for each in found]) == pytest.approx(0.3, rel=0.15)
    assert np.mean([each.correlation_length_mm for each in found]) == pytest.approx(length_mm, rel=0.3)
    assert np.mean([each.offset_mm for each in found]) == pytest.approx(larger_mm, abs=0.05)
    held = [each.offset_interval95[0] < larger_mm < each.offset_interval95[1] for each in found]
    assert sum(held) >= len(SEEDS) - 1


def test_a_larger_second_drawing_has_a_positive_offset_and_exchanging_them_turns_it_round():
    one, other = pair(0, larger_mm=0.8, sd_mm=0.1)
    forth, back = noise_of_drawings(one, other).organs[0], noise_of_drawings(other, one).organs[0]
    assert forth.offset_interval95[0] > 0.5
    assert back.offset_mm == pytest.approx(-forth.offset_mm, rel=0.05)
    assert back.surface_sd_mm == pytest.approx(forth.surface_sd_mm, rel=0.1)


def test_a_scan_that_lies_elsewhere_is_brought_back():
    first, second = pair(1)
    affine = np.eye(4)
    affine[:3, 3] = [7.3, -4.1, 2.2]
    shifted = replace(second, grid=VoxelGrid(GRID.shape, affine))
    still, brought = noise_of_drawings(first, second), noise_of_drawings(first, shifted)
    moved = brought.motion.apply(CENTRE[None])[0] - CENTRE
    assert moved == pytest.approx(affine[:3, 3], abs=0.3)
    assert brought.surface_sd_mm == pytest.approx(still.surface_sd_mm, rel=0.25)
    assert brought.organs[0].offset_mm == pytest.approx(still.organs[0].offset_mm, abs=0.05)
    assert noise_of_drawings(first, shifted, align="none").surface_sd_mm > 1.0


def test_organs_are_known_by_their_names():
    first, second = pair(2, label=5)
    assert [each.organ for each in noise_of_drawings(first, second).organs] == ["ball"]
    with pytest.raises(InputDataError, match="no organ in common"):
        noise_of_drawings(replace(first, names={}), replace(second, names={}))


def test_the_same_image_twice_tells_no_noise():
    first, _ = pair(0)
    with pytest.raises(InputDataError, match="the same label image, voxel by voxel"):
        noise_of_drawings(first, first)


def test_the_command_prints_blocks_that_a_case_takes(tmp_path, capsys):
    paths = [tmp_path / "a.nii.gz", tmp_path / "b.nii.gz"]
    for path, image in zip(paths, pair(3), strict=True):
        write_label_image(path, image)
    assert main(["noise", *map(str, paths), "--json", "--quiet"]) == 0
    document = json.loads(capsys.readouterr().out)
    blocks = tomllib.loads(document["toml"])
    assert blocks["noise"] == pytest.approx(document["noise"], rel=0.05)
    assert blocks["discrepancy"] == pytest.approx(document["discrepancy"], rel=0.05)
    assert main(["noise", *map(str, paths)]) == 0
    assert document["toml"] in capsys.readouterr().out
    (tmp_path / "case.toml").write_text(case_text({"ball": ORGAN, "rest": REST}) + document["toml"])
    read = palpate.read_case(tmp_path / "case.toml")
    assert read.noise.surface_sd_mm == pytest.approx(document["noise"]["surface_sd_mm"], rel=0.01)
    assert palpate.noise(*paths).to_dict() == document


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_an_image_in_another_unit_of_length_is_named_as_such(factor):
    one, other = pair(0)
    grid = VoxelGrid(GRID.shape, np.diag([factor, factor, factor, 1.0]))
    with pytest.raises(InputDataError, match="header seems to be in"):
        noise_of_drawings(replace(one, grid=grid), replace(other, grid=grid))
