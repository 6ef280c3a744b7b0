"""The methods text: every source that is cited stands below, in order, and nothing else."""

from __future__ import annotations

import dataclasses
import re

from palpate.report.collect import collect
from palpate.report.methods import methods_text
from palpate.study.case import CaseLoad, Mechanics


def test_citations_and_sources_belong_together(case_result):
    text = methods_text(collect(case_result))
    cited = [int(n) for group in re.findall(r"\[([\d, ]+)\]", " ".join(text.paragraphs)) for n in group.split(",")]
    assert list(dict.fromkeys(cited)) == list(range(1, len(text.sources) + 1))


def test_the_text_says_what_was_set(case_result):
    text = " ".join(methods_text(collect(case_result)).paragraphs)
    for words in (
        "prostate and bladder",
        "driven by rectum",
        "surroundings (10 kPa)",
        "quadratic tetrahedra",
        "3 starts",
    ):
        assert words in text


def test_the_misfit_is_what_the_observations_say_of_themselves(case_result):
    seen = {"surface distance": "the distance between surfaces", "point motion": "the motion of points"}
    estimation = dataclasses.replace(case_result.estimation, observations=seen)
    text = " ".join(methods_text(collect(dataclasses.replace(case_result, estimation=estimation))).paragraphs)
    assert "The misfit was the distance between surfaces and the motion of points." in text


def test_the_finite_strain_law_is_told_with_its_start(case_result):
    for law, told in (("linear", False), ("neo-hookean", True)):
        case = dataclasses.replace(case_result.case, mechanics=Mechanics(law=law))
        text = " ".join(methods_text(collect(dataclasses.replace(case_result, case=case))).paragraphs)
        assert ("The linear law gave the start" in text) is told


def test_a_known_load_sets_the_scale(case_result):
    data = collect(case_result)
    unknown = tuple(dataclasses.replace(tissue, given_kpa=None) for tissue in data.tissues)
    text = " ".join(methods_text(dataclasses.replace(data, tissues=unknown)).paragraphs)
    assert "The scale was set by the known loads" in text
    ratios = " ".join(methods_text(dataclasses.replace(data, tissues=unknown, unit="ratio")).paragraphs)
    assert "only ratios were found" in ratios


def test_known_loads_are_told_in_words_and_in_numbers(case_result):
    loads = (
        CaseLoad("gravity", acceleration_m_s2=(3.0, 0.0, -9.81)),
        CaseLoad("pressure", surface="air", pressure_kpa=1.5),
    )
    data = collect(dataclasses.replace(case_result, case=dataclasses.replace(case_result.case, loads=loads)))
    text = " ".join(methods_text(data).paragraphs)
    assert "gravity (3, 0, -9.81) m/s^2; following pressure 1.5 kPa on air" in text
    assert ("starts", "0.5, 2, 8 (ratios)") in data.settings


def test_a_further_pair_has_a_mesh_that_is_told_of(two_pairs):
    assert "Each of 2 pairs of images had a mesh of its own" in " ".join(methods_text(collect(two_pairs)).paragraphs)


def test_another_optimiser_is_another_source(case_result):
    options = dataclasses.replace(case_result.case.estimate, method="lbfgs")
    case = dataclasses.replace(case_result.case, estimate=options)
    text = methods_text(collect(dataclasses.replace(case_result, case=case)))
    assert any("Byrd" in source for source in text.sources)
    assert not any("Nocedal J, Wright" in source for source in text.sources)
