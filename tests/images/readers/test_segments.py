"""Segmentations of 3D Slicer: names and colours are kept, layers are merged, what cannot be is refused."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import nrrd
import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images import readers
from palpate.images.checks import check_pair
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.segmentation import segment
from palpate.images.tissue import Role, Tissue

read_label_image = partial(readers.read_label_image, limits=None)

SEGMENTS = (("left hip", "0 0.5 1"), ("bladder", "1 0 0.25"), ("rectum", "0.2 0.4 0.6"))


def organs() -> NDArray[np.uint8]:
    """Three organs (n_organs, 4, 5, 6) that do not overlap."""
    where = np.random.default_rng(5).integers(0, 4, (4, 5, 6))
    return np.stack([where == k for k in (1, 2, 3)]).astype(np.uint8)


def save(path: Path, values: NDArray[np.generic], entries: list[dict[str, object]]) -> Path:
    """As 3D Slicer writes it: the list of layers, if any, is the fastest axis."""
    directions: list[list[float]] = np.diag([-1.0, -1.0, 2.5]).tolist()
    layered = values.ndim == 4
    fields: dict[str, object] = {
        "space": "left-posterior-superior",
        "kinds": (["list"] if layered else []) + ["domain"] * 3,
        "space directions": np.array(([[np.nan] * 3] if layered else []) + directions),
        "space origin": np.zeros(3),
        "encoding": "gzip",
        "Segmentation_MasterRepresentation": "Binary labelmap",
    }
    for k, entry in enumerate(entries):
        fields |= {f"Segment{k}_{key}": str(value) for key, value in entry.items()}
    nrrd.write(str(path), values, fields)
    return path


def entries(layers: tuple[int, ...], values: tuple[int, ...]) -> list[dict[str, object]]:
    return [
        {
            "ID": f"Segment_{k}",
            "Name": name,
            "Color": colour,
            "Layer": layer,
            "LabelValue": value,
            "Extent": "0 3 0 4 0 5",
        }
        for k, ((name, colour), layer, value) in enumerate(zip(SEGMENTS, layers, values, strict=True))
    ]


def by_name(image: LabelImage) -> dict[str, NDArray[np.bool_]]:
    return {name: image.labels == label for label, name in image.names.items()}


def assert_same(image: LabelImage) -> None:
    found = by_name(image)
    assert list(found) == [name for name, _ in SEGMENTS]
    for mask, organ in zip(found.values(), organs(), strict=True):
        assert np.array_equal(mask, organ.astype(bool))
    assert list(image.colours.values()) == ["#0080ff", "#ff0040", "#336699"]
    np.testing.assert_allclose(image.grid.affine, np.diag([1.0, 1.0, 2.5, 1.0]))


def test_one_layer_keeps_its_label_values(tmp_path: Path) -> None:
    values = sum(organ * value for organ, value in zip(organs(), (7, 2, 9), strict=True))
    image = read_label_image(save(tmp_path / "a.seg.nrrd", values, entries((0, 0, 0), (7, 2, 9))))
    assert sorted(image.names) == [2, 7, 9]
    assert image.names[7] == "left hip"
    assert image.colours[2] == "#ff0040"
    assert np.array_equal(image.labels == 7, organs()[0].astype(bool))


def test_layers_without_overlap_become_one_label_image(tmp_path: Path) -> None:
    first = organs()
    two = np.stack([first[0] + 2 * first[2], first[1]])
    assert_same(read_label_image(save(tmp_path / "a.seg.nrrd", two, entries((0, 1, 0), (1, 1, 2)))))
    assert_same(read_label_image(save(tmp_path / "b.seg.nrrd", first, entries((0, 1, 2), (1, 1, 1)))))


def test_label_values_unique_over_layers_stay(tmp_path: Path) -> None:
    first = organs()
    two = np.stack([4 * first[0] + 6 * first[2], 5 * first[1]])
    image = read_label_image(save(tmp_path / "a.seg.nrrd", two, entries((0, 1, 0), (4, 5, 6))))
    assert image.names == {4: "left hip", 5: "bladder", 6: "rectum"}
    assert np.array_equal(image.labels, 4 * first[0] + 5 * first[1] + 6 * first[2])


def test_files_of_before_layers_are_read(tmp_path: Path) -> None:
    old = [{"ID": f"Segment_{k}", "Name": name, "Color": colour} for k, (name, colour) in enumerate(SEGMENTS)]
    assert_same(read_label_image(save(tmp_path / "a.seg.nrrd", organs(), old)))


def test_the_files_own_names_go_before_a_table_which_serves_where_it_has_none(tmp_path: Path) -> None:
    path = save(tmp_path / "a.seg.nrrd", organs(), entries((0, 1, 2), (1, 1, 1)))
    assert read_label_image(path, names={1: "liver"}).names[1] == "left hip"
    plain = save(tmp_path / "a.nrrd", organs()[0], [])
    assert read_label_image(plain, names={1: "liver"}).names == {1: "liver"}


def test_colours_reach_the_tissues(tmp_path: Path) -> None:
    image = read_label_image(save(tmp_path / "a.seg.nrrd", organs(), entries((0, 1, 2), (1, 1, 1))))
    tissues = (
        Tissue("bladder", Role.ESTIMATE, (2,)),
        Tissue("rest", Role.KNOWN, youngs_modulus_kpa=1.0),
        Tissue("hip", Role.RIGID, (1, 3), colour="#123456"),
    )
    assert [tissue.colour for tissue in segment(image, tissues).tissues] == ["#ff0040", None, "#123456"]


def test_one_number_that_means_two_organs_is_refused_and_a_name_finds_both(tmp_path: Path) -> None:
    tissues = (Tissue("bladder", Role.ESTIMATE, (2,)), Tissue("rest", Role.KNOWN, youngs_modulus_kpa=1.0))
    first, second = (
        read_label_image(save(tmp_path / f"{k}.seg.nrrd", organs(), entries(layers, (1, 1, 1))))
        for k, layers in enumerate([(0, 1, 2), (1, 0, 2)])
    )
    other = LabelImage(second.labels, second.grid, {1: "bladder", 2: "left hip", 3: "rectum"})
    with pytest.raises(InputDataError, match=r"called \['bladder'\] in 'before' and \['left hip'\] in 'after'"):
        check_pair(segment(first, tissues), segment(other, tissues))
    renumbered = (Tissue("bladder", Role.ESTIMATE, (1,)), tissues[1])
    with pytest.raises(InputDataError, match="same label image"):  # the right organ was found in both
        check_pair(segment(first, tissues), segment(other, renumbered))
    unnamed = LabelImage(first.labels, first.grid)
    with pytest.raises(InputDataError, match="same label image"):
        check_pair(segment(first, tissues), segment(unnamed, segment(first, tissues).tissues))


def change(number: int, **values: object) -> list[dict[str, object]]:
    changed = entries((0, 1, 2), (1, 1, 1))
    changed[number] |= values
    return changed


@pytest.mark.parametrize(
    ("described", "words"),
    [
        (change(1, Layer=0), "same label value"),
        (change(1, Layer=3), "3 layers"),
        (change(1, LabelValue=0), "whole number"),
        (change(1, LabelValue=-1), "whole number"),
        (change(1, LabelValue="1e5"), "whole number"),
        (change(1, Layer="x"), "whole number"),
        (change(1, LabelValue=2), "belong to no segment"),
        (change(1, Name="rectum"), "twice"),
        ([], "three axes"),
    ],
)
def test_a_segmentation_that_contradicts_itself_is_refused(
    tmp_path: Path, described: list[dict[str, object]], words: str
) -> None:
    path = save(tmp_path / "a.seg.nrrd", organs(), described)
    with pytest.raises(InputDataError, match=words) as caught:
        read_label_image(path)
    assert str(path) in str(caught.value)


def test_overlapping_layers_are_refused_with_the_names_and_the_count(tmp_path: Path) -> None:
    values = organs()
    values[1, values[0] == 1] = 1
    path = save(tmp_path / "a.seg.nrrd", values, entries((0, 1, 2), (1, 1, 1)))
    with pytest.raises(InputDataError, match=f"overlap in {int(values[0].sum())} voxels.*'left hip' and 'bladder'"):
        read_label_image(path)


def test_layers_of_floats_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.seg.nrrd", organs().astype(np.float32), entries((0, 1, 2), (1, 1, 1)))
    with pytest.raises(InputDataError, match="not labels"):
        read_label_image(path)


def test_names_from_a_header_are_cleaned_and_bad_colours_left_out(tmp_path: Path) -> None:
    described = change(0, Name="hip\x1b[2J REVERSEDleft", Color="2 0 0")
    described[1] |= {"Name": "", "Color": "red"}
    path = save(tmp_path / "a.seg.nrrd", organs(), described)
    path.write_bytes(path.read_bytes().replace(b"REVERSED", "\u202eß".encode()))
    image = read_label_image(path)
    assert image.names == {1: "hip?[2J ?ßleft", 2: "segment 2", 3: "rectum"}
    assert image.colours == {3: "#336699"}


FULL, FIRST = (9, 10, 11), np.array([2, 3, 4])  # the reference image's sizes, and where the segments begin in it
WHOLE = np.diag([1.0, 1.0, 2.5, 1.0])


def whole() -> NDArray[np.uint8]:
    labels = np.zeros(FULL, dtype=np.uint8)
    labels[2:6, 3:8, 4:10] = np.where(organs().any(axis=0), organs()[0] + 2 * organs()[1] + 3 * organs()[2], 0)
    labels[2, 3:8, 4:10] = labels[5, 3:8, 4:10] = 1  # all six sides of the box are reached
    labels[2, 3, 4] = 0
    return labels


def geometry(affine: NDArray[np.float64] = WHOLE, shape: tuple[int, ...] = FULL, begin: int = 0) -> str:
    """As 3D Slicer writes it, RAS, with the extent beginning elsewhere if it likes."""
    place = affine.copy()
    place[:3, 3] -= begin * affine[:3, :3].sum(axis=1)
    extent = [edge for n in shape for edge in (begin, begin + n - 1)]
    numbers = ";".join(f"{number:.15g}" for number in [*place.ravel(), *extent])
    return (
        f"Collapse labelmaps|1|Merge. 1 = shared.&Reference image geometry|{numbers};|Image geometry.&Smoothing|0.5|x&"
    )


def cropped(path: Path, box: NDArray[np.uint8], first: NDArray[np.int64], **keys: str) -> Path:
    lps = np.array([-1.0, -1.0, 1.0])
    fields = {
        "space": "left-posterior-superior",
        "space directions": np.diag(lps * [1.0, 1.0, 2.5]),
        "space origin": lps * (WHOLE[:3, :3] @ first),
        "encoding": "gzip",
        **{
            f"Segment{k}_{key}": str(v)
            for k in range(3)
            for key, v in (("Name", SEGMENTS[k][0]), ("LabelValue", k + 1))
        },
        **{f"Segmentation_{key}": value for key, value in keys.items()},
    }
    nrrd.write(str(path), box, fields)
    return path


def text(first: NDArray[np.int64]) -> str:
    return " ".join(map(str, first))


@pytest.mark.parametrize(("begin", "corner"), [(0, 1.0), (5, 1.0), (0, 0.0)])
def test_a_cropped_segmentation_is_completed_by_the_reference_geometry_in_it(
    tmp_path: Path, begin: int, corner: float
) -> None:
    place = np.diag([1.0, 1.0, 2.5, corner])
    box = whole()[2:6, 3:8, 4:10]
    keys = {"ReferenceImageExtentOffset": text(FIRST), "ConversionParameters": geometry(place, begin=begin)}
    image = read_label_image(cropped(tmp_path / "a.seg.nrrd", box, FIRST, **keys))
    assert np.array_equal(image.labels, whole())
    np.testing.assert_allclose(image.grid.affine, WHOLE, atol=1e-12)
    assert image.findings == ()


def test_without_it_the_image_begins_where_its_reference_does_and_says_that_it_ends_with_the_segments(
    tmp_path: Path,
) -> None:
    box = whole()[2:6, 3:8, 4:10]
    path = cropped(tmp_path / "a.seg.nrrd", box, FIRST, ReferenceImageExtentOffset=text(FIRST))
    image = read_label_image(path)
    assert np.array_equal(image.labels, whole()[:6, :8, :10])
    np.testing.assert_allclose(image.grid.affine, WHOLE, atol=1e-12)
    assert [finding.code for finding in image.findings] == ["cropped"]
    grey = VoxelGrid(FULL, WHOLE)
    completed = read_label_image(path, grid=grey)
    assert np.array_equal(completed.labels, whole())
    assert completed.findings == ()
    assert np.array_equal(readers.read_label_image(path, grid=grey).labels, whole())  # by a process of its own
    shifted = VoxelGrid(FULL, WHOLE + np.pad([[0.3]], ((0, 3), (3, 0))))
    assert [finding.code for finding in read_label_image(path, grid=shifted).findings] == ["cropped"]


@pytest.mark.parametrize(
    ("box", "keys", "codes"),
    [
        (np.s_[:, :, :], {"ReferenceImageExtentOffset": "0 0 0"}, []),
        (np.s_[:, :, :], {"ReferenceImageExtentOffset": "-3 0 0"}, []),  # segments went beyond the reference image
        (np.s_[:, :, :], {"ConversionParameters": geometry(shape=(9, 10, 9))}, []),
        (np.s_[:, :, :], {"ConversionParameters": geometry(WHOLE @ np.diag([2.0, 2.0, 2.0, 1.0]), (3, 3, 3))}, []),
        (np.s_[2:6, 3:8, 4:10], {"ReferenceImageExtentOffset": "0 0 0"}, ["cropped"]),
        (np.s_[2:6, 3:8, 4:10], {}, ["cropped"]),
        (np.s_[2:6, 3:8, 4:10], {"ConversionParameters": geometry(np.diag([0.7, 1, 2.5, 1]))}, ["cropped"]),
        (np.s_[2:6, 3:8, 4:10], {"ConversionParameters": "Reference image geometry|1;2;3|x&"}, ["cropped"]),
        (np.s_[2:6, 3:8, :], {}, []),
    ],
)
def test_what_can_be_known_of_a_crop_is_said(tmp_path: Path, box, keys: dict[str, str], codes: list[str]) -> None:
    first = np.array([side.start or 0 for side in box])
    image = read_label_image(cropped(tmp_path / "a.seg.nrrd", whole()[box], first, **keys))
    assert [finding.code for finding in image.findings] == codes
    assert np.array_equal(image.labels, whole()[box])


def test_absurd_extents_are_refused_before_memory_is_taken(tmp_path: Path) -> None:
    box = whole()[2:6, 3:8, 4:10]
    for keys in (
        {"ReferenceImageExtentOffset": "99999 99999 99999"},
        {"ConversionParameters": geometry(shape=(99999, 99999, 99999))},
    ):
        with pytest.raises(InputDataError, match="more than the"):
            read_label_image(cropped(tmp_path / "a.seg.nrrd", box, FIRST, **keys))
    with pytest.raises(InputDataError, match="before 2017"):
        read_label_image(cropped(tmp_path / "a.seg.nrrd", box, FIRST, Extent="2 5 3 7 4 9"))
