"""The paper's experiments: their layout, their statistics and what goes on after an interruption."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

from doubled_parts import doubled
from palpate.cli import main
from palpate.errors import ConfigurationError, GeometryError, ResourceError
from palpate.mesh.anatomy import Box
from palpate_validation.paper.figure4 import LAW, Figure4, Point, draw_figure4
from palpate_validation.paper.real_pelvis import grid_within
from palpate_validation.paper.staging import (
    ORGANS,
    PatientResult,
    Staging,
    draw_staging,
    paper_remark,
    pearson_p,
    points_behind,
    with_stage,
)
from palpate_validation.paper.table import (
    COLUMNS,
    PAPER_STAGING,
    PAPER_TABLE1,
    PAPER_TABLE2,
    Table,
    TableRow,
    draw_table,
    entry_of,
)
from palpate_validation.reproduce import reproduce
from palpate_validation.scenes import Job, Ledger, compute

STAGES = np.array([1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 3.0, 4.0])


def entry(truth, kpa, verdict="identified", interval=(40.0, 70.0)):
    return entry_of(kpa, truth, interval95=interval, verdict=verdict, iterations=7)


def row(truth, voxel, **others):
    columns = {name: entry(truth, truth * 1.001) for name in COLUMNS}
    return TableRow("case", "sphere1", truth, 49.23, columns | {"voxels": entry(truth, voxel, **others)})


@pytest.fixture
def table():
    rows = (row(50.0, 52.0), row(50.0, 80.0, verdict="weak", interval=(30.0, 200.0)), row(50.0, None, interval=None))
    return Table("table1", rows, ("a note",))


@pytest.fixture
def cohort():
    rng = np.random.default_rng(3)
    values = [20.0 * stage * np.exp(0.2 * rng.standard_normal(9)) for stage in STAGES]
    patients = tuple(
        PatientResult(f"P{i}", int(stage), dict.fromkeys(ORGANS, 20.0), dict.fromkeys(ORGANS, v.tolist()), 0, 9, 0.1)
        for i, (stage, v) in enumerate(zip(STAGES, values, strict=True))
    )
    return Staging(patients, dict.fromkeys(ORGANS, with_stage(values, STAGES)))


def test_the_papers_own_errors_follow_from_its_moduli():
    worst = {
        body: max(abs(found[body] / truth - 1.0) for truth, found in PAPER_TABLE1.items()) for body in ("sphere1",)
    }
    assert 100.0 * worst["sphere1"] == pytest.approx(13.16, abs=0.01)
    for organ, stated in (("prostate", 7.5), ("bladder", 2.34)):
        worst = max(abs(found[organ] / truth - 1.0) for truth, found in PAPER_TABLE2.items())
        assert 100.0 * worst == pytest.approx(stated, abs=0.01)


def test_a_table_has_the_layout_of_its_json(table):
    document = json.loads(json.dumps(table.to_dict(), allow_nan=False))
    assert document["experiment"] == "table1"
    first = document["rows"][0]
    assert {"body", "true_kpa", "start_kpa", "paper_kpa", "columns"} <= set(first)
    assert first["start_kpa"] == 25.0
    for name in ("same_mesh", "other_mesh", "voxels", "paper_method"):
        assert {"kpa", "error_percent", "interval95", "verdict", "iterations"} == set(first["columns"][name])
        assert name in document["worst_error_percent"]


def test_the_worst_error_of_voxels_counts_identified_rows_only(table):
    document = table.to_dict()
    assert document["worst_error_percent"]["voxels"] == pytest.approx(4.0)
    assert document["voxels"]["identified"] == 1
    assert document["voxels"]["truth_inside_interval"] == 2


def test_a_row_that_did_not_converge_has_no_value(table):
    assert table.rows[2].columns["voxels"]["error_percent"] is None
    assert "none" in table.text()[3]


def computed(make, ledger, keys, workers=1):
    said = []
    return compute([Job((key,), make) for key in keys], ledger, workers=workers, progress=said.append), said


@pytest.mark.parametrize("workers", [1, 2])
def test_finished_parts_are_not_computed_again(tmp_path, workers):
    ledger = Ledger(tmp_path / "parts.jsonl", "a")
    first, said = computed(doubled, ledger, ("1", "2", "3"), workers)
    assert first == {"1": {"x": 2}, "2": {"x": 4}, "3": {"x": 6}}
    assert "doubling 2" in said
    again, said = computed(doubled, ledger, ("1", "2", "3", "4"), workers)
    assert again == first | {"4": {"x": 8}}
    assert [text for text in said if text.startswith("doubling")] == ["doubling 4"]
    others, said = computed(doubled, Ledger(tmp_path / "parts.jsonl", "other settings"), ("1",))
    assert others == {"1": {"x": 2}}
    assert "doubling 1" in said


def test_what_a_process_raises_is_raised_and_what_was_finished_stays(tmp_path):
    ledger = Ledger(tmp_path / "parts.jsonl", "a")
    jobs = [Job(("1", "bad"), doubled), Job(("2",), doubled)]
    with pytest.raises(GeometryError, match="cannot be doubled"):
        compute(jobs, ledger, workers=2, progress=lambda _: None)
    assert ledger.finished()["1"] == {"x": 2}


def test_a_process_that_dies_is_an_error():
    with pytest.raises(ResourceError, match="ended before its part was done"):
        computed(doubled, Ledger(None, "a"), ("1", "dead"), workers=2)


def test_a_line_cut_by_an_interruption_is_computed_again(tmp_path):
    path = tmp_path / "parts.jsonl"
    ledger = Ledger(path, "a")
    ledger.keep("1", {"x": 1})
    path.write_text(path.read_text() + '{"settings": "a", "key": "2", "va')
    assert computed(doubled, ledger, ("1", "2"))[0] == {"1": {"x": 1}, "2": {"x": 4}}


def test_parts_after_a_cut_line_are_found_again(tmp_path):
    path = tmp_path / "parts.jsonl"
    path.write_text('{"settings": "a", "key": "1", "va')
    ledger = Ledger(path, "a")
    ledger.keep("2", {"x": 2})
    assert ledger.finished() == {"2": {"x": 2}}


@pytest.mark.parametrize(("organ", "for_eight"), [("prostate", 0.076), ("bladder", 0.23)])
def test_the_papers_p_belongs_to_33_points(organ, for_eight):
    r, p = PAPER_STAGING[organ]
    assert points_behind(r, p) == 33
    assert pearson_p(r, 33) == pytest.approx(p, rel=0.02)
    assert not any(pearson_p(r, n) == pytest.approx(p, rel=0.05) for n in (8, 31, 32, 34, 35, 180))
    assert pearson_p(r, 8) == pytest.approx(for_eight, rel=0.02)
    assert "33" in paper_remark()


def test_the_patient_is_the_unit(cohort):
    document = json.loads(json.dumps(cohort.to_dict(), allow_nan=False))
    assert document["experiment"] == "staging"
    for organ in ORGANS:
        found = document["organs"][organ]
        assert found["per_scan"]["n"] == 72
        assert found["per_patient"]["n"] == 8
        assert {"r", "rho", "tau", "n"} <= set(found["per_patient"])
        low, high = found["regression"]["interval95"]
        assert low < found["regression"]["factor_per_stage"] < high
        assert found["per_scan"]["p"] < found["regression"]["p"]  # scans taken for patients look surer than they are


def test_pearson_p_is_that_of_scipy():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 17))
    found = stats.pearsonr(x, y)
    assert pearson_p(found.statistic, 17) == pytest.approx(found.pvalue)


def test_repeating_every_scan_makes_patients_no_more():
    rng = np.random.default_rng(4)
    values = [20.0 * stage * np.exp(0.3 * rng.standard_normal(5)) for stage in STAGES]
    once, often = (with_stage([np.tile(v, n) for v in values], STAGES) for n in (1, 10))
    assert often["per_scan"]["p"] < once["per_scan"]["p"]
    assert often["per_patient"] == once["per_patient"]
    low, high = (np.log(found["regression"]["interval95"]) for found in (once, often))
    assert np.ptp(high) == pytest.approx(np.ptp(low), rel=0.2)
    assert often["regression"]["p"] > 0.5 * once["regression"]["p"]


def points(law, errors):
    return [Point("sphere1", 50.0, d, law, e, "50") for d, e in zip((1.0, 10.0, 20.0), errors, strict=True)]


def test_the_linear_law_ends_where_its_error_passes_five_per_cent():
    result = Figure4((*points("linear", (-1.0, -4.0, -6.0)), *points(LAW, (0.0, 0.0, None))))
    document = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert set(document["points"][0]) >= {"body", "true_kpa", "deformation_percent", "law", "error_percent"}
    assert document["linear_law_ends_percent"] == [{"body": "sphere1", "case": "50", "deformation_percent": 15.0}]
    assert "not converged" in result.text()[3]


def test_figures_are_drawn(tmp_path, table, cohort):
    result = Figure4((*points("linear", (-1.0, -4.0, -6.0)), *points(LAW, (0.0, 0.0, None))))
    draw_table(table, tmp_path / "table.svg")
    draw_staging(cohort, tmp_path / "staging.svg")
    draw_figure4(result, tmp_path / "figure4.svg")
    for name in ("table", "staging", "figure4"):
        assert "<svg" in (tmp_path / f"{name}.svg").read_text()


def test_a_random_grid_ends_within_its_box():
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    box = Box(np.array([5.0, -3.0, 7.0]), turn, np.array([10.3, 11.0, 12.7]))
    first, second = (grid_within(box, 1.0, np.random.default_rng(seed)) for seed in (1, 2))
    assert np.abs(first.affine[:3, 3] - second.affine[:3, 3]).max() > 0.01
    for grid in (first, second):
        low, high = box.local(grid.world(np.array([[0.0] * 3, np.array(grid.shape) - 1.0])))
        assert np.all((low >= 0.0) & (low < 1.5))
        assert np.all((high <= box.lengths) & (high > box.lengths - 1.5))


def test_an_unknown_experiment_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="table3"):
        reproduce("table3", tmp_path, progress=lambda _: None)
    with pytest.raises(SystemExit, match="2"):
        main(["reproduce", "table3"])
