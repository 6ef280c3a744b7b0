"""The table of a cohort: what it may say, what each line means, and what is written of it."""

from __future__ import annotations

import csv
from pathlib import Path

import pyarrow.parquet
import pytest

from case_texts import ORGAN, case_text
from palpate.cohort.records import Modulus, Record
from palpate.cohort.resolve import case_of, row_key
from palpate.cohort.table import read_derivatives, read_table
from palpate.cohort.tables import write_csv, write_parquet
from palpate.cohort.task import Row
from palpate.errors import ConfigurationError

TEMPLATE = case_text(
    {"prostate": ORGAN, "rectum": {"label": 2, "role": "driver"}},
    id="of the template",
    patient="of the template",
    stage=9,
    before="nowhere/b.nii.gz",
    after=["nowhere/a.nii.gz"],
    images={"intensities_before": "nowhere/ct.nii.gz", "align": "none"},
)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "template.toml").write_text(TEMPLATE)
    (tmp_path / "images").mkdir()
    for name in ("b", "a", "c"):
        (tmp_path / f"images/{name}.nii.gz").write_text(name)
    return tmp_path


def table(folder, *lines, heads="id,patient,session,stage,before,after,age"):
    (folder / "cohort.csv").write_text("\n".join([heads, *lines]) + "\n")
    return read_table(folder / "cohort.csv", folder / "template.toml")


def test_the_rows_words_replace_those_of_the_template(folder):
    rows = table(
        folder, "r1,Ann,2,3,images/b.nii.gz,images/a.nii.gz;images/c.nii.gz,61", "", "r2,,,,images/b.nii.gz,x,"
    )
    case = case_of(rows[0], ["mesh.edge_length_mm=7"])
    assert (case.id, case.patient, case.stage, case.mesh.edge_length_mm) == ("r1", "Ann", 3, 7.0)
    assert case.images.before == folder / "images/b.nii.gz"
    assert case.images.after == (folder / "images/a.nii.gz", folder / "images/c.nii.gz")
    assert case.images.intensities_before is None
    assert case.align == "none"
    assert rows[0].covariates == {"age": "61"}
    other = case_of(rows[1])
    assert (other.patient, other.stage) == ("r2", None)


def test_a_row_may_name_its_own_case(folder):
    (folder / "own").mkdir()
    (folder / "own/case.toml").write_text(TEMPLATE.replace("nowhere", "../images"))
    (folder / "cohort.csv").write_text("id,stage,case\nr1,1,own/case.toml\n")
    case = case_of(read_table(folder / "cohort.csv", None)[0])
    assert (case.id, case.patient, case.stage) == ("r1", "r1", 1)
    assert case.images.before.resolve() == folder / "images/b.nii.gz"


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("r,P,,T2,images/b.nii.gz,images/a.nii.gz,", "its stage is 'T2'"),
        ("r,P,,2000,images/b.nii.gz,images/a.nii.gz,", "0 to 1000"),
        ("r,P,,1,images/b.nii.gz,,", "no image 'after'"),
        ("r,P,,1,,,", "either a case file"),
    ],
)
def test_what_is_wrong_with_a_line_is_its_rows_problem(folder, line, problem):
    (row,) = table(folder, line)
    assert problem in row.problem
    with pytest.raises(ConfigurationError, match=r"stage|image|case file"):
        case_of(row)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("patient,before,after\n", "lacks the column 'id'"),
        ("id,before\nr,b\n", "lacks the column 'after'"),
        ("id,before,after,id\n", "'id' twice"),
        ("id,before,after\nr,b\n", "line 2, has 2 cells"),
        ("id,before,after\n", "has 0 rows"),
        ("id,before,after\n../r,b,a\n", "cannot name a folder"),
        ("id,before,after\nCON,b,a\n", "cannot name a folder"),
        ("id,before,after\nr,b,a\nR,b,a\n", "stands there twice"),
        ("id,before,after,=x\nr,b,a,1\n", "cannot be the name of a column"),
        ("id,before,after,state\nr,b,a,1\n", "one of the outcome's"),
        ('id,before,after\n"r,b,a\n', "no CSV file"),
    ],
)
def test_a_table_that_cannot_be_read_is_refused_as_a_whole(folder, text, said):
    (folder / "cohort.csv").write_text(text)
    with pytest.raises(ConfigurationError, match=said):
        read_table(folder / "cohort.csv", folder / "template.toml")


