"""What is stated of an estimate: values, intervals, verdicts, warnings, documents."""

from __future__ import annotations

from typing import TYPE_CHECKING

from palpate.front_door import front_door

if TYPE_CHECKING:
    from palpate.statement.conclusion import Observed as Observed
    from palpate.statement.conclusion import conclude as conclude
    from palpate.statement.stated_posterior import as_stated as as_stated
    from palpate.statement.verdicts import estimates_of as estimates_of
    from palpate.statement.verdicts import intervals_of as intervals_of
    from palpate.statement.verdicts import verdict as verdict

__getattr__, __dir__ = front_door(__name__)
