"""Voxels from a file whose header may lie: sizes are checked before memory is taken, unpacking ends where declared."""

from __future__ import annotations

import bz2
import gzip
import io
import math
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.input_file import InputFile, open_input

MAX_VOXELS = 2**29  # 512 x 512 x 2048, a whole body at 1 mm; a distance map of it would take 4 GiB
MAX_OFFSET = 2**26  # bytes that may stand between header and voxels
SLACK = 2**20  # bytes that may follow the voxels
CHUNK = 2**22  # bytes that are read, and unpacked, at once


@dataclass(frozen=True, slots=True)
class VoxelBlock:
    """What a header says of its voxels: `shape` (fastest axis first), `dtype`, how they are packed.

    packing: "raw", "gzip", "zlib" (with either head), "bzip2" or "ascii"; skip: bytes before the first voxel,
    after unpacking; -1: the voxels are the last bytes of the file; lines: those before that, not packed.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    packing: str = "raw"
    skip: int = 0
    lines: int = 0

    @property
    def n_bytes(self) -> int:
        """Size of the voxels, bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


class _Inflated(io.BufferedIOBase):
    """A zlib or gzip stream, unpacked no further than is asked for."""

    def __init__(self, file: InputFile) -> None:
        self._file = file
        self._inflate = zlib.decompressobj(47)  # 32 + 15: either head

    def read(self, n: int | None = CHUNK, /) -> bytes:
        """The next bytes, `n` at the most; none after the end mark. Raises `EOFError` where that is missing."""
        content = b""
        while not content and not self._inflate.eof:
            packed = self._inflate.unconsumed_tail or self._file.read(CHUNK)
            content = self._inflate.decompress(packed, n or CHUNK)
            if not content and not packed:
                raise EOFError("the compressed voxels end before their end mark")
        return content


# How each packing is opened, and how many bytes a byte of it can hold: for deflate by zlib's technical notes, for bzip2
# 52 runs of 900 kB, packed into some 40 bytes.
STREAMS: dict[str, tuple[Callable[[InputFile], io.BufferedIOBase], float]] = {
    "raw": (lambda file: file, 1.0),
    "gzip": (lambda file: gzip.GzipFile(fileobj=file), 1032.0),
    "zlib": (_Inflated, 1032.0),
    "bzip2": (bz2.BZ2File, 2.0**21),
}


@contextmanager
def opened(path: Path) -> Iterator[InputFile]:
    """The file at `path`; that it cannot be read or unpacked becomes an `InputDataError`."""
    try:
        with open_input(path) as file:
            yield file
    except (OSError, EOFError, zlib.error) as error:
        flaw = str(error).rstrip(".")
        advice = "the file is damaged or cut short, export or copy it again"
        raise InputDataError(f"'{path}' cannot be read: {flaw}; {advice}") from error


def read_block(file: InputFile, block: VoxelBlock, path: Path) -> NDArray[Any]:
    """The voxels (n_1, n_2, n_3), or with more axes, in the machine's byte order, from where `file` stands.

    `path` is for messages, for voxels may lie in a file beside the header.
    Raises `InputDataError` when the file cannot hold them or goes on for long after them.
    """
    for _ in range(block.lines):
        file.readline(MAX_OFFSET)
    available, skip = file.n_bytes - file.tell(), block.skip
    if not (0 <= skip <= MAX_OFFSET or (skip == -1 and block.packing == "raw")):
        flaw = f"{str(skip)[:20]} bytes before the first voxel, not 0 to {MAX_OFFSET}, or -1 where they are raw"
        raise InputDataError(f"the header of '{path}' has {flaw}; export the image again")
    if block.packing == "ascii":
        return _written(file, block, path)
    unpacked, ratio = STREAMS[block.packing]
    check_size(block.shape, path, needed=max(skip, 0) + block.n_bytes, available=available * ratio)
    stream = unpacked(file)
    read_exactly(stream, available - block.n_bytes if skip < 0 else skip, path)
    return read_voxels(stream, block, path)


def read_voxels(stream: io.BufferedIOBase, block: VoxelBlock, path: Path) -> NDArray[Any]:
    """The voxels (nx, ny, nz) of `block`, whose size was checked, from where `stream` stands.

    Raises `InputDataError` when it ends before they do, or goes on for long after them.
    """
    values, left = read_exactly(stream, block.n_bytes, path).view(block.dtype), SLACK
    while left >= 0 and (rest := stream.read(left + 1)):  # to its end, where the sum is checked
        left -= len(rest)
    if left < 0:
        flaw = f"has more than {SLACK} bytes after the {block.n_bytes} bytes of voxels that its header states"
        raise InputDataError(f"'{path}' {flaw}; it is damaged, or not what it claims to be: export it again")
    return values.astype(block.dtype.newbyteorder("="), copy=False).reshape(block.shape, order="F")


def _written(file: InputFile, block: VoxelBlock, path: Path) -> NDArray[Any]:
    """Voxels that are written out as decimal numbers; each is exact in its type."""
    n = math.prod(block.shape)
    check_size(block.shape, path, needed=2 * n - 1, available=file.n_bytes - file.tell() - block.skip)
    try:
        values = np.array(file.read()[block.skip :].split()).astype(np.float64)
    except ValueError:
        values = np.zeros(0)
    with np.errstate(all="ignore"):
        exact = values.astype(block.dtype.newbyteorder("="))
    if len(values) != n or not (block.dtype.kind == "f" or (exact == values).all()):
        flaw = f"are written as text, but are not {n} numbers of the type {block.dtype.name}"
        raise InputDataError(f"the voxels of '{path}' {flaw}; export the image again")
    return exact.reshape(block.shape, order="F")


def check_size(shape: tuple[int, ...], path: Path, *, needed: int = 0, available: float = 0.0) -> None:
    """Refuse more voxels than are read, and what the file cannot hold: `needed` bytes in `available` unpacked ones."""
    sizes = " x ".join(map(str, shape))[:100]
    if math.prod(shape) > MAX_VOXELS:
        flaw = f"states {sizes} voxels, more than the {MAX_VOXELS} that are read"
        raise InputDataError(f"the header of '{path}' {flaw}; crop the image to the organs, or repair the header")
    if needed > available:
        flaw = f"states {needed} bytes ({sizes} voxels), which the file cannot hold"
        raise InputDataError(f"the header of '{path}' {flaw}; it is cut short or damaged: export or copy it again")


def read_exactly(stream: io.BufferedIOBase, n_bytes: int, path: Path) -> NDArray[np.uint8]:
    """The next bytes (n_bytes,) of the stream; pages of the buffer are only taken as the data come.

    Raises `InputDataError` when it ends before.
    """
    buffer, done = np.empty(n_bytes, dtype=np.uint8), 0
    while done < n_bytes and (count := stream.readinto(buffer[done : done + CHUNK].data)):
        done += count
    if done < n_bytes:
        flaw = f"{n_bytes - done} of {n_bytes} bytes are missing"
        raise InputDataError(f"'{path}' is cut short: {flaw}; export or copy it again")
    return buffer
