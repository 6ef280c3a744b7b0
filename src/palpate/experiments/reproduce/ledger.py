"""Parts of an experiment that are already computed: an interrupted run goes on where it stopped."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from palpate.errors import ResourceError
from palpate.experiments.reproduce.table import Entry
from palpate.study.outputs import make_folder

__all__ = ["Ledger"]

Part = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Ledger:
    """A file of JSON lines, one a finished part; `settings` tells parts of other settings from these.

    `path` None: nothing is kept.
    """

    path: Path | None
    settings: str

    def part(self, key: str, make: Callable[[], Part]) -> Part:
        """The part of that `key`: from the file, or made and added to it; raises `ResourceError` on a full disk."""
        found = self._finished().get(key)
        if found is not None:
            return found
        value = make()
        if self.path is not None:
            line = json.dumps({"settings": self.settings, "key": key, "value": value}, allow_nan=False)
            make_folder(self.path.parent)
            cut = self.path.exists() and not self.path.read_bytes().endswith(b"\n")  # an earlier run was killed here
            try:
                with self.path.open("a", encoding="utf-8") as file:
                    file.write(("\n" if cut else "") + line + "\n")
            except OSError as error:
                raise ResourceError(
                    f"cannot write {self.path}: {error.strerror}; choose another --output folder"
                ) from error
        return value

    def entries(self, key: str, make: Callable[[], Mapping[str, Entry]]) -> dict[str, Entry]:
        """The same of a column's entries, by body."""
        stored = self.part(key, lambda: {body: asdict(entry) for body, entry in make().items()})
        return {body: Entry.from_dict(part) for body, part in stored.items()}

    def _finished(self) -> dict[str, Part]:
        if self.path is None or not self.path.exists():
            return {}
        parts: dict[str, Part] = {}
        for line in self.path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                entry = json.loads(line)
            except ValueError:  # the line at which an earlier run was killed
                continue
            if isinstance(entry, dict) and entry.get("settings") == self.settings:
                parts[str(entry.get("key"))] = entry["value"]
        return parts
