"""DICOM segmentations: volumes, places, names and colours are those of what was written; nothing of a patient is."""

from __future__ import annotations

import hashlib
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pydicom
import pytest
from numpy.typing import NDArray
from pydicom.dataset import Dataset

from case_texts import REST, case_text
from dicom_files import TILTED, axes_of, ct_slices, save_contours, save_segmentation, save_series, traced
from palpate.body.read import read_segmentation
from palpate.case.file import read_case
from palpate.errors import InputDataError, ResourceError
from palpate.images import readers
from palpate.images.label_image import LabelImage, VoxelGrid

read_label_image = partial(readers.read_label_image, limits=None)

SHAPE = (14, 40, 36)  # slices, rows, columns
SPACING = (3.0, 1.5, 1.2)
ORIGIN = (-30.0, -70.0, 12.0)  # LPS mm
series = partial(ct_slices, SHAPE, SPACING, ORIGIN)
NAMES = {1: ("prostate", "#804020"), 2: ("Blase ü", "#20c040"), 3: ("tumour", "#4060ff")}


def masks() -> dict[int, NDArray[np.bool_]]:
    """Asymmetric organs (slices, rows, columns) that do not overlap; the first has a hole."""
    k, j, i = (axis * step for axis, step in zip(np.indices(SHAPE), SPACING, strict=True))
    prostate = ((k - 20) / 12) ** 2 + ((j - 20) / 13) ** 2 + ((i - 18) / 11) ** 2 < 1
    hole = ((k - 20) / 7) ** 2 + ((j - 20) / 5) ** 2 + ((i - 18) / 4) ** 2 < 1
    bladder = ((k - 22) / 9) ** 2 + ((j - 46) / 10) ** 2 + ((i - 24) / 14) ** 2 < 1
    tumour = ((k - 12) / 5) ** 2 + ((j - 20) / 4) ** 2 + ((i - 32) / 5) ** 2 < 1
    return {1: prostate & ~hole, 2: bladder & ~prostate, 3: tumour & ~prostate & ~bladder}


def assert_same(
    image: LabelImage, volume_within: float, orientation: str = "axial", organs: dict | None = None
) -> None:
    """Names, volumes, and centroids within 0.1 mm, against what was written."""
    axes, origin = axes_of(series(orientation))
    assert image.names == {number: name for number, (name, _) in NAMES.items()}
    for number, mask in (organs or masks()).items():
        found = image.labels == number
        volume = np.count_nonzero(found) * image.grid.voxel_volume
        assert volume == pytest.approx(np.count_nonzero(mask) * np.prod(SPACING), rel=volume_within)
        centroid = image.grid.world(np.argwhere(found).mean(axis=0, keepdims=True))[0]
        truth = (np.argwhere(mask).mean(axis=0) @ axes + origin) * [-1, -1, 1]
        np.testing.assert_allclose(centroid, truth, atol=0.1)


@pytest.mark.parametrize("kind", ["BINARY", "LABELMAP"])
@pytest.mark.parametrize("orientation", TILTED)
def test_a_segmentation_has_the_volumes_and_places_that_were_written(
    tmp_path: Path, kind: str, orientation: str
) -> None:
    path = save_segmentation(tmp_path / "a.dcm", series(orientation), kind, NAMES, masks())
    assert_same(read_label_image(path), 0.001, orientation)


def test_a_segmentation_is_read_by_a_process_of_its_own_with_colours_and_whatever_name(tmp_path: Path) -> None:
    path = save_segmentation(tmp_path / "a.dcm", series(), "BINARY", NAMES, masks())
    path = path.rename(tmp_path / "IM0001")
    image = readers.read_label_image(path)
    assert_same(image, 0.001)
    assert image.digests == {"": hashlib.sha256(path.read_bytes()).hexdigest()}
    for number, (_, colour) in NAMES.items():
        there, written = (np.frombuffer(bytes.fromhex(c[1:]), np.uint8) for c in (image.colours[number], colour))
        np.testing.assert_allclose(there.astype(int), written, atol=2)  # CIELab in 16 bits is not RGB


def test_slices_left_out_are_filled_from_the_series_beside_or_warned_of(tmp_path: Path) -> None:
    slices = series()
    path = save_segmentation(tmp_path / "a.dcm", slices, "BINARY", NAMES, masks())
    alone = read_label_image(path)
    (finding,) = alone.findings
    assert finding.code == "cropped"
    save_series(tmp_path / "ct", slices[::-1])
    whole = read_label_image(path)
    assert (alone.labels.shape, whole.labels.shape) == ((36, 40, 8), (36, 40, 14))
    assert whole.findings == ()
    assert sorted(whole.digests) == ["", "series"]
    assert_same(whole, 0.001)


