"""Reading and writing NIfTI: the way of storing never matters, and a bad file always gives one clear sentence."""

from __future__ import annotations

import gzip
import itertools
import struct
from collections.abc import Callable
from pathlib import Path

import nibabel
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from image_files import AFFINE, labels, nifti, read_intensities, read_label_image, write
from palpate.errors import ConfigurationError, InputDataError, ResourceError
from palpate.images import readers
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers import write_label_image, write_scalar_image

ORIENTATIONS = list(itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)))
HEADER = 348


def oblique() -> NDArray[np.float64]:
    affine = AFFINE.copy()
    affine[:3, :3] = Rotation.from_euler("xyz", [20, -12, 31], degrees=True).as_matrix() @ affine[:3, :3]
    return affine


def stored_otherwise(
    values: NDArray[np.uint8], affine: NDArray[np.float64], order: tuple[int, ...], signs: tuple[int, ...]
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """The same image with its axes in another order and direction."""
    turned = values.transpose(order)[tuple(slice(None, None, sign) for sign in signs)]
    change = np.zeros((4, 4))  # index of `turned` -> index of `values`
    change[3, 3] = 1
    for new, (old, sign) in enumerate(zip(order, signs, strict=True)):
        change[old, new] = sign
        change[old, 3] = 0 if sign > 0 else values.shape[old] - 1
    return turned, affine @ change


def saved(path: Path, values: NDArray[np.generic], affine: NDArray[np.float64] | None = AFFINE) -> Path:
    nibabel.save(nibabel.Nifti1Image(values, affine), path)
    return path


def raw(path: Path, *, change: Callable[[bytearray], None] | None = None, tail: bytes = b"") -> Path:
    """A valid .nii or .nii.gz with `change` applied to its bytes."""
    content = nifti(change) + tail
    return write(path, gzip.compress(content) if path.suffix == ".gz" else content)


@pytest.mark.parametrize(("order", "signs"), ORIENTATIONS[::5])
@pytest.mark.parametrize("turn", [0, 45])
def test_oblique_images_do_not_depend_on_how_they_are_stored(
    tmp_path: Path, order: tuple[int, ...], signs: tuple[int, ...], turn: int
) -> None:
    affine = oblique()
    affine[:3, :3] = Rotation.from_euler("z", turn, degrees=True).as_matrix() @ affine[:3, :3]
    first = read_label_image(saved(tmp_path / "a.nii.gz", labels(), affine))
    second = read_label_image(saved(tmp_path / "b.nii.gz", *stored_otherwise(labels(), affine, order, signs)))
    assert np.array_equal(first.labels, second.labels)
    np.testing.assert_allclose(first.grid.affine, second.grid.affine, atol=1e-5)


@pytest.mark.parametrize("ending", [".nii", ".nii.gz", ".NII.GZ"])
def test_writing_and_reading_give_the_image_back(tmp_path: Path, ending: str) -> None:
    image = LabelImage(labels() * 200, VoxelGrid((4, 5, 6), oblique()))
    path = tmp_path / f"a{ending}"
    write_label_image(path, image)
    again = read_label_image(path, names={1: "prostate"})
    assert np.array_equal(again.labels, image.labels)
    np.testing.assert_allclose(again.grid.affine, image.grid.affine, atol=1e-5)
    assert again.names == {1: "prostate"}
    assert again.colours == {}
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_sform_and_qform_of_a_written_image_agree_with_millimetres(tmp_path: Path) -> None:
    write_scalar_image(tmp_path / "e.nii.gz", np.full((4, 5, 6), np.nan), VoxelGrid((4, 5, 6), oblique()))
    header = nibabel.load(tmp_path / "e.nii.gz").header
    np.testing.assert_allclose(header.get_sform(), header.get_qform(), atol=1e-4)
    assert int(header["sform_code"]) > 0
    assert int(header["qform_code"]) > 0
    assert header.get_xyzt_units()[0] == "mm"
    assert header.get_data_dtype() == np.float32
    assert np.isnan(read_intensities(tmp_path / "e.nii.gz")[0]).all()


def test_equal_images_give_equal_files(tmp_path: Path) -> None:
    image = LabelImage(labels(), VoxelGrid((4, 5, 6), AFFINE))
    write_label_image(tmp_path / "a.nii.gz", image)
    write_label_image(tmp_path / "b.nii.gz", image)
    assert (tmp_path / "a.nii.gz").read_bytes() == (tmp_path / "b.nii.gz").read_bytes()


def test_a_failed_write_is_a_resource_error_and_leaves_nothing(tmp_path: Path) -> None:
    image = LabelImage(labels(), VoxelGrid((4, 5, 6), AFFINE))
    with pytest.raises(ResourceError, match="cannot be written"):
        write_label_image(tmp_path / "missing" / "a.nii.gz", image)
    with pytest.raises(ConfigurationError, match=r"\.nii"):
        write_label_image(tmp_path / "a.png", image)
    with pytest.raises(InputDataError, match="shape"):
        write_scalar_image(tmp_path / "a.nii", np.zeros((2, 2, 2)), image.grid)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1.0), ("meter", 1000.0), ("micron", 0.001), ("unknown", 1.0)])
