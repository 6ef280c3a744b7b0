"""A short run of the campaign in benchmarks/: spoilt cases and tables give sentences of their class, nothing else."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "fuzz_cases.py"


def test_spoilt_cases_overrides_and_tables_are_read_or_refused() -> None:
    command = [sys.executable, str(BENCHMARK), "--runs", "3000", "--commands", "2", "--seed", "7"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    document = json.loads(done.stdout)
    assert document["findings"] == []
    assert done.returncode == 0
    assert set(document["outcomes"]["case"]) == {"ConfigurationError", "read"}
    assert set(document["outcomes"]["table"]) == {"ConfigurationError", "InputDataError", "read"}
    assert sum(document["outcomes"]["command"].values()) == 2
