"""What NRRD and MetaImage share: a header of text lines, numbers in them, voxels in a file beside it."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.input_file import InputFile, open_input
from palpate.images.named_labels import hex_colour, printable

# Not what float() takes besides: nan, inf, 1_0, digits of other scripts.
NUMBER = re.compile(r"[+-]?([0-9]{1,400}\.?[0-9]{0,400}|\.[0-9]{1,400})([eE][+-]?[0-9]{1,9})?")
MAX_LINE = 2**16
MAX_NUMBER = 1e30  # far beyond any length in mm; products of three stay finite
MAX_HEADER = 2**22  # bytes; a segmentation of a thousand segments has some 400 kB


def header_line(file: BinaryIO, path: Path) -> str | None:
    """The next line of a header without its end, None at the end of the file.

    Raises `InputDataError` for a line or header longer than any real one.
    """
    line = file.readline(MAX_LINE + 1)
    if len(line) > MAX_LINE or file.tell() > MAX_HEADER:
        raise InputDataError(
            f"the header of '{path}' does not end or has a line of over {MAX_LINE} bytes; export it again"
        )
    return line.decode("utf-8", errors="replace").rstrip("\r\n") if line else None


@dataclass(frozen=True, slots=True)
class TextHeader:
    """Fields of the header at `path` by their names in lower case; they may be damaged."""

    fields: Mapping[str, str]
    path: Path

    def need(self, field: str, advice: str = "export the image again") -> str:
        """A field that must be there."""
        if field not in self.fields:
            raise InputDataError(f"the header of '{self.path}' has no '{field}'; {advice}")
        return self.fields[field]

    def refused(self, field: str, advice: str, *, text: str | None = None) -> InputDataError:
        """The sentence for a field, or for a text in it, that cannot be used."""
        shown = printable((self.fields.get(field, "") if text is None else text)[:60])
        return InputDataError(f"the header of '{self.path}' has '{field}: {shown}'; {advice}")

    def numbers(self, field: str, n: int, text: str | None = None) -> NDArray[np.float64]:
        """The `n` numbers (n,) of a field, or of a text in it, separated by blanks, in the field's unit.

        Raises `InputDataError` when it holds anything else.
        """
        text = self.need(field) if text is None else text
        words = text.split()
        plain = len(words) == n and all(NUMBER.fullmatch(word) for word in words)
        values = np.array([float(word) for word in words]) if plain else np.zeros(0)
        if len(values) != n or not (np.abs(values) < MAX_NUMBER).all():
            advice = f"{n} numbers under {MAX_NUMBER:g} are needed: export the image again"
            raise self.refused(field, advice, text=text)
        return values

    def counts(self, field: str) -> tuple[int, ...]:
        """The whole numbers >= 1 of a field; raises `InputDataError` when it holds anything else."""
        words = self.need(field).split()
        plain = all(word.isascii() and word.isdigit() and len(word) <= 20 for word in words)
        sizes = tuple(int(word) for word in words) if plain else ()
        if not sizes or min(sizes) < 1:
            raise self.refused(field, "it must be positive counts: export the image again")
        return sizes


def unit_colour(words: Sequence[str]) -> str | None:
    """Colour #rrggbb of three numbers from 0 to 1; None where they are anything else."""
    if len(words) != 3 or not all(NUMBER.fullmatch(word) for word in words):
        return None
    red, green, blue = (float(word) for word in words)
    return hex_colour(red, green, blue, top=1.0)


def voxels_of(
    file: InputFile, path: Path, name: str | None, read: Callable[[InputFile], NDArray[Any]]
) -> tuple[NDArray[Any], dict[str, str]]:
    """Voxels (nx, ny, nz) that `read` finds in the rest of the file at `path`, or in `name` beside it; the digests."""
    if name is None:
        return read(file), {"": file.sha256()}
    with open_input(beside(path, name)) as other:
        return read(other), {"": file.sha256(), "voxels": other.sha256()}


def beside(path: Path, name: str) -> Path:
    """The file `name` that holds the voxels of the header `path`; it must lie in the header's folder, links followed.

    Raises `InputDataError` when it lies elsewhere, is missing, or is a list or pattern of several files.
    """
    shown = printable(name[:100])
    if not name or name.upper().startswith("LIST") or "%" in name:
        raise InputDataError(
            f"'{path}' keeps its voxels in several files ('{shown}'); save the image as one file (.nrrd, .mha, .nii.gz)"
        )
    try:
        folder = path.parent.resolve()
        target = (folder / name).resolve()
        inside = target.is_relative_to(folder) and not Path(name).is_absolute()
        found = inside and target.is_file()
    except (OSError, ValueError, RuntimeError):  # a loop of links, a zero byte, a name too long
        inside, found = True, False
    if not inside:
        raise InputDataError(
            f"'{path}' says that its voxels are in '{shown}', outside its own folder, which is not followed; put both"
            " files into one folder, or save the image as one file"
        )
    if not found:
        raise InputDataError(
            f"'{path}' says that its voxels are in '{shown}', but there is no such file beside it; copy it there"
        )
    return target
