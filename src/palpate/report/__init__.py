"""Reports to look at: figures and self-contained pages."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from palpate.report.case_report import write_failure_report

__all__ = ["write_failure_report"]

_HOMES = {"write_failure_report": "palpate.report.case_report"}


def __getattr__(name: str) -> Any:
    """Import a name when it is first used: a part of this layer is often wanted alone, and quickly."""
    if name not in _HOMES:
        raise AttributeError(f"module 'palpate.report' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)
