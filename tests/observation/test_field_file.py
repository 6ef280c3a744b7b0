"""Displacement fields of other programs: the same displacements from each, or a refusal that says what to do."""

from __future__ import annotations

import gzip

import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK

from palpate.errors import InputDataError
from palpate.observation import field_file
from palpate.observation.contract import DataFile
from palpate.observation.displacement_field import read_displacement_field

LPS = np.array([-1.0, -1.0, 1.0])
MOTION = np.array([[0.02, 0.1, 0.0], [-0.1, -0.03, 0.02], [0.0, -0.02, 0.05]])
TURN = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
SHAPE = (5, 6, 7)
AFFINE = np.eye(4)
AFFINE[:3, :3] = TURN * np.array([2.0, 2.5, 3.0])
AFFINE[:3, 3] = [-40.0, 12.0, 7.0]
POINTS = np.moveaxis(np.indices(SHAPE), 0, -1) @ AFFINE[:3, :3].T + AFFINE[:3, 3]
MOVED = POINTS @ MOTION.T + np.array([1.0, -2.0, 0.5])


def read(path, axes=""):
    return read_displacement_field(DataFile("displacement-field", "field", (path,), 1, 0.1, axes=axes)).table


def check(path, axes="", *, atol=1e-4):
    table = read(path, axes)
    np.testing.assert_allclose(table.before, POINTS.reshape(-1, 3), atol=atol)
    np.testing.assert_allclose(table.moved, MOVED.reshape(-1, 3), atol=atol)


def nifti(folder, vectors, *, affine=AFFINE, unit="mm", four=False, ending=".nii.gz", **more):
    """A NIfTI file of vectors, with what its header is to say."""
    kind = more.pop("kind", nibabel.Nifti1Image)
    image = kind((vectors if four else vectors[:, :, :, None]).astype(more.pop("dtype", np.float32)), affine)
    image.set_sform(affine, code=more.pop("sform_code", 1))
    image.header.set_xyzt_units(unit)
    content = bytearray(image.to_bytes())
    header = kind.header_class(bytes(content[: len(image.header.binaryblock)]), check=False)
    for key, value in more.items():
        header[key] = value
    content[: len(header.binaryblock)] = header.binaryblock
    path = folder / f"field{ending}"
    path.write_bytes(gzip.compress(bytes(content)) if ending.endswith(".gz") else bytes(content))
    return path


@pytest.mark.parametrize(
    ("what", "axes"),
    [
        ({"vectors": MOVED, "intent_code": 1006}, ""),  # ITK from 5.4 on, 3D Slicer, FreeSurfer
        ({"vectors": MOVED, "intent_code": 1006}, "RAS"),
        ({"vectors": MOVED * LPS, "intent_code": 1007}, ""),  # ITK, ANTs, greedy
        ({"vectors": MOVED * LPS, "intent_code": 1007, "ending": ".nii"}, "LPS"),
        ({"vectors": MOVED, "intent_code": 1007}, "RAS"),  # Connectome Workbench
        ({"vectors": MOVED, "four": True}, "RAS"),  # MRtrix
        ({"vectors": MOVED * LPS, "four": True, "kind": nibabel.Nifti2Image}, "LPS"),
        ({"vectors": MOVED, "intent_code": 1007, "intent_name": "NREG_TRANS", "intent_p1": 1.0}, ""),
        ({"vectors": POINTS + MOVED, "intent_code": 1007, "intent_name": "NREG_TRANS", "intent_p1": 0.0}, ""),
        ({"vectors": POINTS + MOVED, "intent_code": 1007, "intent_name": "Mapping"}, ""),  # SPM
        (
            {
                "vectors": MOVED / 1e3,
                "intent_code": 1006,
                "unit": "meter",
                "affine": np.diag([1e-3] * 3 + [1.0]) @ AFFINE,
            },
            "",
        ),
        (
            {
                "vectors": MOVED * 1e3,
                "intent_code": 1006,
                "unit": "micron",
                "affine": np.diag([1e3] * 3 + [1.0]) @ AFFINE,
            },
            "",
        ),
        (
            {
                "vectors": MOVED,
                "intent_code": 1006,
                "sform_code": 0,
                "qform_code": 1,
                "pixdim": [0, 2, 2.5, 3, 1, 1, 1, 1],
            },
            "",
        ),
        ({"vectors": MOVED, "intent_code": 1006, "qform_code": 1, "quatern_b": 5.0}, ""),
        ({"vectors": MOVED * 2000.0, "intent_code": 1006, "dtype": np.int16, "scl_slope": 5e-4, "scl_inter": 0.0}, ""),
    ],
)
def test_nifti_is_read_as_its_header_says(tmp_path, what, axes):
    """Of a deformation field, of NiftyReg or SPM, positions are turned into displacements."""
    check(nifti(tmp_path, **what), axes, atol=1e-3 if "dtype" in what else 1e-4)


