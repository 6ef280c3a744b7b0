"""The driver's motion where the moduli are known."""

from __future__ import annotations

import numpy as np

from palpate.body.driver_fit import fit_driver


def test_the_driver_alone_is_fitted_at_given_moduli(twin, exact):
    ((displacement,),) = fit_driver(exact, twin.moduli)
    error = np.linalg.norm(displacement - twin.scene.displacement, axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(np.sum(twin.scene.displacement**2, axis=1)))
