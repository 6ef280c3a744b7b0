"""What stands on a terminal fits it: tables of a hundred letters, sentences broken between words."""

from __future__ import annotations

import io
import os
import pty
import termios

import numpy as np
import pytest

from palpate.cli.outcome import MOST_LETTERS, columns, estimates_table
from palpate.images.alignment import RigidMotion
from palpate.images.registration import Registration, length_text
from palpate.report.tornado import TornadoRow, effect_text
from palpate.steps.display import fitted

SETTINGS = ", ".join(f"{setting}: -{setting} %" for setting in range(30))


def test_a_wide_table_is_broken_in_its_widest_column_and_loses_nothing():
    rows = [["tissue", "changed", "modulus", "method"], ["prostate", "surface of bladder", SETTINGS, "re-estimated"]]
    lines = columns(rows).splitlines()
    assert len(lines) > 3
    assert max(map(len, lines)) <= MOST_LETTERS
    others = ("prostate", "surface", "of", "bladder", "re-estimated")
    assert [word for line in lines[1:] for word in line.split() if word not in others] == SETTINGS.split()
    assert [line.split()[-1] for line in lines[:2]] == ["method", "re-estimated"]


def test_a_narrow_table_stands_as_it_is():
    assert columns([["a", "b"], ["long", "c"]]) == "a     b\nlong  c"


@pytest.mark.parametrize("width", [40, 80])
def test_a_sentence_is_broken_between_words_and_set_in(width):
    keyboard, screen = pty.openpty()
    termios.tcsetwinsize(screen, (24, width))
    sentence = "[   1.0 s] " + "finite strain: the equilibrium at the linear estimate " * 3
    with os.fdopen(screen, "w") as terminal, os.fdopen(keyboard):
        lines = fitted(sentence.strip(), terminal).split("\n")
    assert max(map(len, lines)) < width
    assert " ".join(line.strip() for line in lines).split() == sentence.split()
    assert all(line.startswith(" " * 11) for line in lines[1:])


def test_where_there_is_no_terminal_a_sentence_stays_one_line():
    assert fitted("word " * 100, io.StringIO()) == "word " * 100
    assert fitted("word " * 100, None) == "word " * 100


def test_a_setting_without_an_estimate_says_why_in_the_table():
    row = TornadoRow(
        "material law", "re-estimated", False, {"linear": 0.1}, (), {"mooney-rivlin": "no equilibrium was found"}
    )
    assert effect_text(row, reasons=True) == "linear: +10.5 %, mooney-rivlin: no equilibrium was found"
    assert effect_text(row) == "linear: +10.5 %, mooney-rivlin: no estimate"


@pytest.mark.parametrize(
    ("given", "error"), [(10.0, "gland +20 %"), (None, None)], ids=["known reference", "no reference"]
)
def test_a_ratio_is_held_against_the_true_ratio(given, error):
    """Not against the true modulus: 3.6 times 10 kPa is a fifth more than 30 kPa."""
    gland = {"tissue": "gland", "parameter": "youngs_modulus", "unit": "ratio", "relative_to": "rest", "value": None}
    gland |= {"interval95": None, "ratio": 3.6, "ratio_interval95": [2.0, 6.0], "verdict": "ratio only", "truth": 30.0}
    case = {"tissues": {"rest": {"youngs_modulus_kpa": given}}}
    table = estimates_table({"status": "converged", "estimates": [gland], "warnings": [], "case": case})
    assert ("error against the truth" in table) == (error is not None)
    assert error is None or error in table
    assert "-88 %" not in table


def test_a_length_that_no_image_shows_is_not_printed():
    assert [length_text(mm) for mm in (4.7e-7, 0.012, 3.14, 27.0)] == ["less than 0.01", "0.012", "3.1", "27"]


def test_a_motion_that_is_rounding_is_none():
    turn = RigidMotion(np.eye(3), np.full(3, 3e-9))
    found = Registration("surfaces", turn, np.zeros(3), 4.7e-7)
    assert found.still
    assert "was not moved" in found.in_words
    clear = Registration("surfaces", RigidMotion(np.eye(3), np.array([0.2, 0.0, 0.0])), np.zeros(3), 4.7e-7)
    assert "these surfaces then lie less than 0.01 mm apart" in clear.in_words
