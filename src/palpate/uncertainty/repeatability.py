"""How much a modulus varies from scan to scan of one body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["within_subject_cv"]


def within_subject_cv(variance: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Within-subject coefficient of variation of E, of variances (n,) of ln E within subjects, or of one.

    sqrt(exp(s^2) - 1): standard deviation over mean where ln E is normal within a subject (Quan & Shih, Biometrics 52
    (1996) 1195-1203). exp(s) - 1 of Bland & Altman (BMJ 313 (1996) 106) is what one standard deviation adds to E: the
    same for small s, a fifth more at s = 0.5.
    """
    return np.asarray(np.sqrt(np.expm1(variance)))
