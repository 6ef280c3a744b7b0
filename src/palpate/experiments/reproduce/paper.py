"""The paper's own numbers: Yang & Lin, Simultaneous Estimation of Elasticity for Multiple Deformable Bodies.

Tables 1 and 2, section 4.3 (correlations) and section 4.4 (iterations).
"""

from __future__ import annotations

__all__ = ["PAPER_ITERATIONS", "PAPER_STAGING", "PAPER_TABLE1", "PAPER_TABLE2"]

PAPER_ITERATIONS = "less than 10"

# true modulus, kPa: recovered moduli, kPa
PAPER_TABLE1: dict[float, dict[str, float]] = {
    50.0: {"sphere1": 49.23, "sphere2": 49.54, "sphere3": 49.55},
    70.0: {"sphere1": 66.14, "sphere2": 67.41, "sphere3": 67.15},
    90.0: {"sphere1": 89.18, "sphere2": 89.52, "sphere3": 89.68},
    110.0: {"sphere1": 107.93, "sphere2": 108.76, "sphere3": 109.17},
    130.0: {"sphere1": 112.89, "sphere2": 118.95, "sphere3": 124.89},
    150.0: {"sphere1": 132.87, "sphere2": 138.78, "sphere3": 145.32},
}

PAPER_TABLE2: dict[float, dict[str, float]] = {
    50.0: {"prostate": 53.28, "bladder": 49.67},
    100.0: {"prostate": 107.50, "bladder": 97.78},
    150.0: {"prostate": 157.53, "bladder": 146.49},
    200.0: {"prostate": 209.08, "bladder": 198.07},
    250.0: {"prostate": 263.30, "bladder": 248.60},
    300.0: {"prostate": 315.14, "bladder": 296.86},
}

# Pearson's r with the T stage, and its two-tailed p
PAPER_STAGING: dict[str, tuple[float, float]] = {"prostate": (0.658, 3.16e-5), "bladder": (0.481, 4.60e-3)}
