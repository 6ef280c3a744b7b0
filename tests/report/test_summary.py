"""The half page for a reader who is no engineer: true in every case, in plain and short sentences."""

from __future__ import annotations

import re
from itertools import product

import pytest

from palpate.report.summary import summary

# what an engineer says to engineers
JARGON = "posterior prior likelihood deviance covariance modulus moduli gate minimum minima kernel residual sigma frame"
WORDS = 25
VERDICTS = ("identified", "weak", "ratio only", "not identified")


def item(tissue, verdict, *, unit="kPa", value=35.26, ratio=3.526):
    lost = verdict == "not identified"
    kpa = unit == "kPa"
    return {
        "tissue": tissue,
        "parameter": "youngs_modulus",
        "unit": unit,
        "value": value if kpa else None,
        "interval95": None if lost or not kpa else [23.16, 58.44],
        "ratio": ratio,
        "ratio_interval95": None if lost else [2.316, 5.844],
        "relative_to": "fat",
        "verdict": verdict,
        "truth": None,
    }


def document(*items, status="converged", codes=(), minima=(0, 0), known=10.0):
    fat = {"role": "estimate"} if known is None else {"role": "known", "youngs_modulus_kpa": known}
    return {
        "status": status,
        "reason": "the decrement fell under its tolerance",
        "law": "neo-hookean",
        "estimates": list(items),
        "case": {"tissues": {"fat": fat}},
        "warnings": [{"code": code, "message": "m"} for code in codes],
        "starts": [{"minimum": minimum} for minimum in minima],
    }


def words_of(of) -> str:
    found = [f"{tissue}: {words}" for tissue, words in of.found]
    return "\n".join([*of.lead, *found, *of.sure, *of.avoid])


def every_outcome():
    for verdicts in product(VERDICTS, repeat=2):
        items = [item(f"organ {i}", verdict) for i, verdict in enumerate(verdicts)]
        ranged = [4.0, 25.0] if "ratio only" in verdicts else 10.0
        for codes in ((), ("data-misfit",), ("fold-over", "thin", "finer-mesh")):
            yield document(*items, codes=codes, minima=(0, 1), known=ranged)
    yield document(item("organ", "ratio only", unit="ratio"), known=None)
    for status in ("failed", "not converged"):
        yield document(item("organ", "not identified", value=None, ratio=None), status=status)


@pytest.mark.parametrize("of", list(every_outcome()))
def test_every_sentence_is_short_and_in_plain_words_and_every_part_says_something(of):
    found = summary(of)
    text = words_of(found)
    assert found.lead
    assert found.sure
    assert "not a medical device" in found.avoid[-1]
    for sentence in re.split(r"(?<=[.:;])\s+", text):
        assert len(sentence.split()) <= WORDS, sentence
    assert not {word for word in JARGON.split() if re.search(rf"\b{word}\b", text)}
    assert not re.search(r"None|nan|\{|\}|  ", text)


def test_a_modulus_that_is_identified_stands_in_kilopascals_with_its_range():
    found = summary(document(item("gland", "identified")))
    assert found.found == (("gland", "about 35 kPa. The true value probably lies between 23 and 58."),)
    assert "10 kPa for fat" in words_of(found)


@pytest.mark.parametrize(
    ("known", "words"),
    [
        (10.0, "10 kPa for fat, the stated loads and the measured forces. If one of these is wrong"),
        (None, "the stated loads and the measured forces. If the truth is twice that, all double."),
    ],
)
def test_the_loads_and_forces_that_set_the_scale_are_named(known, words):
    of = document(item("gland", "weak"), known=known)
    of["case"] |= {"loads": [{"kind": "gravity"}], "data": [{"kind": "force"}]}
    assert words in words_of(summary(of))


def test_a_ratio_alone_is_never_told_in_kilopascals():
    for of in (
        document(item("gland", "ratio only"), known=[4.0, 25.0]),
        document(item("gland", "ratio only", unit="ratio"), known=None),
    ):
        found = summary(of)
        assert found.found[0][1].startswith("about 3.5 times as stiff as fat.")
        assert "35" not in words_of(found).replace("3.5", "")
        assert any("Do not quote kilopascals for gland" in sentence for sentence in found.avoid)
        assert "Stiffness is given in kilopascals" not in words_of(found)


def test_mixed_verdicts_share_one_unit_and_name_every_tissue_where_it_belongs():
    found = summary(document(item("gland", "identified"), item("muscle", "ratio only"), known=[4.0, 25.0]))
    assert "3.5 times as stiff as fat" in found.found[0][1]
    assert "about 35 kPa" in found.found[0][1]  # which the images fix in kPa as well
    assert "kPa" not in found.found[1][1]
    assert any("kilopascals for muscle" in sentence for sentence in found.avoid)


def test_nothing_that_is_not_identified_has_a_number():
    found = summary(document(item("gland", "not identified"), item("muscle", "weak")))
    assert found.found[0] == ("gland", "no answer. The images do not show how stiff it is.")
    assert "Do not use any number for gland." in found.avoid
    assert "Do not quote the number of muscle without its range." in found.avoid


@pytest.mark.parametrize(
    ("status", "words"), [("failed", "could not be completed"), ("not converged", "did not find a stable answer")]
)
def test_without_a_result_no_number_is_told(status, words):
    found = summary(document(item("gland", "identified"), status=status))
    assert words in found.lead[0]
    assert found.found == ()
    assert not re.search(r"\d", words_of(found))


def test_data_that_are_missed_and_warnings_that_matter_are_told():
    missed = summary(document(item("gland", "weak"), codes=("data-misfit",)))
    assert any("does not explain all of the data" in sentence for sentence in missed.sure)
    grave = summary(document(item("gland", "identified"), codes=("fold-over", "finer-mesh")))
    assert any(sentence.startswith("A warning says") for sentence in grave.sure)
    harmless = summary(document(item("gland", "identified"), codes=("finer-mesh",)))
    assert not any("warning" in sentence for sentence in harmless.sure)
