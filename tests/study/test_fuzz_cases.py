"""A short run of the campaign in benchmarks/: spoilt cases and tables give sentences of their class, nothing else."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "fuzz_cases.py"


def test_spoilt_cases_overrides_and_tables_are_read_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARK.parent))  # benchmarks import one another
    specification = importlib.util.spec_from_file_location("fuzz_cases", BENCHMARK)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules["fuzz_cases"] = module  # dataclasses look their module up there
    try:
        specification.loader.exec_module(module)
        document = module.campaign(3000, 2, 7, tmp_path)
    finally:
        del sys.modules["fuzz_cases"]
    assert document["findings"] == []
    assert set(document["outcomes"]["case"]) == {"ConfigurationError", "read"}
    assert set(document["outcomes"]["table"]) == {"ConfigurationError", "InputDataError", "read"}
    assert sum(document["outcomes"]["command"].values()) == 2
