"""The warnings of a document as text, for the command line and for `print` in Python."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def warning_lines(document: Mapping[str, Any]) -> str:
    """The document's warnings, a line each with its code; docs/warnings.md tells of all codes."""
    return "".join(f"warning ({warning['code']}): {warning['message']}\n" for warning in document["warnings"])
