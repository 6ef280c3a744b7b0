"""The targets of fuzz_readers.py under Atheris, which varies inputs that reach new branches of the readers.

    pip install atheris
    python benchmarks/fuzz_readers_guided.py --runs 300000

The first byte of an input chooses the format, the rest is the file. Stops at the first finding and leaves the input
that caused it in the working folder; else prints libFuzzer's statistics and ends with exit code 0.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import warnings
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["palpate.images"]):
    from fuzz_readers import MEMORY_BYTES, image_targets, table_targets

    from palpate.errors import PalpateError

FOLDER = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
TARGETS = image_targets() + table_targets()


def one_input(content: bytes) -> None:
    """Read one file; anything but a `PalpateError` is a finding."""
    if not content:
        return
    target = TARGETS[content[0] % len(TARGETS)]
    path = FOLDER / f"damaged{target.ending}"
    path.write_bytes(target.pack(content[1:]))
    try:
        target.read(path)
    except PalpateError as error:
        if not str(error).isprintable():
            raise ValueError("control characters in an error's text") from error


def main() -> None:
    """Run libFuzzer on the valid files as first inputs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=300_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    warnings.simplefilter("error")
    corpus = FOLDER / "corpus"
    corpus.mkdir()
    (FOLDER / "voxels.raw").write_bytes(bytes(4 * 5 * 6))
    for number, target in enumerate(TARGETS):
        (corpus / f"valid{number}").write_bytes(bytes([number]) + target.content)
    flags = [
        f"-runs={arguments.runs}",
        f"-seed={arguments.seed}",
        "-max_len=4096",
        "-timeout=10",
        "-print_final_stats=1",
    ]
    atheris.Setup([sys.argv[0], *flags, f"-rss_limit_mb={MEMORY_BYTES // 2**20}", str(corpus)], one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
