"""The tutorial's masks are written by what it shows, and `palpate init` says of them what it shows."""

from __future__ import annotations

import re
from pathlib import Path

from palpate.cli import main

TUTORIAL = (Path(__file__).parents[1] / "docs" / "tutorial.md").read_text(encoding="utf-8")


def test_the_first_steps_give_what_the_tutorial_shows(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    exec(compile(re.findall(r"```python\n(.*?)```", TUTORIAL, flags=re.DOTALL)[0], "docs/tutorial.md", "exec"), {})
    (command,) = re.findall(r"^palpate (init .*)$", TUTORIAL, flags=re.MULTILINE)
    assert main(command.split()) == 0
    shown = re.findall(r"```text\n(.*?)```", TUTORIAL, flags=re.DOTALL)[0]
    assert capsys.readouterr().out == shown
