"""The methods text: every source that is cited stands below, in order, and nothing else."""

from __future__ import annotations

import dataclasses
import re

from palpate.report.collect import collect
from palpate.report.methods import methods_text


def test_citations_and_sources_belong_together(case_result):
    text = methods_text(collect(case_result))
    cited = [int(n) for group in re.findall(r"\[([\d, ]+)\]", " ".join(text.paragraphs)) for n in group.split(",")]
    assert list(dict.fromkeys(cited)) == list(range(1, len(text.sources) + 1))


def test_the_text_says_what_was_set(case_result):
    text = " ".join(methods_text(collect(case_result)).paragraphs)
    for words in ("prostate and bladder", "driven by rectum", "surroundings (10 kPa)", "P2 elements", "3 starts"):
        assert words in text


def test_another_optimiser_is_another_source(case_result):
    options = dataclasses.replace(case_result.case.estimate, method="lbfgs")
    case = dataclasses.replace(case_result.case, estimate=options)
    text = methods_text(collect(dataclasses.replace(case_result, case=case)))
    assert any("Byrd" in source for source in text.sources)
    assert not any("Nocedal J, Wright" in source for source in text.sources)
