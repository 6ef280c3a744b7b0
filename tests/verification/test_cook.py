"""B7: Cook's membrane, a tapered panel that is clamped on one side and sheared on the other.

Plane strain, E = 70, nu = 1/3, traction 6.25 (MPa; here kPa): deflection of the corner 32.27 (CalculiX), 32.20
(Code_Aster), 32.28 mm (Elmer), all from the CoFEA benchmark's table. At nu = 0.4999 the reference is our own,
extrapolated from three meshes.
"""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.dilatation import Dilatation, choose_element
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.laws.registry import LAWS
from palpate.mechanics.loads import traction
from palpate.mesh.space import lagrange_space

INCOMPRESSIBLE = 27.73  # deflection at nu = 0.4999: see docs/elements.md


def panel(meshes, n, nu):
    """n x n x 1 cells, corners (0, 0), (48, 44), (48, 60), (0, 44) mm, as thick as a cell is wide."""
    places, tets = meshes.kuhn_tets((n, n, 1))
    x, y = places[:, 0] / n, places[:, 1] / n
    low, high = 44.0 * x, 44.0 + 16.0 * x
    nodes = np.column_stack([48.0 * x, low + (high - low) * y, places[:, 2] * 48.0 / n])
    return meshes.make_mesh(nodes, tets, np.zeros(len(tets), int), [meshes.known("panel", nu=nu)])


def deflection(meshes, n, nu, element, dilatation):
    mesh = panel(meshes, n, nu)
    space = lagrange_space(mesh, element)
    held = np.zeros(space.points.shape, dtype=bool)
    held[space.points[:, 0] < 1e-9] = True
    held[:, 2] = True  # plane strain
    free_side = mesh.boundary[np.all(mesh.nodes[mesh.boundary][:, :, 0] > 48.0 - 1e-9, axis=1)]
    load = traction(space, free_side, np.array([0.0, 6.25, 0.0]))
    constraint = meshes.held_components(held, np.zeros_like(space.points))
    model = finite_strain_model(space, constraint, LAWS["linear"], dilatation=dilatation, loads=(load,))
    u = model.solve(np.array([70.0]), np.zeros(0)).displacement
    corner = np.argmin(np.linalg.norm(space.points[:, :2] - [48.0, 60.0], axis=1))
    return u[corner, 1]


@pytest.mark.parametrize("dilatation", [Dilatation.POINTWISE, Dilatation.BLENDED])
def test_compressible_panel(meshes, dilatation):
    assert deflection(meshes, 10, 1.0 / 3.0, "P2", dilatation) == pytest.approx(32.25, rel=1.2e-2)


def test_the_automatic_element_does_not_lock_where_linear_tetrahedra_do(meshes):
    auto = choose_element("auto")
    found = deflection(meshes, 10, 0.4999, auto.space, auto.dilatation)
    assert found == pytest.approx(INCOMPRESSIBLE, rel=2.5e-2)
    assert deflection(meshes, 10, 0.4999, "P1", Dilatation.POINTWISE) < 0.7 * INCOMPRESSIBLE
