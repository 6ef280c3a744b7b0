"""An estimate whose numbers are known beforehand, run by the command line; its page is a line of text."""

from __future__ import annotations

import dataclasses

import pytest

from case_texts import ORGAN, REST, case_text
from palpate.cli import main
from palpate.report import case_report
from palpate.study import run as study_run

CASE = case_text({"prostate": ORGAN, "surroundings": REST}, id="ID")


def plain_page(data, **_):
    return f"the page of {data.document['id']}"


@pytest.fixture
def estimate(tmp_path, monkeypatch, case_result):
    """Run `palpate estimate` of a patient into the folder `out`, whatever case has its result there.

    `overwrite`: a result of another case is replaced; `meanwhile` is called in the place of the numbers; `draw` draws
    the page, this time and until another does.
    """

    def run(patient: str, *flags: str, overwrite=True, meanwhile=lambda: None, draw=plain_page) -> int:
        def compute(case, *, progress, truth):
            assert truth is None
            progress("working")
            meanwhile()
            return dataclasses.replace(case_result, case=case)

        monkeypatch.setattr(study_run, "estimate", compute)
        monkeypatch.setattr(case_report, "render", draw)
        (tmp_path / f"{patient}.toml").write_text(CASE.replace("ID", patient))
        flags = (*flags, "--overwrite") if overwrite else flags
        return main(["estimate", str(tmp_path / f"{patient}.toml"), "--output", str(tmp_path / "out"), *flags])

    return run


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"
