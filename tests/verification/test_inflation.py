"""B11, B12, B13: inflation of thick spheres, in one layer and in two, and of a thick tube; incompressible.

Sphere: P = sum over layers of mu (g(l_out) - g(l_in)), g(l) = 2 / l + 1 / (2 l^4), for b^3 = B^3 + a^3 - A^3 and
l = b / B (Green & Zerna, Theoretical Elasticity, 1968, section 3.10, integrated). Tube in plane strain:
P = mu (ln(la / lb) + (lb^-2 - la^-2) / 2). The wall is moved; its pressure is the work of its forces over the volume
that it sweeps.
"""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.laws.registry import law_named
from palpate.mechanics.loads import pressure
from palpate.mesh.space import lagrange_space

NU = 0.4999
NEO = law_named("neo-hookean")
MOONEY = law_named("mooney-rivlin", c01_over_c10=0.25)

# stretch of the bore: pressure in kPa; A = 10, B = 20 mm, mu = 10 kPa (Mooney-Rivlin: c10 = 4, c01 = 1 kPa)
BALLOON = {
    "neo-hookean": {1.1: 2.871548, 1.5: 7.554331, 2.0: 8.069266},
    "mooney-rivlin": {1.1: 2.936591, 1.5: 8.474268},
}
TWO_LAYERS = {1.1: 4.209372, 1.5: 12.899483}  # radii 10, 15, 20 mm, mu = 10 and 30 kPa
TUBE = {1.1: 1.315623, 1.2: 2.333698, 1.5: 4.282284}  # A = 10, B = 20 mm, mu = 10 kPa


def youngs(mu):
    return 2.0 * np.asarray(mu) * (1.0 + NU)


def bore_of(mesh, radius, axes):
    distance = np.linalg.norm(mesh.nodes[:, :axes], axis=1)
    return mesh.boundary[np.all(distance[mesh.boundary] < 1.06 * radius, axis=1)]


def wall_pressures(meshes, mesh, law, *, moduli, stretches, axes=3):
    """Pressures (kPa) on the bore of 10 mm when its wall has been moved outwards by each of the stretches."""
    space = lagrange_space(mesh, "P2")
    bore = bore_of(mesh, 10.0, axes)
    points = np.unique(space.facets(bore))
    outwards = space.points[points].copy()
    outwards[:, axes:] = 0.0
    held = np.zeros(space.points.shape, dtype=bool)
    held[points, :axes] = True
    flat = np.abs(space.points) < 1e-9
    held |= flat
    if axes == 2:
        held[:, 2] = True
    modes = np.zeros(space.points.shape)
    modes[points] = outwards
    model = finite_strain_model(space, meshes.held_components(held, 0.0 * modes, modes), law)
    unit, found, start = pressure(space, bore, 1.0), [], None
    for stretch in stretches:
        equilibrium = model.solve(youngs(moduli), np.array([stretch - 1.0]), start=start)
        start = equilibrium.displacement
        work = equilibrium.balance.residual(equilibrium.values)[0] @ modes.ravel()
        found.append(work / (unit.forces(start) @ modes.ravel()))
    return np.array(found)


@pytest.mark.parametrize("law", [NEO, MOONEY], ids=lambda law: law.name)
def test_thick_balloon(meshes, law):
    mesh = meshes.octant_mesh(np.array([10.0, 20.0]), [3], 6, [meshes.known("shell", nu=NU)])
    stretches, expected = zip(*BALLOON[law.name].items(), strict=True)
    found = wall_pressures(meshes, mesh, law, moduli=[10.0], stretches=stretches)
    assert np.allclose(found, expected, rtol=1e-2)


def test_balloon_of_two_layers(meshes):
    tissues = [meshes.known("inner", nu=NU), meshes.known("outer", nu=NU)]
    mesh = meshes.octant_mesh(np.array([10.0, 15.0, 20.0]), [2, 1], 4, tissues)
    stretches, expected = zip(*TWO_LAYERS.items(), strict=True)
    found = wall_pressures(meshes, mesh, NEO, moduli=[10.0, 30.0], stretches=stretches)
    assert np.allclose(found, expected, rtol=1e-2)


def test_thick_tube_in_plane_strain(meshes):
    mesh = meshes.quarter_ring_mesh(10.0, 20.0, 4, 6, meshes.known("tube", nu=NU))
    stretches, expected = zip(*TUBE.items(), strict=True)
    found = wall_pressures(meshes, mesh, NEO, moduli=[10.0], stretches=stretches, axes=2)
    assert np.allclose(found, expected, rtol=1e-2)


def test_a_following_pressure_inflates_the_balloon_by_the_same_law(meshes):
    mesh = meshes.octant_mesh(np.array([10.0, 20.0]), [2], 5, [meshes.known("shell", nu=NU)])
    space = lagrange_space(mesh, "P2")
    nothing = meshes.prescribe(space, np.zeros(0, int), np.zeros((0, 3)))
    constraint = outer_constraint(space, outer="sliding", **nothing)
    bore = bore_of(mesh, 10.0, 3)
    load = pressure(space, bore, BALLOON["neo-hookean"][1.1])
    model = finite_strain_model(space, constraint, NEO, loads=(load,))
    u = model.solve(youngs([10.0]), np.zeros(0)).displacement
    points = np.unique(space.facets(bore))
    radius = np.linalg.norm(space.points[points], axis=1)
    stretch = np.linalg.norm((space.points + u)[points], axis=1) / radius
    assert stretch.mean() == pytest.approx(1.1, rel=3e-3)
