"""Names and colours of labels in a header extension of a NIfTI file, as TotalSegmentator writes them with `--ml`.

The extension has the code 0 and holds XML in UTF-8: CaretExtension/VolumeInformation/LabelTable/Label with the
attributes Key, Red, Green and Blue (0 to 1). Layout: https://nifti.nimh.nih.gov/pub/dist/src/niftilib/nifti1.h.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Literal
from xml.parsers import expat

from palpate.errors import InputDataError
from palpate.images.named_labels import MAX_NAME, NamedLabel, printable
from palpate.images.readers.segments import unit_colour

ROOT = "CaretExtension"
LABEL = (ROOT, "VolumeInformation", "LabelTable", "Label")
MOST_BYTES = 2**20  # as of a label table
MOST_DEPTH = 50


def extension_names(content: bytes, byte_order: Literal["<", ">"], path: Path) -> tuple[NamedLabel, ...]:
    """The names in `content`, the bytes between the header of `path` and its voxels; none where it holds no such table.

    Raises `InputDataError` for a table that is damaged, too large, or declares a document type.
    """
    place = 4
    while content[:1] not in (b"", b"\0") and place + 8 <= len(content):
        size, code = struct.unpack_from(f"{byte_order}2i", content, place)
        if not 8 <= size <= len(content) - place:  # a size that cannot be: nothing behind it can be found
            break
        text = content[place + 8 : place + size].rstrip(b"\0 \r\n\t")
        if code == 0 and f"<{ROOT}".encode() in text[:1000]:
            return tuple(_Table(path).read(text))
        place += size
    return ()


class _Table:
    """Takes the labels out of the XML as it is parsed; nothing else of it is kept, and no entity is expanded."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open: list[str] = []
        self._rows: list[NamedLabel] = []
        self._attributes: dict[str, str] = {}
        self._name = ""

    def read(self, content: bytes) -> list[NamedLabel]:
        """The rows of the table."""
        if len(content) > MOST_BYTES:
            raise self._refused(f"hold {len(content)} bytes, more than the {MOST_BYTES} that are read")
        parser = expat.ParserCreate(encoding="utf-8")
        parser.buffer_text = True
        parser.StartDoctypeDeclHandler = self._doctype
        parser.StartElementHandler = self._start
        parser.CharacterDataHandler = self._text
        parser.EndElementHandler = self._end
        try:
            parser.Parse(content, True)
        except expat.ExpatError as error:
            raise self._refused(f"are no XML ({error})") from error
        return self._rows

    def _refused(self, flaw: str) -> InputDataError:
        return InputDataError(
            f"the label names in the header of '{self._path}' {flaw}; save the image again, without that extension, and"
            " name a label table"
        )

    def _doctype(self, *_: object) -> None:
        raise self._refused("declare a document type, which label tables do not have")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._open.append(name)
        if len(self._open) > MOST_DEPTH:
            raise self._refused(f"are nested deeper than {MOST_DEPTH}")
        self._attributes, self._name = attributes, ""

    def _text(self, text: str) -> None:
        if tuple(self._open) == LABEL:
            self._name += text

    def _end(self, _: str) -> None:
        if tuple(self._open) == LABEL:
            key, name = self._attributes.get("Key", ""), printable(self._name.strip())
            if not (key.isascii() and key.isdigit() and len(key) <= 9) or len(name) > MAX_NAME:
                raise self._refused(f"have the entry '{printable(key[:20])}': '{name[:50]}'")
            parts = [self._attributes.get(colour, "") for colour in ("Red", "Green", "Blue")]
            self._rows.append(NamedLabel(int(key), name, unit_colour(parts)))
        self._open.pop()
