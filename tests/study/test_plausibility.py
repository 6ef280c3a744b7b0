"""Plausibility: published ranges are named with their source, units that slipped are noticed."""

from __future__ import annotations

import dataclasses

import pytest

from palpate.case.case import Case
from palpate.statement.plausibility import (
    estimate_warnings,
    plausibility_warnings,
    published_for,
    unit_warnings,
)


def test_a_value_within_the_published_range_is_not_warned_of():
    assert plausibility_warnings({"prostate": 25.0}) == ()


@pytest.mark.parametrize("value", [0.1, 1e5])
def test_a_value_far_outside_is_warned_of_with_its_source(value):
    (warning,) = plausibility_warnings({"prostate": value})
    assert warning.code == "implausible-stiffness"
    assert any(entry.source in warning.message for entry in published_for("prostate"))


def test_a_bladder_meshed_as_one_solid_is_not_compared_with_its_wall():
    assert plausibility_warnings({"bladder": 20.0}) == ()
    assert [w.code for w in plausibility_warnings({"bladder wall": 20.0})] == ["implausible-stiffness"]


@pytest.mark.parametrize(
    ("name", "value", "hint"),
    [
        ("surroundings", 1e7, "Pa, write 10000"),
        ("surroundings", 0.01, "MPa, write 10"),
        ("surroundings", 8000.0, "8000 Pa, write 8"),
        ("fat", 2250.0, "2250 Pa, write 2.25"),
        ("muscle", 3000.0, "3000 Pa, write 3"),
        ("prostate tumour", 17000.0, "17000 Pa, write 17"),
        ("muscle", 0.003, "0.003 MPa, write 3"),
        ("colon wall", 5180.0, None),
        ("muscle", 280.0, None),
        ("surroundings", 2.6, None),
        ("surroundings", 10.0, None),
    ],
)
def test_a_modulus_in_pascals_is_noticed_by_the_tissues_own_range(case_result, name, value, hint):
    case: Case = case_result.case
    known = dataclasses.replace(case.tissues[3], name=name, youngs_modulus_kpa=value)
    warnings = unit_warnings(dataclasses.replace(case, tissues=(*case.tissues[:3], known)))
    assert [hint in warning.message for warning in warnings] == ([True] if hint else [])


def test_what_did_not_converge_is_not_told_by_a_warning(case_result):
    first = dataclasses.replace(case_result.estimation.estimates[0], tissue="prostate", value=1e5)
    estimation = dataclasses.replace(case_result.estimation, estimates=(first,))
    case = case_result.case
    assert [warning.code for warning in estimate_warnings(case, estimation)] == ["implausible-stiffness"]
    assert estimate_warnings(case, dataclasses.replace(estimation, status="not converged")) == ()


@pytest.mark.parametrize(
    ("name", "tissue"),
    [
        ("Prostate", "prostate"),
        ("urinary_bladder", "bladder wall"),
        ("prostate tumour", "prostate cancer"),
        ("liver_tumor", "liver tumour"),
        ("LiverTumours", "liver tumour"),
        ("breast cancer", "breast tumour"),
        ("thyroid nodule", "thyroid nodule"),
        ("uterine fibroid", "uterine fibroid"),
        ("Kidney_L", "kidney"),
        ("left lungs", "lung"),
        ("LV myocardium", "heart muscle in diastole"),
        ("breast_fat", "fat"),
        ("fibroglandular tissue", "breast gland"),
        ("Cerebral white matter", "brain"),
    ],
)
def test_organs_and_their_tumours_have_their_own_range(name, tissue):
    assert {entry.tissue for entry in published_for(name)} == {tissue}


@pytest.mark.parametrize(
    "name",
    ["omentum", "gallbladder", "gall bladder", "Gall-Bladder", "tumour", "lesion 2", "kidney tumor", "brain_tumour",
     "hepatic vessel", "oesophagus"],
)  # fmt: skip
def test_what_nobody_published_is_not_judged(name):
    assert published_for(name) == ()
    assert plausibility_warnings({name: 1e6}) == ()


@pytest.mark.parametrize(
    ("known_kpa", "verdict", "warned"),
    [(10.0, "identified", True), ((9.0, 11.0), "identified", True), ((1.3, 5.2), "identified", False),
     (10.0, "ratio only", False), (10.0, "not identified", False)],
)  # fmt: skip
def test_no_modulus_is_judged_on_a_scale_that_is_a_guess(case_result, known_kpa, verdict, warned):
    first = dataclasses.replace(case_result.estimation.estimates[0], tissue="prostate", value=1e5, verdict=verdict)
    estimation = dataclasses.replace(case_result.estimation, estimates=(first,))
    case: Case = case_result.case
    known = dataclasses.replace(case.tissues[3], youngs_modulus_kpa=known_kpa)
    case = dataclasses.replace(case, tissues=(*case.tissues[:3], known))
    assert bool(estimate_warnings(case, estimation)) is warned
