"""Validation, benchmarks and examples use what the layers offer in their `__init__`, and nothing deeper."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = (
    "body",
    "case",
    "export",
    "images",
    "inversion",
    "mechanics",
    "mesh",
    "observation",
    "phantoms",
    "report",
    "statement",
    "study",
    "uncertainty",
)
SCRIPTS = sorted(
    path.relative_to(ROOT)
    for folder in ("benchmarks", "examples", "validation")
    for path in (ROOT / folder).rglob("*.py")
)


def imports_of(path):
    """Module and names of each `from palpate...` import, at any depth of the file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "palpate":
            yield node.module, [alias.name for alias in node.names]
        if isinstance(node, ast.Import):
            yield from ((alias.name, []) for alias in node.names if alias.name.startswith("palpate."))


@pytest.mark.parametrize("path", SCRIPTS, ids=str)
def test_nothing_deeper_than_a_front_door_is_imported(path):
    deeper = [module for module, _ in imports_of(ROOT / path) if module.split(".")[1:2] and module.count(".") > 1]
    assert [module for module in deeper if module.split(".")[1] in LAYERS] == []


@pytest.mark.parametrize("path", SCRIPTS, ids=str)
def test_a_front_door_names_what_is_taken_through_it(path):
    for module, names in imports_of(ROOT / path):
        if module.count(".") == 1 and module.split(".")[1] in LAYERS:
            missing = set(names) - set(dir(importlib.import_module(module)))
            assert not missing, f"{module} does not offer {sorted(missing)}"
