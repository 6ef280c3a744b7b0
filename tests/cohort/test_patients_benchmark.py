"""What benchmarks/patients.py says of its rows: known errors and intervals, and the known effect of a stage."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"


def loaded(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def rows():
    assert {loaded(name).__name__ for name in ("rows", "scenes")} <= sys.modules.keys()  # which it imports
    return loaded("patients")


@pytest.fixture(scope="module")
def text():
    return loaded("figures_text")


def item(tissue, truth, value, interval, verdict="identified", profile=()):
    """One entry of "estimates", as a row keeps it."""
    of = {"parameter": "youngs_modulus", "unit": "kPa", "ratio": None, "ratio_interval95": None}
    known = {"tissue": tissue, "truth": truth, "value": value, "interval95": interval, "verdict": verdict}
    return of | known | {"variance_shares": None, "profile": list(profile)}


def row(seed, estimates, *, noise=0.3, images=6, stage=None, **more):
    took = {"seconds": 90.0, "processor_seconds": 100.0 + seed, "peak_gb": 1.0 + seed}
    state = {"status": "converged", "reason": "", "warnings": []}
    who = {"seed": seed, "law": "linear", "noise_mm": noise, "images": images, "stage": stage}
    return who | {"estimates": estimates} | took | state | more


def around(value, factor):
    return [value / factor, value * factor]


def cohort(effect, *, n=8, reach=1.2, seed=3):
    """Patients of two stages by turns, whose prostates are found within their intervals."""
    rng, found = np.random.default_rng(seed), []
    for number in range(n):
        stage = number % 2
        truth = 25.0 * effect**stage * np.exp(0.05 * rng.normal())
        value, still = truth * np.exp(0.5 * np.log(reach) * rng.normal()), 30.0 * np.exp(0.05 * rng.normal())
        estimates = [
            item("prostate", truth, value, around(value, reach)),
            item("bladder", 30.0, still, around(still, 1.2)),
        ]
        found.append(row(number, estimates, stage=stage))
    return found


def test_errors_half_widths_and_intervals_that_hold_have_their_known_values(rows):
    e = float(np.e)
    results = [
        row(1, [item("prostate", 20.0, 20.0 * e, around(20.0 * e, e**2)), item("bladder", 30.0, 30.0, None)]),
        row(
            2, [item("prostate", 20.0, 20.0 / e**2, around(20.0 / e**2, e)), item("bladder", 30.0, 30.0, [15.0, None])]
        ),
        row(3, [item("prostate", 20.0, 20.0, around(20.0, e**3), "not identified")], noise=0.15),
    ]
    results[0]["estimates"][1]["verdict"] = "not identified"
    found = rows.summary_of(results)
    assert list(found) == ["linear, 0.15 mm, 6", "linear, 0.3 mm, 6"]
    of = found["linear, 0.3 mm, 6"]
    assert (of["patients"], of["moduli"], of["stated"], of["held"], of["failed"]) == (2, 4, 3, 2, 0)
    assert of["rms"] == pytest.approx(np.sqrt(5.0 / 4.0), abs=0.005)
    assert (of["error"], of["half_width"]) == (0.5, 1.5)
    assert (of["seconds"], of["peak_gb"]) == (101.5, 3.0)
    assert (found["linear, 0.15 mm, 6"]["stated"], found["linear, 0.15 mm, 6"]["half_width"]) == (0, 3.0)


def test_the_effect_of_a_stage_is_recovered_where_estimates_are_near_the_truth(rows):
    found = rows.stage_effects(cohort(1.3))
    prostate, bladder = found["prostate"], found["bladder"]
    assert prostate["patients"] == [4, 4]
    assert (prostate["stated"], prostate["censored"], prostate["truth"]) == (8, 0, 1.3)
    assert prostate["interval95"][0] < 1.3 < prostate["interval95"][1]
    assert prostate["interval95"][0] < prostate["drawn"] < prostate["interval95"][1]
    assert bladder["interval95"][0] < 1.0 < bladder["interval95"][1]
    assert bladder["drawn"] == 1.0


def test_exact_estimates_give_the_ratio_of_geometric_means(rows):
    levels = np.array([0.9, 1.0, 1.05, 1.1])
    values = [(stage, 25.0 * 1.3**stage * level) for level in levels for stage in (0, 1)]
    results = [
        row(n, [item("prostate", value, value, around(value, 1.01))], stage=stage)
        for n, (stage, value) in enumerate(values)
    ]
    of = rows.stage_effects(results)["prostate"]
    assert of["factor"] == of["drawn"] == 1.3
    assert of["p"] == pytest.approx(2.0 / 70.0, abs=5e-4)  # no arrangement of four and four is as far


def test_what_is_not_identified_enters_by_its_profile_alone(rows):
    results = cohort(1.3)
    profile = [[10.0, -1.96], [25.0, 0.0], [400.0, 1.5]]
    results[0]["estimates"][0] = item("prostate", 25.0, 25.0, None, "not identified", profile)
    of = rows.stage_effects(results)["prostate"]
    assert (of["stated"], of["censored"]) == (7, 1)
    assert of["interval95"][0] < 1.3


@pytest.mark.parametrize("n", [0, 1, 2])
def test_few_rows_and_rows_that_failed_make_tables(rows, text, n):
    killed = {"seed": 9, "law": "linear", "noise_mm": 0.3, "images": 8, "status": "failed", "reason": "killed"}
    results = [killed, killed | {"stage": 1, "images": 6}, *cohort(1.3, n=n)]
    found = rows.figures_of(results)
    (of,) = found["rows"].values()
    assert (of["failed"], of["rms"], of["seconds"]) == (1, None, None)
    assert all("undefined" in each["undefined"] for each in found["cohort"]["rows"].values())
    assert len(found["cohort"]["rows"]) == (2 if n else 0)
    for name in ("table", "short", "cost"):
        assert len(text.VIEWS[f"patients.{name}"].table(found)) == 3
    assert len(text.VIEWS["patients.cohort-table"].table(found["cohort"])) == 2 + len(found["cohort"]["rows"])


def test_the_moduli_of_a_cohort_scatter_about_those_of_their_stage(rows):
    kpa = [[rows.Patient(seed, "linear", 0.3, stage).moduli_kpa for seed in range(400)] for stage in (0, 1)]
    logs = {organ: np.log([[of[organ] for of in stage] for stage in kpa]) for organ in ("prostate", "bladder")}
    assert np.exp(logs["prostate"][1] - logs["prostate"][0]) == pytest.approx(1.3)
    assert logs["bladder"][1] == pytest.approx(logs["bladder"][0])
    assert logs["prostate"][0].std() == pytest.approx(0.2, abs=0.02)
    assert abs(np.corrcoef(logs["prostate"][0], logs["bladder"][0])[0, 1]) < 0.15
    assert rows.Patient(901, "linear", 0.3).moduli_kpa is None
