"""Names from files: a mapping with colours beside it, and nothing in it that could command a terminal."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate.errors import InputDataError
from palpate.images.named_labels import LabelTable, NamedLabel, checked_table, hex_colour, printable


def test_a_table_is_the_mapping_of_its_names() -> None:
    table = checked_table([NamedLabel(2, " bladder "), NamedLabel(1, "prostate", "#ff0000")], Path("t"))
    assert list(table.items()) == [(1, "prostate"), (2, "bladder")]
    assert table == {1: "prostate", 2: "bladder"}
    assert table.colours == {1: "#ff0000"}
    assert not LabelTable()


@pytest.mark.parametrize(
    "rows",
    [
        [NamedLabel(1, "a"), NamedLabel(1, "b")],
        [NamedLabel(1, "a"), NamedLabel(2, " a")],
        [NamedLabel(-1, "a")],
        [NamedLabel(65536, "a")],
        [NamedLabel(1, " ")],
        [NamedLabel(1, "a" * 201)],
        [NamedLabel(1, "a\nb")],
    ],
)
def test_an_impossible_row_is_refused(rows: list[NamedLabel]) -> None:
    with pytest.raises(InputDataError, match="'t'"):
        checked_table(rows, Path("t"))


def test_what_could_command_a_terminal_is_replaced() -> None:
    assert printable("a\x1b[2J\r\n\u202eb\0ü ") == "a?[2J???b?ü "


@pytest.mark.parametrize(
    ("parts", "top", "colour"),
    [
        ((0, 128, 255), 255, "#0080ff"),
        ((1, 0.5, 0), 1, "#ff8000"),
        ((256, 0, 0), 255, None),
        ((float("nan"), 0, 0), 1, None),
    ],
)
def test_colours_are_written_as_in_css(parts: tuple[float, ...], top: float, colour: str | None) -> None:
    assert hex_colour(parts, top=top) == colour
