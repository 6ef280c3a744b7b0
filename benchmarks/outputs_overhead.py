"""The extra time to replace all outputs together, compared with writing each file alone, in turns.

    python benchmarks/outputs_overhead.py [--runs 20] [--folder DIR]

The files are those of an output folder (by default random bytes of the sizes of the demo's). Prints JSON: the median
seconds of both ways, and their difference.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from pathlib import Path

from palpate.study import staged

SIZES = {
    "labels.csv": 1_000,
    "labels.nii.gz": 1_000_000,
    "mesh.vtu": 2_500_000,
    "report-data.npz": 4_000_000,
    "report.html": 6_500_000,
    "result.json": 30_000,
    "stiffness.nii.gz": 1_000_000,
}


def main() -> None:
    """Print the seconds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    content = {name: os.urandom(size) for name, size in SIZES.items()}
    seconds: dict[str, list[float]] = {"together": [], "alone": []}
    with tempfile.TemporaryDirectory(dir=arguments.folder) as temporary:
        for _ in range(arguments.runs):
            for way, write in (("together", write_together), ("alone", write_alone)):
                folder = Path(temporary) / way
                folder.mkdir(exist_ok=True)
                began = time.perf_counter()
                write(folder, content)
                seconds[way].append(time.perf_counter() - began)
    medians = {way: statistics.median(times) for way, times in seconds.items()}
    print(
        json.dumps({"bytes": sum(SIZES.values()), **medians, "more": medians["together"] - medians["alone"]}, indent=1)
    )


def write_together(folder: Path, content: dict[str, bytes]) -> None:
    """As a command does: digested, brought to the disk, renamed together."""
    with staged(folder) as staging:
        for name, data in content.items():
            (staging.area / name).write_bytes(data)
        staging.digests()
        staging.commit()


def write_alone(folder: Path, content: dict[str, bytes]) -> None:
    """Each file in its place."""
    for name, data in content.items():
        (folder / name).write_bytes(data)


if __name__ == "__main__":
    main()