def test_the_key_depends_on_what_the_numbers_depend_on_and_on_nothing_else(folder):
    line = "r,P,2,3,images/b.nii.gz,images/a.nii.gz,61"
    (row,) = table(folder, line)
    key = row_key(row)
    for same in (line.replace(",3,", ",,"), line.replace("P,2", "Q,3"), line.replace("61", "62")):
        assert row_key(*table(folder, same)) == key
    (folder / "images/moved.nii.gz").write_text("b")
    assert row_key(*table(folder, line.replace("/b.", "/moved."))) == key
    assert row_key(row, ["mesh.edge_length_mm=7"]) != key
    assert row_key(*table(folder, line.replace("/b.", "/c."))) != key
    (folder / "images/a.nii.gz").write_text("another")
    changed = row_key(row)
    assert changed != key
    (folder / "images/a.nii.gz").unlink()
    assert row_key(row) not in (key, changed)
    template = (folder / "template.toml").read_text()
    (folder / "template.toml").write_text(template + "poisson_ratio = 0.4\n")
    assert row_key(row) not in (key, changed)


def test_what_lies_beside_a_header_counts(folder):
    (folder / "images/b.mhd").write_text("ElementDataFile = b.raw")
    (folder / "images/b.raw").write_text("voxels")
    (row,) = table(folder, "r,P,2,3,images/b.mhd,images/a.nii.gz,61")
    key = row_key(row)
    (folder / "images/b.raw").write_text("other voxels")
    assert row_key(row) != key


def test_cells_that_a_spreadsheet_would_compute_are_texts(tmp_path):
    moduli = (Modulus("prostate", "kPa", 30.5, 25.0, None, "weak"), Modulus("core", "ratio", 3.0, 2.0, 4.0, "weak"))
    rows = [
        Row("a", "=cmd|' /C calc'!A0", "+1", 2, covariates={"note": "@SUM(1)", "age": "-3"}),
        Row("b", "P\x1b[31m", "", None),
    ]
    records = [Record(rows[0], "done", moduli=moduli), Record(rows[1], "failed", "input", "-1 is, no image")]
    write_csv(records, tmp_path / "cohort.csv")
    lines = list(csv.DictReader((tmp_path / "cohort.csv").read_text().splitlines()))
    assert [lines[0][name] for name in ("patient", "session", "note", "age")] == [
        "'=cmd|' /C calc'!A0",
        "'+1",
        "'@SUM(1)",
        "'-3",
    ]
    assert lines[1]["message"] == "'-1 is, no image"
    assert "\x1b" not in lines[1]["patient"]
    numbers = ("prostate_kpa", "prostate_low95", "prostate_high95", "prostate_verdict", "core_ratio")
    assert [lines[0][name] for name in numbers] == ["30.5", "25.0", "", "weak", "3.0"]
    first = ["id", "patient", "session", "stage", "state", "failure_class", "message", "warnings"]
    assert list(lines[0])[: len(first)] == first
    assert [(line["used_prostate"], line["left_out_prostate"]) for line in lines] == [("true", ""), ("false", "failed")]
    write_parquet(records, tmp_path / "cohort.parquet")
    found = pyarrow.parquet.read_table(tmp_path / "cohort.parquet").to_pylist()
    assert found[0]["stage"] == 2
    assert found[0]["prostate_high95"] is None
    assert [row["used_prostate"] for row in found] == [True, False]
    assert found[1]["state"] == "failed"


def image(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()


def test_bids_derivatives_are_rows_against_the_first_session(folder):
    root = folder / "derivatives"
    for session in ("ses-2", "ses-10", "ses-1/anat"):
        image(root / f"sub-01/{session}/sub-01_{session.split('/')[0]}_dseg.nii.gz")
    image(root / "sub-02/ses-1/sub-02_ses-1_dseg.nii.gz")
    (root / "dseg.tsv").write_text("index\tname\n1\tprostate\n")
    (root / "participants.tsv").write_text("participant_id\tstage\tage\nsub-01\t3\tn/a\n")
    rows = read_derivatives(root, folder / "template.toml")
    assert [(row.id, row.patient, row.session, row.stage) for row in rows] == [
        ("sub-01_ses-2", "sub-01", "ses-2", 3),
        ("sub-01_ses-10", "sub-01", "ses-10", 3),
    ]
    assert rows[0].covariates == {"age": ""}
    case = case_of(rows[0])
    assert case.images.before == root / "sub-01/ses-1/anat/sub-01_ses-1_dseg.nii.gz"
    assert case.images.names == root / "dseg.tsv"
    assert [row.id for row in read_derivatives(root, folder / "template.toml", reference="10")] == [
        "sub-01_ses-1",
        "sub-01_ses-2",
    ]
    with pytest.raises(ConfigurationError, match="two sessions"):
        read_derivatives(root, folder / "template.toml", reference="ses-7")
    with pytest.raises(ConfigurationError, match="--template"):
        read_derivatives(root, None)
    image(root / "sub-01/ses-2/other_dseg.nii.gz")
    assert "several images" in read_derivatives(root, folder / "template.toml")[0].problem
