"""The preview: one page that shows a case before it is estimated, with every name escaped."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from bodies import ELSEWHERE, STILL, body
from palpate.body.imaged import brought
from palpate.case.case import Case, CaseTissue, Images
from palpate.findings import HELP
from palpate.report.preview import GENERATOR, preview_page
from palpate.study.check import Checked, CheckReport, Problem
from palpate.study.prediction import PredictedModulus, Prediction

NASTY = "<img src=x onerror=alert(1)>"


def case_of(segmentation):
    return Case(
        "preview",
        images=Images(Path("one/a.nii.gz"), (Path("one/a.nii.gz"),)),
        tissues=tuple(
            CaseTissue(t.name, t.labels or "remaining", t.role, youngs_modulus_kpa=t.youngs_modulus_kpa)
            for t in segmentation.tissues
        ),
    )


@pytest.fixture(scope="module")
def states():
    before, after = body(STILL), body(ELSEWHERE, filling=4.0, seed=1)
    return brought(before, (after,), method="surfaces")


@pytest.fixture(scope="module")
def checked(states):
    report = CheckReport("preview", (Problem("volume-change", f"a warning {NASTY}"),))
    return Checked(report, case_of(states.before), (states,))


def page_of(checked, **options):
    return preview_page(checked, created="today", version="1", **options)


@pytest.fixture(scope="module")
def page(checked):
    return page_of(checked)


def facts(page):
    return json.loads(re.search(r'id="facts">(.*?)</script>', page, flags=re.DOTALL)[1])


def test_it_shows_who_is_who_how_all_lay_and_what_is_held(page, states):
    for tissue in states.before.tissues:
        assert re.search(rf'class="swatch"[^>]*></span>{tissue.name}</th>', page)
    assert states.later[0].alignment.in_words in page
    assert re.search(r"after shows \d\d % of what before shows", page)
    assert "may move: each point by about" in page
    assert "towards the" in page
    assert page.index(GENERATOR) < 2000


def test_a_later_image_that_lay_elsewhere_can_be_seen_as_it_lay(page, checked, states):
    image = facts(page)["preview"][0]
    assert len(image["organs"]) == len(image["whole"]) == 3
    motion = np.array(image["motion"])
    assert motion[:, 3] == pytest.approx(ELSEWHERE.translation, abs=0.5)
    still = dataclasses.replace(states, later=(dataclasses.replace(states.later[0], alignment=None),))
    assert facts(page_of(dataclasses.replace(checked, states=(still,))))["preview"][0]["motion"] is None


def test_arrows_lead_from_middle_to_middle(page, states):
    image = facts(page)["preview"][0]
    start, end = next(ends for tissue, *ends in image["arrows"] if tissue == 2)
    assert np.subtract(end, start) == pytest.approx(states.after[0].middle(2) - states.before.middle(2))


def test_names_and_sentences_are_escaped(checked, states):
    tissues = tuple(
        dataclasses.replace(t, name=NASTY if i == 0 else t.name) for i, t in enumerate(states.before.tissues)
    )
    hostile = dataclasses.replace(
        states,
        before=dataclasses.replace(states.before, tissues=tissues),
        later=tuple(
            dataclasses.replace(of, image=dataclasses.replace(of.image, tissues=tissues)) for of in states.later
        ),
    )
    page = page_of(dataclasses.replace(checked, states=(hostile,)), no_prediction=NASTY)
    assert "<img src=x" not in page
    assert page.count("&lt;img src=x") >= 3


def test_it_asks_for_nothing_from_elsewhere(page):
    assert "default-src 'none'" in page
    assert not re.search(r'<(?!a\b)[^>]*(?:src|href)="(?!#|data:)', page)
    assert set(re.findall(r'<a href="([^#"][^#]*)', page)) <= {HELP}  # which is only followed


def test_a_predicted_interval_is_called_a_prediction(checked):
    moduli = (
        PredictedModulus("prostate", "kPa", 20.0, (10.0, 40.0), "rest", "identified", "why", {"noise": 1.0}),
        PredictedModulus("bladder", "kPa", 20.0, (None, 90.0), "rest", "not identified", "open", {"noise": 1.0}),
    )
    report = dataclasses.replace(checked.report, predicted=Prediction(moduli, 0.3, 6.0, stated=True))
    page = page_of(dataclasses.replace(checked, report=report))
    assert "A prediction, not a result." in page
    assert "predicted: not identified" in page
    assert "10.0 to 40.0 <small>kPa" in page
    assert "These images can hardly fix the stiffness of bladder." in page
    assert "stated in the case" in page


def test_a_scale_within_a_range_alone_is_predicted_as_a_ratio_as_the_estimate_then_says_it(checked):
    range_alone = PredictedModulus(
        "prostate", "kPa", 20.0, (4.0, 100.0), "rest", "ratio only", "why", {"noise": 1.0}, 2.0, (1.5, 2.7)
    )
    prediction = Prediction((range_alone,), 0.3, 6.0, stated=True)
    report = dataclasses.replace(checked.report, predicted=prediction)
    page = page_of(dataclasses.replace(checked, report=report))
    assert "predicted: ratio only" in page
    assert "1.50 to 2.70 <small>× rest" in page
    assert "E / E of rest (ratio)" in page
    assert "4.00 to 100" not in page
    assert "can hardly fix" not in page
    assert prediction.lines() == [
        "predicted for prostate, if it has 2 times rest: 95 % interval 1.5 to 2.7 times rest (ratio only)"
    ]


def test_a_case_that_is_refused_says_so_first(checked):
    refused = (Problem("InputDataError", "no such file", 3), *checked.report.problems)
    page = page_of(dataclasses.replace(checked, report=dataclasses.replace(checked.report, problems=refused)))
    assert "An estimate would refuse this case." in page
    assert "Refused:" in page


def test_a_case_without_images_still_has_its_problems():
    page = page_of(Checked(CheckReport("a", (Problem("x", "nothing is there", 3),))))
    assert "nothing is there" in page
    assert 'id="facts"' not in page