def test_the_unit_of_length_in_the_header_is_honoured(tmp_path: Path, unit: str, factor: float) -> None:
    image = nibabel.Nifti1Image(labels(), np.diag([4.0, 2.0, 8.0, 1.0]))
    image.header.set_xyzt_units(unit)
    nibabel.save(image, tmp_path / "a.nii.gz")
    np.testing.assert_allclose(read_label_image(tmp_path / "a.nii.gz").grid.spacing, factor * np.array([4.0, 2.0, 8.0]))


def test_sform_or_qform_serves_alone_and_two_that_disagree_are_refused(tmp_path: Path) -> None:
    image = nibabel.Nifti1Image(labels(), None)
    image.set_qform(np.diag([1.0, 1.0, 2.5, 1.0]), code=1)
    nibabel.save(image, tmp_path / "q.nii")
    np.testing.assert_allclose(read_label_image(tmp_path / "q.nii").grid.spacing, [1.0, 1.0, 2.5])
    image.set_sform(AFFINE, code=1)
    nibabel.save(image, tmp_path / "both.nii")
    with pytest.raises(InputDataError, match="sform and qform"):
        read_label_image(tmp_path / "both.nii")
    image.set_qform(None, code=0)
    nibabel.save(image, tmp_path / "s.nii")
    np.testing.assert_allclose(read_label_image(tmp_path / "s.nii").grid.affine, AFFINE)


def of_qform(path: Path, affine: NDArray[np.float64], *, sform: bool = False) -> Path:
    """A file placed by its qform, with an sform beside it or none."""
    image = nibabel.Nifti1Image(labels(), affine)
    image.set_qform(affine, code=1)
    image.set_sform(affine if sform else None, code=int(sform))
    nibabel.save(image, path)
    return path


def patched(path: Path, *changes: Callable[[bytearray], None]) -> Path:
    content = bytearray(path.read_bytes())
    for change in changes:
        change(content)
    path.write_bytes(content)
    return path


QFAC, QUATERNION = 76, 256  # where pixdim[0] and quatern_b, c, d stand


@pytest.mark.parametrize("sform", [False, True])
@pytest.mark.parametrize(("qfac", "sign"), [(0.0, 1), (1.0, 1), (3.0, 1), (-1.0, -1)])
def test_the_third_axis_turns_by_the_sign_of_qfac_and_zero_is_one(
    tmp_path: Path, qfac: float, sign: int, sform: bool
) -> None:
    affine = oblique() @ np.diag([1.0, 1.0, sign, 1.0])
    path = of_qform(tmp_path / "a.nii", affine, sform=sform)
    there = read_label_image(patched(path, put("<f", QFAC, qfac)))
    right = read_label_image(saved(tmp_path / "b.nii", labels(), affine))
    assert np.array_equal(there.labels, right.labels)
    np.testing.assert_allclose(there.grid.affine, right.grid.affine, atol=1e-5)


@pytest.mark.parametrize("longer", [1e-7, 3e-7, 1e-5, 5e-4])
def test_a_quaternion_longer_than_one_by_rounding_is_normalised(tmp_path: Path, longer: float) -> None:
    half = np.sqrt(0.5) * (1.0 + longer)  # 180 degrees about the middle between two axes: b^2 + c^2 = 1
    path = of_qform(tmp_path / "a.nii", np.diag([1.0, 2.0, 3.0, 1.0]))
    image = read_label_image(patched(path, put("<3f", QUATERNION, half, half, 0.0)))
    exact = nibabel.quaternions.quat2mat([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0]) @ np.diag([1.0, 2.0, 3.0])
    found = image.grid.affine[:3, :3]
    np.testing.assert_allclose(np.abs(found), np.abs(exact[:, np.argmax(np.abs(exact), axis=1)]), atol=1e-6)
    np.testing.assert_allclose(np.sort(image.grid.spacing), [1.0, 2.0, 3.0], atol=1e-6)


