"""B1, B2, B3: Lame's thick spheres and cylinder under inner pressure."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.linear_model import linear_model, weighted_sum
from palpate.mechanics.solvers.registry import factorise
from palpate.mesh.space import lagrange_space


def inflated(meshes, mesh, faces, *, moduli, pressure, dilatation=Dilatation.POINTWISE):
    """Space and displacement (n_dof,) of a body whose flat sides slide, under a pressure on faces seen from outside."""
    space = lagrange_space(mesh, "P2")
    nothing = meshes.prescribe(space, np.zeros(0, int), np.zeros((0, 3)))
    model = linear_model(space, outer_constraint(space, outer="sliding", **nothing), dilatation=dilatation)
    load = meshes.pressure_load(space, faces, pressure)
    free = model.constraint.free
    matrix = weighted_sum(np.asarray(moduli), model.free_stiffness)
    return space, (free @ factorise(matrix).solve((free.T @ load)[:, None]))[:, 0]


@pytest.mark.parametrize(("nu", "at_inner", "at_outer"), [(0.30, 0.80000, 0.30000), (0.49, 0.854286, 0.218571)])
def test_thick_sphere_under_inner_pressure(meshes, nu, at_inner, at_outer):
    mesh = meshes.octant_mesh(np.array([10.0, 20.0]), [5], 9, [meshes.known("shell", nu=nu)])
    cavity = meshes.sphere_faces(mesh, 10.0)[:, ::-1]
    space, u = inflated(meshes, mesh, cavity, moduli=[10.0], pressure=1.0)
    assert meshes.mean_radial(space, 10.0) @ u == pytest.approx(at_inner, rel=5e-3)
    assert meshes.mean_radial(space, 20.0) @ u == pytest.approx(at_outer, rel=5e-3)


def test_two_glued_spheres_are_one(meshes):
    """Code_Aster V6.03.173: radii 20, 30, 40 mm, E 2000 MPa, nu 0.3, 25 MPa inside (here kPa for MPa)."""
    tissues = [meshes.known("inner", nu=0.3), meshes.known("outer", nu=0.3)]
    mesh = meshes.octant_mesh(np.array([20.0, 30.0, 40.0]), [3, 3], 9, tissues)
    cavity = meshes.sphere_faces(mesh, 20.0)[:, ::-1]
    space, u = inflated(meshes, mesh, cavity, moduli=[2000.0, 2000.0], pressure=25.0)
    found = [meshes.mean_radial(space, radius) @ u for radius in (20.0, 30.0, 40.0)]
    assert np.allclose(found, [0.200000, 0.103968, 0.075000], rtol=5e-3)


@pytest.mark.parametrize("nu", [0.3, 0.49])
def test_thick_cylinder_in_plane_strain(meshes, nu):
    """u = p a^2 (1 + nu) / (E (b^2 - a^2)) ((1 - 2 nu) r + b^2 / r); 9.07937e-3 mm at nu 0.3 is published."""
    inner, outer, modulus, pressure = 10.0, 20.0, 210e6, 100e3
    mesh = meshes.quarter_ring_mesh(inner, outer, 6, 12, meshes.known("tube", nu=nu))
    bore = np.all(np.hypot(mesh.nodes[:, 0], mesh.nodes[:, 1])[mesh.boundary] < 1.001 * inner, axis=1)
    space, u = inflated(meshes, mesh, mesh.boundary[bore], moduli=[modulus], pressure=pressure)
    scale = pressure * inner**2 * (1 + nu) / (modulus * (outer**2 - inner**2))
    nodes = space.mesh.nodes
    radius = np.hypot(nodes[:, 0], nodes[:, 1])
    found = np.hypot(*u.reshape(-1, 3)[: len(nodes), :2].T)
    assert np.allclose(found, scale * ((1 - 2 * nu) * radius + outer**2 / radius), rtol=5e-3)
    if nu == 0.3:
        assert found[np.abs(radius - inner) < 1e-9].mean() == pytest.approx(9.07937e-3, rel=5e-3)


def test_thick_sphere_at_the_edge_of_incompressibility(meshes):
    """B1 at nu = 0.4999, by the same formula: 0.857114 and 0.214329 mm."""
    mesh = meshes.octant_mesh(np.array([10.0, 20.0]), [5], 9, [meshes.known("shell", nu=0.4999)])
    cavity = meshes.sphere_faces(mesh, 10.0)[:, ::-1]
    space, u = inflated(meshes, mesh, cavity, moduli=[10.0], pressure=1.0, dilatation=Dilatation.BLENDED)
    assert meshes.mean_radial(space, 10.0) @ u == pytest.approx(0.857114, rel=5e-3)
    assert meshes.mean_radial(space, 20.0) @ u == pytest.approx(0.214329, rel=5e-3)


@pytest.mark.parametrize("dilatation", [Dilatation.MEAN, Dilatation.BLENDED])
def test_incompressible_cylinder(meshes, dilatation):
    """Code_Aster V3.04.130: bore 0.1 m, 60 MPa, E = 200 GPa, nu = 0.5 gives 6e-5 m at the bore and 3e-5 m outside."""
    mesh = meshes.quarter_ring_mesh(10.0, 20.0, 6, 12, meshes.known("tube", nu=0.4999))
    radius = np.hypot(*mesh.nodes[:, :2].T)
    bore = np.all(radius[mesh.boundary] < 10.01, axis=1)
    _, u = inflated(meshes, mesh, mesh.boundary[bore], moduli=[200e6], pressure=60e3, dilatation=dilatation)
    found = np.hypot(*u.reshape(-1, 3)[: len(radius), :2].T)
    assert found[np.abs(radius - 10.0) < 1e-9].mean() == pytest.approx(6e-3, rel=5e-3)
    assert found[np.abs(radius - 20.0) < 1e-9].mean() == pytest.approx(3e-3, rel=5e-3)
