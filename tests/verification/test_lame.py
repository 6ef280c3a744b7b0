"""B3 at every node, and with the mean dilatation."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.dilatation import Dilatation
from palpate_validation.problems.lame import thick_cylinder


@pytest.mark.parametrize(
    ("nu", "dilatation"), [(0.3, Dilatation.POINTWISE), (0.49, Dilatation.POINTWISE), (0.4999, Dilatation.MEAN)]
)
def test_thick_cylinder_in_plane_strain(nu, dilatation):
    """u = p a^2 (1 + nu) / (E (b^2 - a^2)) ((1 - 2 nu) r + b^2 / r)."""
    modulus, pressure = 210e6, 100e3
    radius, found = thick_cylinder(nu, modulus, pressure, dilatation)
    scale = pressure * 100.0 * (1 + nu) / (modulus * 300.0)
    assert np.allclose(found, scale * ((1 - 2 * nu) * radius + 400.0 / radius), rtol=5e-3)
