"""The methods text: every source that is cited stands below, in order, and nothing else."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from palpate.case.case import CaseLoad, Mechanics, MeshBody
from palpate.case.data import CaseData
from palpate.report.collect import collect
from palpate.report.methods import SOURCES, bibtex, methods_text, reference_line


@pytest.fixture(scope="module")
def text(case_result):
    return methods_text(collect(case_result))


def test_citations_and_sources_belong_together(text):
    cited = [int(n) for group in re.findall(r"\[([\d, ]+)\]", " ".join(text.paragraphs)) for n in group.split(",")]
    assert list(dict.fromkeys(cited)) == list(range(1, len(text.sources) + 1))


def test_the_text_says_what_was_set(text):
    for words in (
        "prostate and bladder",
        "driven by rectum",
        "surroundings (10 kPa)",
        "quadratic tetrahedra",
        "3 starts",
    ):
        assert words in " ".join(text.paragraphs)


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


def test_the_prior_of_a_map_is_told(case_result, text):
    first, *others = case_result.case.tissues
    mapped = dataclasses.replace(first, modulus="field")
    case = dataclasses.replace(case_result.case, tissues=(mapped, *others))
    of_map = methods_text(collect(dataclasses.replace(case_result, case=case)))
    told = f"Inside {first.name} (Gaussian, Matern's kernel, sd 0.7 of ln E, length 8 mm) ln E was a field"
    assert told in " ".join(of_map.paragraphs)
    test_citations_and_sources_belong_together(of_map)
    assert "ln E was a field" not in " ".join(text.paragraphs)


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


def test_measurements_and_a_mesh_are_told(case_result):
    data = (
        CaseData("landmarks", Path("m.csv"), sd_mm=0.3),
        CaseData("force", surface="plate", force_n=12.5, direction=(0.0, 0.0, 1.0), sd_n=0.1),
    )
    case = dataclasses.replace(case_result.case, images=None, pairs=(), body=MeshBody(Path("block.vtu")), data=data)
    collected = collect(dataclasses.replace(case_result, case=case))
    text = " ".join(methods_text(collected).paragraphs)
    assert "measurements of one body, given as a mesh" in text
    assert "Mmg" not in text
    told = [words for key, words in collected.settings if key == "measurement"]
    assert told == ["landmarks, sd 0.3 mm, state 1", "force of 12.5 N on plate, sd 0.1 N, state 1"]


def test_a_further_pair_has_a_mesh_that_is_told_of(two_pairs):
    assert "Each of 2 pairs of images had a mesh of its own" in " ".join(methods_text(collect(two_pairs)).paragraphs)


def test_the_bibtex_of_palpate_is_that_of_citation_cff(case_result, text):
    citation = (Path(__file__).parents[2] / "CITATION.cff").read_text()
    entry = text.bibtex.partition("\n\n")[0]
    fields = dict(re.findall(r"^  (\w+) = \{(.*)\},?$", entry, flags=re.MULTILINE))
    stated = dict(re.findall(r'^([\w-]+): "?(.*?)"?$', citation, flags=re.MULTILINE))
    assert entry.startswith("@software{palpate,")
    assert fields["title"] == f"{{{stated['title']}}}"
    assert fields["url"] == stated["repository-code"]
    assert fields["version"] == stated["version"] == case_result.to_dict()["versions"]["palpate"]
    authors = citation[citation.index("authors:") : citation.index("keywords:")]
    author = re.search('name: "(.*)"', authors).group(1)
    assert fields["author"] == f"{{{author}}}"


def test_the_bibtex_of_the_paper_is_that_of_citation_cff():
    citation = (Path(__file__).parents[2] / "CITATION.cff").read_text()
    first = citation[citation.index("references:") : citation.index("TotalSegmentator")]
    yang = SOURCES["yang"]
    assert yang.title == re.search('title: "(.*)"', first).group(1)
    names = zip(re.findall("family-names: (.*)", first), re.findall("given-names: (.*)", first), strict=True)
    assert yang.fields["author"] == " and ".join(", ".join(name) for name in names)


@pytest.mark.parametrize("key", SOURCES)
def test_an_entry_has_balanced_braces_and_its_title(key):
    entry = bibtex(key, SOURCES[key])
    assert entry.count("{") == entry.count("}")
    assert SOURCES[key].title in entry
    assert SOURCES[key].title in reference_line(SOURCES[key])


def test_every_cited_source_has_its_entry(text):
    assert len(re.findall("^@", text.bibtex, flags=re.MULTILINE)) == len(text.sources)


def test_an_interval_from_the_profile_is_told_of(case_result, text):
    first, second = case_result.estimation.estimates
    leaning = dataclasses.replace(first, interval_kind="profile")
    estimation = dataclasses.replace(case_result.estimation, estimates=(leaning, second))
    told = " ".join(methods_text(collect(dataclasses.replace(case_result, estimation=estimation))).paragraphs)
    assert "of prostate, whose profile likelihood leans to one side" in told
    assert "leans" not in " ".join(text.paragraphs)


def test_intervals_are_said_to_cover_what_is_unknown_and_no_error_of_what_is_given(case_result):
    def told(**shares):
        first, second = case_result.estimation.estimates
        estimates = (dataclasses.replace(first, variance_shares={"noise": 0.5, **shares}), second)
        estimation = dataclasses.replace(case_result.estimation, estimates=estimates)
        return methods_text(collect(dataclasses.replace(case_result, estimation=estimation))).paragraphs[-1]

    assert "They do not cover the errors of the material law, the boundary condition, given Poisson" in told()
    assert "allow for" not in told()
    text = told(frame=0.2, poisson=0.3, offset=0.0)
    assert "They allow for the frame's motion and Poisson's ratios." in text
    assert "They do not cover the errors of the material law and the given moduli." in text
