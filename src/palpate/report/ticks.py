"""Round numbers for the marks of a logarithmic axis, and the words that stand at them."""

from __future__ import annotations

import math

FEWEST, MOST = 3, 7  # marks of an axis that can be read
DECADE = ((1.0,), (1.0, 5.0), (1.0, 2.0, 5.0))
STEPS = (1.0, 2.0, 5.0)


def log_marks(low: float, high: float, *, most: int = MOST) -> list[float]:
    """Marks of a logarithmic axis from `low` to `high`, in its unit: 1, 2 and 5 of each decade where these fit.

    Of a range over more decades 1 and 5, or 1 alone, of every second or third decade where need be; of a range with
    less than three of 1, 2 and 5 evenly spaced round numbers. Both ends must be above 0.
    """
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))

    def inside(steps: tuple[float, ...], every: int = 1) -> list[float]:
        """Those steps of each decade, or of every so many, that lie on the axis."""
        numbers = [float(f"{step}e{decade}") for decade in range(first, last + 1, every) for step in steps]
        return [number for number in numbers if low <= number <= high]

    marks = inside(DECADE[2])
    if len(marks) > most:
        sparser = (inside(DECADE[0], every) for every in range(1, last - first + 2))
        return next(found for found in (inside(DECADE[1]), *sparser) if len(found) <= most)
    if len(marks) >= FEWEST:
        return marks
    return even_marks(low, high, most=most)


def even_marks(low: float, high: float, *, most: int = MOST) -> list[float]:
    """As many evenly spaced round numbers from `low` to `high` as fit, `most` at the most."""
    decade = 10.0 ** math.floor(math.log10((high - low) / most))
    found = list[float]()
    for step in (step * decade * scale for scale in (1.0, 10.0, 100.0) for step in STEPS):
        start = math.ceil(low / step * (1.0 - 1e-12))
        found = [float(f"{n * step:.10g}") for n in range(start, math.floor(high / step * (1.0 + 1e-12)) + 1)]
        if len(found) <= most:
            break
    return found


def mark_text(number: float) -> str:
    """A mark as it is written: "0.05", "20", "5000"; powers of ten only beyond a million and a thousandth's tenth."""
    return f"{number:.10g}" if 1e-4 <= abs(number) < 1e7 or not number else f"{number:.3g}"
