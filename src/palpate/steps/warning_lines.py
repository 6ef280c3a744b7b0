"""The warnings of a document as text, for the command line and for `print` in Python."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from palpate.findings import HELP


def warning_lines(document: Mapping[str, Any]) -> str:
    """The document's warnings, one line each with its code, then where the codes are explained."""
    lines = [f"warning ({warning['code']}): {warning['message']}" for warning in document["warnings"]]
    return "".join(f"{line}\n" for line in [*lines, f"each code is explained on {HELP}"]) if lines else ""
