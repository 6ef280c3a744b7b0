"""Reports to look at: figures and self-contained pages."""

from __future__ import annotations

from typing import TYPE_CHECKING

from palpate.front_door import front_door

if TYPE_CHECKING:
    from palpate.report.cards import moduli_axes as moduli_axes
    from palpate.report.cards import moduli_figure as moduli_figure
    from palpate.report.cards import result_cards as result_cards
    from palpate.report.cards import result_lines as result_lines
    from palpate.report.case_report import redrawn_page as redrawn_page
    from palpate.report.case_report import write_case_report as write_case_report
    from palpate.report.case_report import write_failure_report as write_failure_report
    from palpate.report.rows import interval_text as interval_text
    from palpate.report.rows import number as number
    from palpate.report.tornado import sensitivity_page as sensitivity_page

__getattr__, __dir__ = front_door(__name__)
