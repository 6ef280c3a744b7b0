"""Every example runs, stays short, and gives its number."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
NUMBERS = {  # what `main` gives, and how far it may be off
    "01_estimate_spheres": (60.0, 6.0),  # kPa, the truth; voxels of 1 mm, a coarse mesh
    "02_from_files": (1.0, 0.01),  # the ball's volume
    "03_ratios_only": (0.0, 1e-9),  # mm
    "04_simulate": (3.1, 0.1),  # mm, the filling
    "05_markers_in_gel": (40.0, 4.0),  # kPa, the truths; meshes coarser than those that made the data, and noise
    "06_dvc_block": (150.0, 7.5),
    "07_breast_by_gravity": (10.0, 2.0),
    "08_soft_beam": (200.0, 20.0),
    "09_skin": (16.8, 1.5),  # kPa mm, measured: what this version finds
}
PAGES = {
    "01_estimate_spheres": "README.md",
    "05_markers_in_gel": "docs/fields/gel.md",
    "06_dvc_block": "docs/fields/dvc.md",
    "07_breast_by_gravity": "docs/fields/breast.md",
    "08_soft_beam": "docs/fields/beam.md",
    "09_skin": "docs/fields/skin.md",
}
LINE = re.compile(r"^\w+: ([\d.]+) kPa \(95 %: ([\d.]+) to ([\d.]+) kPa\), (\w+):", flags=re.MULTILINE)


def test_every_example_has_a_number():
    assert sorted(path.stem for path in EXAMPLES.glob("*.py")) == sorted(NUMBERS)


@pytest.mark.parametrize("name", NUMBERS)
def test_an_example_gives_its_number_and_its_page_in_under_60_lines(name, capsys):
    """What a page shows is what the example prints; on another build of the mesher near it."""
    path = EXAMPLES / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"example_{name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    number, tolerance = NUMBERS[name]
    assert module.main() == pytest.approx(number, abs=tolerance)
    assert len(path.read_text().splitlines()) < 60
    if name in PAGES:
        printed = LINE.findall(capsys.readouterr().out)
        shown = LINE.findall((ROOT / PAGES[name]).read_text(encoding="utf-8"))
        assert len(printed) > 0
        for (*numbers, verdict), (*told, verdict_told) in zip(printed, shown, strict=True):
            assert [float(number) for number in numbers] == pytest.approx([float(number) for number in told], rel=0.15)
            assert verdict == verdict_told
