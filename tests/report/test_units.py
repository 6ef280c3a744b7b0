"""The unit of a page: ratios wherever one modulus is known as a ratio alone, and nothing of the scale in them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from palpate.report.units import scale_sd, shown_correlation, shown_region, shown_unit

SCALE, OWN, ACROSS = 0.25, (0.20, 0.30), 0.018  # sd of ln E of the known tissue; sds and covariance of the ln ratios


def entry(tissue, value, ratio, sd, *, verdict="ratio only", unit="kPa", truth=None):
    """An entry of "estimates" whose ln ratio has the sd, and whose ln E that and the scale's."""
    both = math.hypot(sd, SCALE)
    return {
        "tissue": tissue,
        "parameter": "youngs_modulus",
        "unit": unit,
        "value": value,
        "interval95": value and [value * math.exp(-1.959964 * both), value * math.exp(1.959964 * both)],
        "ratio": ratio,
        "ratio_interval95": ratio and [ratio * math.exp(-1.959964 * sd), ratio * math.exp(1.959964 * sd)],
        "relative_to": "fat",
        "verdict": verdict,
        "truth": truth,
        "variance_shares": {"known modulus": (SCALE / both) ** 2, "noise": (sd / both) ** 2},
    }


def ranged(**changes):
    """A document whose known tissue is known within a range: a shared scale beside two ratios."""
    covariance = np.array([[OWN[0] ** 2, ACROSS], [ACROSS, OWN[1] ** 2]]) + SCALE**2
    sd = np.sqrt(np.diag(covariance))
    document = {
        "estimates": [entry("gland", 30.0, 3.0, OWN[0]), entry("muscle", 15.0, 1.5, OWN[1])],
        "correlation": (covariance / np.outer(sd, sd)).tolist(),
        "case": {"tissues": {"fat": {"youngs_modulus_kpa": [6.0, 16.0]}}},
    }
    turn = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    around = np.column_stack([np.cos(turn), np.sin(turn)]) @ np.linalg.cholesky(covariance).T * math.sqrt(5.99)
    edge = (np.array([30.0, 15.0]) * np.exp(around)).tolist()
    document["regions"] = [{"tissues": ["gland", "muscle"], "boundary": edge, "ellipse": edge, "open": False}]
    return document | changes


@pytest.mark.parametrize(
    ("verdicts", "unit"),
    [
        (("identified", "weak"), "kPa"),
        (("identified", "not identified"), "kPa"),
        (("identified", "ratio only"), "ratio"),
        (("ratio only", "not identified"), "ratio"),
    ],
)
def test_one_modulus_that_is_known_as_a_ratio_alone_brings_the_page_to_ratios(verdicts, unit):
    items = [entry(f"organ {i}", 20.0, 2.0, 0.1, verdict=verdict) for i, verdict in enumerate(verdicts)]
    assert shown_unit({"estimates": items}).name == unit


def test_without_any_known_modulus_the_unit_is_a_ratio_even_where_nothing_converged():
    nothing = entry("gland", None, None, 0.1, verdict="not identified", unit="ratio")
    unit = shown_unit({"estimates": [nothing]})
    assert (unit.name, unit.text, unit.axis) == ("ratio", "× fat", "E / E of fat (ratio)")


def test_numbers_of_the_documents_lists_are_divided_by_the_known_modulus_once():
    document = ranged()
    assert shown_unit(document).of_document(30.0) == pytest.approx(3.0)
    assert shown_unit(document, "kPa").of_document(30.0) == 30.0
    of_ratios = entry("gland", None, 3.0, 0.1, unit="ratio")
    assert shown_unit({"estimates": [of_ratios]}).of_document(3.0) == 3.0


def test_a_true_ratio_needs_a_true_known_modulus():
    item = entry("gland", 30.0, 3.0, 0.1, truth=32.0)
    assert shown_unit(ranged(estimates=[item])).truth(item) is None
    exact = {"tissues": {"fat": {"youngs_modulus_kpa": 8.0}}}
    assert shown_unit(ranged(estimates=[item], case=exact)).truth(item) == pytest.approx(4.0)


def test_the_correlation_of_ratios_is_without_the_scale_that_they_share():
    document = ranged()
    assert document["correlation"][0][1] > 0.6
    assert shown_correlation(document)[0][1] == pytest.approx(ACROSS / (OWN[0] * OWN[1]))
    assert shown_correlation(document)[0][0] == 1.0


def test_a_joint_region_of_ratios_is_that_of_their_own_covariance():
    document = ranged()
    boundary, _ = shown_region(document, document["regions"][0])
    offsets = np.log(np.array(boundary) / [3.0, 1.5])
    own = np.array([[OWN[0] ** 2, ACROSS], [ACROSS, OWN[1] ** 2]])
    squares = np.einsum("ni,ij,nj->n", offsets, np.linalg.inv(own), offsets)
    assert np.allclose(squares, 5.99, rtol=1e-3)


def test_a_profile_in_ratios_ends_where_the_interval_of_the_ratio_does():
    document = ranged()
    item = document["estimates"][0] | {"profile": [(document["estimates"][0]["interval95"][1], 1.959964)]}
    assert scale_sd(item) == pytest.approx(SCALE, rel=1e-5)
    (at, root), *_ = shown_unit(document).profile(item)
    assert at == pytest.approx(item["ratio_interval95"][1], rel=1e-5)
    assert root == 1.959964