def test_segments_that_overlap_go_to_the_smaller_one(tmp_path: Path) -> None:
    organs = masks()
    organs[2] = organs[2] | organs[3]
    image = read_label_image(save_segmentation(tmp_path / "a.dcm", series(), "BINARY", NAMES, organs))
    assert "overlap" in [finding.code for finding in image.findings]
    assert_same(image, 0.001)


def test_a_fractional_segmentation_is_refused(tmp_path: Path) -> None:
    path = save_segmentation(tmp_path / "a.dcm", series(), "FRACTIONAL", NAMES, masks())
    with pytest.raises(InputDataError, match="is a fractional segmentation"):
        read_label_image(path)


@pytest.mark.parametrize("level", [0.5, 0.9995])
@pytest.mark.parametrize("orientation", TILTED)
def test_contours_have_the_volumes_and_places_that_were_drawn(tmp_path: Path, level: float, orientation: str) -> None:
    slices = series(orientation)
    save_series(tmp_path / "ct", slices)
    path = save_contours(tmp_path / "a.dcm", slices, NAMES, {n: traced(mask, level) for n, mask in masks().items()})
    image = read_label_image(path)
    assert_same(image, 0.01, orientation)
    assert image.colours == {number: colour for number, (_, colour) in NAMES.items()}
    assert image.findings == ()
    assert sorted(image.digests) == ["", "series"]


def test_contours_of_sparser_or_finer_planes_make_slices_which_are_named(tmp_path: Path) -> None:
    """The ends reach half the planes' distance further: as many voxels as the slabs round the planes hold."""
    slices = series()
    save_series(tmp_path / "ct", slices)
    square = np.array([[0, 9.5, 9.5], [0, 9.5, 19.5], [0, 29.5, 19.5], [0, 29.5, 9.5]])
    cases = (
        ((2, 4, 6), 6, "2 interpolated, at S = 21, 27 mm; contours every 6 mm"),
        (np.arange(2, 6.1, 0.5), 5, ""),
        ((2.5, 3.5), 2, "1 interpolated, at S = 21 mm; contours every 3 mm"),
        ((4,), 1, ""),
        ((2, 3, 5, 6), 5, "1 interpolated, at S = 24 mm"),
        ((2, 3, 4, 9, 10), 5, "4 left empty, too far from the next, at S = 27, 30, 33 and 1 more mm"),
    )
    for planes, expected, words in cases:
        lines = [(np.add(square, [k, 0, 0]), "CLOSED_PLANAR") for k in planes]
        image = read_label_image(save_contours(tmp_path / "a.dcm", slices, NAMES, {1: lines}))
        layers = np.count_nonzero(image.labels, axis=(0, 1))
        assert layers.sum() == expected * 200
        assert np.average(np.arange(SHAPE[0]), weights=layers) == pytest.approx(np.mean(planes))
        assert [finding.code for finding in image.findings] == ["sparse-contours"] * bool(words)
        assert all(f"'prostate' ({words}" in finding.message for finding in image.findings)


def test_contours_that_enclose_nothing_are_left_out_and_warned_of(tmp_path: Path) -> None:
    slices = series()
    save_series(tmp_path, slices)
    square = np.array([[3, 9.5, 9.5], [3, 9.5, 19.5], [3, 29.5, 19.5], [3, 29.5, 9.5]])
    lines = [(square, "CLOSED_PLANAR"), (np.add(square, [1, 0, 0]), "OPEN_PLANAR"), (square[:2], "CLOSED_PLANAR")]
    lines += [(square[:1], "POINT"), (square[::-1], "CLOSED_PLANAR")]
    below = [(np.add(square, [-9, 0, 0]), "CLOSED_PLANAR")]
    image = read_label_image(save_contours(tmp_path / "a.dcm", slices, NAMES, {1: lines, 2: [], 3: below}))
    assert np.count_nonzero(image.labels) == 200
    (finding,) = image.findings
    assert finding.code == "open-contours"
    assert "'prostate' (1 open and 2 with under 3 points and 1 twice in the file)" in finding.message
    assert "'Blase ü' (none on this series) and 1 more" in finding.message
    (finding,) = read_label_image(save_contours(tmp_path / "b.dcm", slices, NAMES, {1: lines, 3: below})).findings
    assert "'tumour' (100.0% of its points beyond the series and no voxel)" in finding.message


