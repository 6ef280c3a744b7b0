"""Organs beyond the pelvis: `palpate init` on names of many programs, a filling stomach, what it asks for."""

from __future__ import annotations

import json

import numpy as np
import pytest

from palpate.case.file import read_case
from palpate.case.tissue_names import found_word
from palpate.errors import ConfigurationError, InputDataError
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers import write_label_image
from palpate.images.tissue import Role
from palpate.study.guess import guess_tissues, volume_change
from palpate.study.new_case import CaseImages, new_case

BOXES = VoxelGrid((40, 20, 20), np.diag([2.0, 2.0, 2.0, 1.0]))
GROWN = 6  # voxels along an edge of five: by a fifth
ABDOMEN = {1: "liver", 2: "liver_tumor", 3: "stomach", 4: "spine", 5: "ribs", 9: "body"}
WIDE = VoxelGrid((48, 38, 30), np.array([[6.0, 0, 0, -141], [0, 6.0, 0, -111], [0, 0, 6.0, -87], [0, 0, 0, 1]]))
STOMACH, RADIUS, GROWTH = np.array([-55.0, 15.0, 0.0]), 26.0, 1.34


def boxes(names, changed=()) -> LabelImage:
    """A box of 5 x 5 x 5 voxels for each name, those of `changed` longer by one."""
    labels = np.zeros(BOXES.shape, dtype=np.int32)
    for number, name in enumerate(names):
        x, y, z = 2 + 9 * (number % 4), 1 + 6 * (number // 4 % 3), 2 + 9 * (number // 12)
        labels[x : x + (GROWN if name in changed else 5), y : y + 5, z : z + 5] = number + 1
    return LabelImage(labels, BOXES, {number + 1: name for number, name in enumerate(names)})


def roles(names, changed=()) -> dict[str, str]:
    return {g.name: str(g.role) for g in guess_tissues(boxes(names), [boxes(names, changed)])}


KNOWN = "surroundings"
BTCV = ["spleen", "right kidney", "gallbladder", "esophagus", "liver", "stomach", "aorta", "inferior vena cava"]
HEART = ["LV blood pool", "RV blood pool", "LA blood pool", "RA blood pool", "LV myocardium", "ascending aorta"]
CHAMBERS = ["heart_myocardium", "heart_atrium_left", "heart_ventricle_left", "pulmonary_artery"]
FREESURFER = [
    "Left-Cerebral-White-Matter",
    "Right-Cerebral-White-Matter",
    "Left-Cerebral-Cortex",
    "Left-Thalamus-Proper",
    "Left-Lateral-Ventricle",
    "4th-Ventricle",
    "Brain-Stem",
    "CSF",
]


@pytest.mark.parametrize(
    ("names", "changed", "estimate", "driver", "rigid", "known"),
    [
        (BTCV, ["stomach"], "spleen|right kidney|liver", "stomach", "", KNOWN),
        (["liver", "gall bladder", "oesophagus", "postcava", "duodenum"], ["duodenum"], "liver", "duodenum", "", KNOWN),
        (["Liver", "liver tumours", "hepatic vessel"], [], "Liver|liver tumours", "", "", KNOWN),
        (["kidney_L", "kidney_R", "tumor", "cyst"], ["cyst"], "kidney_L|kidney_R|tumor", "cyst", "", KNOWN),
        (["RV", "MYO", "LV"], ["LV", "RV"], "MYO", "RV|LV", "", KNOWN),
        (HEART, [], "LV myocardium", "|".join(HEART[:4]), "", KNOWN),
        (HEART, ["ascending aorta"], "LV myocardium", "|".join([*HEART[:4], HEART[5]]), "", KNOWN),
        (CHAMBERS, [], CHAMBERS[0], "|".join(CHAMBERS[1:3]), "", KNOWN),
        (["breast_fat", "fibroglandular tissue", "skin", "rib 4", "rib 5"], [], "fibroglandular tissue", "", "bones",
         f"{KNOWN}|breast_fat"),
        (["lung_left", "liver", "trachea"], ["lung_left"], "liver", "lung_left", "", KNOWN),
        (["lung_left", "lung_right", "airway"], [], "lung_left|lung_right", "", "", KNOWN),
        (FREESURFER, ["Left-Lateral-Ventricle"], "white matter|grey matter|Brain-Stem", "Left-Lateral-Ventricle", "",
         KNOWN),
        (["vastus lateralis", "rectus femoris", "femur", "fat"], [], "vastus lateralis|rectus femoris", "", "femur",
         f"{KNOWN}|fat"),
        (["prostate", "urinary_bladder", "rectum"], [], "prostate|urinary_bladder", "rectum", "", KNOWN),
        (["prostate", "urinary_bladder", "rectum"], ["urinary_bladder"], "prostate", "urinary_bladder|rectum", "",
         KNOWN),
        (["pelvic floor muscle", "uterus", "external iliac artery", "rectum"], [], "uterus", "rectum", "",
         f"{KNOWN}|pelvic floor muscle"),
    ],
)  # fmt: skip
def test_names_of_many_programs_tell_roles(names, changed, estimate, driver, rigid, known):
    found = roles(names, changed)
    wanted = {"estimate": estimate, "driver": driver, "rigid": rigid, "known": known}
    assert {role: {name for name in found if found[name] == role} for role in wanted} == {
        role: set(names.split("|")) - {""} for role, names in wanted.items()
    }


@pytest.mark.parametrize(
    ("name", "word"), [("Tumors", "tumour"), ("leftKidney 2", "kidney"), ("Esophageal", ""), ("LV_Blood_Pool", "lv")]
)
def test_spelling_plural_capitals_and_numbers_do_not_matter(name, word):
    assert found_word(name, ("tumour", "kidney", "lv", "oesophagus")) == word


def test_a_label_that_only_another_field_of_view_cuts_does_not_change():
    whole = boxes(["colon"])
    shorter = LabelImage(whole.labels[:4], VoxelGrid((4, 20, 20), BOXES.affine), whole.names)
    assert volume_change(1, whole, [shorter]) == 0.0
    assert volume_change(1, whole, [boxes(["colon"], ["colon"])]) == pytest.approx(0.2)


def test_a_lung_that_holds_a_tumour_is_no_driver_but_asked_about():
    images = []
    for changed in ([], ["lung"]):
        labels = boxes(["lung"], changed).labels.copy()
        labels[4, 3, 4] = 2
        images.append(LabelImage(labels, BOXES, {1: "lung", 2: "nodule"}))
    lung = next(guess for guess in guess_tissues(images[0], images[1:]) if guess.name == "lung")
    assert lung.role is Role.ESTIMATE
    assert "it holds 'nodule'" in lung.question


def abdomen(*, filled: bool) -> LabelImage:
    """A liver with a lesion beside a stomach that fills by 134 %, in a body with spine and ribs.

    The stomach pushes all soft tissue as an incompressible medium: r^3 grows by the same everywhere.
    """
    x = WIDE.world(np.indices(WIDE.shape).reshape(3, -1).T.astype(float))
    start = x
    if filled:
        away = x - STOMACH
        r = np.linalg.norm(away, axis=1)
        inner = r < np.cbrt(1.0 + GROWTH) * RADIUS
        was = np.where(inner, r / np.cbrt(1.0 + GROWTH), np.cbrt(np.maximum(r**3 - GROWTH * RADIUS**3, 0.0)))
        start = STOMACH + away * (was / np.maximum(r, 1e-9))[:, None]

    def ellipsoid(points, middle, axes):
        return (((points - middle) / axes) ** 2).sum(axis=1) < 1.0

    labels = np.zeros(len(x), dtype=np.int32)
    labels[ellipsoid(x, [0.0, 0.0, 0.0], [130.0, 100.0, 200.0])] = 9
    labels[ellipsoid(start, [50.0, 5.0, 0.0], [58.0, 50.0, 55.0])] = 1
    labels[ellipsoid(start, [25.0, 15.0, 5.0], [17.0, 17.0, 17.0])] = 2
    labels[ellipsoid(start, STOMACH, [RADIUS] * 3)] = 3
    labels[((x[:, :2] - [0.0, -70.0]) ** 2).sum(axis=1) < 18.0**2] = 4
    ring = np.hypot(x[:, 0] / 122.0, x[:, 1] / 92.0)
    labels[(ring > 0.9) & (ring < 1.0) & (np.abs(x[:, 0]) > 60.0) & (np.abs(x[:, 2]) < 40.0)] = 5
    return LabelImage(labels.reshape(WIDE.shape), WIDE)


@pytest.fixture
def folder(tmp_path):
    for name, filled in (("before", False), ("after", True)):
        write_label_image(tmp_path / f"{name}.nii.gz", abdomen(filled=filled))
    return tmp_path


def case_of(folder, names=None, *, first="before", last="after"):
    table = None
    if names is not None:
        table = folder / "names.json"
        table.write_text(json.dumps({str(number): name for number, name in names.items()}))
    return new_case(CaseImages(folder / f"{first}.nii.gz", (folder / f"{last}.nii.gz",), table), folder)


@pytest.mark.parametrize("names", [ABDOMEN, None])
def test_a_filling_stomach_moves_the_liver_with_names_and_without(folder, names):
    case = case_of(folder, names)
    assert case.questions == ()
    found = {label: g.role for g in case.tissues for label in g.labels}
    expected = {1: "estimate", 2: "estimate", 3: "driver", 4: "rigid", 5: "rigid", 0: "void"}
    assert found == {label: Role(role) for label, role in expected.items()}
    assert [g.role for g in case.tissues if not g.labels] == [Role.KNOWN]
    (folder / "case.toml").write_text(case.text)
    assert len(read_case(folder / "case.toml").tissues) == len(case.tissues)


def test_exchanged_images_are_asked_about_in_one_sentence(folder):
    (question,) = case_of(folder, ABDOMEN, first="after", last="before").questions
    assert "'stomach' shrinks by 5" in question
    assert "is 'before' the relaxed state?" in question


def test_what_moves_the_organs_is_asked_for_in_words_of_their_region(folder):
    names = {**ABDOMEN, 3: "spleen"}
    questions = " ".join(case_of(folder, names).questions)
    assert "the stomach, the duodenum or the colon" in questions
    assert "rectum" not in questions
    pelvis = " ".join(case_of(folder, {**names, 1: "prostate"}).questions)
    assert "the rectum, which TotalSegmentator does not segment" in pelvis


def test_every_missing_role_is_named_at_once(folder):
    case = case_of(folder, {**ABDOMEN, 1: "structure x", 2: "structure y"})
    (question,) = [question for question in case.questions if question.startswith("which role")]
    (folder / "case.toml").write_text(case.text)
    for name in ('[tissues."structure x"]', '[tissues."structure y"]'):
        assert name in question
    with pytest.raises(ConfigurationError, match=r"\[tissues.structure [xy]\], \[tissues.structure [xy]\].*estimate"):
        read_case(folder / "case.toml")


@pytest.mark.parametrize(("scale", "unit"), [(1e-3, "metres"), (1e3, "micrometres")])
def test_a_header_in_another_unit_is_named_before_anything_else(tmp_path, scale, unit):
    affine = WIDE.affine * scale
    affine[3, 3] = 1.0
    for name, filled in (("before", False), ("after", True)):
        image = LabelImage(abdomen(filled=filled).labels, VoxelGrid(WIDE.shape, affine))
        write_label_image(tmp_path / f"{name}.nii.gz", image)
    with pytest.raises(InputDataError, match=f"header seems to be in {unit}"):
        case_of(tmp_path, ABDOMEN)
