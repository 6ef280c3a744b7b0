"""Why a case needs a tissue of known stiffness: displacements fix the ratios of moduli, never their scale.

The stiffness matrix K(E) is linear in the moduli, and no force is prescribed. So K(5 E) u = 5 K(E) u = 0 has the same
solution u as K(E) u = 0.
"""

from __future__ import annotations

import sys

import numpy as np

from palpate.images import Role, Tissue
from palpate.mechanics import linear_model, outer_constraint
from palpate.mesh import Anatomy, Box, lagrange_space, tetrahedralise
from palpate.phantoms import ball

TISSUES = (
    Tissue("cavity", Role.DRIVER, (1,)),
    Tissue("organ", Role.ESTIMATE, (2,)),
    Tissue("surroundings", Role.KNOWN, (), youngs_modulus_kpa=10.0),
)
BOX = Box(np.full(3, -30.0), np.eye(3), np.full(3, 60.0))


def displacement(moduli: list[float]) -> np.ndarray:
    """Displacement (n_points, 3) mm when the cavity grows by 3 mm, for moduli (kPa) of organ and surroundings."""
    anatomy = Anatomy(TISSUES, (ball(np.zeros(3), 8.0), ball(np.zeros(3), 16.0), None), BOX)
    space = lagrange_space(tetrahedralise(anatomy, edge_length_mm=8.0), "P2")
    wall = np.zeros(len(space.points), dtype=bool)
    wall[space.facets(space.mesh.boundary[space.mesh.beyond == 0]).ravel()] = True
    radius = np.linalg.norm(space.points, axis=1, keepdims=True)
    offset = np.where(wall[:, None], 3.0 * space.points / np.maximum(radius, 1.0), 0.0)
    no_modes = np.zeros((offset.size, 0))
    constraint = outer_constraint(space, outer="fixed", modes=no_modes, offset=offset.ravel(), prescribed=wall)
    return linear_model(space, constraint).solve(np.array(moduli), np.zeros(0)).displacement


def main() -> float:
    """Return the largest change (mm) of the displacement if every modulus is multiplied by five."""
    first = displacement([30.0, 10.0])
    scaled = float(np.abs(displacement([150.0, 50.0]) - first).max())
    other = float(np.abs(displacement([60.0, 10.0]) - first).max())
    sys.stdout.write(f"all moduli times 5: {scaled:.1e} mm; only the organ's times 2: {other:.2f} mm\n")
    assert scaled < 1e-9 < other
    return scaled


if __name__ == "__main__":
    main()
