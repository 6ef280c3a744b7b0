"""Voxels from a file whose header may lie: sizes are checked before memory is taken, unpacking ends where declared."""

from __future__ import annotations

import gzip
import io
import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.input_file import InputFile, open_input

MAX_VOXELS = 2**29  # 512 x 512 x 2048, a whole body at 1 mm; a distance map of it would take 4 GiB
MAX_OFFSET = 2**26  # bytes that may stand between header and voxels
MAX_DEFLATE_RATIO = 1032  # no deflate stream expands further (zlib's technical notes)
SLACK = 2**20  # bytes that may follow the voxels
CHUNK = 2**22  # bytes that are read, and unpacked, at once


@dataclass(frozen=True, slots=True)
class VoxelBlock:
    """What a header says of its voxels: `shape` (fastest axis first), `dtype`, how they are packed.

    packing: "raw", "gzip" or "zlib" (MetaImage's, with either head); skip: bytes before the first voxel, after
    unpacking; -1: the voxels are the last bytes of the file.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    packing: str = "raw"
    skip: int = 0

    @property
    def n_bytes(self) -> int:
        """Size of the voxels, bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


@contextmanager
def opened(path: Path) -> Iterator[InputFile]:
    """The file at `path`; that it cannot be read or unpacked becomes an `InputDataError`."""
    try:
        with open_input(path) as file:
            yield file
    except (OSError, EOFError, zlib.error) as error:
        flaw = str(error).rstrip(".")
        raise InputDataError(
            f"'{path}' cannot be read: {flaw}; the file is damaged or cut short, export or copy it again"
        ) from error


def bytes_to_skip(text: str, packing: str) -> int | None:
    """A header's number for `VoxelBlock.skip`, -1 for raw voxels only; None where `text` is no number that can be."""
    if text == "-1" and packing == "raw":
        return -1
    plain = text.isascii() and text.isdigit() and len(text) <= 12 and int(text) <= MAX_OFFSET
    return int(text) if plain else None


def read_block(file: InputFile, block: VoxelBlock, path: Path) -> NDArray[Any]:
    """The voxels (n_1, n_2, n_3), or with more axes, in the machine's byte order, from where `file` stands.

    `path` is for messages, for voxels may lie in a file beside the header.
    Raises `InputDataError` when the file cannot hold them or goes on for long after them.
    """
    available, skip, packed = file.n_bytes - file.tell(), max(block.skip, 0), block.packing != "raw"
    check_size(block.shape, skip + block.n_bytes, path, available=available, packed=packed)
    stream: BinaryIO = file
    if block.skip < 0:
        skip = available - block.n_bytes
    if block.packing == "gzip":
        stream = gzip_stream(file)
    elif block.packing == "zlib":
        stream = io.BufferedReader(_Inflated(file), buffer_size=CHUNK)
    while skip:
        skip -= len(read_exactly(stream, min(skip, SLACK), path))
    return read_voxels(stream, block, path)


def read_voxels(stream: BinaryIO, block: VoxelBlock, path: Path) -> NDArray[Any]:
    """The voxels (nx, ny, nz) of `block`, whose size was checked, from where `stream` stands.

    Raises `InputDataError` when it ends before they do, or goes on for long after them.
    """
    values = read_exactly(stream, block.n_bytes, path).view(block.dtype)
    if len(stream.read(SLACK + 1)) > SLACK:  # to its end, where gzip checks its sum
        raise InputDataError(
            f"'{path}' goes on for more than {SLACK} bytes after the {block.n_bytes} bytes of voxels that its header"
            " declares; it is damaged or not what it claims to be: export it again"
        )
    return values.astype(block.dtype.newbyteorder("="), copy=False).reshape(block.shape, order="F")


def check_size(shape: tuple[int, ...], needed: int, path: Path, *, available: int, packed: bool) -> None:
    """Refuse what the file cannot hold: `needed` bytes after unpacking, `available` bytes before it."""

    def count(number: int) -> str:
        """A count that a damaged header may have made absurd."""
        return str(number) if number < 10**12 else f"over {10**12}"

    sizes = " x ".join(map(count, shape))
    if math.prod(shape) > MAX_VOXELS:
        raise InputDataError(
            f"the header of '{path}' promises {count(math.prod(shape))} voxels ({sizes}), more than the {MAX_VOXELS}"
            " that are read; crop the image to the organs, or the header is damaged"
        )
    if needed > (available * MAX_DEFLATE_RATIO if packed else available):
        raise InputDataError(
            f"the header of '{path}' promises {needed} bytes ({sizes} voxels), but the {available} bytes there"
            " cannot hold them; the file is cut short or its header damaged: export or copy it again"
        )


def gzip_stream(file: InputFile) -> BinaryIO:
    """What is packed in the file from where it stands; no more is unpacked than is asked for."""
    return io.BufferedReader(gzip.GzipFile(fileobj=file, mode="rb"))


def read_exactly(stream: BinaryIO, n_bytes: int, path: Path) -> NDArray[np.uint8]:
    """The next bytes (n_bytes,) of the stream; pages of the buffer are only taken as the data come.

    Raises `InputDataError` when it ends before.
    """
    buffer = np.empty(n_bytes, dtype=np.uint8)
    done = 0
    while done < n_bytes:
        chunk = stream.read(min(CHUNK, n_bytes - done))
        if not chunk:
            raise InputDataError(
                f"'{path}' is cut short: {n_bytes - done} of {n_bytes} bytes are missing; export or copy it again"
            )
        buffer[done : done + len(chunk)] = np.frombuffer(chunk, dtype=np.uint8)
        done += len(chunk)
    return buffer


class _Inflated(io.RawIOBase):
    """A zlib or gzip stream, unpacked no further than is asked for."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._inflate = zlib.decompressobj(47)  # 32 + 15: either head

    def readable(self) -> bool:
        """Always: `io.BufferedReader` asks before it reads."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Fill `buffer` from its start with unpacked bytes and return their number, 0 after the stream's end mark.

        Raises `EOFError` when the file ends before that mark.
        """
        target = memoryview(buffer).cast("B")
        while not self._inflate.eof:
            packed = self._inflate.unconsumed_tail or self._file.read(CHUNK)
            content = self._inflate.decompress(packed, len(target))
            if content:
                target[: len(content)] = content
                return len(content)
            if not packed:
                raise EOFError("the compressed voxels end before their end mark")
        return 0