@pytest.mark.parametrize(
    ("what", "axes", "words"),
    [
        ({"vectors": MOVED, "four": True}, "", 'axes = "RAS"'),
        ({"vectors": MOVED, "intent_code": 1006}, "LPS", "in RAS, by its header"),
        ({"vectors": MOVED, "intent_code": 1007, "intent_name": "NREG_TRANS", "intent_p1": 2.0}, "", "reg_transform"),
        ({"vectors": MOVED, "intent_code": 1007, "intent_name": "NREG_TRANS", "intent_p1": 4.0}, "", "reg_transform"),
        ({"vectors": MOVED, "intent_code": 2006}, "RAS", "warp of FSL"),
        ({"vectors": MOVED, "intent_code": 2007}, "", "warp of FSL"),
        ({"vectors": POINTS + MOVED, "intent_code": 1006}, "", "may be positions"),
        ({"vectors": (POINTS + MOVED) * LPS, "four": True}, "RAS", "may be positions"),
        ({"vectors": np.repeat(MOVED, 2, axis=3), "intent_code": 1007}, "", "three components"),
        ({"vectors": MOVED, "intent_code": 1007, "sform_code": 0, "qform_code": 0}, "", "neither sform nor qform"),
        ({"vectors": MOVED, "intent_code": 1006, "dim": [5, 900, 900, 900, 1, 3, 1, 1]}, "", "resample it"),
        ({"vectors": MOVED, "intent_code": 1006, "dim": [5, 300, 300, 300, 1, 3, 1, 1]}, "", "cannot hold"),
    ],
)
def test_nifti_that_says_nothing_or_something_else_is_refused(tmp_path, what, axes, words):
    with pytest.raises(InputDataError, match=words):
        read(nifti(tmp_path, **what), axes)


def nrrd_file(path, vectors, space, *, named="", last=False, unit=1.0, few=3, **more):
    """An NRRD file of vectors as they are; its grid is the one of `AFFINE`, in `space`."""
    signs = {"right-anterior-superior": np.ones(3), "left-posterior-superior": LPS, "LAS": LPS * [1, -1, 1]}[space]
    vectors = vectors[..., :few]
    edges = list((signs[:, None] * AFFINE[:3, :3] * unit).T)
    none = np.full(3, np.nan)
    header = {
        "space": named or space,
        "kinds": ["domain"] * 3 + ["vector"] if last else ["vector"] + ["domain"] * 3,
        "space directions": np.array([*edges, none] if last else [none, *edges]),
        "space origin": signs * AFFINE[:3, 3] * unit,
    } | more
    nrrd.write(str(path), vectors * unit if last else np.moveaxis(vectors * unit, -1, 0), header)
    return path


FRAME = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # its rows are written, columns of the matrix


@pytest.mark.parametrize(
    ("vectors", "space", "more", "axes"),
    [
        (MOVED * LPS, "left-posterior-superior", {}, ""),
        (MOVED, "left-posterior-superior", {}, "RAS"),
        (MOVED * LPS, "left-posterior-superior", {"last": True, "encoding": "raw"}, "LPS"),
        (MOVED * LPS, "right-anterior-superior", {}, "LPS"),  # as ITK writes and reads them
        (MOVED, "right-anterior-superior", {"measurement frame": np.eye(3)}, ""),
        (MOVED * LPS * [1, -1, 1], "LAS", {"measurement frame": np.eye(3)}, ""),
        ((MOVED * LPS) @ FRAME.T, "left-posterior-superior", {"measurement frame": FRAME}, ""),
        (MOVED * LPS, "left-posterior-superior", {"unit": 1e-3, "space units": ["m", "m", "m"]}, ""),
        (MOVED * LPS, "left-posterior-superior", {"kinds": ["covariant-vector", *["space"] * 3]}, ""),
        (MOVED * LPS, "left-posterior-superior", {"kinds": ["list", *["domain"] * 3]}, ""),
        (MOVED * LPS, "left-posterior-superior", {"kinds": ["domain"] * 4}, ""),
    ],
)
def test_nrrd_is_read_as_its_header_says(tmp_path, vectors, space, more, axes):
    check(nrrd_file(tmp_path / "field.nrrd", vectors, space, **more), axes)


