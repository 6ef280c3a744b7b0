"""`palpate init`: a case that its own reader takes, roles with their reasons, questions where nothing can be known."""

from __future__ import annotations

import json
import re

import nibabel
import numpy as np
import pytest

from palpate.body.cost import expected_cost
from palpate.body.read import read_segmentation, read_states
from palpate.case.file import read_case
from palpate.cli import main
from palpate.demo import DATA
from palpate.errors import ConfigurationError, InputDataError
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.label_table import CLASSES, read_label_table
from palpate.images.readers import read_label_image, write_label_image
from palpate.images.tissue import Role
from palpate.progress import silent
from palpate.study import check
from palpate.study.guess import class_names, guess_tissues
from palpate.study.new_case import CaseImages, new_case

GRID = VoxelGrid((30, 30, 30), np.diag([2.0, 2.0, 2.0, 1.0]))
NAMES = {1: "Prostate", 2: "urinary_bladder", 3: "rectum", 4: "femur_left", 5: "colon", 6: "prostateTumour", 9: "body"}


def labels(*, filled: bool = False) -> np.ndarray:
    """Seven boxes in a body that air surrounds."""
    array = np.zeros((30, 30, 30), dtype=np.int32)
    array[2:28, 2:28, :] = 9
    array[10:18, 10:18, 10:18] = 1
    array[12:16, 12:16, 12:16] = 6
    array[10:18, 10:18, 20:28] = 2
    array[10 : 18 if filled else 15, 4:8, 5:25] = 3
    array[22:26, 10:18, 10:18] = 4
    array[22:26, 4:8, 10:18] = 5
    return array


def image(names=None, **options) -> LabelImage:
    return LabelImage(labels(**options), GRID, names or {})


@pytest.fixture
def folder(tmp_path):
    write_label_image(tmp_path / "b.nii.gz", image())
    write_label_image(tmp_path / "a.nii.gz", image(filled=True))
    write_names(tmp_path, NAMES)
    return tmp_path


def write_names(folder, names):
    (folder / "names.json").write_text(json.dumps({str(number): name for number, name in names.items()}))


def case_of(folder, names=None, *cts):
    """The new case of the images in a folder, which is written there, too."""
    if names is not None:
        write_names(folder, names)
    case = new_case(CaseImages(folder / "b.nii.gz", (folder / "a.nii.gz",), folder / "names.json", cts), folder)
    (folder / "case.toml").write_text(case.text)
    return case


def test_roles_follow_from_names_in_the_order_that_a_case_needs():
    guesses = guess_tissues(image(NAMES), [image(NAMES, filled=True)])
    assert [(g.name, g.role) for g in guesses] == [
        ("prostateTumour", Role.ESTIMATE),
        ("Prostate", Role.ESTIMATE),
        ("urinary_bladder", Role.ESTIMATE),
        ("rectum", Role.DRIVER),
        ("femur_left", Role.RIGID),
        ("surroundings", Role.KNOWN),
        ("outside", Role.VOID),
    ]
    assert all(g.reason for g in guesses)
    surroundings = guesses[-2]
    assert "colon" in surroundings.reason
    assert 2.25 < surroundings.youngs_modulus_kpa < 3.0


def test_without_names_places_and_volumes_tell():
    guesses = {g.labels: g for g in guess_tissues(image(), [image(filled=True)])}
    assert guesses[(3,)].role is Role.DRIVER
    assert "+60%" in guesses[(3,)].reason
    assert guesses[(4,)].role is Role.RIGID
    assert guesses[()].role is Role.KNOWN
    assert guesses[(0,)].role is Role.VOID


def test_a_body_without_air_is_surrounded_by_its_background():
    array = labels()
    array[array == 9] = 0
    guesses = guess_tissues(
        LabelImage(array, GRID, {1: "prostate", 3: "rectum", 2: "bladder", 4: "sacrum", 5: "aorta"})
    )
    assert [g.role for g in guesses if not g.labels] == [Role.KNOWN]
    assert Role.VOID not in [g.role for g in guesses]


def test_an_organ_that_a_later_image_lacks_is_left_to_the_surroundings():
    later = labels(filled=True)
    later[later == 2] = 9
    guesses = guess_tissues(image(NAMES), [LabelImage(later, GRID, NAMES)])
    assert "urinary_bladder" not in [g.name for g in guesses]


def test_an_image_of_one_label_is_refused():
    with pytest.raises(InputDataError, match="no organ"):
        guess_tissues(LabelImage(np.zeros((30, 30, 30), dtype=np.int32), GRID))


