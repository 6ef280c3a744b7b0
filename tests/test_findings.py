"""Warnings: one a cause, ordered by what they cost in the answer, with every place that they were seen in."""

from __future__ import annotations

import random
import re
from pathlib import Path
from types import SimpleNamespace as Stand

import numpy as np
import pytest

from palpate.body.imaged import alignment_findings
from palpate.findings import (
    CODES,
    HARMLESS,
    MOST_WORDS,
    SENTENCE_END,
    Finding,
    known_code,
    listing,
    of_pair,
    one_a_cause,
    warning_rows,
    words_in,
)
from palpate.images.alignment import Alignment, RigidFit, RigidMotion
from palpate.images.checks import later_names
from palpate.statement.estimate_findings import inversion_findings

SEEN = [Finding("thin", f"thin in {image}", "prostate", f"in {image}") for image in ("before", "after[1]", "after[2]")]


def test_one_cause_is_one_line_that_names_the_other_places():
    other = Finding("thin", "thin, too", "bladder", "in before")
    found = one_a_cause([*SEEN, other, SEEN[1]])
    assert [finding.message for finding in found] == ["thin in before; also in after[1], in after[2]", "thin, too"]
    assert one_a_cause(found) == found


def test_causes_that_say_different_things_of_no_place_stay_apart():
    found = [Finding("correlated", text) for text in ("a and b", "a and c", "a and b")]
    assert one_a_cause(found) == tuple(found[:2])


def test_what_costs_most_in_the_answer_comes_first_whatever_the_order_they_were_found_in():
    shuffled = random.Random(0).sample(CODES, len(CODES))
    rows = warning_rows([Finding(code, "x") for code in shuffled])
    assert [row["code"] for row in rows] == list(CODES)
    later = warning_rows([Finding(HARMLESS[0], "y")], beside=[*rows, {"code": "of-others", "message": "z"}])
    assert [row["code"] for row in later][-1] == "of-others"
    assert later[0] == rows[0]


def test_a_further_pair_is_named_and_one_cause_with_the_first():
    found = one_a_cause([*of_pair(SEEN[:2], 1), *of_pair(SEEN[:1], 2)])
    assert [finding.message for finding in found] == ["thin in before; also in after[1], in before of pair 2"]
    assert of_pair([Finding("units", "5 Pa")], 2) == (Finding("units", "Pair 2: 5 Pa"),)


def test_a_code_that_is_not_registered_is_refused():
    assert known_code("thin") == "thin"
    with pytest.raises(ValueError, match="'tin'"):
        known_code("tin")


def test_bones_in_pieces_unseen_or_round_are_one_warning_each_over_all_bones_and_images():
    still = RigidMotion(np.eye(3), np.zeros(3))
    fits = {"hip": RigidFit(still, 0.1, 0, np.zeros((0, 3))), "femur": RigidFit(still, 0.1, 90, np.eye(3)[:1])}
    loose = {"hip": 2.0, "femur": 1.5}
    alignment = Alignment(fits["femur"], fits, loose)
    of_bones = one_a_cause([finding for name in later_names(2) for finding in alignment_findings(alignment, name)])
    assert [each.code for each in of_bones] == ["several-bodies", "rotation-undetermined", "rigid-unseen"]
    assert "'hip' 2.0 mm, 'femur' 1.5 mm" in of_bones[0].message
    assert "; also in 'after[2]' ('hip' 2.0 mm, 'femur' 1.5 mm). Give" in of_bones[0].message


def test_moduli_that_depend_on_each_other_are_one_warning_with_every_pair():
    names = ("prostate", "bladder", "uterus")
    inversion = Stand(
        objective=Stand(parameters=Stand(absolute=True, tissues=names, names=names)),
        minimum=Stand(converged=True),
        mixture=Stand(explanations=(Stand(chosen={}, weight=1.0),)),
    )
    sd = np.array([0.1, 0.2, 0.5])
    correlation = np.array([[1.0, -0.995, 0.5], [-0.995, 1.0, 0.992], [0.5, 0.992, 1.0]])
    (finding,) = inversion_findings(inversion, correlation * np.outer(sd, sd))
    assert finding.code == "correlated"
    assert "the moduli of 'prostate' and 'bladder', 'bladder' and 'uterus'." in finding.message
    assert inversion_findings(inversion, np.diag(sd)) == ()


def test_places_are_named_as_far_as_60_words_reach_and_counted_beyond():
    text = f"{'word ' * 30}in 'before'. {'Do ' * 12}it."
    seen = [Finding("thin", text, "prostate", f"in 'after[{number}]' ({number}%)") for number in range(40)]
    (found,) = one_a_cause(seen)
    assert words_in(found.message) <= MOST_WORDS
    first, advice = SENTENCE_END.split(found.message)
    assert first.endswith(" more")
    assert "; also in 'after[1]' (1%), in 'after[2]' (2%)" in first
    assert advice == f"{'Do ' * 12}it."
    (full,) = one_a_cause([Finding("thin", "word " * 54 + "end.", "prostate", f"in {number}") for number in range(9)])
    assert full.message.endswith("end; also in 8 more places.")
    assert words_in(full.message) <= MOST_WORDS


def test_a_list_is_cut_where_the_words_end_and_its_first_entry_always_stands():
    names = [f"'tissue {number}'" for number in range(100)]
    text = listing("Too thin: ", names, ". Use finer images.")
    assert words_in(text) <= MOST_WORDS
    assert text.startswith("Too thin: 'tissue 0', 'tissue 1', ")
    assert re.search(r" and \d+ more\. Use finer images\.$", text)
    assert listing("Too thin: ", names[:1], ".") == "Too thin: 'tissue 0'."
    assert listing("Too thin: ", ["word " * 80, "b"], ".").endswith("and 1 more.")


def test_a_row_leads_to_the_page_where_its_code_is_explained():
    rows = warning_rows([Finding(code, "x") for code in CODES])
    page = (Path(__file__).parents[1] / "docs" / "warnings.md").read_text(encoding="utf-8")
    address = "https://github.com/palpate/palpate/blob/main/docs/warnings.md#"
    assert [row["help"] for row in rows] == [address + code for code in CODES]
    for row in rows:
        assert re.search(rf"^### {row['help'].removeprefix(address)}$", page, flags=re.MULTILINE)
    (strange,) = warning_rows([Finding("of-others", "x")])
    assert "help" not in strange
