"""B4: concentric organs under prescribed displacements, with their log-sensitivities (the paper's experiment I, exact).

Each layer moves by u = A r + B / r^2, with continuous u and radial stress.
"""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.reduced import reduce
from palpate.mesh.space import lagrange_space


@pytest.fixture(scope="module")
def hollow(meshes):
    """Radii 5, 10, 20, 30 mm; u(5) = 1 mm as a mode, u(30) = 0."""
    tissues = [meshes.known(name, nu=0.4) for name in ("core", "middle", "outer")]
    mesh = meshes.octant_mesh(np.array([5.0, 10.0, 20.0, 30.0]), [4, 4, 2], 8, tissues)
    space = lagrange_space(mesh, "P2")
    round_side = mesh.boundary[mesh.beyond != -1]
    points = np.unique(space.facets(round_side))
    inner = np.linalg.norm(space.points[points], axis=1) < 7.0
    mode = np.where(inner[:, None], space.points[points] / 5.0, 0.0)[:, :, None]
    given = meshes.prescribe(space, points, np.zeros((len(points), 3)), mode)
    return linear_model(space, outer_constraint(space, outer="sliding", **given))


@pytest.fixture(scope="module")
def solid(meshes):
    """Radii 10, 20, 30 mm; u(30) = -1 mm."""
    tissues = [meshes.known(name, nu=0.4) for name in ("core", "middle", "outer")]
    mesh = meshes.octant_mesh(np.array([2.5, 10.0, 20.0, 30.0]), [3, 4, 4], 8, tissues, solid=True)
    space = lagrange_space(mesh, "P2")
    points = np.unique(space.facets(mesh.boundary[mesh.beyond != -1]))
    given = meshes.prescribe(space, points, -space.points[points] / 30.0)
    return linear_model(space, outer_constraint(space, outer="sliding", **given))


def radial(meshes, model):
    """Matrix (2, n_dof) to the mean radial displacement at the radii 10 and 20 mm."""
    return np.stack([meshes.mean_radial(model.space, radius) for radius in (10.0, 20.0)])


@pytest.mark.parametrize(
    ("moduli", "expected"),
    [([50.0, 100.0, 150.0], [0.193361, 0.029300]), ([150.0, 100.0, 50.0], [0.265434, 0.061048])],
)
def test_hollow_spheres_move_as_the_closed_form(meshes, hollow, moduli, expected):
    found = radial(meshes, hollow) @ hollow.solve(np.array(moduli), np.ones(1)).values
    assert np.allclose(found, expected, rtol=1e-2)


def test_log_sensitivities_of_the_hollow_spheres(meshes, hollow):
    """At E = (50, 100, 150) and u(5) = 5 mm; singular values 0.4809 and 0.0984."""
    observe = radial(meshes, hollow)
    tangent = observe @ hollow.solve(np.array([50.0, 100.0, 150.0]), np.array([5.0])).tangent()[:, :3]
    expected = [[0.36443, -0.30645, -0.05798], [0.05522, 0.02853, -0.08376]]
    assert np.allclose(tangent, expected, atol=3e-3)
    assert np.allclose(tangent.sum(axis=1), 0.0, atol=1e-10)
    assert np.allclose(np.linalg.svd(tangent)[1], [0.4809, 0.0984], rtol=2e-2)


def test_the_reduced_model_has_the_same_sensitivities(hollow):
    moduli = np.array([50.0, 100.0, 150.0])
    system = hollow.system(moduli)
    responses = system.responses()
    snapshots = np.concatenate([responses, *system.modulus_responses(responses)], axis=1)
    small = reduce(hollow, hollow.constraint.free.T @ snapshots)
    exact = system.solve(np.array([5.0])).tangent()
    assert abs(small.solve(moduli, np.array([5.0])).tangent() - exact).max() < 1e-9 * abs(exact).max()


@pytest.mark.parametrize("moduli", [[50.0, 100.0, 150.0], [100.0, 200.0, 300.0]])
def test_solid_spheres_tell_the_ratios_and_not_the_scale(meshes, solid, moduli):
    found = radial(meshes, solid) @ solid.solve(np.array(moduli), np.zeros(0)).values
    assert np.allclose(found, [-0.645299, -0.851437], rtol=5e-3)


def test_equal_moduli_shrink_uniformly_whatever_they_are(meshes, solid):
    equilibrium = solid.solve(np.full(3, 77.0), np.zeros(0))
    observe = radial(meshes, solid)
    assert np.allclose(observe @ equilibrium.values, [-1.0 / 3.0, -2.0 / 3.0], atol=1e-10)
    expected = [[0.250, -0.067, -0.182], [0.046, 0.319, -0.365]]
    assert np.allclose(observe @ equilibrium.tangent(), expected, atol=5e-3)