def test_names_that_stand_twice_series_without_uid_and_structures_of_another_series(tmp_path: Path) -> None:
    slices, other = series(), series("sagittal")
    for number, each in enumerate((slices, other)):
        save_series(tmp_path / f"ct{number}", each)
    lines = {n: traced(mask, 0.5) for n, mask in masks().items()}
    twice = NAMES | {2: NAMES[1]}
    ds = pydicom.dcmread(save_contours(tmp_path / "a.dcm", slices, twice, lines))
    frames = [Dataset(), ds.ReferencedFrameOfReferenceSequence[0]]  # that of the other series stands first, without it
    for roi, frame in zip(ds.StructureSetROISequence, "BBA", strict=True):
        roi.ReferencedFrameOfReferenceUID = f"1.{ord(frame)}"
    frames[0].FrameOfReferenceUID, frames[1].FrameOfReferenceUID = "1.65", "1.66"
    ds.ReferencedFrameOfReferenceSequence = frames
    ds.save_as(tmp_path / "a.dcm")
    image = read_label_image(tmp_path / "a.dcm")
    assert image.names == {1: "prostate (ROI 1)", 2: "prostate (ROI 2)", 3: "tumour"}
    assert np.count_nonzero(image.labels == 1) == np.count_nonzero(masks()[1])
    frames[0].RTReferencedStudySequence = [Dataset()]
    frames[0].RTReferencedStudySequence[0].RTReferencedSeriesSequence = [Dataset()]
    frames[0].RTReferencedStudySequence[0].RTReferencedSeriesSequence[0].SeriesInstanceUID = "1.2"
    ds.save_as(tmp_path / "a.dcm")
    image = read_label_image(tmp_path / "a.dcm")
    assert sorted(image.names) == [1, 2]
    assert "'tumour' (none on this series)" in image.findings[0].message
    del ds.ReferencedFrameOfReferenceSequence
    drawn = Dataset()
    drawn.ReferencedSOPInstanceUID = slices[3].SOPInstanceUID
    ds.ROIContourSequence[0].ContourSequence[0].ContourImageSequence = [drawn]
    ds.save_as(tmp_path / "a.dcm")
    assert np.array_equal(read_label_image(tmp_path / "a.dcm").labels == 1, image.labels == 1)


def test_contours_without_their_slices_or_across_them_are_refused(tmp_path: Path) -> None:
    slices = series()
    path = save_contours(tmp_path / "a.dcm", slices, NAMES, {1: traced(masks()[1], 0.5)})
    with pytest.raises(
        InputDataError, match=r"the DICOM series on which '.*a\.dcm' was drawn is not in the same folder"
    ):
        read_label_image(path)
    save_series(tmp_path / "ct", [*slices[:5], *slices[6:]])
    with pytest.raises(InputDataError, match=r"13 slices of the series beside .* differ in size, or are not evenly"):
        read_label_image(path)
    save_series(tmp_path / "ct", slices[5:6])
    across = np.array([[2, 9, 9], [2, 9, 19], [5, 29, 19]])
    path = save_contours(tmp_path / "a.dcm", slices, NAMES, {1: [(across, "CLOSED_PLANAR")]})
    with pytest.raises(InputDataError, match=r"'prostate' in .* runs across 3 slices"):
        read_label_image(path)
    with pytest.raises(InputDataError, match="no structure with a contour"):
        read_label_image(save_contours(tmp_path / "a.dcm", slices, NAMES, {1: []}))


def test_a_link_to_a_series_is_not_followed(tmp_path: Path) -> None:
    slices = series()
    save_series(tmp_path / "ct", slices)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "ct").symlink_to(tmp_path / "ct")
    path = save_contours(tmp_path / "mine" / "a.dcm", slices, NAMES, {1: traced(masks()[1], 0.5)})
    with pytest.raises(InputDataError, match="is not in the same folder"):
        read_label_image(path)


def test_a_plain_series_is_refused_with_what_converts_it(tmp_path: Path) -> None:
    save_series(tmp_path / "ct", series())
    first = sorted((tmp_path / "ct").iterdir())[0]
    bare = first.rename(tmp_path / "ct" / "IM0001")
    for path in (tmp_path / "ct", bare):
        for read in (read_label_image, readers.read_label_image):
            with pytest.raises(InputDataError, match="dcm2niix or 3D Slicer"):
                read(path)
    with pytest.raises(InputDataError, match="dcm2niix or 3D Slicer"):
        readers.read_intensities(bare)


