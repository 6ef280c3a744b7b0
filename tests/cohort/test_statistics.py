"""Statistics of a cohort: their unit is the patient, intervals are weights, what is undefined is said in words."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from palpate.cohort.page import cohort_page
from palpate.cohort.records import Modulus, Record
from palpate.cohort.statistics.association import association
from palpate.cohort.statistics.document import statistics_document
from palpate.cohort.statistics.models import combined, mixed_model, repeatability, weighted_regression
from palpate.cohort.statistics.scans import inside_fences, usable_scans
from palpate.cohort.task import Row

NAME = "</script><img src=x onerror=alert(1)>"


def record(number, patient, stage, value, sd=0.1, *, verdict="identified", unit="kPa", covariates=None):
    ends = (value * math.exp(-1.959964 * sd), value * math.exp(1.959964 * sd))
    modulus = Modulus("prostate", unit, value, *ends, verdict)
    row = Row(f"r{number}", patient, str(number), stage, covariates=covariates or {})
    return Record(row, "done", moduli=(modulus,))


@pytest.fixture(scope="module")
def records():
    """12 patients with 4 scans each; E grows by 1.3 a stage; 15 % between patients, 20 % within."""
    rng = np.random.default_rng(5)
    found = []
    for patient in range(12):
        stage = 1 + patient % 4
        own = 20.0 * 1.3**stage * math.exp(0.15 * rng.standard_normal())
        for _ in range(4):
            value = own * math.exp(0.2 * rng.standard_normal())
            found.append(record(len(found), f"P{patient}", stage, value, covariates={"age": str(50 + patient)}))
    return found


@pytest.fixture(scope="module")
def document(records):
    bad = Record(Row("bad", NAME, stage=2), "failed", "input", NAME)
    return statistics_document([*records, bad, Record(Row("left", "Q"), "waiting")])


def test_the_unit_of_analysis_is_named_and_counted(document):
    organ = document["organs"]["prostate"]
    assert document["unit_of_analysis"] == "patient"
    assert (organ["per_patient"]["n"], organ["per_scan"]["n"], document["paper"]["prostate"]["n"] <= 48) == (
        12,
        48,
        True,
    )
    assert organ["per_scan"]["p"] < organ["per_patient"]["p"]
    assert organ["left_out"] == {"failed": 1, "waiting": 1, "not identified": 0, "other unit": 0}
    assert {"patients", "organs", "paper", "notes"} <= set(document)
    first = document["patients"][0]
    assert (first["patient"], first["stage"], len(first["kpa"]["prostate"])) == ("P0", 1, 4)
    assert [row["n_patients"] for row in organ["by_stage"]] == [3, 3, 3, 3]


def test_all_models_find_the_growth_that_was_put_in(document):
    organ = document["organs"]["prostate"]
    for name in ("weighted", "mixed_model", "mixed_model_adjusted"):
        low, high = organ[name]["interval95"]
        assert low < 1.3 < high
        assert organ[name]["p"] < 0.01
    assert organ["mixed_model_adjusted"]["covariates"] == ["age"]
    assert organ["mixed_model"]["sd_within_patients"] == pytest.approx(0.2, rel=0.25)
    assert organ["repeatability"]["within_patient_cv"] == pytest.approx(0.2, rel=0.25)
    low, high = organ["repeatability"]["icc_interval95"]
    assert low < organ["repeatability"]["icc"] < high


def test_icc_of_equal_groups_is_shrout_and_fleiss():
    """Their table 2 as far as it goes one way: ICC(1,1) = 0.17 of 6 targets and 4 judges."""
    scores = [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]]
    rows = [
        record(4 * i + j, f"P{i}", 1, math.exp(score)) for i, line in enumerate(scores) for j, score in enumerate(line)
    ]
    found = repeatability(usable_scans(rows, "prostate"))
    assert found["icc"] == pytest.approx(0.17, abs=0.005)
    assert found["within_patient_sd_ln"] ** 2 == pytest.approx(6.26, abs=0.01)


def test_a_scan_with_a_wide_interval_counts_for_little():
    sharp, vague = record(0, "P", 1, 20.0, 0.05), record(1, "P", 1, 40.0, 0.5)
    scans = usable_scans([sharp, vague], "prostate").scans
    assert 20.0 < combined(scans).value < 25.0
    assert combined(scans[:1]).sd == pytest.approx(0.05, rel=1e-4)


def test_scans_that_agree_no_better_than_their_intervals_are_not_made_certain():
    far = [record(i, "P", 1, value, 0.01) for i, value in enumerate([10.0, 40.0])]
    found = combined(usable_scans(far, "prostate").scans)
    assert found.low95 < 10.0
    assert found.high95 > 40.0


def test_what_is_not_identified_is_left_out_and_counted(records):
    changed = [dataclasses.replace(records[0], moduli=(dataclasses.replace(records[0].moduli[0], high95=None),))]
    changed += [record(1, "P0", 1, 1e6, verdict="not identified"), record(2, "P0", 1, 3.0, unit="ratio"), records[3]]
    usable = usable_scans(changed, "prostate")
    assert [scan.id for scan in usable.scans] == ["r3"]
    assert usable.left_out == {"failed": 0, "waiting": 0, "not identified": 2, "other unit": 1}


def test_the_papers_mean_leaves_out_what_box_plots_draw_as_outliers():
    assert inside_fences(np.array([1.0, 1.1, 0.9, 1.05, 5.0])).tolist() == [True, True, True, True, False]


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        (lambda r: r[:8], "2 patients with a stage"),
        (lambda r: [one for one in r if one.row.stage == 2], "have the stage 2"),
        (lambda _: [], None),
        (lambda r: [dataclasses.replace(one, row=dataclasses.replace(one.row, stage=None)) for one in r], "0 patients"),
    ],
)
def test_what_is_undefined_is_said_in_words(records, chosen, words):
    document = statistics_document(chosen(records))
    if words is None:
        assert document["organs"] == {}
        return
    organ = document["organs"]["prostate"]
    assert words in organ["per_patient"]["undefined"]
    assert organ["per_patient"]["r"] is None
    assert "undefined" in organ["weighted"]
    assert "undefined" in organ["mixed_model"]
    assert "undefined" in cohort_page(chosen(records), document, created="now", version="0")


def test_single_scans_have_no_mixed_model(records):
    usable = usable_scans(records[::4], "prostate")
    assert "no patient has two scans" in mixed_model(usable, {})["undefined"]
    assert weighted_regression(usable)["factor_per_stage"] > 1.0
    assert "two scans" in repeatability(usable)["undefined"]


def test_a_patient_with_several_stages_enters_the_mixed_model_alone(records):
    changed = [*records[:-1], dataclasses.replace(records[-1], row=dataclasses.replace(records[-1].row, stage=1))]
    organ = statistics_document(changed)["organs"]["prostate"]
    assert organ["per_patient"]["n"] == 11
    assert organ["mixed_model"]["n_patients"] == 12
    assert "several stages" in organ["remarks"][0]


def test_intervals_of_correlations_cover_them(records):
    usable = usable_scans(records, "prostate")
    values = [np.array([scan.value for scan in usable.of(patient)]) for patient in usable.patients]
    stages = np.array([float(usable.stage_of(patient)) for patient in usable.patients])
    found = association(values, stages, seed=0).per_patient
    for value, (low, high) in (
        (found.r, found.interval95),
        (found.rho, found.rho_interval95),
        (found.tau, found.tau_interval95),
    ):
        assert low < value < high <= 1.0


def test_the_page_loads_nothing_and_escapes_every_name(records, document):
    shown = [*records, Record(Row("bad", NAME, stage=2), "failed", "input", NAME)]
    page = cohort_page(shown, document, created="now", version="0")
    assert "onerror=alert(1)>" not in page
    assert "&lt;img src=x" in page
    assert "<script" not in page
    assert page.count("<svg") == 3
    assert "http" not in page.replace("http://www.w3.org/", "").replace("http-equiv", "")
