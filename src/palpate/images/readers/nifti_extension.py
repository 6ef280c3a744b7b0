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
            try:
                return _rows(text)
            except (expat.ExpatError, ValueError) as error:
                flaw = f"are no XML ({error})" if isinstance(error, expat.ExpatError) else str(error)
                advice = "save the image again, without that extension, and name a label table"
                raise InputDataError(f"the label names in the header of '{path}' {flaw}; {advice}") from error
        place += size
    return ()


def _rows(content: bytes) -> tuple[NamedLabel, ...]:
    """The rows of the table; nothing else of the XML is kept, and no entity is expanded.

    Raises `ValueError` with what is wrong.
    """
    rows: list[NamedLabel] = []
    elements: list[tuple[str, dict[str, str]]] = []  # those that are open
    texts: list[str] = []

    def doctype(*_: object) -> None:
        raise ValueError("declare a document type, which label tables do not have")

    def start(name: str, attributes: dict[str, str]) -> None:
        elements.append((name, attributes))
        texts.clear()
        if len(elements) > MOST_DEPTH:
            raise ValueError(f"are nested deeper than {MOST_DEPTH}")

    def end(_: str) -> None:
        if tuple(name for name, _ in elements) == LABEL:
            rows.append(_row(elements[-1][1], printable("".join(texts).strip())))
        elements.pop()

    if len(content) > MOST_BYTES:
        raise ValueError(f"hold {len(content)} bytes, more than the {MOST_BYTES} that are read")
    parser = expat.ParserCreate(encoding="utf-8")
    parser.StartDoctypeDeclHandler, parser.CharacterDataHandler = doctype, texts.append
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(content, True)
    return tuple(rows)


def _row(attributes: dict[str, str], name: str) -> NamedLabel:
    key = attributes.get("Key", "")
    if not (key.isascii() and key.isdigit() and len(key) <= 9) or len(name) > MAX_NAME:
        raise ValueError(f"have the entry '{printable(key[:20])}': '{name[:50]}'")
    return NamedLabel(int(key), name, unit_colour([attributes.get(part, "") for part in ("Red", "Green", "Blue")]))
