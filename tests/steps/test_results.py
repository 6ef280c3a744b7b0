"""A result in Python: a table, cards, a figure; nothing of an estimate that did not converge looks like a number."""

from __future__ import annotations

import dataclasses
from dataclasses import fields

import pytest
from matplotlib.figure import Figure

from palpate.errors import ConfigurationError, ResourceError
from palpate.findings import HELP
from palpate.steps.results import CaseResult

NUMBERS = ["value_kpa", "low_kpa", "high_kpa", "ratio", "ratio_low", "ratio_high"]


@pytest.fixture
def result(case_result) -> CaseResult:
    return CaseResult(**{field.name: getattr(case_result, field.name) for field in fields(case_result)})


def with_estimates(result, *changes, **estimation):
    """The result whose first estimates have the `changes`."""
    items = list(result.estimation.estimates)
    for i, change in enumerate(changes):
        items[i] = dataclasses.replace(items[i], **change)
    changed = dataclasses.replace(result.estimation, estimates=tuple(items), **estimation)
    return dataclasses.replace(result, estimation=changed)


def test_the_table_has_a_row_a_tissue_and_a_column_a_quantity(result):
    table = with_estimates(result, {"interval95": (47.1, None)}, {"interval95": (None, None)}).to_dataframe()
    assert list(table["tissue"]) == ["prostate", "bladder"]
    assert list(table["patient"]) == ["sub-01", "sub-01"]
    assert (table.loc[0, "value_kpa"], table.loc[0, "low_kpa"]) == (58.9, 47.1)
    assert table["high_kpa"].isna().all()
    assert list(table["low_kpa"].isna()) == [False, True]
    assert {str(table[name].dtype) for name in NUMBERS} == {"float64"}
    assert list(table["verdict"]) == ["identified", "identified"]
    assert table["truth_kpa"].tolist()[0] == 60.0


def test_a_table_of_what_did_not_converge_has_no_number(result):
    table = with_estimates(result, status="not converged").to_dataframe()
    assert table[NUMBERS].isna().all(axis=None)
    assert set(table["status"]) == {"not converged"}


def test_without_pandas_a_sentence_says_what_to_install(result, without):
    without("pandas")
    with pytest.raises(ResourceError, match=r"pip install 'palpate\[dataframe\]'"):
        result.to_dataframe()


def test_cards_say_value_interval_and_verdict_of_each_tissue(result):
    page = with_estimates(result, {"interval95": (47.1, None)})._repr_html_()
    assert "58.9 kPa" in page
    assert "&gt; 47.1 kPa" in page
    assert page.count("identified") == 2
    assert "a warning to be shown" in page
    assert "58.9" not in with_estimates(result, status="not converged")._repr_html_()


def test_a_result_is_printed_a_line_a_tissue_with_open_ends_in_words(result):
    ratio = {"value": None, "interval95": None, "ratio": 3.12, "ratio_interval95": (None, 5.0)}
    lines = str(with_estimates(result, {"interval95": (47.1, None)}, ratio)).splitlines()
    assert lines == [
        "prostate: 58.9 kPa (95 %: > 47.1 kPa), identified: high / low is 1.56",
        "bladder: 3.12 x surroundings (95 %: < 5.00), identified: high / low is 1.56",
        "warning (example): a warning to be shown",
        f"each code is explained on {HELP}",
    ]
    lost = str(with_estimates(result, {"interval95": None, "verdict": "not identified"})).splitlines()
    assert lost[0] == "prostate: 58.9 kPa, not identified: high / low is 1.56"
    failed = str(with_estimates(result, status="not converged", reason="it stopped")).splitlines()
    assert failed[0] == "not converged: it stopped"
    assert failed[1].startswith("prostate: no value, not identified: ")


def test_names_in_cards_are_text(result):
    page = with_estimates(result, {"tissue": "<script>alert(1)</script>", "why": "<b>"})._repr_html_()
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert "&lt;b&gt;" in page


def test_the_figure_shows_intervals_with_open_ends_as_arrows(result):
    figure = with_estimates(result, {"interval95": (47.1, None)}, {"tissue": "$x_"}).plot()
    (axes,) = figure.axes
    intervals = [line for line in axes.lines if line.get_gid() == "interval"]
    assert list(intervals[0].get_xdata()) == [47.1, axes.get_xlim()[1]]
    assert list(intervals[1].get_xdata()) == pytest.approx([0.8 * 31.2, 1.25 * 31.2])
    assert [line.get_marker() for line in axes.lines if line.get_gid() == "open"] == [">"]
    assert [label.get_text().split()[0] for label in axes.get_yticklabels()] == ["prostate", "$x_"]
    figure.draw_without_rendering()


@pytest.mark.parametrize("changes", [{"value": None, "interval95": None}, {"status": "not converged"}])
def test_a_figure_of_ratios_or_of_nothing_can_be_drawn(result, changes):
    estimation = {key: value for key, value in changes.items() if key == "status"}
    items = [{} if estimation else changes] * 2
    with_estimates(result, *items, **estimation).plot().draw_without_rendering()


def test_a_figure_shows_itself_in_a_notebook_and_can_be_saved(result, tmp_path):
    figure = result.plot()
    assert figure._repr_png_().startswith(b"\x89PNG")
    figure.savefig(tmp_path / "moduli.svg")
    assert (tmp_path / "moduli.svg").stat().st_size > 1000


def test_a_plot_goes_on_given_axes(result):
    figure = Figure()
    left, right = figure.subplots(1, 2)
    assert result.plot(right, unit="ratio") is right
    assert not left.lines
    assert right.get_xlabel().startswith("E / E of surroundings (ratio)")
    assert [line.get_xdata()[0] for line in right.lines if line.get_gid() == "interval"] == pytest.approx(
        [4.712, 2.496]
    )


def test_moduli_known_as_ratios_alone_are_plotted_as_ratios(result):
    lost = with_estimates(result, {"verdict": "ratio only"})
    (axes,) = lost.plot().axes
    assert "kPa" not in axes.get_xlabel()
    with pytest.raises(ConfigurationError, match="ask for the unit 'ratio'"):
        lost.plot(unit="kPa")
