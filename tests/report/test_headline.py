"""The banner: what came out in plain words, never a result where there is none."""

from __future__ import annotations

import pytest

from palpate.report.rows import headline, listed


def document(*verdicts, status="converged", warnings=0, minima=(0, 0)):
    return {
        "status": status,
        "reason": "the predicted decrease of the objective fell below its tolerance",
        "estimates": [
            {"tissue": f"organ {i}", "parameter": "youngs_modulus", "verdict": v} for i, v in enumerate(verdicts)
        ],
        "warnings": [{"code": "a", "message": "b"}] * warnings,
        "starts": [{"minimum": minimum} for minimum in minima],
    }


@pytest.mark.parametrize(
    ("verdicts", "warnings", "kind"),
    [
        (("identified", "identified"), 0, "good"),
        (("ratio only", "identified"), 0, "good"),
        (("identified", "weak"), 0, "fair"),
        (("identified",), 1, "fair"),
        (("not identified",), 0, "bad"),
        (("identified", "not identified"), 0, "bad"),
    ],
)
def test_only_what_can_be_used_as_it_stands_is_good(verdicts, warnings, kind):
    assert headline(document(*verdicts, warnings=warnings)).kind == kind


def test_every_tissue_is_named_once_with_what_its_verdict_means():
    banner = headline(document("identified", "not identified", "identified"))
    said = " ".join((banner.title, *banner.sentences))
    assert "The images fix the stiffness of organ 0 and organ 2." in said
    assert said.count("organ") == 3


def test_data_that_are_missed_stand_in_the_banner():
    missed = document("weak") | {"warnings": [{"code": "data-misfit", "message": "b"}]}
    assert any("misses some of the data" in sentence for sentence in headline(missed).sentences)
    assert not any("misses" in sentence for sentence in headline(document("weak", warnings=1)).sentences)


@pytest.mark.parametrize(
    ("count", "words"),
    [
        (1, "The images do not fix the stiffness of organ 0: do not use its number."),
        (2, "The images do not fix the stiffness of organ 0 and organ 1: do not use their numbers."),
    ],
)
def test_what_is_not_identified_is_the_title_in_one_sentence(count, words):
    banner = headline(document(*["not identified"] * count))
    assert banner.title == words
    assert "found" not in " ".join((banner.title, *banner.sentences))


@pytest.mark.parametrize("status", ["not converged", "failed"])
def test_without_convergence_there_is_no_result(status):
    banner = headline(document("identified", status=status))
    assert banner.kind == "bad"
    assert banner.title.startswith("There is no result")
    assert banner.sentences == ("the predicted decrease of the objective fell below its tolerance",)


@pytest.mark.parametrize(("count", "words"), [(0, "No warnings."), (1, "1 warning"), (3, "3 warnings")])
def test_warnings_are_counted(count, words):
    assert headline(document("weak", warnings=count)).warnings == words


def test_starts_that_disagree_are_told_of():
    assert "2 different answers" in " ".join(headline(document("weak", minima=(0, 1, 0))).sentences)
    assert "same answer from all 3" in " ".join(headline(document("weak", minima=(0, 0, 0))).sentences)


@pytest.mark.parametrize(("minima", "count"), [((0, None, 0), 2), ((None, 0, None), 1), ((None, None, None), 0)])
def test_starts_that_led_nowhere_are_not_said_to_agree(minima, count):
    said = " ".join(headline(document("weak", minima=minima)).sentences)
    assert f"from {count} of 3 starts" in said
    assert "all 3" not in said


@pytest.mark.parametrize(
    ("names", "words"), [([], ""), (["a"], "a"), (["a", "b"], "a and b"), (["a", "b", "c"], "a, b and c")]
)
def test_names_stand_as_in_a_sentence(names, words):
    assert listed(names) == words
