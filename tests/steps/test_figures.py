"""`palpate.figures`: all files or none, from a result or its folder, and refusals that say what to do."""

from __future__ import annotations

import json
import re

import pytest

import palpate
from palpate.cli import main
from palpate.errors import ConfigurationError, InputDataError
from palpate.steps.saving import save_estimate
from palpate.study.outputs import OutputFolder


@pytest.fixture(scope="module")
def folder(case_result, tmp_path_factory):
    """The output folder of an estimate."""
    path = tmp_path_factory.mktemp("estimate") / "out"
    save_estimate(case_result, OutputFolder(path))
    return path


def test_a_folder_and_the_result_itself_give_the_same_figures(folder, case_result, tmp_path):
    of_folder = palpate.figures(folder, tmp_path / "a", formats=["svg"], unit="kPa")
    of_result = palpate.figures(case_result, tmp_path / "b", formats=["svg"], unit="kPa")
    assert [path.name for path in of_folder] == [path.name for path in of_result]
    assert "captions.txt" in [path.name for path in of_folder]
    for one, other in zip(of_folder, of_result, strict=True):
        assert one.read_bytes() == other.read_bytes()


def test_the_command_lists_what_it_wrote(folder, tmp_path, capsys):
    code = main(
        ["figures", str(folder), "--output", str(tmp_path / "out"), "--formats", "png", "--dpi", "60", "--json"]
    )
    document = json.loads(capsys.readouterr().out)
    assert code == 0
    assert document["schema"] == "palpate.figures/1"
    assert sorted(document["files"]) == sorted(path.name for path in (tmp_path / "out").iterdir())
    assert not document["missing"]
    assert all(of["caption"] and of["files"] for of in document["figures"])


def test_neither_figures_nor_exports_are_written_among_the_files_of_another_result(folder, case_result, tmp_path):
    other = tmp_path / "other"
    save_estimate(case_result, OutputFolder(other))
    before = {path.name: path.read_bytes() for path in other.iterdir()}
    with pytest.raises(ConfigurationError, match="choose another --output"):
        palpate.figures(folder, other, formats=["svg"])
    with pytest.raises(ConfigurationError, match="choose another --output"):
        palpate.export(folder, other, format="slicer")
    assert {path.name: path.read_bytes() for path in other.iterdir()} == before


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"formats": ["eps"]}, "choose among svg, pdf, png"),
        ({"formats": []}, "choose among svg, pdf, png"),
        ({"dpi": 5000}, "give 50 to 1200"),
        ({"unit": "Pa"}, "choose 'kPa' or 'ratio'"),
    ],
)
def test_settings_that_cannot_be_leave_nothing(folder, tmp_path, options, said):
    with pytest.raises(ConfigurationError, match=re.escape(said)):
        palpate.figures(folder, tmp_path / "out", **options)
    assert not list(tmp_path.rglob("*.*"))


def test_figures_do_not_go_into_the_result(folder):
    before = sorted(folder.iterdir())
    with pytest.raises(ConfigurationError, match="which stays alone"):
        palpate.figures(folder, folder)
    assert sorted(folder.iterdir()) == before


def test_a_folder_without_data_says_what_to_do(folder, tmp_path):
    document = json.loads((folder / "result.json").read_text())
    del document["files"]["report-data.npz"]
    (tmp_path / "result.json").write_text(json.dumps(document))
    with pytest.raises(InputDataError, match=r"left no report-data\.npz.*run the estimate again"):
        palpate.figures(tmp_path, tmp_path / "out")
    with pytest.raises(InputDataError, match="run the estimate first"):
        palpate.figures(tmp_path / "nowhere", tmp_path / "out")


def test_numbers_that_were_changed_are_not_drawn(folder, tmp_path):
    document = json.loads((folder / "result.json").read_text())
    document["estimates"][0]["value"] = 1.0
    (tmp_path / "result.json").write_text(json.dumps(document))
    (tmp_path / "report-data.npz").write_bytes((folder / "report-data.npz").read_bytes())
    with pytest.raises(InputDataError, match="one was changed since"):
        palpate.figures(tmp_path, tmp_path / "out")
    (tmp_path / "report-data.npz").write_bytes(b"PK")
    with pytest.raises(InputDataError, match="SHA-256"):
        palpate.figures(tmp_path, tmp_path / "out")
