"""The tutorial leads from a clone to the first result of one's own, in ten minutes and with what it shows."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from palpate.cli import main

PAGE = (Path(__file__).parents[1] / "docs" / "tutorial.md").read_text(encoding="utf-8")
STEPS = PAGE.partition("## 5. The report")[0]
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", STEPS, flags=re.DOTALL | re.MULTILINE)
TYPED = [line for kind, block in BLOCKS if not kind for line in block.splitlines()]
(MASKS,) = (block for kind, block in BLOCKS if kind == "python")
SHOWN = [block for kind, block in BLOCKS if kind == "text"]
MACHINE = re.compile(r"[\d.]+ GB, [\d.]+ (?:s|min) .*")  # time and memory, which are the machine's
NUMBER = re.compile(r"\d+(?:\.\d+)?")
WORDS_A_MINUTE = 200
KEYS_A_MINUTE = 200


def test_from_a_clone_to_ones_own_result_it_is_ten_minutes_of_reading_and_typing():
    """All before the report is read, but the script for who has no masks; typed are all commands, each scan's anew."""
    read = len(STEPS.replace(MASKS, "").split())
    programs = [line.split()[0] for line in TYPED]
    assert programs == ["git", "pip", "TotalSegmentator", "TotalSegmentator", *["palpate"] * 3]
    typed = sum((2 if line.startswith("TotalSegmentator") else 1) * (len(line) + 1) for line in TYPED)
    assert 2.0 < read / WORDS_A_MINUTE + typed / KEYS_A_MINUTE <= 10.0


def test_the_steps_give_what_the_tutorial_shows(tmp_path, monkeypatch, capsys):
    """In order, on the masks that the page writes; on another mesh, which another mesher makes, to 15 %."""
    monkeypatch.chdir(tmp_path)
    exec(compile(MASKS, "docs/tutorial.md", "exec"), {})
    for command, shown in zip((line for line in TYPED if line.startswith("palpate ")), SHOWN, strict=True):
        assert main(shlex.split(command)[1:]) == 0
        printed = MACHINE.sub("", capsys.readouterr().out)
        told = MACHINE.sub("", shown)
        assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", told).split()
        assert [float(n) for n in NUMBER.findall(printed)] == pytest.approx(
            [float(n) for n in NUMBER.findall(told)], rel=0.15, abs=0.05
        )
