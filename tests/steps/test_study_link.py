"""A report links to the sensitivity study beside it, if that is of its own estimate."""

from __future__ import annotations

import shutil

import pytest

from palpate.cli import main
from palpate.steps import saving
from palpate.study.outputs import OutputFolder, read_json

LINK = 'href="sensitivity.html"'


class Study:
    """A sensitivity study of the estimates of a result, of whose assumptions the law alone was changed."""

    def __init__(self, estimates):
        self.estimates = estimates

    def to_dict(self):
        keys = {"id": "a", "law": "linear", "element": "P2", "versions": {}, "case": {}}
        of_law = {"cause": "law", "subject": "", "setting": "linear", "method": "exact", "at_bound": [], "reason": None}
        variations = [of_law | {"changes": {item["tissue"]: 0.1 for item in self.estimates}}]
        return keys | {"estimates": self.estimates, "variations": variations, "warnings": []}


@pytest.fixture(scope="module")
def saved(case_result, tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved")
    saving.save_estimate(case_result, OutputFolder(folder))
    return folder


@pytest.fixture
def folder(saved, tmp_path):
    return shutil.copytree(saved, tmp_path, dirs_exist_ok=True)


def study_of(folder, **changes):
    found = [dict(item) | changes for item in read_json(folder / "result.json")["estimates"]]
    saving.save_sensitivity(Study(found), OutputFolder(folder))


def test_the_study_of_the_same_estimate_is_linked_to(folder):
    assert LINK not in (folder / "report.html").read_text(encoding="utf-8")
    study_of(folder)
    assert saving.has_study(folder)
    assert LINK in (folder / "report.html").read_text(encoding="utf-8")
    assert main(["report", str(folder), "--quiet"]) == 0
    assert LINK in (folder / "report.html").read_text(encoding="utf-8")


def test_that_of_another_one_is_not(folder):
    study_of(folder, value=1.0)
    assert not saving.has_study(folder)
    assert LINK not in (folder / "report.html").read_text(encoding="utf-8")
