"""B11 the other way round: the pressure is given, and the wall moves."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.loads import pressure
from palpate.mesh.space import lagrange_space
from palpate_validation.conditions import sliding_sides
from palpate_validation.problems.inflation import BALLOON, NEO, NU, bore_of, youngs
from palpate_validation.structured_meshes import known, octant_mesh


def test_a_following_pressure_inflates_the_balloon_by_the_same_law():
    mesh = octant_mesh(np.array([10.0, 20.0]), [2], 6, [known("shell", nu=NU)])
    space = lagrange_space(mesh, "P2")
    bore = bore_of(mesh, 10.0)
    load = pressure(space, bore, BALLOON["neo-hookean"][1.1])
    model = finite_strain_model(space, sliding_sides(space), NEO, loads=(load,))
    u = model.solve(youngs(model, [10.0]), np.zeros(0)).displacement
    points = np.unique(space.facets(bore))
    radius = np.linalg.norm(space.points[points], axis=1)
    stretch = np.linalg.norm((space.points + u)[points], axis=1) / radius
    assert stretch.mean() == pytest.approx(1.1, rel=3e-3)
