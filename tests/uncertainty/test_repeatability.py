"""How much a modulus varies from scan to scan of one body."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.uncertainty.intervals import within_subject_cv


@pytest.mark.parametrize("sd", [0.05, 0.3, 0.8])
def test_the_coefficient_of_variation_is_standard_deviation_over_mean(rng, sd):
    moduli = np.exp(1.0 + sd * rng.standard_normal(400_000))
    assert within_subject_cv(sd**2) == pytest.approx(moduli.std() / moduli.mean(), rel=0.02)