@pytest.mark.parametrize(
    "change",
    [
        lambda content: struct.pack_into("<3f", content, QUATERNION, 1.0, 1.0, 0.0),
        lambda content: struct.pack_into("<f", content, QUATERNION, np.nan),
        lambda content: struct.pack_into("<f", content, QFAC, np.nan),
        lambda content: struct.pack_into("<f", content, QFAC + 4, 0.0),
        lambda content: struct.pack_into("<f", content, QFAC + 8, -1.0),
        lambda content: struct.pack_into("<f", content, QUATERNION + 12, np.inf),
    ],
)
def test_a_damaged_qform_is_refused_alone_and_does_not_matter_beside_an_sform(tmp_path: Path, change) -> None:
    with pytest.raises(InputDataError, match=r"header of '.*q\.nii' has a damaged qform: .*; set an sform"):
        read_label_image(patched(of_qform(tmp_path / "q.nii", oblique()), change))
    image = read_label_image(patched(of_qform(tmp_path / "s.nii", oblique(), sform=True), change))
    np.testing.assert_allclose(image.grid.affine, oblique(), atol=1e-5)


def test_labels_that_the_header_scales_are_named_as_such(tmp_path: Path) -> None:
    def scaled(slope: float, intercept: float = 0.0) -> Path:
        return raw(tmp_path / "a.nii", change=put("<ff", 112, slope, intercept))

    image = read_label_image(scaled(2.0))
    assert np.array_equal(image.labels, 2 * labels())
    assert [finding.code for finding in image.findings] == ["scaled-labels"]
    assert "scl_slope = 2 and scl_inter = 0" in image.findings[0].message
    for slope, intercept, words in ((0.3, 0.0, "not integers"), (1.0, -1.0, "from -1"), (2e4, 0.0, "0 to 80000")):
        with pytest.raises(
            InputDataError, match=f"{words}.*scales.*scl_slope = {slope:g} and scl_inter = {intercept:g}"
        ):
            read_label_image(scaled(slope, intercept))
    for slope in (0.0, 1.0):
        assert read_label_image(scaled(slope)).findings == ()
    image = nibabel.Nifti1Image(labels().astype(np.float64), AFFINE)
    image.header.set_data_dtype(np.int16)  # nibabel scales to the whole range
    nibabel.save(image, tmp_path / "b.nii")
    found = read_label_image(tmp_path / "b.nii")
    assert np.array_equal(found.labels, labels())
    assert found.findings == ()


def test_vectors_are_there_for_those_who_can_use_them_and_are_no_image(tmp_path: Path) -> None:
    vectors = np.random.default_rng(2).normal(size=(4, 5, 6, 1, 3)).astype(np.float32)
    image = nibabel.Nifti1Image(vectors, AFFINE)
    image.header.set_intent(1006)
    nibabel.save(image, tmp_path / "a.nii.gz")
    content = readers.nifti.nifti_content(tmp_path / "a.nii.gz", lambda *_: None)
    assert np.array_equal(content.values, vectors)
    assert np.array_equal(readers.nifti.nifti_affine(content.header, tmp_path), AFFINE)
    with pytest.raises(InputDataError, match=r"intent: displacement vector.*three axes"):
        read_label_image(tmp_path / "a.nii.gz")


def test_nifti_2_is_read_like_nifti_1(tmp_path: Path) -> None:
    nibabel.save(nibabel.Nifti2Image(labels(), AFFINE), tmp_path / "a.nii.gz")
    assert np.array_equal(read_label_image(tmp_path / "a.nii.gz").labels, labels())


def test_intensities_are_scaled_as_the_header_says(tmp_path: Path) -> None:
    def scale(content: bytearray) -> None:
        struct.pack_into("<ff", content, 112, 2.0, -1000.0)

    values, grid = read_intensities(raw(tmp_path / "a.nii.gz", change=scale))
    assert values.dtype == np.float32
    np.testing.assert_allclose(values, labels() * 2.0 - 1000.0)
    np.testing.assert_allclose(grid.affine, AFFINE)


def test_floats_close_to_integers_are_labels_and_others_are_refused(tmp_path: Path) -> None:
    near = labels().astype(np.float32)
    near[near == 1] = 0.9999
    assert np.array_equal(read_label_image(saved(tmp_path / "a.nii.gz", near)).labels, labels())
    for value, words in [
        (0.5, "not integers"),
        (np.nan, "NaN"),
        (np.inf, "NaN or inf"),
        (-1, "from -1"),
        (65536, "65536"),
    ]:
        bad = labels().astype(np.float32)
        bad[1, 2, 3] = value
        with pytest.raises(InputDataError, match=words):
            read_label_image(saved(tmp_path / "b.nii.gz", bad))


@pytest.mark.parametrize("shape", [(4, 5, 6, 1), (4, 5, 6, 1, 1), (4, 5, 1)])
def test_trailing_axes_of_one_are_accepted(tmp_path: Path, shape: tuple[int, ...]) -> None:
    path = saved(tmp_path / "a.nii.gz", np.ones(shape, dtype=np.uint8))
    assert read_label_image(path).labels.shape == shape[:3]


