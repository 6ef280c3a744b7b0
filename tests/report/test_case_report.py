"""report.html: self-contained, safe against names, whole whatever goes wrong."""

from __future__ import annotations

import dataclasses
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from palpate.errors import NotConverged
from palpate.images.readers import write_scalar_image
from palpate.report import case_report
from palpate.report.case_report import write_case_report, write_failure_report

EVIL = '</script><img src=x onerror=alert(1)>$\\frac{"&'


class Tags(HTMLParser):
    """Tags and attributes of a page."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))


def tags(page):
    parser = Tags()
    parser.feed(page)
    return parser.found


@pytest.fixture(scope="session")
def page(case_result, tmp_path_factory):
    return write_case_report(case_result, tmp_path_factory.mktemp("report")).read_text(encoding="utf-8")


def test_every_estimate_stands_with_unit_interval_verdict_and_truth(page):
    for text in (
        "58.9",
        "kPa",
        "47.1 to 73.6 kPa",
        "identified",
        "60.0",
        "-1.8 %",
        "to surroundings",
        "a warning to be",
    ):
        assert text in page


def test_the_page_is_self_contained(page):
    assert "default-src 'none'" in page
    for tag, attributes in tags(page):
        assert tag not in ("script", "link", "iframe", "object", "base")
        for name in ("src", "href", "xlink:href"):
            assert attributes.get(name, "#").startswith(("#", "data:image/png"))
    assert not re.findall(r"url\((?!#)", page)


def test_identifiers_are_unique_and_every_reference_is_met(page):
    names = [attributes["id"] for _, attributes in tags(page) if "id" in attributes]
    assert len(names) == len(set(names))
    used = re.findall(r'(?:href="#|url\(#)([^")]+)', page)
    assert set(used) <= set(names)


def test_three_slices_show_before_after_and_model(page):
    for layer in ("layer-before", "layer-after", "layer-model"):
        assert page.count(f'class="{layer}"') >= 3 * 2  # prostate and bladder at least, in each of three views
    for view in ("axial", "coronal", "sagittal"):
        assert f">{view}</figcaption>" in page


def with_name(result, name):
    """The same result, its first tissue called otherwise."""
    mesh = result.space.mesh
    tissues = (dataclasses.replace(mesh.tissues[0], name=name), *mesh.tissues[1:])
    space = dataclasses.replace(result.space, mesh=dataclasses.replace(mesh, tissues=tissues))
    first = dataclasses.replace(result.estimation.estimates[0], tissue=name, why=name)
    estimates = (first, *result.estimation.estimates[1:])
    case_tissues = (dataclasses.replace(result.case.tissues[0], name=name), *result.case.tissues[1:])
    return dataclasses.replace(
        result,
        case=dataclasses.replace(result.case, id=name, tissues=case_tissues),
        space=space,
        estimation=dataclasses.replace(result.estimation, estimates=estimates, reason=name),
        note=name,
    )


def test_a_name_can_neither_inject_markup_nor_stop_the_drawing(case_result, tmp_path):
    page = write_case_report(with_name(case_result, EVIL), tmp_path).read_text(encoding="utf-8")
    assert not [tag for tag, attributes in tags(page) if tag == "script" or "onerror" in attributes]
    assert "could not be drawn" not in page
    assert "&lt;/script&gt;" in page


def test_a_figure_that_fails_leaves_a_sentence(case_result, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("no canvas")

    monkeypatch.setattr(case_report, "slice_svg", fail)
    monkeypatch.setattr(case_report, "angle_svg", fail)
    page = write_case_report(case_result, tmp_path).read_text(encoding="utf-8")
    assert page.count("could not be drawn (RuntimeError: no canvas)") == 4
    assert "58.9" in page


def test_what_did_not_converge_shows_no_number(case_result, tmp_path):
    estimation = dataclasses.replace(case_result.estimation, status="not converged", reason="it stopped early")
    page = write_case_report(dataclasses.replace(case_result, estimation=estimation), tmp_path).read_text()
    table = page[page.index("How stiff") : page.index("Correlation of")]
    assert "it stopped early" in page
    assert not any(number in table for number in ("58.9", "31.2", "5.89", "3.12"))
    assert "not identified" in table


def test_an_estimate_that_failed_has_a_report_too(case_result, tmp_path):
    page = write_failure_report(case_result.case, NotConverged("stopped <here>"), tmp_path).read_text()
    assert "stopped &lt;here&gt;" in page
    assert "not-converged" in page


def test_a_grey_image_lies_under_the_contours(case_result, tmp_path):
    grid = case_result.before.grid
    write_scalar_image(tmp_path / "ct.nii.gz", np.random.default_rng(4).normal(40, 100, grid.shape), grid)
    images = dataclasses.replace(case_result.case.images, intensities_before=tmp_path / "ct.nii.gz")
    result = dataclasses.replace(case_result, case=dataclasses.replace(case_result.case, images=images))
    page = write_case_report(result, tmp_path).read_text()
    assert page.count("data:image/png") == 3
    assert "could not be drawn" not in page


def test_a_grey_image_that_cannot_be_read_does_not_stop_the_report(case_result, tmp_path):
    images = dataclasses.replace(case_result.case.images, intensities_before=tmp_path / "nowhere.nii.gz")
    result = dataclasses.replace(case_result, case=dataclasses.replace(case_result.case, images=images))
    assert "could not be drawn" not in write_case_report(result, tmp_path).read_text()


def test_open_intervals_and_ratios_are_shown_as_such(case_result, tmp_path):
    first, second = case_result.estimation.estimates
    ratio = {"unit": "ratio", "value": None, "interval95": None}
    open_end = dataclasses.replace(first, ratio_interval95=(2.0, None), verdict="not identified", truth=None, **ratio)
    only = dataclasses.replace(second, verdict="ratio only", **ratio)
    estimation = dataclasses.replace(case_result.estimation, estimates=(open_end, only))
    page = write_case_report(dataclasses.replace(case_result, estimation=estimation), tmp_path).read_text()
    assert "&gt; 2.00" in page
    assert "ratio only" in page
    assert "only ratios can be found" in page
