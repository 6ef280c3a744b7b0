"""TotalSegmentator's reports of its runs: found beside images, and compared."""

from __future__ import annotations

import json

import pytest

from palpate.findings import MOST_WORDS, words_in
from palpate.images.run_report import run_report, segmented_otherwise


def report(path, version="2.18.0", task="total", **speed):
    """As version 2.18.0 writes it, in part."""
    document = {"totalsegmentator_version": version, "nnunetv2_version": "2.6.2", "task": task, "modality": "ct"}
    document |= {"fast": False, "fastest": False, "input": "ct.nii.gz", "num_classes": 117} | speed
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(document, indent=2))


@pytest.mark.parametrize("place", ["before/report.json", "before.json", "before_report.json"])
def test_the_report_of_a_folder_of_masks_lies_in_it_or_beside_it(tmp_path, place):
    (tmp_path / "before").mkdir()
    report(tmp_path / place, fast=True)
    found = run_report(tmp_path / "before")
    assert (found.version, found.task, found.speed) == ("2.18.0", "total", "fast")


def test_the_report_of_a_file_has_a_name_that_begins_like_its_own(tmp_path):
    report(tmp_path / "before.json", "2.15.1")
    report(tmp_path / "after.json", "2.18.0")
    assert run_report(tmp_path / "before.nii.gz").version == "2.15.1"
    assert run_report(tmp_path / "other.nii.gz") is None


@pytest.mark.parametrize("text", ["{", "[]", "null", '{"totalsegmentator_version": 2}', "[" * 100_000])
def test_other_documents_are_passed_over(tmp_path, text):
    (tmp_path / "before.json").write_text(text)
    report(tmp_path / "before_run.json")
    assert run_report(tmp_path / "before.nii.gz").version == "2.18.0"


def test_one_release_with_the_same_options_draws_alike(tmp_path):
    for name, version in (("before", "2.18.0"), ("after", "2.18.3")):
        report(tmp_path / f"{name}.json", version)
    assert segmented_otherwise(tmp_path / "before.nii.gz", [tmp_path / "after.nii.gz"]) == ()


@pytest.mark.parametrize(
    ("version", "options", "words"),
    [
        ("2.15.0", {}, "2.15.0 (task total, resampled by cubic splines)"),
        ("2.17.0", {}, "2.17.0 (task total, resampled linearly)"),
        ("2.18.0", {"fast": True}, "2.18.0 (task total, fast, resampled linearly)"),
        ("2.18.0", {"task": "total_mr"}, "2.18.0 (task total_mr, resampled linearly)"),
        ("a branch", {}, "a branch (task total)"),
    ],
)
def test_another_release_task_or_speed_is_said_with_both(tmp_path, version, options, words):
    report(tmp_path / "before.json")
    report(tmp_path / "b.json", version, **options)
    (finding,) = segmented_otherwise(tmp_path / "before.nii.gz", [tmp_path / "nothing.nii.gz", tmp_path / "b.nii.gz"])
    assert finding.code == "segmented-otherwise"
    assert "2.18.0 (task total, resampled linearly) segmented 'before'" in finding.message
    assert words in finding.message
    assert "'after[1]'" in finding.message
    assert words_in(finding.message) <= MOST_WORDS


def test_where_one_image_has_no_report_nothing_is_said(tmp_path):
    report(tmp_path / "after.json", "2.15.0")
    assert segmented_otherwise(tmp_path / "before.nii.gz", [tmp_path / "after.nii.gz"]) == ()