def test_the_case_is_read_by_its_reader_with_paths_that_lead_to_the_images(folder, capsys):
    command = ["init", str(folder / "b.nii.gz"), str(folder / "a.nii.gz"), "--labels", str(folder / "names.json")]
    assert main([*command, "--output", str(folder / "new" / "case 1"), "--json", "--quiet"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "palpate.init/1"
    assert {row["role"] for row in document["tissues"]} == {"estimate", "driver", "rigid", "known", "void"}
    assert document["questions"] == []
    path = folder / "new" / "case 1" / "case.toml"
    assert sorted(item.name for item in path.parent.iterdir()) == ["case.toml", "preview.html"]
    case = read_case(path)
    assert case.images.before.resolve() == (folder / "b.nii.gz").resolve()
    assert str(folder) not in path.read_text()
    assert "'rectum' is hollow" in path.read_text()
    assert check.checked_case(path, progress=silent, meshed=False).report.exit_code == 0


def test_what_cannot_be_guessed_is_asked_for_and_then_refused_by_its_key(folder):
    case = case_of(folder, {1: "prostate", 3: "rectum", 2: "structure x", 9: "body"})
    assert any('tissues."structure x"' in question for question in case.questions)
    with pytest.raises(ConfigurationError, match=r"the key 'role' is missing in \[tissues.structure x\]"):
        read_case(folder / "case.toml")


def test_a_case_without_a_driver_asks_for_one(folder):
    case = case_of(folder, {1: "prostate", 3: "vein", 2: "bladder", 9: "body"})
    assert any("nothing was found that moves" in question for question in case.questions)


def test_another_case_is_never_replaced(folder, capsys):
    images = [str(folder / "b.nii.gz"), str(folder / "a.nii.gz")]
    (folder / "case.toml").write_text("# corrected by hand\n")
    assert main(["init", *images, "--output", str(folder), "--quiet"]) == 2
    assert "it is not replaced" in capsys.readouterr().err
    assert (folder / "case.toml").read_text() == "# corrected by hand\n"


def test_identical_images_are_refused_before_anything_is_written(folder, capsys):
    images = [str(folder / "b.nii.gz")] * 2
    assert main(["estimate", *images, "--output", str(folder / "out"), "--quiet"]) == 3
    assert "the same label image" in capsys.readouterr().err
    assert not (folder / "out").exists()


def test_one_image_is_not_enough(folder, capsys):
    assert main(["init", str(folder / "b.nii.gz"), "--output", str(folder), "--quiet"]) == 2
    assert "one or more after" in capsys.readouterr().err


def test_names_that_toml_could_stumble_over_survive(folder):
    names = {1: 'prostate "x" # [a]', 3: "rectum\\", 9: "body", 2: "bladder = 3"}
    case_of(folder, names)
    tissues = read_case(folder / "case.toml").tissues
    assert {tissue.name for tissue in tissues} >= {names[1], names[2], names[3]}


def write_ct(path, labels_shown, *, inside=40.0, outside=-1000.0):
    """A CT of the body of `labels`, on a table."""
    hounsfield = np.where(labels_shown == 0, outside, inside)
    hounsfield[:, 0, :] = inside  # a table of one voxel, which does not touch the body
    nibabel.save(nibabel.Nifti1Image(hounsfield.astype(np.float32), GRID.affine), path)


@pytest.fixture
def bodiless(tmp_path):
    """The seven boxes without the label of the body, and CTs of both states."""
    for name, filled in (("b", False), ("a", True)):
        array = labels(filled=filled)
        write_ct(tmp_path / f"{name}_ct.nii.gz", array)
        write_label_image(tmp_path / f"{name}.nii.gz", LabelImage(np.where(array == 9, 0, array), GRID))
    write_names(tmp_path, {number: name for number, name in NAMES.items() if number != 9})
    return tmp_path


def test_what_a_ct_shows_to_be_air_is_void_and_the_rest_of_label_0_is_tissue(bodiless):
    case = case_of(bodiless, None, bodiless / "b_ct.nii.gz", bodiless / "a_ct.nii.gz")
    read = read_case(bodiless / "case.toml")
    for path, filled in ((read.images.before, False), (read.images.after[0], True)):
        found = read_segmentation(read, path, read_label_table(read.images.names), None)
        names = [tissue.name for tissue in found.tissues]
        array = labels(filled=filled)
        assert np.array_equal(found.mask(names.index("air")), array == 0)
        assert np.array_equal(found.mask(names.index("surroundings")), np.isin(array, [5, 9]))
    share = np.count_nonzero(labels() == 0) / np.count_nonzero(np.isin(labels(), [0, 9]))
    assert f"is air around the body for {share:.1%} of its volume" in case.text
    assert 'intensities_after = ["a_ct.nii.gz"]' in case.text


@pytest.mark.parametrize("ct", [None, {"inside": 300.0, "outside": 0.0}])
def test_without_a_ct_the_case_says_how_much_of_label_0_no_label_tells_from_air(bodiless, ct):
    if ct is not None:  # an MR image shows no air in Hounsfield units
        write_ct(bodiless / "mr.nii.gz", labels(), **ct)
    case = case_of(bodiless, None, *([bodiless / "mr.nii.gz"] if ct else []))
    shown = np.argwhere(np.isin(labels(), [1, 2, 3, 4, 5, 6]))
    low, high = shown.min(axis=0), shown.max(axis=0)
    within = np.prod(high - low + 1) / labels().size  # the hull is smaller than the box around the labels
    (note,) = [line for line in case.text.splitlines() if line.startswith("# NOTE: label 0")]
    beyond = int(re.search(r"(\d+)% of its volume lies outside", note)[1]) / 100
    assert 1.0 - within < beyond < 1.0
    assert Role.VOID not in [tissue.role for tissue in case.tissues]
    assert "give the CT" in note


def test_in_an_image_wider_than_a_body_air_is_asked_for(bodiless):
    wide = VoxelGrid((30, 30, 30), np.diag([10.0, 10.0, 2.0, 1.0]))
    for name, filled in (("b", False), ("a", True)):
        array = labels(filled=filled)
        write_label_image(bodiless / f"{name}.nii.gz", LabelImage(np.where(array == 9, 0, array), wide))
    assert [question for question in case_of(bodiless).questions if "label 0" in question]


def test_a_background_without_a_body_is_no_air():
    array = np.where(labels() == 9, 0, labels())
    guesses = guess_tissues(LabelImage(array, GRID, {0: "background", **{k: v for k, v in NAMES.items() if k != 9}}))
    assert [(g.name, g.role) for g in guesses if not g.labels] == [("surroundings", Role.KNOWN)]
    assert guess_tissues(LabelImage(array, GRID, {0: "air", **NAMES}))[-1].role is Role.VOID


def test_the_proposed_mesh_fits_the_memory_of_the_machine(folder, environment):
    has_gb = 1.0

    def edge_and_memory(text):
        (folder / "case.toml").write_text(text)
        case = read_case(folder / "case.toml")
        return case.mesh.edge_length_mm, [problem.code for problem in _memory(case)]

    def _memory(case):
        states = read_states(case)
        return check.memory_problems(expected_cost(case, states.before, states.after, n_pairs=1))

    roomy, _ = edge_and_memory(case_of(folder).text)
    environment(PALPATE_MEMORY_GB=f"{has_gb:g}")
    text = case_of(folder).text
    edge, problems = edge_and_memory(text)
    assert edge > roomy
    assert problems == []
    assert f"this machine has {has_gb:.0f} GB" in text
    _, before = edge_and_memory(text.replace(f"edge_length_mm = {edge:g}", f"edge_length_mm = {edge - 0.5:g}"))
    assert before == ["memory"]


COLON = {1: "prostate", 2: "urinary_bladder", 3: "colon", 4: "femur_left", 9: "body"}


def test_without_a_rectum_the_colon_near_an_organ_of_the_pelvis_is_offered_as_driver(folder):
    case = case_of(folder, COLON)
    roles = {tissue.name: tissue.role for tissue in read_case(folder / "case.toml").tissues}
    assert roles["colon"] is Role.DRIVER
    (question,) = case.questions
    assert "[tissues.colon] role: no rectum is labelled, and 'colon' comes within 6.0 mm of 'prostate'" in question


def test_a_colon_that_is_far_from_the_pelvic_organs_is_not_offered():
    near, far = ({1: organ, 2: "liver", 3: "colon", 9: "body"} for organ in ("prostate", "pancreas"))
    roles = [{g.name: g.role for g in guess_tissues(image(names)) if g.labels == (3,)} for names in (near, far)]
    assert roles == [{"colon": Role.DRIVER}, {}]
    array = labels()
    array[array == 3] = 9
    array[27, 27, :] = 3
    assert Role.DRIVER not in [g.role for g in guess_tissues(LabelImage(array, GRID, near))]


def test_every_class_of_totalsegmentator_has_a_rule():
    for names in CLASSES.values():
        array = np.zeros((5, 5, len(names)), dtype=np.int32)
        array[2, 2] = list(names.values())
        grid = VoxelGrid(array.shape, np.diag([20.0, 20.0, 20.0, 1.0]))
        guesses = guess_tissues(LabelImage(array, grid, {number: name for name, number in names.items()}))
        assert [g.name for g in guesses if g.role is None] == []
        roles = {g.name: g.role for g in guesses}
        assert {roles[name] for name in ("urinary_bladder", "prostate")} == {Role.ESTIMATE}
        (bones,) = [g for g in guesses if g.role is Role.RIGID]
        named = {names[name] for name in ("hip_left", "hip_right", "femur_left", "sacrum")}
        assert named <= set(bones.labels)
        assert "hip_left" in bones.reason


@pytest.mark.parametrize(("task", "organ", "colon"), [("total", 22, 20), ("total_mr", 17, 15)])
def test_numbers_of_totalsegmentator_are_known_where_left_and_right_confirm_them(tmp_path, task, organ, colon):
    classes = CLASSES[task]
    array = np.zeros((30, 30, 30), dtype=np.int32)
    array[10:18, 10:18, 10:18] = organ
    array[12:16, 4:8, 5:25] = colon
    for name, place in (("hip_left", 3), ("hip_right", 26), ("femur_left", 1), ("femur_right", 28)):
        array[place, 10:18, 10:18] = classes[name]
    paths = [tmp_path / "b.nii.gz", tmp_path / "a.nii.gz"]
    write_label_image(paths[0], LabelImage(array, GRID))
    array[11, 4:8, 5:25] = colon
    write_label_image(paths[1], LabelImage(array, GRID))
    case = new_case(CaseImages(paths[0], (paths[1],)), tmp_path)
    assert {t.name: t.role for t in case.tissues if t.labels and t.labels != (0,)} == {
        "prostate": Role.ESTIMATE,
        "colon": Role.DRIVER,
        "bones": Role.RIGID,
    }
    assert (
        f"NOTE: the labels have no names; their numbers were taken for those of TotalSegmentator's task '{task}', for 2"
        in (case.text)
    )
    (tmp_path / "case.toml").write_text(case.text)
    assert {t.name: t.label for t in read_case(tmp_path / "case.toml").tissues}["prostate"] == (organ,)
    mirrored = VoxelGrid(GRID.shape, np.diag([-2.0, 2.0, 2.0, 1.0]))
    assert class_names(LabelImage(array, mirrored)).names == {}
    assert class_names(LabelImage(labels(), GRID)).names == {}


def test_names_in_a_folder_of_masks_make_a_case_without_numbers(tmp_path):
    for state, filled in (("before", False), ("after", True)):
        (tmp_path / state).mkdir()
        array = labels(filled=filled)
        for number, name in COLON.items():
            if name != "body":
                mask = (array == number) | ((array == 1) & (number == 2) & (np.arange(30) == 17))
                write_label_image(tmp_path / state / f"{name}.nii.gz", LabelImage(mask, GRID))
    assert main(["init", *(str(tmp_path / s) for s in ("before", "after")), "--output", str(tmp_path), "--quiet"]) == 0
    text = (tmp_path / "case.toml").read_text()
    assert 'before = "before"' in text
    assert "64 voxels belong to several masks" in text, text
    assert 'label = "urinary_bladder"' in text


def test_the_demo_as_masks_of_totalsegmentator_is_the_same_segmentation(tmp_path):
    demo = read_case(DATA / "demo.toml")
    names = read_label_table(demo.images.names)
    classes = {"rectum": "colon", "sacrum_S1": "sacrum"}
    images = dict(zip(("before", "after"), (demo.images.before, *demo.images.after), strict=True))
    for state, path in images.items():
        (tmp_path / state).mkdir()
        shown = read_label_image(path)
        for number in np.unique(shown.labels[shown.labels > 0]):
            name = classes.get(names[number], names[number])
            mask = LabelImage(shown.labels == number, shown.grid)
            write_label_image(tmp_path / state / f"{name}.nii.gz", mask)
    case = new_case(CaseImages(tmp_path / "before", (tmp_path / "after",)), tmp_path)
    (tmp_path / "case.toml").write_text(case.text)
    (question,) = case.questions
    assert "is the rectum part of that label?" in question
    ours = read_case(tmp_path / "case.toml")
    for state, path in images.items():
        there = read_segmentation(demo, path, names, None)
        here = read_segmentation(ours, tmp_path / state, None, None)
        mine = {tissue.name: i for i, tissue in enumerate(here.tissues)}
        same = {"bladder": "urinary_bladder", "rectum": "colon"}
        for i, tissue in enumerate(there.tissues):
            j = mine[same.get(tissue.name, tissue.name)]
            assert here.tissues[j].role is tissue.role
            assert np.array_equal(here.mask(j), there.mask(i))
        assert np.array_equal(here.grid.affine, there.grid.affine)
