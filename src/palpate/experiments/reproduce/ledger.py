"""Parts of an experiment that are already computed: an interrupted run goes on where it stopped."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.errors import ResourceError
from palpate.study import make_folder, own_file

__all__ = ["Ledger", "Part"]

Part = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Ledger:
    """A file of JSON lines, one a finished part; `settings` tells parts of other settings from these.

    `path` None: nothing is kept.
    """

    path: Path | None
    settings: str

    def keep(self, key: str, value: Part) -> Part:
        """Add a finished part; raises `ResourceError` on a full disk."""
        if self.path is None:
            return value
        line = json.dumps({"settings": self.settings, "key": key, "value": value}, allow_nan=False)
        make_folder(self.path.parent)
        cut = self.path.exists() and not self.path.read_bytes().endswith(b"\n")  # an earlier run was killed here
        try:
            with os.fdopen(own_file(self.path), "ab") as file:
                file.write((("\n" if cut else "") + line + "\n").encode("utf-8"))
        except OSError as error:
            raise ResourceError(
                f"cannot write {self.path}: {error.strerror}; choose another --output folder"
            ) from error
        return value

    def finished(self) -> dict[str, Part]:
        """The finished parts by their keys."""
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
