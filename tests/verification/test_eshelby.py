"""B5 beyond its table: why stiff inclusions saturate."""

from __future__ import annotations

import numpy as np

from palpate_validation.problems.inclusion import ball_in_matrix, strain_factors


def test_a_stiff_inclusion_hides_its_modulus():
    """A factor of ten in E moves the border of the inclusion less and less: what the interval must show."""
    model = ball_in_matrix(0.3)
    change = [
        abs(np.subtract(strain_factors(model, 10.0 * c), strain_factors(model, c))).max() for c in (1.0, 10.0, 100.0)
    ]
    assert change[0] > 4 * change[1] > 16 * change[2]
