"""A check answers what an estimate ends with, of docs/bad-input.md; images are read in this process."""

from __future__ import annotations

import pytest
from bad_inputs import ACCEPTED, REFUSED


@pytest.mark.parametrize("name", [*REFUSED, *ACCEPTED])
def test_a_check_answers_first_what_an_estimate_ends_with(name, folder, answer):
    spoil, code, words = REFUSED.get(name) or (ACCEPTED[name], 0, "")
    spoil(folder)
    found, sentence = answer(folder / "case.toml")
    assert found == code
    assert words in sentence
