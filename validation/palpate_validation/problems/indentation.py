"""B8: Hertz's indenter, a flat punch and a point force on a half-space, by their closed forms: no contact algorithm.

A ball of radius R indents by d = a^2 / R over the circle of radius a: F = 4/3 E* a^3 / R with E* = E / (1 - nu^2),
pressure p0 sqrt(1 - r^2 / a^2), p0 = 2 E* a / (pi R). Flat punch F = 2 a E* d. Point force w(r) = P / (pi E* r)
(Johnson, Contact Mechanics, 1985, chapters 3 and 4). The half-space is a quarter of a half-ball of many radii.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics import linear_model, triangle_quadrature
from palpate.mesh import LagrangeSpace, lagrange_space, shape_functions, triangle_normals
from palpate_validation.conditions import held_components, loaded
from palpate_validation.problems.contract import Check, Problem
from palpate_validation.structured_meshes import known, octant_mesh

__all__ = ["INDENTATION_PROBLEMS", "half_space", "hertz_depth", "indenting_force", "point_force_depth"]

Array = NDArray[np.float64]

TOLERANCE = 3.0
E, NU = 10.0, 0.45  # kPa, soft tissue
BALL, DEPTH = 5.0, 0.5  # radius of the indenter and its depth, mm
CONTACT = float(np.sqrt(BALL * DEPTH))  # radius of the contact, mm
FAR = 200.0  # radius of the half-ball, of that of the contact
POINT_FAR = 3000.0  # for a point force, whose depth falls as slowly as 1 / r


def half_space(contact: float, nu: float, *, n_surface: int = 12, fine: int = 6, far: float = FAR) -> LagrangeSpace:
    """A quarter of the half-ball z > 0 whose flat side z = 0 has a ring of nodes at the radius `contact` (mm).

    The layers are thin near that ring and grow by half outwards, to `far` radii; the ring encloses the circle's area.
    """
    turn = 0.5 * np.pi / n_surface
    # how far outside of the unit sphere the corners of an eighth of a ball lie
    mesh = octant_mesh(np.array([0.5, 1.0]), [1], n_surface, [known("ball")])
    grow = np.sqrt(turn / np.sin(turn)) / float(np.linalg.norm(mesh.nodes, axis=1).max())
    near = 1.0 - 0.5 ** np.arange(1, fine)
    beyond = 1.0 + 0.5 ** np.arange(fine - 1, -1, -1)
    outwards = np.geomspace(2.0, far, round(np.log(far / 2.0) / np.log(1.5)) + 1)[1:]
    radii = contact * grow * np.concatenate([[0.25], near, [1.0], beyond, outwards])
    tissues = [known(f"layer {i}", nu=nu) for i in range(len(radii) - 1)]
    return lagrange_space(octant_mesh(radii, [1] * len(tissues), n_surface, tissues, solid=True), "P2")


def _on_top(space: LagrangeSpace) -> tuple[NDArray[np.bool_], Array]:
    """Which points (n_points,) are on z = 0, and every point's distance (n_points,) mm from the axis."""
    return np.abs(space.points[:, 2]) < 1e-9, np.linalg.norm(space.points[:, :2], axis=1)


def _held(space: LagrangeSpace) -> NDArray[np.bool_]:
    """The planes x = 0 and y = 0 slide, the far end is fixed, the top is free: marks (n_points, 3)."""
    distance = np.linalg.norm(space.points, axis=1)
    held = np.abs(space.points) < 1e-9
    held[:, 2] = False
    held[distance > 0.97 * distance.max()] = True
    return held


def indenting_force(space: LagrangeSpace, contact: float, depth: Array, modulus: float) -> float:
    """Force (mN) that moves the points within `contact` mm by depth (n_points,) mm along z, without friction."""
    top, r = _on_top(space)
    held, values = _held(space), np.zeros_like(space.points)
    under = top & (r < 1.01 * contact)
    held[under, 2] = True
    values[under, 2] = depth[under]
    model = linear_model(space, held_components(held, values))
    moduli = np.full(model.n_regions, modulus)
    forces = model.forces(moduli, model.solve(moduli, np.zeros(0)).values[:, None])[:, 0].reshape(-1, 3)
    return 4.0 * float(forces[under, 2].sum())


