"""The README shows what the demo finds, and the demo warns of nothing."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from palpate.demo import run_demo
from palpate.progress import STAGES, Forecast, Told

ROOT = Path(__file__).parents[1]
ROW = re.compile(
    r"^(\w+) +([\d.]+) kPa +([\d.]+) to ([\d.]+) kPa +([\d.]+) to surroundings +(\w+) +([\d.]+)$", flags=re.MULTILINE
)


def test_the_readme_shows_what_the_demo_finds(tmp_path):
    """To a tenth of a per cent beyond the printed digit on the mesh that the docs tell of; on another, near it."""
    heard = []
    result = run_demo(tmp_path, heard.append)
    rows = {row[0]: row[1:] for row in ROW.findall((ROOT / "README.md").read_text(encoding="utf-8"))}
    assert set(rows) == {estimate.tissue for estimate in result.estimation.estimates} == {"prostate", "bladder"}
    unknowns = f"{3 * len(result.space.points):,} unknowns".replace(",", " ")
    same_mesh = unknowns in (ROOT / "docs" / "speed.md").read_text(encoding="utf-8")
    for estimate in result.estimation.estimates:
        *numbers, ratio, verdict, truth = rows[estimate.tissue]
        low, high = estimate.interval95
        assert low < float(truth) < high
        assert estimate.verdict == verdict == "identified"
        for text, found in zip((*numbers, ratio), (estimate.value, low, high, estimate.ratio), strict=True):
            digit = 0.5 * 10.0 ** -len(text.partition(".")[2])
            assert found == pytest.approx(float(text), abs=digit + (1e-3 if same_mesh else 0.15) * found)
    assert result.all_remarks == ()
    forecasts = [sentence for sentence in heard if isinstance(sentence, Forecast)]
    stages = dict.fromkeys(sentence.stage for sentence in heard if isinstance(sentence, Told))
    assert tuple(stages) == STAGES[:-1]  # what a bar needs; the report is the caller's
    assert len(forecasts) == 2  # of the images, and of the mesh
    assert all(tuple(each.seconds) == STAGES and min(each.seconds.values()) > 0.0 for each in forecasts)
