"""What is refused, of docs/bad-input.md: the exit code of its class, one sentence, nothing written."""

from __future__ import annotations

import pytest
from bad_inputs import REFUSED, masks, sentence


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_has_its_code_and_a_sentence_and_leaves_nothing(name, folder, palpate):
    spoil, code, words = REFUSED[name]
    spoil(folder)
    done = palpate("estimate", "case.toml", "--output", "out", "--quiet", cwd=folder)
    assert words in sentence(done, code)
    assert code == 4 or not (folder / "out").exists()
    assert code != 4 or [path.name for path in (folder / "out").iterdir()] == ["log.txt"]


def test_no_image_is_written_among_the_masks_of_a_run(folder, palpate):
    masks(folder)
    done = palpate("estimate", "case.toml", "--output", "after", "--quiet", cwd=folder)
    assert "a folder of masks" in sentence(done, 2)
    assert sorted(path.name for path in (folder / "after").iterdir()) == ["prostate.nii.gz", "rectum.nii.gz"]
