"""B1, B2, B3: Lame's thick spheres and cylinder under inner pressure, at small strain.

Sphere u(r) = p a^3 / (E (b^3 - a^3)) ((1 - 2 nu) r + (1 + nu) b^3 / (2 r^2)), tangential stress at r
p a^3 / (b^3 - a^3) (1 + b^3 / (2 r^3)); cylinder in plane strain u(r) = p a^2 (1 + nu) / (E (b^2 - a^2))
((1 - 2 nu) r + b^2 / r) (Timoshenko & Goodier, Theory of Elasticity, 1970, articles 28 and 136).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics import Dilatation
from palpate.mesh import lagrange_space
from palpate_validation.conditions import loaded, mean_radial, pressure_load, sliding_sides, sphere_faces
from palpate_validation.problems.contract import Check, Problem, checked
from palpate_validation.structured_meshes import known, octant_mesh, quarter_ring_mesh

__all__ = ["LAME_PROBLEMS", "glued_spheres", "thick_cylinder", "thick_sphere"]

Array = NDArray[np.float64]

TOLERANCE = 0.5
INNER, OUTER = 10.0, 20.0  # radii, mm
GLUED = {20: 0.200000, 30: 0.103968, 40: 0.075000}  # radius: displacement, mm
FORMULA = "closed form (Timoshenko & Goodier 1970)"


def thick_sphere(nu: float, dilatation: Dilatation) -> Array:
    """Mean radial displacement (2,) mm at 10 and 20 mm: E = 10 kPa, 1 kPa inside."""
    mesh = octant_mesh(np.array([INNER, OUTER]), [5], 9, [known("shell", nu=nu)])
    space = lagrange_space(mesh, "P2")
    load = pressure_load(space, sphere_faces(mesh, INNER)[:, ::-1], 1.0)
    u = loaded(space, sliding_sides(space), load, moduli=[10.0], dilatation=dilatation)
    return np.array([mean_radial(space, radius) @ u for radius in (INNER, OUTER)])


def glued_spheres() -> Array:
    """Mean radial displacement (3,) mm at 20, 30 and 40 mm of two spheres as one: E = 2000 kPa, nu 0.3, 25 kPa."""
    tissues = [known("inner", nu=0.3), known("outer", nu=0.3)]
    mesh = octant_mesh(np.array([20.0, 30.0, 40.0]), [3, 3], 9, tissues)
    space = lagrange_space(mesh, "P2")
    load = pressure_load(space, sphere_faces(mesh, 20.0)[:, ::-1], 25.0)
    u = loaded(space, sliding_sides(space), load, moduli=[2000.0, 2000.0])
    return np.array([mean_radial(space, radius) @ u for radius in (20.0, 30.0, 40.0)])


def thick_cylinder(nu: float, modulus: float, pressure: float, dilatation: Dilatation) -> tuple[Array, Array]:
    """Radii (n_nodes,) mm and radial displacements there (n_nodes,) mm; modulus and pressure in kPa."""
    mesh = quarter_ring_mesh(INNER, OUTER, 6, 12, known("tube", nu=nu))
    radius = np.hypot(*mesh.nodes[:, :2].T)
    bore = mesh.boundary[np.all(radius[mesh.boundary] < 1.001 * INNER, axis=1)]
    space = lagrange_space(mesh, "P2")
    load = pressure_load(space, bore, pressure)
    u = loaded(space, sliding_sides(space), load, moduli=[modulus], dilatation=dilatation)
    return radius, np.hypot(*u.reshape(-1, 3)[: len(radius), :2].T)


def _sphere_checks(nu: float, inner: float, outer: float, dilatation: Dilatation) -> tuple[Check, ...]:
    references = {f"u({r} mm), nu = {nu:g} (mm)": u for r, u in ((10, inner), (20, outer))}
    return checked(references, thick_sphere(nu, dilatation), TOLERANCE)


def _cylinder_checks(
    nu: float, modulus: float, pressure: float, dilatation: Dilatation, ends: dict[float, float]
) -> tuple[Check, ...]:
    radius, found = thick_cylinder(nu, modulus, pressure, dilatation)
    references = {f"u({end:g} mm), nu = {nu:g} (mm)": value for end, value in ends.items()}
    return checked(references, (found[np.abs(radius - end) < 1e-9].mean() for end in ends), TOLERANCE)


LAME_PROBLEMS = (
    Problem(
        "B1a",
        "Thick sphere under inner pressure",
        FORMULA,
        lambda: _sphere_checks(0.30, 0.80000, 0.30000, Dilatation.POINTWISE),
    ),
    Problem(
        "B1b",
        "Thick sphere, nearly incompressible",
        FORMULA,
        lambda: _sphere_checks(0.49, 0.854286, 0.218571, Dilatation.BLENDED),
    ),
    Problem(
        "B1c",
        "Thick sphere at the edge of incompressibility",
        FORMULA,
        lambda: _sphere_checks(0.4999, 0.857114, 0.214329, Dilatation.BLENDED),
    ),
    Problem(
        "B2",
        "Two glued spheres are one",
        "Code_Aster V6.03.173; closed form",
        lambda: checked({f"u({radius} mm) (mm)": u for radius, u in GLUED.items()}, glued_spheres(), TOLERANCE),
    ),
    Problem(
        "B3a",
        "Thick cylinder in plane strain",
        "femorph-solver, lame_cylinder; closed form",
        lambda: _cylinder_checks(0.3, 210e6, 100e3, Dilatation.POINTWISE, {INNER: 9.07937e-3}),
    ),
    Problem(
        "B3b",
        "Incompressible cylinder",
        "Code_Aster V3.04.130 (nu = 0.5)",
        lambda: _cylinder_checks(0.4999, 200e6, 60e3, Dilatation.BLENDED, {INNER: 6e-3, OUTER: 3e-3}),
    ),
)
