"""What the pages say of assumptions and the interval: true for each row, in the unit of the page."""

from __future__ import annotations

import math

import pytest

from palpate.report.tornado import coverage, is_covered, sensitivity_page, sensitivity_table, tornado_rows

STEP = math.log(1.2)


def document(*, verdict="identified", known=10.0, discrepancy=None, boundary="moving"):
    item = {
        "tissue": "gland",
        "unit": "kPa",
        "value": 30.0,
        "interval95": [20.0, 45.0],
        "ratio": 3.0,
        "ratio_interval95": [2.4, 3.7],
        "relative_to": "fat",
        "verdict": verdict,
        "why": "",
    }
    changes = (
        ("known_modulus", "fat", "/ 1.2", -STEP),
        ("known_modulus", "fat", "x 1.2", STEP),
        ("poisson_ratio", "gland", "0.43", -0.05),
        ("segmentation", "gland", "+0.5 voxel", 0.1),
        ("frame", "", "held still", 0.02),
        ("law", "", "linear", 0.07),
        ("outer_boundary", "", "free", -0.3),
        ("edge_length", "", "10 mm", 0.03),
        ("driver_prior", "", "2 times as wide", 0.01),
    )
    return {
        "id": "case",
        "law": "neo-hookean",
        "versions": {},
        "estimates": [item],
        "variations": [
            {"cause": c, "subject": of, "setting": w, "method": "linearised", "changes": {"gland": by}, "reason": ""}
            | {"at_bound": []}
            for c, of, w, by in changes
        ],
        "case": {
            "tissues": {"fat": {"role": "known", "youngs_modulus_kpa": known}},
            "discrepancy": {"poisson_sd": 0.02, "surface_offset_mm": 0.5} if discrepancy is None else discrepancy,
            "domain": {"outer_boundary": boundary},
        },
    }


def test_the_interval_holds_what_the_estimate_has_as_an_unknown_and_nothing_else():
    held, not_held = coverage(document())
    assert held == (
        "Poisson's ratio of gland",
        "surface of gland",
        "motion of the frame",
        "edge length of the mesh",
    )
    assert not_held == ("modulus of fat", "material law", "outer boundary", "prior of the drivers' motion")


@pytest.mark.parametrize(
    ("changed", "cause", "held"),
    [
        ({"known": [6.0, 16.0]}, "known_modulus", True),
        ({"discrepancy": {"poisson_sd": 0.0}}, "poisson_ratio", False),
        ({"discrepancy": {"surface_offset_mm": 0.0}}, "segmentation", False),
        ({"boundary": "fixed"}, "frame", False),
    ],
)
def test_what_the_case_states_otherwise_is_said_otherwise(changed, cause, held):
    assert is_covered(document(**changed), cause, "fat") == held


def test_the_page_says_it_in_each_row_and_claims_nothing_of_all_rows():
    page = sensitivity_page(document())
    assert "none of the rows" not in page
    for row in tornado_rows(document(), "gland"):
        label = row.label.replace("'", "&#39;")
        cells = page[page.index(f'<td class="name">{label}') :].split("</tr>")[0]
        assert cells.endswith(f'in the interval">{"yes" if row.covered else "no"}</td>')


def test_what_is_known_as_a_ratio_alone_is_varied_as_a_ratio():
    ranged = document(verdict="ratio only", known=[6.0, 16.0])
    (known,) = [row for row in tornado_rows(ranged, "gland") if row.label == "modulus of fat"]
    assert list(known.effects.values()) == [0.0, 0.0]
    table = sensitivity_table(ranged)
    assert table[0][2] == "ratio"
    assert table[1][2] == "3.00 × fat (95 %: 2.40 to 3.70)"
    page = sensitivity_page(ranged)
    assert "/ 1.2: no change, x 1.2: no change" in page
    assert "kPa" not in page
    (in_kpa,) = [row for row in tornado_rows(document(), "gland") if row.label == "modulus of fat"]
    assert list(in_kpa.effects.values()) == [-STEP, STEP]
