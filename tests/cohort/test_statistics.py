"""Statistics of a cohort: their unit is the patient, intervals are weights, what is undefined is said in words."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pytest

from palpate.cli.cohorts import left_out_rows
from palpate.cohort.page import cohort_page
from palpate.cohort.plan import Plan, write_mark
from palpate.cohort.records import Modulus, Record, records_of
from palpate.cohort.statistics.document import statistics_document
from palpate.cohort.statistics.scans import UNFIT, combined, inside_fences, repeatability, usable_scans
from palpate.cohort.tables import columns_of
from palpate.cohort.task import Outcome, Row
from palpate.findings import MISLEADING
from palpate.study.outputs import write_json

NAME = "</script><img src=x onerror=alert(1)>"


def record(number, patient, stage, value, sd=0.1, *, verdict="identified", unit="kPa", covariates=None, **others):
    ends = (value * math.exp(-1.959964 * sd), value * math.exp(1.959964 * sd))
    modulus = Modulus("prostate", unit, value, *ends, verdict)
    row = Row(f"r{number}", patient, str(number), stage, covariates=covariates or {})
    return Record(row, "done", moduli=(modulus,), **others)


def opened(found, low95=25.0):
    """The same where the modulus is not identified: bounded from below, and still with a value."""
    (modulus,) = found.moduli
    ends = {"low95": low95, "high95": None, "verdict": "not identified"}
    return dataclasses.replace(found, moduli=(dataclasses.replace(modulus, **ends),))


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
def few(records):
    """The scans of a patient at each stage, without an age beside it."""
    return [dataclasses.replace(one, row=dataclasses.replace(one.row, covariates={})) for one in records[:16]]


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
    assert organ["left_out"] == {"failed": 1, "waiting": 1, "not identified": 0, "unfit": 0, "other unit": 0}
    assert {"patients", "organs", "paper", "notes"} <= set(document)
    first = document["patients"][0]
    assert (first["patient"], first["stage"], len(first["kpa"]["prostate"])) == ("P0", 1, 4)
    assert [row["n_patients"] for row in organ["by_stage"]] == [3, 3, 3, 3]


def test_the_growth_that_was_put_in_is_found_and_tested_once(document):
    organ = document["organs"]["prostate"]
    for name in ("regression", "regression_adjusted"):
        low, high = organ[name]["interval95"]
        assert low < 1.3 < high
    assert organ["regression"]["p"] < 0.01
    assert organ["regression_adjusted"]["covariates"] == ["age"]
    assert math.hypot(organ["regression"]["sd_within_patients"], 0.1) == pytest.approx(0.2, rel=0.25)
    tests = [name for name, part in organ.items() if isinstance(part, dict) and "p" in part]
    assert tests == ["regression"]
    assert "p" not in document["paper"]["prostate"]
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


def test_a_patients_scans_vary_by_standard_deviation_over_mean():
    rng = np.random.default_rng(8)
    values = np.exp(3.0 + 0.6 * rng.standard_normal((2000, 2)))
    rows = [record(2 * i + j, f"P{i}", 1, values[i, j]) for i in range(len(values)) for j in range(2)]
    found = repeatability(usable_scans(rows, "prostate"))["within_patient_cv"]
    assert found == pytest.approx(values.std() / values.mean(), rel=0.06)


def test_what_is_not_identified_enters_by_its_ends_or_is_left_out_and_named(few):
    nothing = record(1, "P0", 1, 1e6, verdict="not identified")
    nothing = dataclasses.replace(nothing, moduli=(dataclasses.replace(nothing.moduli[0], low95=None, high95=None),))
    changed = [opened(few[0]), nothing, record(2, "P0", 1, 3.0, unit="ratio"), few[3]]
    usable = usable_scans(changed, "prostate")
    assert (usable.scans[0].value, usable.scans[0].high) == (None, math.inf)
    assert [scan.id for scan in usable.scans] == ["r0", "r3"]
    assert usable.left_out == {"failed": 0, "waiting": 0, "not identified": 1, "unfit": 0, "other unit": 1}
    document = statistics_document([*few[4:], *changed])
    organ = document["organs"]["prostate"]
    assert organ["left_out_rows"]["not identified"] == ["r1"]
    assert organ["used"]["censored"] == organ["regression"]["n_censored"] == 1
    assert organ["per_patient"]["n_censored"] == 1
    assert organ["by_stage"][0]["n_censored"] == 1
    page = cohort_page(changed, document, created="now", version="0")
    assert "left out, not identified and no end of the interval known" in page


def test_the_table_says_which_rows_enter_the_statistics_and_why_others_do_not(few):
    unknown = dataclasses.replace(few[1].moduli[0], value=None, low95=None, high95=None, verdict="not identified")
    changed = [
        dataclasses.replace(few[0], warnings=("memory", "fold-over")),
        dataclasses.replace(few[1], moduli=(unknown,)),
        Record(few[2].row, "failed", "solver", "it stopped"),
        *few[3:],
    ]
    columns, usable = columns_of(changed), usable_scans(changed, "prostate")
    names = [record.row.id for record, used in zip(changed, columns["used_prostate"], strict=True) if used]
    assert names == [scan.id for scan in usable.scans] == [record.row.id for record in few[3:]]
    assert columns["left_out_prostate"][:4] == [
        "fold-over",
        "not identified, and no end of its interval is known",
        "failed",
        None,
    ]
    assert columns["warnings"][:2] == ["memory; fold-over", None]
    said = left_out_rows(statistics_document(changed))
    assert said == [
        f"1 row left out: fold-over ({few[0].row.id})",
        f"1 row left out: prostate is not identified ({few[1].row.id})",
    ]
    assert left_out_rows(statistics_document(few)) == []


def test_what_is_not_identified_has_no_number_in_the_table_or_on_the_page(few):
    held = [opened(dataclasses.replace(few[0], moduli=(dataclasses.replace(few[0].moduli[0], value=987.6),)))]
    columns = columns_of(held)
    assert [columns[f"prostate_{name}"] for name in ("kpa", "low95", "high95")] == [[None]] * 3
    assert columns["prostate_verdict"] == ["not identified"]
    document = statistics_document([*held, *few[1:]])
    assert document["patients"][0]["kpa"]["prostate"] == [one.moduli[0].value for one in few[1:4]]
    assert "987.6" not in str(document)
    assert ">988<" not in cohort_page(held, document, created="now", version="0")


def test_a_stage_of_which_no_scan_has_a_value_is_drawn_by_its_ends(few):
    changed = [opened(one) if one.row.stage == 4 else one for one in few]
    document = statistics_document(changed)
    last = next(patient for patient in document["patients"] if patient["stage"] == 4)["summary"]["prostate"]
    assert (last["median"], last["combined"], last["censored"]) == (None, None, [[25.0, None]] * 4)
    assert document["organs"]["prostate"]["by_stage"][-1]["median"] is None
    assert cohort_page(changed, document, created="now", version="0").count("<svg") == 3


def test_warnings_of_scans_are_counted_and_those_that_make_them_unfit_leave_them_out(records, document):
    codes = [("linear-strains", "finer-mesh"), ("units",), ("linear-strains",)]
    changed = [dataclasses.replace(one, warnings=of) for one, of in zip(records, codes, strict=False)]
    changed += records[3:]
    found = statistics_document(changed)
    organ = found["organs"]["prostate"]
    assert organ["warnings"] == {"linear-strains": 2, "finer-mesh": 1}
    assert organ["left_out"]["unfit"] == 1
    assert organ["left_out_rows"]["unfit"] == {"r1": ["units"]}
    assert organ["used"]["scans"] == len(records) - 1
    assert organ["regression_without_warned"]["n_scans"] == len(records) - 3
    assert "p" not in organ["regression_without_warned"]
    page = cohort_page(changed, found, created="now", version="0")
    assert "used with the warning linear-strains" in page
    assert "r1 (units)" in page
    assert document["organs"]["prostate"]["regression_without_warned"] is None


def test_only_warnings_that_may_cost_the_answer_make_a_scan_unfit():
    assert set(UNFIT) <= set(MISLEADING)
    assert "implausible-stiffness" not in UNFIT  # that would leave out by what was found


def test_the_same_image_in_two_patients_is_named(records):
    images = [
        {"before": "a" * 64, "after[0]": "b" * 64},
        {"before": "a" * 64},
        {"before": "c" * 64, "after[0]": "b" * 64},
    ]
    held = [dataclasses.replace(records[i], images=of) for i, of in zip((0, 1, 4), images, strict=True)]
    document = statistics_document(held)
    (same,) = document["identical_images"]  # rows of one patient share their rest state
    assert same["patients"] == ["P0", "P1"]
    assert same["rows"] == [{"id": "r0", "image": "after[0]"}, {"id": "r4", "image": "after[0]"}]
    assert "after[0] of r0, after[0] of r4" in cohort_page(held, document, created="now", version="0")


def test_what_a_result_says_of_a_row_is_read_from_its_file(tmp_path):
    """A modulus without interval is censored where its profile ends; a table of labels is no image."""
    profile = [[20.0, -1.95], [40.0, -1.0], [80.0, 0.0], [2000.0, 0.9]]
    common = {"parameter": "youngs_modulus", "interval95": None, "ratio_interval95": None, "ratio": 8.0}
    known = common | {
        "tissue": "prostate",
        "unit": "kPa",
        "value": 80.0,
        "verdict": "not identified",
        "profile": profile,
    }
    sought = common | {"tissue": "core", "unit": "ratio", "value": None, "verdict": "not identified", "profile": []}
    warnings = [{"code": "units", "message": "."}, {"code": "units", "message": "!"}]
    inputs = {"before": {"sha256": "1"}, "before.voxels": {"sha256": "2"}, "names": {"sha256": "3"}}
    place = tmp_path / "cases/r0"
    place.mkdir(parents=True)
    write_json(place / "result.json", {"estimates": [known, sought], "warnings": warnings, "inputs": inputs})
    write_mark(place, Outcome("r0", "done", "0" * 64))
    (found,) = records_of(Plan((Row("r0", "P", stage=1),), ("0" * 64,)), tmp_path)
    prostate, core = found.moduli
    assert prostate.low95 == pytest.approx(20.0, rel=0.01)
    assert (prostate.high95, prostate.stated) == (None, (None, None, None))
    assert (core.unit, core.low95, core.high95) == ("ratio", None, None)
    assert found.warnings == ("units",)
    assert found.images == {"before.voxels": "2"}


def test_a_scan_whose_known_modulus_is_a_range_enters_with_its_ratio(tmp_path):
    """The range is one guess for all scans: what it adds to each interval is no scatter between them."""
    item = {
        "parameter": "youngs_modulus",
        "tissue": "prostate",
        "unit": "kPa",
        "value": 40.0,
        "interval95": [15.0, 105.0],
        "ratio": 10.0,
        "ratio_interval95": [8.0, 12.5],
        "verdict": "identified",
        "profile": [[20.0, -1.96], [40.0, 0.0], [80.0, 1.96]],
    }
    shares = {"noise": 0.2, "known modulus": 0.8}
    open_ends = {"verdict": "not identified", "interval95": None, "ratio_interval95": None}
    of = {"given": {}, "ranged": {"variance_shares": shares}, "open": open_ends | {"variance_shares": shares}}
    for row, more in of.items():
        place = tmp_path / "cases" / row
        place.mkdir(parents=True)
        write_json(place / "result.json", {"estimates": [item | more], "warnings": [], "inputs": {}})
        write_mark(place, Outcome(row, "done", "0" * 64))
    rows = tuple(Row(row, row, stage=1) for row in of)
    given, ranged, left_open = (r.moduli[0] for r in records_of(Plan(rows, ("0" * 64,) * 3), tmp_path))
    assert (given.unit, given.value, given.low95, given.high95) == ("kPa", 40.0, 15.0, 105.0)
    assert (ranged.unit, ranged.value, ranged.low95, ranged.high95) == ("ratio", 10.0, 8.0, 12.5)
    assert (left_open.low95, left_open.high95) == pytest.approx((5.0, 20.0), rel=1e-4)


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
    assert words in organ["regression"]["undefined"]
    assert "undefined" in cohort_page(chosen(records), document, created="now", version="0")


def test_single_scans_tell_no_repeatability(records):
    organ = statistics_document(records[::4])["organs"]["prostate"]
    assert "two scans" in organ["repeatability"]["undefined"]
    assert organ["regression"]["factor_per_stage"] > 1.0
    assert organ["regression"]["sd_within_patients"] is None


def test_a_patient_with_several_stages_enters_nothing_by_stage(records):
    changed = [*records[:-1], dataclasses.replace(records[-1], row=dataclasses.replace(records[-1].row, stage=1))]
    organ = statistics_document(changed)["organs"]["prostate"]
    assert organ["per_patient"]["n"] == organ["regression"]["n_patients"] == 11
    assert "several stages" in organ["remarks"][0]


def test_the_page_loads_nothing_and_escapes_every_name(records, document):
    shown = [*records, Record(Row("bad", NAME, stage=2), "failed", "input", NAME)]
    page = cohort_page(shown, document, created="now", version="0")
    assert "onerror=alert(1)>" not in page
    assert "&lt;img src=x" in page
    assert "<script" not in page
    assert page.count("<svg") == 3
    assert "http" not in page.replace("http://www.w3.org/", "").replace("http-equiv", "")


def test_a_patients_point_leads_to_a_report_where_there_is_one(records, document):
    shown = [dataclasses.replace(one, page=f"cases/{one.row.id}/report.html") for one in records[:4]] + records[4:]
    page = cohort_page(shown, document, created="now", version="0")
    links = re.findall(r'<a href="(cases/[^"]+)" aria-label="([^"]+)">', page)
    assert links == [("cases/r0/report.html", "report of r0, patient P0")] * 3  # one in each chart
    assert "palpate-link" not in page
