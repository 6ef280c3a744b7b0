"""Reports to look at: figures and self-contained pages."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from palpate.report.cards import moduli_figure, result_cards, result_lines
    from palpate.report.case_report import redrawn_page, write_case_report, write_failure_report
    from palpate.report.rows import interval_text, number
    from palpate.report.sensitivity_report import sensitivity_page

__all__ = [
    "interval_text",
    "moduli_figure",
    "number",
    "redrawn_page",
    "result_cards",
    "result_lines",
    "sensitivity_page",
    "write_case_report",
    "write_failure_report",
]

_HOMES = {
    "interval_text": "palpate.report.rows",
    "number": "palpate.report.rows",
    "moduli_figure": "palpate.report.cards",
    "result_cards": "palpate.report.cards",
    "result_lines": "palpate.report.cards",
    "sensitivity_page": "palpate.report.sensitivity_report",
    "redrawn_page": "palpate.report.case_report",
    "write_case_report": "palpate.report.case_report",
    "write_failure_report": "palpate.report.case_report",
}


def __getattr__(name: str) -> Any:
    """Import a name when it is first used: what draws takes half a second to import, and most commands draw nothing."""
    if name not in _HOMES:
        raise AttributeError(f"module 'palpate.report' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)