@pytest.mark.parametrize(
    ("space", "more", "axes", "words"),
    [
        ("right-anterior-superior", {}, "", "does not say"),
        ("right-anterior-superior", {"measurement frame": np.eye(3)}, "LPS", "remove the key axes"),
        ("left-posterior-superior", {"space units": ["inch"] * 3}, "", "must be"),
        ("left-posterior-superior", {"named": "scanner-xyz"}, "", "right, front and head"),
        ("left-posterior-superior", {"kinds": ["vector"] + ["domain"] * 3, "few": 2}, "", "has 2 components"),
    ],
)
def test_nrrd_that_says_too_little_is_refused(tmp_path, space, more, axes, words):
    with pytest.raises(InputDataError, match=words):
        read(nrrd_file(tmp_path / "field.nrrd", MOVED, space, **more), axes)


def itk_image():
    """The field as a vector image of SimpleITK, LPS mm."""
    image = SimpleITK.GetImageFromArray(np.swapaxes(MOVED * LPS, 0, 2), isVector=True)
    image.SetOrigin(LPS * AFFINE[:3, 3])
    image.SetSpacing(np.array([2.0, 2.5, 3.0]))
    image.SetDirection((LPS[:, None] * TURN).ravel())
    return image


@pytest.mark.parametrize("ending", [".mha", ".mhd"])
def test_metaimage_is_read_in_lps_and_both_its_files_are_digested(tmp_path, ending):
    path = tmp_path / f"field{ending}"
    SimpleITK.WriteImage(itk_image(), str(path))
    check(path)
    assert len(read(path).digests) == 1 + (ending == ".mhd")
    np.testing.assert_allclose(read(path, "RAS").moved, read(path, "LPS").moved * LPS, atol=1e-9)
    path.write_bytes(path.read_bytes().replace(b"ElementDataFile", b"DistanceUnits = um\nElementDataFile", 1))
    with pytest.raises(InputDataError, match="DistanceUnits"):
        read(path)


@pytest.mark.parametrize(("intent", "signs"), [(1006, np.ones(3)), (1007, LPS)])
def test_nifti_is_the_field_that_itk_reads(tmp_path, intent, signs):
    path = nifti(tmp_path, MOVED * signs, intent_code=intent)
    image = SimpleITK.ReadImage(str(path))
    index = (1, 2, 3)
    place, vector = image.TransformIndexToPhysicalPoint(index), image.GetPixel(index)
    table = read(path)
    (row,) = np.flatnonzero(np.linalg.norm(table.before - LPS * place, axis=1) < 1e-3)
    np.testing.assert_allclose(table.moved[row], LPS * vector, atol=1e-5)


@pytest.mark.parametrize("field", ["ElementDataFile = ../away.raw", "ElementDataFile: ../away.raw"])
def test_vectors_outside_of_the_headers_folder_are_not_read(tmp_path, field):
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / "field.mhd"
    SimpleITK.WriteImage(itk_image(), str(path))
    (tmp_path / "in" / "field.raw").rename(tmp_path / "away.raw")
    path.write_text(path.read_text().replace("ElementDataFile = field.raw", field))
    with pytest.raises(InputDataError, match="outside its own folder"):
        read(path)


def transform(shift=None):
    """The field as a transform of ITK, or a shift (LPS mm)."""
    return (
        SimpleITK.DisplacementFieldTransform(itk_image()) if shift is None else SimpleITK.TranslationTransform(3, shift)
    )


@pytest.mark.parametrize("ending", [".h5", ".tfm", ".txt", ".mat", ".xfm"])
def test_a_transform_of_one_field_is_that_field(tmp_path, ending):
    path = tmp_path / f"one{ending}"
    SimpleITK.WriteTransform(transform(), str(path))
    check(path, "LPS" if ending == ".xfm" else "")  # an .xfm of MNI tools is in RAS, of ITK up to 5.4 in LPS


