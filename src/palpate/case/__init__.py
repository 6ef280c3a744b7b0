"""What a case file says, as frozen values."""

from __future__ import annotations

from typing import TYPE_CHECKING

from palpate.front_door import front_door

if TYPE_CHECKING:
    from palpate.case.case import Case as Case
    from palpate.case.case import Discrepancy as Discrepancy
    from palpate.case.case import Domain as Domain
    from palpate.case.case import DriverMotion as DriverMotion
    from palpate.case.case import Mechanics as Mechanics
    from palpate.case.case import MeshSettings as MeshSettings
    from palpate.case.file import read_case as read_case
    from palpate.case.sources import Phantom as Phantom

__getattr__, __dir__ = front_door(__name__)
