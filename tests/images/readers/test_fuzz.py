"""A short run of the fuzz campaign in benchmarks/: damaged files give sentences, never a foreign error or a warning."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

BENCHMARK = Path(__file__).parents[3] / "benchmarks" / "fuzz_readers.py"


def test_damaged_files_of_every_format_are_read_or_refused(tmp_path: Path) -> None:
    specification = importlib.util.spec_from_file_location("fuzz_readers", BENCHMARK)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules["fuzz_readers"] = module  # dataclasses look their module up there
    try:
        specification.loader.exec_module(module)
        document = module.campaign(4000, 7, tmp_path)
    finally:
        del sys.modules["fuzz_readers"]
    assert document["findings"] == []
    assert set(document["outcomes"]) == {"InputDataError", "read"}
    assert len(document["files"]) == 12
