"""The works that the methods text cites, in assets/sources.bib: as a line below it, and as BibTeX."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources


@dataclass(frozen=True, slots=True)
class Source:
    """A cited work: BibTeX's kind of entry, and its fields as they stand there."""

    kind: str
    fields: Mapping[str, str]

    @property
    def title(self) -> str:
        """Its title, without the braces that keep capitals."""
        return self.fields["title"].strip("{}")


FILE = (resources.files("palpate.report") / "assets" / "sources.bib").read_text(encoding="utf-8")
SOURCES = {
    key: Source(kind, dict(re.findall(r"^  (\w+) = \{(.*)\},?$", fields, re.MULTILINE)))
    for kind, key, fields in re.findall(r"^@(\w+)\{(\w+),$(.*?)^\}$", FILE, re.MULTILINE | re.DOTALL)
}


def reference_line(source: Source) -> str:
    """The source as a line of a list of references: "Family AB", or a body's name, of each author; title, and where."""
    fields, names = source.fields, list[str]()
    for author in fields["author"].split(" and "):
        family, _, given = author.strip("{}").partition(", ")
        names.append(f"{family} {''.join(part[0] for part in given.split())}".strip())
    title = f"{source.title}, {fields['edition']} ed." if "edition" in fields else f"{source.title}."
    rest = ""
    if source.kind == "article":
        pages = fields["pages"].replace("--", "-")
        rest = f" {fields['journal']} {fields['volume']} ({fields['year']}) {pages}."
    elif source.kind == "book":
        rest = f" {fields['publisher']}, {fields['year']}."
    elif "version" in fields:
        rest = f" Version {fields['version']}, {fields['url']}"
    return f"{', '.join(names)}. {title}{rest}"


def bibtex(key: str, source: Source) -> str:
    """The source as an entry of a BibTeX file under `key`."""
    lines = [f"  {name} = {{{value}}}" for name, value in source.fields.items()]
    return f"@{source.kind}{{{key},\n" + ",\n".join(lines) + "\n}"
