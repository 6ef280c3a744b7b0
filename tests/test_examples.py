"""Every example runs, stays short, and gives its number."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
NUMBERS = {  # what `main` gives, and how far it may be off
    "01_estimate_spheres": (60.0, 12.0),  # kPa, the truth; voxels of 1 mm, a coarse mesh
    "02_from_files": (1.0, 0.01),  # the ball's volume
    "03_ratios_only": (0.0, 1e-9),  # mm
    "04_simulate": (3.1, 0.1),  # mm, the filling
}


def test_every_example_has_a_number():
    assert sorted(path.stem for path in EXAMPLES.glob("*.py")) == sorted(NUMBERS)


@pytest.mark.parametrize("name", NUMBERS)
def test_an_example_gives_its_number_in_under_60_lines(name):
    path = EXAMPLES / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"example_{name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    number, tolerance = NUMBERS[name]
    assert module.main() == pytest.approx(number, abs=tolerance)
    assert len(path.read_text().splitlines()) < 60
