"""Charts that can be read: every label within the picture, and marks enough to tell a value by."""

from __future__ import annotations

import dataclasses

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from palpate.report import charts
from palpate.report.collect import collect
from palpate.report.rows import expected_share, scale_marks
from palpate.report.svg import SIZE, draw_svg, link_url


def figure_of(chart, *arguments):
    """What a chart draws, as matplotlib's own figure."""
    figure = Figure(figsize=SIZE, layout="constrained")
    FigureCanvasAgg(figure)
    chart(figure, *arguments)
    figure.draw_without_rendering()
    return figure


def moduli_between(case_result, low, high):
    """Report data whose bladder goes from one modulus to another, with an interval just about."""
    data = collect(case_result)
    items = [dict(item) for item in data.document["estimates"]]
    items[0] |= {"interval95": [0.98 * low, 1.02 * high], "truth": None}
    name = items[0]["tissue"]
    paths = tuple(dict(path) | {name: (low, high)} for path in data.moduli_paths)
    return dataclasses.replace(data, document=data.document | {"estimates": items}, moduli_paths=paths)


@pytest.mark.parametrize(("low", "high"), [(21.0, 24.0), (2.0, 90.0), (101.0, 103.0)])
def test_an_axis_of_moduli_has_three_marks_or_more(case_result, low, high):
    data = moduli_between(case_result, low, high)
    (axes,) = figure_of(charts.modulus, data, data.document["estimates"][0]).axes
    bottom, top = axes.get_ylim()
    assert sum(bottom <= mark <= top for mark in axes.get_yticks()) >= 3


@pytest.mark.parametrize("draw", [charts.objective, charts.waterfall])
@pytest.mark.parametrize("misfit", [0.00123, 12.34])
def test_the_label_of_the_misfit_lies_within_its_picture(case_result, draw, misfit):
    data = collect(case_result)
    document = dict(data.document)
    document["starts"] = [
        dict(start) | {"objective_mm2": misfit, "history_mm2": [1.17 * misfit, misfit]} for start in document["starts"]
    ]
    document["outer_loop"] = {"history_mm2": [1.03 * misfit, 1.01 * misfit]}
    figure = figure_of(draw, document)
    label = figure.axes[0].yaxis.label.get_window_extent(figure.canvas.get_renderer())
    assert label.x0 >= 0.0
    assert label.y0 >= 0.0


@pytest.mark.parametrize(("low", "high"), [(13.8, 36.6), (21.0, 24.0), (0.5, 900.0)])
def test_the_scale_of_the_bars_has_three_to_six_marks(low, high):
    item = {"parameter": "youngs_modulus", "value": low, "interval95": [low, high], "truth": None}
    item |= {"unit": "kPa", "verdict": "weak", "relative_to": "fat", "ratio": None}
    marks = scale_marks({"status": "converged", "estimates": [item]})
    assert 3 <= len(marks) <= 6
    assert all(low * 0.8 < float(label) < high * 1.25 for _, label in marks)


def test_a_link_in_a_chart_has_its_address_and_its_words_escaped():
    def draw(figure):
        """One point."""
        figure.subplots().plot([1], [1], "o")[0].set_url(link_url(0))
        return "a chart"

    svg = draw_svg(draw, [('x/"<b>/report.html', "<i>")])
    assert '<a href="x/&#34;&lt;b&gt;/report.html" aria-label="&lt;i&gt;">' in svg
    assert 'role="group"' in svg
    assert "palpate-link" not in svg


def test_how_often_an_error_is_as_large_is_that_of_its_interval():
    """At an end of the 95 % interval in 5 % of cases, at the truth always; the side of the truth counts."""
    assert expected_share(20.0, (10.0, 80.0), 10.0) == "5 %"
    assert expected_share(20.0, (10.0, 80.0), 80.0) == "5 %"
    assert expected_share(20.0, (10.0, 80.0), 40.0) == "33 %"  # half of 1.96 standard deviations
    assert expected_share(20.0, (10.0, 80.0), 20.0 + 1e-12) == "100 %"
    assert expected_share(20.0, (10.0, None), 40.0) == "–"
    assert expected_share(20.0, None, 40.0) == "–"
