"""Closed surfaces as label images: the same voxels as of the bodies that they bound, whatever wrote them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from palpate.body.surface_labels import surface_labels
from palpate.cli import main
from palpate.errors import ConfigurationError, InputDataError, ResourceError
from palpate.images.label_image import VoxelGrid
from palpate.images.readers import read_label_image
from palpate.images.readers.stl import FACET

LPS = np.array([-1.0, -1.0, 1.0])
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
SIDES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
QUADS = np.array([[[a, b, c], [a, c, d]] for a, b, c, d in SIDES]).reshape(-1, 3)


def box(low, high):
    """Corners (12, 3, 3) of a box's triangles, outwards, RAS mm."""
    return (np.array(low) + (np.array(high) - low) * CUBE)[QUADS]


def stl(path, corners, *, heading=b"SPACE=RAS", text=False):
    if text:
        rows = "".join(
            "facet normal 0 0 0\nouter loop\n"
            + "".join("vertex {} {} {}\n".format(*corner) for corner in facet)
            + "endloop\nendfacet\n"
            for facet in corners.tolist()
        )
        path.write_text(f"solid {path.stem}\n{rows}endsolid\n")
        return path
    facets = np.zeros(len(corners), FACET)
    facets["corners"] = corners
    path.write_bytes(heading.ljust(80) + np.uint32(len(corners)).tobytes() + facets.tobytes())
    return path


@pytest.mark.parametrize("inwards", [False, True])
@pytest.mark.parametrize("text", [False, True])
def test_a_box_has_the_voxels_whose_centres_it_holds(tmp_path, text, inwards):
    corners = box([0.0, -5.0, 2.0], [10.0, 7.0, 8.0])
    found = surface_labels([stl(tmp_path / "organ.stl", corners[:, :: 1 - 2 * inwards], text=text)], margin_mm=5.0)
    image = found.image
    centres = image.grid.world(np.argwhere(image.labels == 1).astype(float))
    assert len(centres) == 10 * 12 * 6
    assert np.all((centres > [0.0, -5.0, 2.0]) & (centres < [10.0, 7.0, 8.0]))
    assert image.names == {1: "organ"}
    assert image.grid.shape == (20, 22, 16)
    assert found.volumes_mm3["organ"] == pytest.approx((720.0, 720.0))


@pytest.mark.parametrize(("heading", "axes"), [(b"SPACE=LPS", "RAS"), (b"", "LPS")])
def test_axes_are_those_of_the_heading_or_as_is_said(tmp_path, heading, axes):
    corners = box([1.0, 2.0, 3.0], [9.0, 9.0, 9.0])
    ours, theirs = (
        surface_labels([stl(tmp_path / f"{name}.stl", of, heading=head)], axes=axes).image
        for name, of, head in (("a", corners, b"SPACE=RAS"), ("b", corners * LPS, heading))
    )
    assert np.array_equal(ours.labels, theirs.labels)
    assert ours.grid.affine == pytest.approx(theirs.grid.affine)


def test_the_later_state_lies_on_the_grid_of_the_first_and_a_part_goes_to_itself(tmp_path):
    """A tumour stays whole in its gland, and the overlap is told."""
    gland, tumour = box([0.0] * 3, [20.0] * 3), box([5.0] * 3, [10.0] * 3)
    before = surface_labels([stl(tmp_path / "gland.stl", gland), stl(tmp_path / "tumour.stl", tumour)])
    (finding,) = before.image.findings
    assert finding.code == "overlap"
    assert np.count_nonzero(before.image.labels == 2) == 125
    after = surface_labels([stl(tmp_path / "gland.stl", gland + 3.0)], like=before.image.grid).image
    assert after.grid is before.image.grid
    moved = np.argwhere(after.labels == 1).mean(axis=0) - np.argwhere(before.image.labels > 0).mean(axis=0)
    assert moved == pytest.approx(np.full(3, 3.0))