def test_without_the_extra_a_segmentation_names_it_and_a_series_its_converters(
    tmp_path: Path, first_place: Path
) -> None:
    path = save_segmentation(tmp_path / "a.dcm", series(), "BINARY", NAMES, masks())
    save_series(tmp_path, series())
    for name in ("pydicom", "highdicom"):
        (first_place / f"{name}.py").write_text("raise ModuleNotFoundError(__name__)")
    with pytest.raises(ResourceError, match=r'pip install "palpate\[dicom\]"'):
        readers.read_label_image(path)
    with pytest.raises(InputDataError, match="dcm2niix"):
        readers.read_label_image(next(each for each in tmp_path.iterdir() if each != path))


def test_damaged_files_are_sentences_without_a_word_of_the_patient(tmp_path: Path) -> None:
    slices = series()
    save_series(tmp_path / "ct", slices)
    files = [
        save_segmentation(tmp_path / "a.dcm", slices, "BINARY", NAMES, masks()),
        save_contours(tmp_path / "b.dcm", slices, NAMES, {n: traced(mask, 0.5) for n, mask in masks().items()}),
    ]
    random = np.random.default_rng(3)
    outcomes = []
    for path in files:
        content = path.read_bytes()
        for number in range(40):
            damaged = bytearray(content)
            if number % 4 == 0:
                del damaged[int(random.integers(132, len(content))) :]
            for place in random.integers(132, len(damaged), 6) if number % 4 else ():
                damaged[place] = int(random.integers(0, 256))
            bad = tmp_path / "bad.dcm"
            bad.write_bytes(damaged)
            try:
                read_label_image(bad)
                outcomes.append("read")
            except InputDataError as error:
                outcomes.append(str(error))
    assert 1 < len(set(outcomes)) < len(outcomes)
    assert not any("Meyer" in outcome for outcome in outcomes)


def test_sizes_beyond_all_are_refused_before_memory_is_taken(tmp_path: Path) -> None:
    ds = pydicom.dcmread(save_segmentation(tmp_path / "a.dcm", series(), "BINARY", NAMES, masks()))
    ds.PerFrameFunctionalGroupsSequence[-1].PlanePositionSequence[0].ImagePositionPatient = [-30, -70, 12 + 3 * 10**7]
    ds.save_as(tmp_path / "a.dcm")
    with pytest.raises(InputDataError):
        read_label_image(tmp_path / "a.dcm")


@pytest.mark.parametrize("orientation", ["axial", "sagittal"])
def test_a_grid_that_is_given_stands_for_a_series_that_is_not_there(tmp_path: Path, orientation: str) -> None:
    slices = series(orientation)
    segments = save_segmentation(tmp_path / "a.dcm", slices, "BINARY", NAMES, masks())
    contours = save_contours(tmp_path / "b.dcm", slices, NAMES, {n: traced(mask, 0.5) for n, mask in masks().items()})
    save_series(tmp_path / "ct", slices)
    whole = read_label_image(segments)
    shutil.rmtree(tmp_path / "ct")
    here, apart_from_here = read_label_image, readers.read_label_image
    for read, path in ((here, segments), (here, contours), (apart_from_here, contours)):
        image = read(path, grid=whole.grid)
        assert image.findings == ()
        assert sorted(image.digests) == [""]
        assert np.array_equal(image.labels, whole.labels)
    apart = VoxelGrid(whole.grid.shape, whole.grid.affine + np.eye(4)[:, ::-1] * 0.3)
    assert [finding.code for finding in read_label_image(segments, grid=apart).findings] == ["cropped"]


def test_a_case_gives_contours_the_grid_of_its_grey_image(tmp_path: Path) -> None:
    slices = series()
    save_series(tmp_path / "ct", slices)
    path = save_contours(tmp_path / "a.dcm", slices, NAMES, {n: traced(mask, 0.5) for n, mask in masks().items()})
    whole = read_label_image(path)
    shutil.rmtree(tmp_path / "ct")
    readers.write_scalar_image(tmp_path / "ct.nii.gz", np.zeros(whole.grid.shape), whole.grid)
    (tmp_path / "case.toml").write_text(
        case_text(
            {"gland": {"label": "prostate", "role": "estimate"}, "rest": REST},
            before="a.dcm",
            after=["a.dcm"],
            images={"intensities_before": "ct.nii.gz"},
        )
    )
    case = read_case(tmp_path / "case.toml")
    assert case.images is not None
    found = read_segmentation(case, case.images.before, None, None)
    assert np.count_nonzero(found.mask(0)) == np.count_nonzero(masks()[1])