def hertz_depth(space: LagrangeSpace, contact: float, peak: float) -> Array:
    """Depths (2,) mm at the centre and on the ring under the pressure peak sqrt(1 - r^2 / a^2) kPa."""
    top, r = _on_top(space)
    # the load, by quadrature of degree 5 on the faces of z = 0
    mesh = space.mesh
    faces = mesh.boundary[np.all(np.abs(mesh.nodes[mesh.boundary][:, :, 2]) < 1e-9, axis=1)]
    faces = faces[np.linalg.norm(mesh.nodes[faces][:, :, :2], axis=2).max(axis=1) < 1.02 * contact]
    places, weights = triangle_quadrature(5)
    away = np.linalg.norm(np.einsum("qk,fki->fqi", places, mesh.nodes[faces])[:, :, :2], axis=2)
    pressure = peak * np.sqrt(np.maximum(1.0 - (away / contact) ** 2, 0.0))
    area = 0.5 * np.linalg.norm(2.0 * triangle_normals(mesh.nodes, faces), axis=1)
    nodal = np.einsum("f,q,fq,qa->fa", area, weights, pressure, shape_functions(space.order, places))
    load = np.zeros_like(space.points)
    np.add.at(load[:, 2], space.facets(faces), nodal)
    u = _under(space, load)
    ring = top & (np.abs(r / contact - 1.0) < 0.02)
    return np.array([u[r < 1e-9][np.argmin(space.points[r < 1e-9, 2]), 2], u[ring, 2].mean()])


def point_force_depth(space: LagrangeSpace, force: float) -> tuple[float, float]:
    """Distance (mm) of the surface points nearest to 10 mm and their mean depth (mm) under `force` mN at the centre."""
    top, r = _on_top(space)
    load = np.zeros_like(space.points)
    load[np.argmin(np.linalg.norm(space.points, axis=1)), 2] = 0.25 * force
    u = _under(space, load)
    ring = top & (np.abs(r - r[top][np.argmin(np.abs(r[top] - 10.0))]) < 1e-6)
    return float(r[ring].mean()), float(u[ring, 2].mean())


def _under(space: LagrangeSpace, load: Array) -> Array:
    """Displacement (n_points, 3) mm of the held space under nodal forces (n_points, 3) mN."""
    constraint = held_components(_held(space), np.zeros_like(space.points))
    regions = len([t for t in space.mesh.tissues if t.meshed])
    return loaded(space, constraint, load.ravel(), moduli=np.full(regions, E)).reshape(-1, 3)


def _hertz_checks() -> tuple[Check, ...]:
    space = half_space(CONTACT, NU)
    depth = DEPTH - _on_top(space)[1] ** 2 / (2.0 * BALL)
    force = indenting_force(space, CONTACT, depth, E)
    peak = 1.5 * force / (np.pi * CONTACT**2)
    return (
        Check("force (mN)", 13.2175, force, TOLERANCE),
        Check("largest pressure 3 F / (2 pi a^2) (kPa)", 2.52435, peak, TOLERANCE),
    )


def _two_ball_checks() -> tuple[Check, ...]:
    """Each of two equal balls (50 mm, E = 20 000 MPa, nu 0.3) is indented by half the approach of 4 mm."""
    space = half_space(10.0, 0.3)
    depth = 2.0 - _on_top(space)[1] ** 2 / 100.0
    force = indenting_force(space, 10.0, depth, 20e3)
    return (Check("largest pressure (MPa)", 2798.3, 1.5 * force / (np.pi * 100.0), TOLERANCE),)


def _pressure_checks() -> tuple[Check, ...]:
    centre, edge = hertz_depth(half_space(CONTACT, NU), CONTACT, 2.52435)
    return (
        Check("depth at the centre (mm)", DEPTH, float(centre), TOLERANCE),
        Check("depth at the contact's edge (mm)", 0.5 * DEPTH, float(edge), TOLERANCE),
    )


def _punch_checks() -> tuple[Check, ...]:
    space = half_space(5.0, NU, n_surface=16, fine=8)
    force = indenting_force(space, 5.0, np.full(len(space.points), DEPTH), E)
    return (Check("force (mN)", 62.696, force, TOLERANCE),)


def _boussinesq_checks() -> tuple[Check, ...]:
    r, depth = point_force_depth(half_space(CONTACT, NU, far=POINT_FAR), 1.0)
    return (Check("depth at 10 mm, 1 mN (mm)", 0.00253852, depth * r / 10.0, TOLERANCE),)


JOHNSON = "closed form (Johnson 1985)"
INDENTATION_PROBLEMS = (
    Problem("B8a", "Hertz: the force under a rigid ball", JOHNSON, _hertz_checks),
    Problem("B8b", "Hertz: the depth under the closed-form pressure", JOHNSON, _pressure_checks, quick=False),
    Problem("B8c", "Hertz: two equal balls", "Code_Aster V6.04.104; closed form", _two_ball_checks, quick=False),
    Problem("B8d", "Flat punch", JOHNSON, _punch_checks, quick=False),
    Problem("B8e", "Boussinesq: point force", JOHNSON, _boussinesq_checks, quick=False),
)
