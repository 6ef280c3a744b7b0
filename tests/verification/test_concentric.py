"""B4 beyond its closed form: the reduced model has the derivatives of the full one."""

from __future__ import annotations

import numpy as np

from palpate.mechanics.reduced import projection
from palpate_validation.problems.concentric import hollow_spheres


def test_the_reduced_model_has_the_same_sensitivities():
    hollow = hollow_spheres()
    moduli = np.array([50.0, 100.0, 150.0])
    system = hollow.system(moduli)
    responses = system.responses()
    snapshots = np.concatenate([responses, *system.modulus_responses(responses)], axis=1)
    small = projection(hollow, hollow.constraint.free.T @ snapshots).reduced
    exact = system.solve(np.array([5.0])).tangent()
    assert abs(small.solve(moduli, np.array([5.0])).tangent() - exact).max() < 1e-9 * abs(exact).max()
