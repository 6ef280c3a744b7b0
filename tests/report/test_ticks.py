"""Marks of logarithmic axes: 10, 20, 50, 100, in plain numbers, as many as can be read."""

from __future__ import annotations

import pytest
from matplotlib.figure import Figure

from palpate.report.svg import mark_decades
from palpate.report.ticks import FEWEST, MOST, log_marks, mark_text


@pytest.mark.parametrize(
    ("low", "high", "marks"),
    [
        (5.0, 120.0, [5, 10, 20, 50, 100]),
        (0.015, 0.6, [0.02, 0.05, 0.1, 0.2, 0.5]),
        (0.3, 900.0, [0.5, 1, 5, 10, 50, 100, 500]),
        (1e-4, 10.0, [1e-4, 1e-3, 1e-2, 0.1, 1, 10]),
        (23.0, 41.0, [25, 30, 35, 40]),
    ],
)
def test_marks_are_1_2_and_5_of_each_decade_where_they_fit(low, high, marks):
    assert log_marks(low, high) == pytest.approx(marks)


@pytest.mark.parametrize("width", [1.0002, 1.01, 1.3, 2.0, 4.0, 30.0, 1e3, 1e6, 1e12])
@pytest.mark.parametrize("low", [3.1e-5, 0.00805, 0.9, 17.0, 4.2e6])
@pytest.mark.parametrize("most", [5, 6, MOST])
def test_no_axis_has_too_many_marks_or_too_few_or_one_beyond_it(low, width, most):
    marks = log_marks(low, low * width, most=most)
    assert marks == sorted(set(marks))
    assert (2 if width > 1e3 or most < MOST else FEWEST) <= len(marks) <= most
    assert all(low * (1 - 1e-9) <= mark <= low * width * (1 + 1e-9) for mark in marks)


@pytest.mark.parametrize(("number", "text"), [(0.05, "0.05"), (10.0, "10"), (5000.0, "5000"), (0.0001, "0.0001")])
def test_marks_are_plain_numbers(number, text):
    assert mark_text(number) == text


def test_a_marked_axis_keeps_its_ends_and_has_no_smaller_marks():
    axes = Figure().add_subplot()
    axes.set_xscale("log")
    axes.plot([12.0, 70.0], [0.0, 1.0])
    ends = axes.get_xlim()
    mark_decades(axes.xaxis)
    assert axes.get_xlim() == ends
    assert [text.get_text() for text in axes.get_xticklabels()] == ["20", "30", "40", "50", "60", "70"]
    assert len(axes.xaxis.get_minorticklocs()) == 0