@pytest.mark.parametrize("shape", [(4, 5), (4, 5, 6, 2), (4, 5, 6, 1, 3)])
def test_images_of_other_dimensions_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(InputDataError, match="three axes"):
        read_label_image(saved(tmp_path / "a.nii.gz", np.ones(shape, dtype=np.uint8)))


@pytest.mark.parametrize("dtype", ["c8", [("R", "u1"), ("G", "u1"), ("B", "u1")]])
def test_colours_and_complex_numbers_are_refused(tmp_path: Path, dtype: object) -> None:
    with pytest.raises(InputDataError, match="of the type"):
        read_label_image(saved(tmp_path / "a.nii.gz", np.zeros((3, 3, 3), dtype=np.dtype(dtype))))


def put(form: str, offset: int, *numbers: float) -> Callable[[bytearray], None]:
    return lambda content: struct.pack_into(form, content, offset, *numbers)


FOUND_BY_FUZZING = {  # the sform of a NIfTI-2 file, in 64 bits
    "the box of voxels overflows": [1e200, 1e200, 1e200],
    "one edge is subnormal": [1e-320, 1.0, 1.0],
    "the determinant underflows": [1e-160, 1e-160, 1.0],
    "metres made millimetres overflow": [1e307, 1.0, 1.0],
}


@pytest.mark.parametrize("name", FOUND_BY_FUZZING)
def test_an_affine_beyond_what_floats_hold_is_refused_without_a_warning(tmp_path: Path, name: str) -> None:
    content = bytearray(nibabel.Nifti2Image(labels(), np.eye(4)).to_bytes())
    struct.pack_into("<ii", content, 344, 0, 1)  # no qform, a sform
    struct.pack_into("<12d", content, 400, *(np.diag(FOUND_BY_FUZZING[name]) @ np.eye(3, 4)).ravel())
    struct.pack_into("<i", content, 500, 1)  # metres
    (tmp_path / "a.nii").write_bytes(content)
    with pytest.raises(InputDataError, match=r"flattens|not finite"):
        read_label_image(tmp_path / "a.nii")


def test_files_that_are_no_images_are_refused_with_advice(tmp_path: Path) -> None:
    good = raw(tmp_path / "good.nii.gz").read_bytes()
    (tmp_path / "folder.nii.gz").mkdir()
    contents = {
        "empty.nii.gz": (b"", "empty"),
        "ten.nii.gz": (good[:10], "cut short|damaged"),
        "plain.nii.gz": (gzip.decompress(good), "not compressed"),
        "text.nii.gz": (b"this is no image", "not compressed"),
        "zipped.nii": (good, "is compressed"),
        "short.nii": (gzip.decompress(good)[:-5], "cut short"),
        "stub.nii": (gzip.decompress(good)[:100], "cut short"),
        "cut.nii.gz": (good[:-30], "cut short|damaged"),
        "sum.nii.gz": (good[:-8] + b"\0" * 8, "damaged"),
        "bits.nii.gz": (good[:40] + bytes(b ^ 0xFF for b in good[40:60]) + good[60:], "damaged|begin|header"),
        "a.png": (good, "no reader"),
        "a.hdr": (good, "one half of a pair"),
        "a.img.gz": (good, "one half of a pair"),
    }
    for name, (content, _) in contents.items():
        (tmp_path / name).write_bytes(content)
    wanted = {name: words for name, (_, words) in contents.items()}
    wanted |= {
        "folder.nii.gz": "folder",
        "missing.nii.gz": "no file",
        "x" * 300 + ".nii": "cannot be opened",
        "\0.nii": "no file|cannot be opened",
    }
    for name, words in wanted.items():
        for read in (read_label_image, read_intensities):
            with pytest.raises(InputDataError, match=words):
                read(tmp_path / name)


def test_a_gzip_bomb_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    """Its end is missing: whoever unpacked three of its fifty million bytes would come upon that."""
    path = raw(tmp_path / "a.nii.gz", tail=bytes(50_000_000))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 50])
    with pytest.raises(InputDataError, match="has more than"):
        read_label_image(path)


def test_no_damaged_byte_lets_a_foreign_error_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    path = tmp_path / "a.nii"
    good = nibabel.Nifti1Image(labels(), AFFINE).to_bytes()
    texts: list[str] = []
    for _ in range(1500):
        content = bytearray(good)
        for place in rng.integers(0, HEADER, rng.integers(1, 4)):
            content[place] = rng.integers(0, 256)
        path.write_bytes(bytes(content))
        for read in (read_label_image, read_intensities):
            try:
                read(path)
            except InputDataError as error:  # any other exception or warning fails the test
                texts.append(str(error))
    assert len(texts) > 100
    assert all(str(path) in text for text in texts)
