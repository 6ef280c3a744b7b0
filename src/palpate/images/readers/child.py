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
from palpate.images.readers.registry import own_format
from palpate.images.readers.values import reduced

try:
    import resource
except ImportError:  # Windows: the process still keeps a crash to itself
    LIMITED = False
else:
    LIMITED = True


def main(arguments: list[str]) -> None:
    """Read an image.

    Arguments: bytes of address space, seconds of processor time and by the clock, "labels" or "intensities", the
    format's name, path, and a grid (JSON).
    """
    memory_bytes, cpu_seconds, wall_seconds = int(arguments[0]), int(arguments[1]), float(arguments[2])
    kind, name, path = arguments[3], arguments[4], Path(arguments[5])
    with os.fdopen(os.dup(1), "wb") as pipe:  # to the parent
        nowhere = os.open(os.devnull, os.O_WRONLY)  # where goes what a C library prints on standard output
        os.dup2(nowhere, 1)
        os.close(nowhere)
        _limit(memory_bytes, cpu_seconds, wall_seconds)
        try:
            grid = None
            if len(arguments) > 6:
                (nx, ny, nz), affine = json.loads(arguments[6])
                grid = VoxelGrid((int(nx), int(ny), int(nz)), np.array(affine, dtype=np.float64))
            image_format = own_format(name)
            for module in image_format.needless:
                sys.modules[module] = cast("ModuleType", None)  # whoever imports it is told that it is not installed
            stored = reduced(image_format.stored(path, grid), path, kind=kind)
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
    """No more memory or time than this, no file written, no core dumped; an earlier, lower limit stays."""
    if not LIMITED:
        return
    signal.signal(signal.SIGALRM, signal.SIG_DFL)  # which ends the process
    signal.setitimer(signal.ITIMER_REAL, wall_seconds)
    for kind, value in (
        (resource.RLIMIT_AS, memory_bytes),
        (resource.RLIMIT_CPU, cpu_seconds),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
    ):
        soft, hard = resource.getrlimit(kind)
        lowest = min(limit for limit in (value, soft, hard) if limit != resource.RLIM_INFINITY)
        resource.setrlimit(kind, (lowest, hard))


def _send(pipe: BinaryIO, answer: dict[str, Any]) -> None:
    pipe.write(json.dumps(answer).encode("ascii") + b"\n")


if __name__ == "__main__":
    main(sys.argv[1:])
