"""Every axis of every chart says what it shows in which unit, and nothing of it is cut off or hides another part."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from palpate.cohort import charts as cohort_charts
from palpate.report import charts
from palpate.report.collect import collect
from palpate.report.svg import SIZE, STYLE
from palpate.report.tornado import tornado
from palpate.statement.image_pairs import ImagePairs, PairAlone
from palpate.statement.joint import ModulusRegion
from palpate.statement.variations import Variation

TURN = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
EDGE = tuple((58.9 * math.exp(0.4 * math.cos(t)), 31.2 * math.exp(0.5 * math.sin(t))) for t in TURN.tolist())


def drawn(chart, *arguments) -> Figure:
    """The figure that a chart paints, before it becomes text."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=SIZE, layout="constrained")
        FigureCanvasAgg(figure)
        chart(figure, *arguments)
        figure.canvas.draw()
    return figure


def data_in(case_result, unit):
    """The report's data with every chart in it, in kPa or as ratios to a tissue whose modulus is a range."""
    first, second = case_result.estimation.estimates
    changes = {"profile": ((40.0, -2.5), (58.9, 0.0), (75.0, 1.96))}
    if unit == "ratio":
        changes |= {"verdict": "ratio only", "ratio": 5.89, "ratio_interval95": (4.9, 7.1)}
    alone = PairAlone({"prostate": 55.0}, {"prostate": (40.0, 80.0)}, False, {}, {})
    estimation = dataclasses.replace(
        case_result.estimation,
        estimates=(dataclasses.replace(first, **changes), second),
        regions=(ModulusRegion(("prostate", "bladder"), EDGE, EDGE, open=False),),
        image_pairs=ImagePairs((alone, alone), 0.5, {}, {"prostate": 56.0}, {"prostate": (50.0, 63.0)}),
        variations=(Variation("law", "", "linear", "linearised", {"prostate": 0.2, "bladder": -0.1}),),
    )
    return collect(dataclasses.replace(case_result, estimation=estimation))


CHARTS = {
    "profile": lambda figure, data: charts.profile(figure, data, data.document["estimates"][0]),
    "region": lambda figure, data: charts.region(figure, data, data.document["regions"][0]),
    "repeats": lambda figure, data: charts.repeats(figure, data, data.document["estimates"][0]),
    "modulus": lambda figure, data: charts.modulus(figure, data, data.document["estimates"][0]),
    "misfit": lambda figure, data: charts.objective(figure, data.document),
    "waterfall": lambda figure, data: charts.waterfall(figure, data.document),
    "angles": lambda figure, data: charts.angles(figure, data.mesh.angles),
    "residuals": lambda figure, data: charts.residuals(figure, data, data.later[0].model[0], 1.0),
    "tornado": lambda figure, data: tornado(figure, data.document, "prostate"),
}


def assert_readable(figure, *, categories=()):
    canvas = figure.canvas.get_renderer()
    whole = figure.bbox
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            label = axis.label.get_text()
            if axis.axis_name not in categories:
                assert label.endswith(")"), label
                assert "(" in label
                box = axis.label.get_window_extent(canvas)
                assert whole.x0 <= box.x0 < box.x1 <= whole.x1, label
                assert whole.y0 <= box.y0 < box.y1 <= whole.y1, label
            low, high = axis.get_view_interval()
            texts = [
                t for at, t in zip(axis.get_majorticklocs(), axis.get_ticklabels(), strict=True) if low <= at <= high
            ]
            boxes = [text.get_window_extent(canvas) for text in texts if text.get_text()]
            assert all("$" not in text.get_text() and "e" not in text.get_text() for text in texts) or categories
            ends = sorted((b.x0, b.x1) if axis.axis_name == "x" else (b.y0, b.y1) for b in boxes)
            assert all(one[1] <= other[0] + 0.5 for one, other in pairwise(ends)), label
            assert not any(text.get_text() for text in axis.get_ticklabels(minor=True))


@pytest.mark.parametrize("unit", ["kPa", "ratio"])
@pytest.mark.parametrize("chart", CHARTS)
def test_every_axis_of_the_report_has_its_unit_and_marks_apart(case_result, chart, unit):
    figure = drawn(CHARTS[chart], data_in(case_result, unit))
    assert_readable(figure, categories=("y",) if chart == "tornado" else ())
    labels = " ".join(axis.label.get_text() for axes in figure.axes for axis in (axes.xaxis, axes.yaxis))
    if chart in ("profile", "region", "repeats", "modulus"):
        assert ("kPa" in labels) == (unit == "kPa")
        assert ("of surroundings (ratio)" in labels) == (unit == "ratio")


@pytest.mark.parametrize("unit", ["kPa", "ratio"])
def test_every_axis_of_a_cohort_has_its_unit_and_marks_apart(unit):
    found = {"value": 20.0, "low95": 12.0, "high95": 33.0}
    summary = {"organ": {"median": 20.0, "combined": found, "censored": [[15.0, None]]}}
    values = {"kpa" if unit == "kPa" else "ratio": {"organ": [18.0, 20.0, 25.0]}}
    patients = [
        {"patient": f"P{i}", "stage": 1 + i % 3, "summary": summary, "kpa": {}, "ratio": {}} | values for i in range(6)
    ]
    line = {"factor_per_stage": 1.2, "at_mean_stage": 20.0, "mean_stage": 2.0}
    for chart, more, categories in (
        (cohort_charts.boxes, (), ("x",)),
        (cohort_charts.scatter, (line,), ()),
        (cohort_charts.forest, (), ("y",)),
    ):
        figure = drawn(chart, patients, "organ", unit, *more, {})
        assert_readable(figure, categories=categories)
        words = [axis.label.get_text() for axis in (figure.axes[0].xaxis, figure.axes[0].yaxis)]
        assert any(f"({unit})" in word for word in words)