SHIFT = (1.0, 2.0, -1.0)
MATRIX = "Transform_Type = Linear;\nLinear_Transform =\n 1 0 0 1\n 0 1 0 2\n 0 0 1 -1;\n"


@pytest.mark.parametrize("ending", [".h5", ".tfm", ".xfm"])
@pytest.mark.parametrize("first", ["field", "shift"])
def test_transforms_of_one_file_are_composed(tmp_path, ending, first):
    """In the order of the file: an .xfm applies its first one first, a composite of ITK its last one."""
    path = tmp_path / f"two{ending}"
    if ending == ".xfm":
        SimpleITK.WriteTransform(transform(), str(path))
        head, grid = path.read_text().split("Transform_Type", 1)
        sections = [f"Transform_Type{grid}", MATRIX]
        path.write_text(head + "\n".join(sections if first == "field" else sections[::-1]))
    else:
        both = [SimpleITK.AffineTransform(3), transform()]
        both[0].SetTranslation(SHIFT)
        SimpleITK.WriteTransform(SimpleITK.CompositeTransform(both if first == "field" else both[::-1]), str(path))
    table = read(path, "LPS" if ending == ".xfm" else "")
    shift = LPS * SHIFT
    start = table.before + (0.0 if first == "field" else shift)
    moved = start @ MOTION.T + np.array([1.0, -2.0, 0.5]) + shift
    np.testing.assert_allclose(table.moved, moved, atol=1e-4)
    assert (len(table.before) == MOVED[..., 0].size) == (first == "field")


def test_an_xfm_of_mni_tools_is_in_ras(tmp_path):
    """Its grid as well as its vectors."""
    image = SimpleITK.GetImageFromArray(np.swapaxes(MOVED, 0, 2), isVector=True)
    image.SetOrigin(AFFINE[:3, 3])
    image.SetSpacing([2.0, 2.5, 3.0])
    image.SetDirection(TURN.ravel())
    SimpleITK.WriteTransform(SimpleITK.DisplacementFieldTransform(image), str(tmp_path / "mni.xfm"))
    check(tmp_path / "mni.xfm", "RAS")


INVERTED = ("Transform_Type = Grid_Transform;", "Transform_Type = Grid_Transform;\nInvert_Flag = True;")
LISTED = (
    "#Transform 0",
    "#Transform 0\nTransform: TranslationTransform_double_3_3\nParameters: 1 0 0\nFixedParameters:\n#Transform 1",
)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("one.xfm", None, "does not say"),
        ("one.xfm", INVERTED, "an inverted one"),
        ("one.xfm", ("one_grid_0", "../one_grid_0"), "outside its own folder"),
        ("one.xfm", ("Displacement", "Displacement_Volume = ../a.mnc;\nDisplacement"), "outside its own folder"),
        ("one.xfm", ("Displacement_Volume = one", '"Displacement_Volume"="../one'), "outside its own folder"),
        ("one.tfm", LISTED, "2 transforms"),
    ],
)
def test_a_part_is_never_taken_for_the_whole(tmp_path, name, change, words):
    path = tmp_path / name
    SimpleITK.WriteTransform(transform(), str(path))
    if change:
        path.write_text(path.read_text().replace(*change))
    with pytest.raises(InputDataError, match=words):
        read(path, "LPS" if change and name.endswith(".xfm") else "")


def test_the_grid_of_an_xfm_is_measured_before_it_is_read(tmp_path, monkeypatch):
    path = tmp_path / "one.xfm"
    SimpleITK.WriteTransform(transform(), str(path))
    path.write_text(path.read_text().replace("one_grid_0.mnc", '"one_grid_0.mnc"').replace("%", "# = ../a;\n%"))
    check(path, "LPS")
    monkeypatch.setattr(field_file, "MOST_VECTORS", 200)
    with pytest.raises(InputDataError, match=r"one_grid_0.mnc' has 5 x 6 x 7 vectors"):
        read(path, "LPS")


def test_a_transform_without_a_field_and_an_unknown_kind_are_refused(tmp_path):
    SimpleITK.WriteTransform(transform(SHIFT), str(tmp_path / "shift.tfm"))
    with pytest.raises(InputDataError, match="holds no displacement field"):
        read(tmp_path / "shift.tfm")
    (tmp_path / "warp.m3z").write_bytes(b"")
    with pytest.raises(InputDataError, match="not read as a field"):
        read(tmp_path / "warp.m3z")
