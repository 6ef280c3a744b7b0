"""Nothing in the package can turn data into code or unpack an archive to the disk: no pickle, no eval, no shell."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "palpate"
FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "yaml", "tarfile"}
FORBIDDEN_NAMES = {"eval", "exec", "__import__"}


def flaws(tree: ast.AST) -> list[str]:
    found: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name.split(".")[0] in FORBIDDEN_MODULES]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in FORBIDDEN_MODULES:
            found.append(str(node.module))
        elif isinstance(node, ast.Name) and node.id in FORBIDDEN_NAMES:
            found.append(node.id)
        elif isinstance(node, ast.Attribute) and node.attr in ("extract", "extractall", "unpack_archive"):
            found.append(node.attr)
        elif isinstance(node, ast.keyword) and node.arg in ("shell", "allow_pickle"):
            found += [] if isinstance(node.value, ast.Constant) and node.value.value is False else [node.arg]
    return found


def test_the_search_finds_each_kind() -> None:
    code = "import pickle\nfrom yaml import load\neval('1')\nf(shell=True)\nnp.load(x, allow_pickle=flag)\n"
    code += "f(shell=False)\nz.extractall()"
    assert sorted(flaws(ast.parse(code))) == ["allow_pickle", "eval", "extractall", "pickle", "shell", "yaml"]


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=lambda path: str(path.relative_to(SOURCE)))
def test_no_module_unpickles_evaluates_or_starts_a_shell(path: Path) -> None:
    assert flaws(ast.parse(path.read_text(encoding="utf-8"))) == []
