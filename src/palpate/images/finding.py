"""What the user should know of an image, found while it was read or checked."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Finding"]


@dataclass(frozen=True, slots=True)
class Finding:
    """Something the user should know: `code` for programs (lower case, hyphens), `message` a sentence with advice."""

    code: str
    message: str