def test_a_voxel_partly_inside_counts_by_its_centre(tmp_path):
    found = surface_labels(
        [stl(tmp_path / "organ.stl", box([0.0] * 3, [9.4, 9.6, 9.5]))], spacing_mm=2.0, margin_mm=4.0
    )
    sizes = np.ptp(np.argwhere(found.image.labels), axis=0) + 1
    assert sizes.tolist() == [5, 5, 5]
    assert found.volumes_mm3["organ"] == pytest.approx((9.4 * 9.6 * 9.5, 1000.0))


def test_what_is_no_closed_surface_is_refused(tmp_path):
    whole = box([0.0] * 3, [10.0] * 3)
    turned = np.concatenate([whole[:5, ::-1], whole[5:]])
    wrong = {
        "open": (stl(tmp_path / "open.stl", whole[1:]), "is not closed .3 edges of its 11 triangles"),
        "none": (tmp_path / "none.stl", "cannot be read"),
        "cut": (stl(tmp_path / "cut.stl", whole), "is not an STL"),
        "text": (stl(tmp_path / "text.stl", whole, text=True), "damaged text"),
        "nan": (stl(tmp_path / "nan.stl", np.where(whole == 10.0, np.nan, whole)), "too large for millimetres"),
        "empty": (stl(tmp_path / "empty.stl", whole[:0]), "is not closed"),
        "turned": (stl(tmp_path / "turned.stl", turned), "beside 9 of 18 edges of .* face opposite ways"),
    }
    wrong["cut"][0].write_bytes(wrong["cut"][0].read_bytes()[:-7])
    wrong["text"][0].write_text(wrong["text"][0].read_text().replace("10.0", "ten", 1))
    for path, words in wrong.values():
        with pytest.raises(InputDataError, match=words):
            surface_labels([path])


@pytest.mark.parametrize(
    ("factor", "shift", "words"),
    [
        (1e-3, 0.0, "1000 times as large it would be 27 mL: where the file is in metres, write --scale 1000"),
        (0.1, 0.0, "10 times as large it would be 27 mL: where the file is in centimetres, write --scale 10"),
        (0.05, 0.0, "has 0 voxels: it holds 0.00337 mL"),
        (1.0, 300.0, "has 0 voxels: .* check its unit and its axes"),
    ],
)
def test_an_organ_without_voxels_is_refused_with_what_to_write(tmp_path, factor, shift, words):
    path = stl(tmp_path / "organ.stl", box([5.0 + shift] * 3, [35.0 + shift] * 3) * factor)
    like = VoxelGrid((60, 60, 60), np.diag([2.0, 2.0, 2.0, 1.0]))
    with pytest.raises(InputDataError, match=words):
        surface_labels([path], like=like)
    if factor < 1.0:
        right = surface_labels([path], like=like, scale=1.0 / factor)
        assert np.count_nonzero(right.image.labels) == 15**3
        assert right.image.findings == ()


def test_files_too_large_by_their_unit_are_refused_with_what_to_write(tmp_path):
    with pytest.raises(ResourceError, match=r"0\.001 times as large it would be 27 mL.* write --scale 0\.001"):
        surface_labels([stl(tmp_path / "organ.stl", box([5e3] * 3, [35e3] * 3))])


def test_a_file_that_does_not_say_its_axes_beside_one_that_does_is_asked_for_them(tmp_path):
    a, b = box([0.0] * 3, [10.0] * 3), box([12.0] * 3, [20.0] * 3)
    paths = [stl(tmp_path / "a.stl", a * LPS, heading=b"SPACE=LPS"), stl(tmp_path / "b.stl", b * LPS, heading=b"")]
    with pytest.raises(InputDataError, match=r"a\.stl' says SPACE=LPS, that of '.*b\.stl' does not.* --axes LPS"):
        surface_labels(paths)
    found = surface_labels(paths, axes="LPS").image
    assert np.ptp(np.argwhere(found.labels), axis=0) == pytest.approx([19.0] * 3)


