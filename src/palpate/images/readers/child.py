"""The process that reads one image under limits and sends it through a pipe; started by `isolation`."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO, cast

import numpy as np

from palpate.errors import PalpateError
from palpate.images.label_image import VoxelGrid
from palpate.images.readers.registry import StoredImage, own_format
from palpate.images.readers.values import reduced

try:
    import resource
except ImportError:  # Windows has no limits, but a crash still ends this process alone
    LIMITED = False
else:
    LIMITED = True


def main(request: str) -> None:
    """Read an image. `request`: JSON of the limits, "labels" or "intensities", the format's name, path, and grid."""
    limits, kind, name, path, grid = json.loads(request)
    with os.fdopen(os.dup(1), "wb") as pipe:  # to the parent
        nowhere = os.open(os.devnull, os.O_WRONLY)  # receives what a C library prints on standard output
        os.dup2(nowhere, 1)
        os.close(nowhere)
        _limit(*limits)
        try:
            stored = _read(name, Path(path), kind, grid)
            values = np.asfortranarray(stored.values)
        except PalpateError as error:
            _send(pipe, {"error": type(error).__name__, "message": str(error)})
        except MemoryError:
            advice = f"'{path}' does not fit into the memory that reading may take; crop the image to the organs"
            _send(pipe, {"error": "ResourceError", "message": advice})
        except Exception as error:
            flaw = f"the reader of '{path}' failed ({type(error).__name__}: {error})"
            _send(pipe, {"error": "InputDataError", "message": f"{flaw}; export the image again, and report this"})
        else:
            names = [[row.label, row.name, row.colour] for row in stored.names]
            place = {"shape": values.shape, "dtype": values.dtype.str, "affine": stored.affine.tolist()}
            findings = [[finding.code, finding.message] for finding in stored.findings]
            _send(pipe, {**place, "names": names, "digests": dict(stored.digests), "findings": findings})
            pipe.write(values.T.data.cast("B"))


def _limit(memory_bytes: int, cpu_seconds: int, wall_seconds: float) -> None:
    """Limit memory and time, and forbid written files and core dumps; an earlier, lower limit stays."""
    if not LIMITED:
        return
    signal.signal(signal.SIGALRM, signal.SIG_DFL)  # which ends the process
    signal.setitimer(signal.ITIMER_REAL, wall_seconds)
    for name, value in (("AS", memory_bytes), ("CPU", cpu_seconds), ("FSIZE", 0), ("CORE", 0)):
        kind = getattr(resource, f"RLIMIT_{name}")
        soft, hard = resource.getrlimit(kind)
        lowest = min(limit for limit in (value, soft, hard) if limit != resource.RLIM_INFINITY)
        resource.setrlimit(kind, (lowest, hard))


def _read(name: str, path: Path, kind: str, place: Any) -> StoredImage:
    image_format, grid = own_format(name), None
    if place:
        (nx, ny, nz), affine = place
        grid = VoxelGrid((nx, ny, nz), affine)
    for module in image_format.needless:
        sys.modules[module] = cast("ModuleType", None)  # importing it fails as if it were not installed
    return reduced(image_format.stored(path, grid), path, kind=kind)


def _send(pipe: BinaryIO, answer: dict[str, Any]) -> None:
    pipe.write(json.dumps(answer).encode("ascii") + b"\n")


if __name__ == "__main__":
    main(sys.argv[1])
