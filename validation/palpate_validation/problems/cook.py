"""B7: Cook's membrane, a tapered panel that is clamped on one side and sheared on the other.

Corners (0, 0), (48, 44), (48, 60), (0, 44) mm. Plane stress, E = 1, nu = 1/3, force 1: 23.96 is the deflection of the
free side's middle (48, 52). Some pages ascribe it to the corner (48, 60), which moves by 25.1 on the finest mesh that
we tried. Plane strain, E = 70, nu = 1/3, traction 6.25: the corner moves by 32.27 (CalculiX), 32.20 (Code_Aster),
32.28 mm (Elmer), all from the CoFEA benchmark's table. At nu = 0.4999 no number is published; the reference is our own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics import LAWS, ElementChoice, choose_element, finite_strain_model, traction
from palpate.mesh import TetMesh, lagrange_space
from palpate_validation.conditions import held_components
from palpate_validation.problems.contract import Check, Problem
from palpate_validation.structured_meshes import known, kuhn_tets, make_mesh

__all__ = ["COOK_PROBLEMS", "INCOMPRESSIBLE", "deflection", "panel"]

Array = NDArray[np.float64]

TOLERANCE = 1.0
INCOMPRESSIBLE = 27.73  # mm, plane strain at nu = 0.4999, extrapolated from three meshes of our own


def panel(n: int, nu: float) -> TetMesh:
    """A panel of n x n x 1 cells, as thick as a cell is wide."""
    places, tets = kuhn_tets((n, n, 1))
    x, y = places[:, 0] / n, places[:, 1] / n
    low, high = 44.0 * x, 44.0 + 16.0 * x
    nodes = np.column_stack([48.0 * x, low + (high - low) * y, places[:, 2] * 48.0 / n])
    return make_mesh(nodes, tets, np.zeros(len(tets), int), [known("panel", nu=nu)])


def deflection(
    n: int,
    nu: float,
    element: ElementChoice,
    *,
    height: float = 60.0,
    plane_strain: bool = True,
    modulus: float = 70.0,
    shear: float = 6.25,
) -> float:
    """Deflection (mm) at (48, height) mm under `shear` kPa; in plane stress the panel is held on one face only."""
    mesh = panel(n, nu)
    space = lagrange_space(mesh, element.space)
    held = np.zeros(space.points.shape, dtype=bool)
    held[space.points[:, 0] < 1e-9, :2] = True
    held[:, 2] = plane_strain | (space.points[:, 2] < 1e-9)
    free_side = mesh.boundary[np.all(mesh.nodes[mesh.boundary][:, :, 0] > 48.0 - 1e-9, axis=1)]
    load = traction(space, free_side, np.array([0.0, shear, 0.0]))
    constraint = held_components(held, np.zeros_like(space.points))
    model = finite_strain_model(space, constraint, LAWS["linear"], dilatation=element.dilatation, loads=(load,))
    u = model.solve(np.array([modulus]), np.zeros(0)).displacement
    place = np.argmin(np.linalg.norm(space.points[:, :2] - [48.0, height], axis=1))
    return float(u[place, 1])


def _plane_stress_checks() -> tuple[Check, ...]:
    element = choose_element("P2")
    found = deflection(24, 1 / 3, element, height=52.0, plane_strain=False, modulus=1.0, shear=1.0 / 16.0)
    return (Check("u_y(48, 52) (mm)", 23.96, found, TOLERANCE),)


def _plane_strain_checks(quantity: str, nu: float, reference: float) -> tuple[Check, ...]:
    return (Check(quantity, reference, deflection(24, nu, choose_element("auto")), TOLERANCE),)


COOK_PROBLEMS = (
    Problem(
        "B7a",
        "Cook's membrane in plane stress",
        "Cook 1974; Belytschko et al. 2014 (by femorph-solver)",
        _plane_stress_checks,
    ),
    Problem(
        "B7b",
        "Cook's membrane in plane strain",
        "CoFEA: CalculiX 32.27, Code_Aster 32.20, Elmer 32.28",
        lambda: _plane_strain_checks("u_y(48, 60), nu = 1/3 (mm)", 1 / 3, 32.25),
    ),
    Problem(
        "B7c",
        "Cook's membrane, incompressible",
        "our own, extrapolated from three meshes of another element (no number is published)",
        lambda: _plane_strain_checks("u_y(48, 60), nu = 0.4999 (mm)", 0.4999, INCOMPRESSIBLE),
    ),
)