@pytest.mark.parametrize(
    ("pieces", "voxels", "codes"),
    [
        ([box([0.0] * 3, [10.0] * 3), box([20.0] * 3, [26.0] * 3)], 1216, ["islands"]),
        ([box([0.0] * 3, [10.0] * 3), box([20.0] * 3, [26.0] * 3)[:, ::-1]], 1216, ["overlap", "islands"]),
        ([box([0.0] * 3, [10.0] * 3), box([3.0] * 3, [7.0] * 3)[:, ::-1]], 936, ["islands"]),
        ([box([0.0] * 3, [10.0] * 3), box([1.0] * 3, [12.0] * 3)], 1602, ["overlap", "islands"]),
        ([box([0.0] * 3, [10.0] * 3)] * 2, 1000, ["overlap"]),
        ([box([-40.0] * 3, [10.0] * 3)], 27000, ["cut-by-border"]),
        ([box([0.0] * 3, [3.0] * 3)], 27, []),
    ],
)
@pytest.mark.parametrize("text", [False, True])
def test_pieces_of_a_surface_and_what_its_grid_cuts_are_told(tmp_path, pieces, voxels, codes, text):
    path = stl(tmp_path / "organ.stl", np.concatenate(pieces), heading=b"solid organ")
    path.write_bytes(path.read_bytes() + b"\0\0")  # what follows the last triangle is passed over
    if text:  # each piece as a solid of its own
        path.write_text("".join(stl(tmp_path / "piece", piece, text=True).read_text() for piece in pieces))
    affine = np.diag([1.0, 1.0, 1.0, 1.0])
    affine[:3, 3] = -19.5
    found = surface_labels([path], like=VoxelGrid((60, 60, 60), affine)).image
    assert np.count_nonzero(found.labels) == voxels
    assert [finding.code for finding in found.findings] == codes


def test_an_organ_that_another_one_takes_whole_is_refused(tmp_path):
    twice = [stl(tmp_path / f"{name}.stl", box([0.0] * 3, [10.0] * 3)) for name in "ab"]
    with pytest.raises(InputDataError, match="smaller organs claim all 1000 voxels of 'b'"):
        surface_labels(twice)


def test_a_text_too_large_to_be_taken_apart_is_refused_before_it_is(tmp_path):
    path = tmp_path / "large.stl"
    with path.open("wb") as file:
        file.write(b"solid large\n")
        file.truncate(2**26 + 1)
    with pytest.raises(InputDataError, match="export it as a binary STL"):
        surface_labels([path])


def test_names_that_stand_twice_and_grids_beyond_all_are_refused(tmp_path):
    (tmp_path / "other").mkdir()
    twice = [stl(folder / "organ.stl", box([0.0] * 3, [10.0] * 3)) for folder in (tmp_path, tmp_path / "other")]
    with pytest.raises(ConfigurationError, match="2 surfaces are given, with 1 different names"):
        surface_labels(twice)
    with pytest.raises(ResourceError, match="voxels"):
        surface_labels(twice[:1], spacing_mm=0.01)


def test_the_command_writes_an_image_and_a_table_that_a_case_takes(tmp_path, capsys):
    paths = [
        str(stl(tmp_path / "prostate.stl", box([0.0] * 3, [20.0] * 3))),
        str(stl(tmp_path / "rectum.stl", box([0.0, -30.0, 0.0], [20.0, -10.0, 20.0]))),
    ]
    out = tmp_path / "out"
    (tmp_path / "later_prostate").mkdir()
    assert main(["voxelise", *paths, "--spacing", "2", "--output", str(out), "--json", "--quiet"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["labels"] == {"1": "prostate", "2": "rectum"}
    image = read_label_image(out / "surfaces.nii.gz")
    assert np.count_nonzero(image.labels == 1) == 1000
    first, later = out / "surfaces.nii.gz", tmp_path / "later"
    moved = str(stl(tmp_path / "later_prostate" / "prostate.stl", box([2.0] * 3, [22.0] * 3)))
    assert main(["voxelise", moved, paths[1], "--like", str(first), "--output", str(later), "--quiet"]) == 0
    arguments = ["init", str(first), str(later / "surfaces.nii.gz")]
    assert main([*arguments, "--labels", str(out / "labels.json"), "--output", str(tmp_path / "case"), "--quiet"]) == 0
    assert 'role = "driver"' in (tmp_path / "case" / "case.toml").read_text()
    assert main(["voxelise", paths[0], str(tmp_path / "none.stl"), "--output", str(out), "--quiet"]) == 3
