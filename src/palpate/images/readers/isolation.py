"""Images are read in a process of their own with limits: a crash, a bomb or a hang there is a sentence here.

The process answers on a pipe with a line of JSON and the bare numbers; nothing that it sends can be executed.
"""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from palpate.errors import ConfigurationError, InputDataError, PalpateError, ResourceError
from palpate.findings import Finding, known_code
from palpate.images.label_image import VoxelGrid
from palpate.images.named_labels import NamedLabel, printable
from palpate.images.readers.registry import ImageFormat, StoredImage
from palpate.images.readers.voxel_stream import MAX_VOXELS
from palpate.processes import environment_of_child, name_of_end

MAX_ANSWER = 2**24  # bytes of the line before the voxels
DTYPE, DIGEST = re.compile(r"[<>|][iuf][1248]"), re.compile(r"[0-9a-f]{64}")
NEVER_BEGAN = 1  # exit code of a Python that cannot import its module; our code reports every other failure
ERRORS = {error.__name__: error for error in (ConfigurationError, InputDataError, ResourceError)}


@dataclass(frozen=True, slots=True)
class ReadLimits:
    """What reading one file may take: address space (bytes), processor time and time by the clock (s)."""

    memory_bytes: int = 10 * 2**30
    cpu_seconds: int = 120
    wall_seconds: float = 900.0


def read_stored(
    path: Path, kind: str, image_format: ImageFormat, limits: ReadLimits, grid: VoxelGrid | None = None
) -> StoredImage:
    """Read `path` in a process of its own, which reduces its values to `kind`, "labels" or "intensities".

    `grid` is as of `ImageFormat.stored`. A format that the program itself registered is read here, as it is.
    Raises what the reader raises, `InputDataError` when it crashed, `ResourceError` when it ran over a limit.
    """
    if not image_format.read.__module__.startswith("palpate."):
        return image_format.stored(path, grid)  # code of another program, which a new process would not find
    limits = replace(limits, cpu_seconds=image_format.patience * limits.cpu_seconds)
    place = grid and [grid.shape, grid.affine.tolist()]
    request = json.dumps([astuple(limits), kind, image_format.name, str(path), place])
    # -P: an image's folder, if it is the working folder, must not be searched for modules.
    command = [sys.executable, "-P", "-W", "ignore", "-m", "palpate.images.readers.child", request]
    try:
        process = subprocess.Popen(  # noqa: S603 - our own interpreter and module, no shell
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment_of_child(),  # on one thread, because a pool of threads would take address space
        )
    except OSError as error:
        raise _sudden_end(NEVER_BEGAN, path, limits) from error
    with process:
        try:
            stored = _stored(cast("BinaryIO", process.stdout), path)
            if stored is None:
                raise _sudden_end(process.wait(), path, limits)
            return stored
        finally:
            process.kill()


def _sudden_end(code: int, path: Path, limits: ReadLimits) -> PalpateError:
    """Why a process ended without an image, by its exit code."""
    name = name_of_end(code)
    if code == NEVER_BEGAN:
        advice = f"is Palpate installed in {sys.prefix} and is memory left?"
        return ResourceError(f"the process that reads '{path}' did not start; {advice}")
    if name in ("SIGXCPU", "SIGALRM"):
        took = f"more than {limits.cpu_seconds} s of processor time, or {limits.wall_seconds:g} s in all"
        return ResourceError(f"reading '{path}' took {took}; copy it to a local disk, or export it again")
    if name == "SIGKILL":
        return ResourceError(f"the system stopped the reading of '{path}', as memory is short; crop the image")
    return InputDataError(f"the reader of '{path}' crashed ({name}); it is most likely damaged: export it again")


def _stored(pipe: BinaryIO, path: Path) -> StoredImage | None:
    """The image, None when the process died while it sent it; raises what the reader raised."""
    line = pipe.readline(MAX_ANSWER)
    try:  # a process that died before or while it wrote the line leaves none, or half of one
        answer: Any = json.loads(line) if line.endswith(b"\n") else None
    except ValueError:
        answer = None
    if not isinstance(answer, dict):
        return None
    if "error" in answer:
        raise ERRORS.get(str(answer["error"]), InputDataError)(printable(str(answer.get("message", ""))))
    try:
        shape = tuple(int(n) for n in answer["shape"])
        affine = np.array(answer["affine"], dtype=np.float64)
        names = tuple(NamedLabel(int(k), str(name), None if c is None else str(c)) for k, name, c in answer["names"])
        digests = {printable(str(part)): str(digest) for part, digest in answer.get("digests", {}).items()}
        findings = tuple(Finding(known_code(code), printable(str(text))) for code, text in answer.get("findings", ()))
        placed = len(shape) == 3 and min(shape) > 0 and math.prod(shape) <= MAX_VOXELS and affine.shape == (4, 4)
        valid = placed and DTYPE.fullmatch(answer["dtype"]) and all(map(DIGEST.fullmatch, digests.values()))
    except (AttributeError, KeyError, TypeError, ValueError):
        valid = None
    if not valid:
        raise InputDataError(f"the process that read '{path}' gave an answer of no use; export the image again")
    dtype = np.dtype(answer["dtype"])
    content = pipe.read(math.prod(shape) * dtype.itemsize)
    if len(content) < math.prod(shape) * dtype.itemsize:
        return None
    values = np.frombuffer(content, dtype).reshape(shape, order="F")
    return StoredImage(values, affine, names, digests, findings)
