"""A problem with a known answer, and the checks of a computation against it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from palpate.errors import PalpateError

__all__ = ["Check", "Problem", "checked", "rows_of"]


@dataclass(frozen=True, slots=True)
class Check:
    """One quantity of a problem: its `reference`, the computed value `ours`, the largest error allowed in per cent.

    `order`: observed order of convergence, where the mesh was refined; `scale`: what 100 % is (default: the reference).
    """

    quantity: str
    reference: float
    ours: float
    tolerance_percent: float
    order: float | None = None
    scale: float | None = None

    @property
    def error_percent(self) -> float:
        """100 |ours - reference| / scale."""
        return 100.0 * abs(self.ours - self.reference) / (self.scale or abs(self.reference))

    @property
    def passed(self) -> bool:
        """Whether the error is a number within the tolerance."""
        return math.isfinite(self.error_percent) and self.error_percent <= self.tolerance_percent


@dataclass(frozen=True, slots=True)
class Problem:
    """A problem: its id in the list of problems, its title, where the reference comes from, and how it is computed.

    `quick`: one of those that continuous integration runs.
    """

    id: str
    title: str
    source: str
    measure: Callable[[], tuple[Check, ...]]
    quick: bool = True


def checked(references: Mapping[str, float], values: Iterable[float], tolerance_percent: float) -> tuple[Check, ...]:
    """A check of each of some quantities, references by their names, with our values in the same order."""
    pairs = zip(references.items(), map(float, values), strict=True)
    return tuple(Check(name, reference, value, tolerance_percent) for (name, reference), value in pairs)


def rows_of(problem: Problem) -> list[dict[str, Any]]:
    """The problem's checks as objects of `palpate verify --json`; a value that is no number becomes null.

    One that cannot be computed gives a row that has failed, with the reason.
    """
    try:
        checks = problem.measure()
    except PalpateError as error:
        checks = (Check(f"not computed: {error}", 0.0, math.nan, 0.0, scale=1.0),)
    return [
        {
            "id": problem.id,
            "title": problem.title,
            "quantity": check.quantity,
            "reference": check.reference,
            "source": problem.source,
            "value": check.ours if math.isfinite(check.ours) else None,
            "error_percent": check.error_percent if math.isfinite(check.ours) else None,
            "tolerance_percent": check.tolerance_percent,
            "order": check.order,
            "pass": check.passed,
        }
        for check in checks
    ]
