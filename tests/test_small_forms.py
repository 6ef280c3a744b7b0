"""Every script that README and docs name has a small form, and every small form names a script with its flags."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LINES = (ROOT / "benchmarks" / "small_forms.txt").read_text(encoding="utf-8").splitlines()
FORMS = [line.rpartition(": ")[2] for line in LINES if line and not line.startswith("#")]
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")] + sorted(
    (ROOT / "docs").rglob("*.md")
)


def test_every_script_that_a_page_names_has_a_small_form():
    told = {
        name for page in PAGES for name in re.findall(r"benchmarks/([a-z_]+\.py)", page.read_text(encoding="utf-8"))
    }
    assert told <= {form.split()[0] for form in FORMS}


@pytest.mark.parametrize("form", FORMS)
def test_a_small_form_has_flags_that_its_script_knows(form):
    script, *words = form.split()
    files = (ROOT / "benchmarks" / name for name in (script, "rows.py", "fuzz_readers.py"))  # whose flags others share
    text = "\n".join(path.read_text(encoding="utf-8") for path in files)
    for flag in (word for word in words if word.startswith("--")):
        assert f'"{flag}"' in text, flag
