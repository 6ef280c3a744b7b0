"""README and tutorial show what the demo's pelvis gives: one estimate, to which the tutorial's steps lead, too."""

from __future__ import annotations

import json
import re
import shlex
from contextlib import chdir
from dataclasses import replace
from pathlib import Path

import pytest

from palpate.case.file import read_case
from palpate.cli import main
from palpate.demo import DATA, run_demo
from palpate.progress import STAGES, Forecast, Line, Told
from palpate.study.outputs import RESULT, RESULT_FILES

ROOT = Path(__file__).parents[1]
TUTORIAL = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
STEPS = TUTORIAL.partition("## 5. The report")[0]
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", STEPS, flags=re.DOTALL | re.MULTILINE)
TYPED = [line for kind, block in BLOCKS if not kind for line in block.splitlines()]
(MASKS,) = (block for kind, block in BLOCKS if kind == "python")
SHOWN = [block for kind, block in BLOCKS if kind == "text"]
MACHINE = re.compile(r"(?<=expected: ).* of memory|\S+ on \d+ processors?\)")  # time and memory are the machine's
NUMBER = re.compile(r"\d+(?:\.\d+)?")
WORDS_A_MINUTE = 200
KEYS_A_MINUTE = 200
ROW = re.compile(
    r"^(\w+) +([\d.]+) kPa +([\d.]+) to ([\d.]+) kPa +([\d.]+) to surroundings +(\w+)(?: +([\d.]+))?$",
    flags=re.MULTILINE,
)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The demo's result, and what it told on the way."""
    heard = []
    return run_demo(tmp_path_factory.mktemp("demo"), heard.append), heard


@pytest.mark.parametrize("page", ["README.md", "docs/tutorial.md"])
def test_a_page_shows_what_the_demo_finds(demo, page):
    """To a tenth of a per cent beyond the printed digit on the mesh that the docs tell of; on another, near it."""
    result, _ = demo
    named = {"urinary_bladder": "bladder"}  # by its mask's name in the tutorial
    rows = {named.get(row[0], row[0]): row[1:] for row in ROW.findall((ROOT / page).read_text(encoding="utf-8"))}
    assert set(rows) == {estimate.tissue for estimate in result.estimation.estimates} == {"prostate", "bladder"}
    figures = json.loads((ROOT / "docs" / "figures.json").read_text(encoding="utf-8"))
    unknowns = f"{3 * len(result.space.points):,}".replace(",", " ")
    same_mesh = unknowns == figures["demo"]["values"]["unknowns"]
    for estimate in result.estimation.estimates:
        *numbers, ratio, verdict, truth = rows[estimate.tissue]
        low, high = estimate.interval95
        assert (low < float(truth) < high) if page == "README.md" else not truth
        assert estimate.verdict == verdict == "identified"
        for text, found in zip((*numbers, ratio), (estimate.value, low, high, estimate.ratio), strict=True):
            digit = 0.5 * 10.0 ** -len(text.partition(".")[2])
            assert found == pytest.approx(float(text), abs=digit + (1e-3 if same_mesh else 0.15) * found)


def test_the_demo_warns_of_nothing_and_tells_what_a_bar_needs(demo):
    result, heard = demo
    assert result.all_remarks == ()
    forecasts = [sentence for sentence in heard if isinstance(sentence, Forecast)]
    told = dict.fromkeys(sentence.stage for sentence in heard if isinstance(sentence, Told))
    lines = [sentence.stage for sentence in heard if isinstance(sentence, Line) and sentence.stage]
    assert tuple(told) == tuple(lines) == STAGES  # each of them in a line of its own
    assert len(forecasts) == 2  # of the images, and of the mesh
    assert all(tuple(each.seconds) == STAGES and min(each.seconds.values()) > 0.0 for each in forecasts)


def test_from_a_clone_to_ones_own_result_it_is_ten_minutes_of_reading_and_typing():
    """All before the report is read, but the script for who has no masks; typed are all commands, each scan's anew."""
    read = len(STEPS.replace(MASKS, "").split())
    programs = [line.split()[0] for line in TYPED]
    assert programs == ["git", "pip", "TotalSegmentator", "TotalSegmentator", *["palpate"] * 3]
    typed = sum((2 if line.startswith("TotalSegmentator") else 1) * (len(line) + 1) for line in TYPED)
    assert 2.0 < read / WORDS_A_MINUTE + typed / KEYS_A_MINUTE <= 10.0


def test_the_tutorials_steps_lead_to_the_demos_case(tmp_path, capsys):
    """On the masks that the page writes; numbers to 15 %, as another mesher makes another mesh.

    What is estimated there is the demo's case under another name, whose outcome the page shows.
    """
    with chdir(tmp_path):
        exec(compile(MASKS, "docs/tutorial.md", "exec"), {})
        *first, (program, command, file, *options) = [
            shlex.split(line) for line in TYPED if line.startswith("palpate ")
        ]
        for typed, shown in zip(first, SHOWN[:-1], strict=True):
            assert main(typed[1:]) == 0
            printed, told = (MACHINE.sub("", text) for text in (capsys.readouterr().out, shown))
            assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", told).split()
            assert [float(n) for n in NUMBER.findall(printed)] == pytest.approx(
                [float(n) for n in NUMBER.findall(told)], rel=0.15, abs=0.05
            )
        assert (program, command, options[:3:2]) == ("palpate", "estimate", ["--output", "--set"])
        case, demos = read_case(Path(file), options[3::2]), read_case(DATA / "demo.toml")
    assert {(t.role, t.modulus_kpa, t.poisson_ratio) for t in case.tissues} == {
        (t.role, t.modulus_kpa, t.poisson_ratio) for t in demos.tissues
    }
    same = {name: getattr(demos, name) for name in ("id", "patient", "images", "tissues")}
    assert replace(case, **same) == demos
    (written,) = re.findall(r"^written to out: (.*)$", SHOWN[-1], flags=re.MULTILINE)
    asked_for = {"posterior.nc", "stiffness_sd.nii.gz", "known-images.npz"}  # samples, a map, several later images
    assert {*written.split(", ")} == {*RESULT_FILES, RESULT, "case.toml", "log.txt"} - asked_for
