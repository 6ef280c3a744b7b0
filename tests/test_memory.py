"""Free memory: the machine's, or less where a control group limits it."""

from __future__ import annotations

import pytest

from palpate import memory


@pytest.fixture
def group(tmp_path, monkeypatch):
    """A control group of 1 GB, 0.7 GB of it used, of which 0.2 GB are caches that it would give back."""
    (tmp_path / "memory.max").write_text("1000000000\n")
    (tmp_path / "memory.current").write_text("700000000\n")
    (tmp_path / "memory.stat").write_text("anon 5\ninactive_file 200000000\n")
    paths = str(tmp_path / "memory.max"), str(tmp_path / "memory.current"), "inactive_file"
    monkeypatch.setattr(memory, "CGROUPS", (paths,))
    return tmp_path


@pytest.mark.usefixtures("group")
def test_a_control_group_leaves_no_more_than_its_limit():
    assert memory.available_memory() == 5e8


def test_a_control_group_without_a_limit_leaves_what_the_machine_has(group):
    (group / "memory.max").write_text("max\n")
    assert memory.available_memory() == memory._of_machine() or memory.available_memory() > 5e8


def test_nothing_is_said_where_the_system_does_not_tell(monkeypatch):
    monkeypatch.setattr(memory, "CGROUPS", (("/nowhere/limit", "/nowhere/use", "inactive_file"),))
    monkeypatch.setattr(memory, "_of_machine", lambda: None)
    assert memory.available_memory() is None
