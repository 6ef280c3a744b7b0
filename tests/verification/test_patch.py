"""B0: patch tests and objectivity."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.laws.registry import LAWS
from palpate.mechanics.linear_model import linear_model
from palpate.mesh.space import lagrange_space

GRADIENT = np.array([[0.02, -0.01, 0.03], [0.015, -0.03, 0.005], [-0.02, 0.01, 0.04]])


@pytest.mark.parametrize("element", ["P1", "P2"])
@pytest.mark.parametrize("poisson_ratio", [0.3, 0.49])
def test_an_affine_field_is_reproduced_on_a_distorted_mesh(meshes, element, poisson_ratio):
    space = lagrange_space(
        meshes.box_mesh(4, size=40.0, distortion=0.25, tissues=[meshes.known("block", nu=poisson_ratio)]), element
    )
    given = meshes.every_node_prescribed(space, lambda x: x @ GRADIENT.T + 1.0)
    model = linear_model(space, outer_constraint(space, outer="free", **given))
    exact = space.points @ GRADIENT.T + 1.0
    found = model.solve(np.array([3.0]), np.zeros(0)).displacement
    assert abs(found - exact).max() < 1e-10 * abs(exact).max()


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_layers_in_series_share_the_strain_by_their_moduli(meshes, element):
    """Piecewise affine, exact: with nu = 0 each layer takes the strain sigma / E, sigma = d / sum(h / E)."""
    size, moduli = 40.0, np.array([1.0, 3.0, 12.0])
    heights = np.array([10.0, 10.0, 20.0])
    mesh = meshes.box_mesh(
        4,
        size=size,
        tissues=[meshes.known(name, nu=0.0) for name in ("low", "middle", "high")] + [meshes.VOID],
        region=lambda c: np.searchsorted([10.0, 20.0], c[:, 2]),
    )
    space = lagrange_space(mesh, element)
    ends = np.flatnonzero((space.points[:, 2] < 1e-9) | (space.points[:, 2] > size - 1e-9))
    pull = np.zeros((len(ends), 3))
    pull[space.points[ends, 2] > 1.0, 2] = 1.0
    model = linear_model(space, outer_constraint(space, outer="sliding", **meshes.prescribe(space, ends, pull)))
    found = model.solve(moduli, np.zeros(0)).displacement
    stress = 1.0 / np.sum(heights / moduli)
    exact = np.interp(space.points[:, 2], [0, 10, 20, 40], np.append(0.0, np.cumsum(stress * heights / moduli)))
    assert abs(found[:, 2] - exact).max() < 1e-10
    assert abs(found[:, :2]).max() < 1e-10


def test_a_rigid_translation_stores_no_energy(meshes):
    mesh = meshes.box_mesh(3, size=30.0, distortion=0.25)
    space = lagrange_space(mesh, "P2")
    given = meshes.every_node_prescribed(space, np.ones_like)
    model = linear_model(space, outer_constraint(space, outer="free", **given))
    u = model.solve(np.array([5.0]), np.zeros(0)).values[:, None]
    forces = model.forces(np.array([5.0]), u)
    assert abs(forces).max() < 1e-10 * 5.0 * abs(model.stiffness[0]).max()


def test_the_linear_law_takes_a_large_rotation_for_strain(meshes):
    """The documented failure of small strain: a turn by 30 degrees gives the strain cos 30 - 1 in its plane."""
    mesh = meshes.box_mesh(2, size=10.0)
    space = lagrange_space(mesh, "P2")
    angle = np.deg2rad(30.0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    given = meshes.every_node_prescribed(space, lambda x: x @ (turn - np.eye(3)).T)
    model = linear_model(space, outer_constraint(space, outer="free", **given))
    u = model.solve(np.array([1.0]), np.zeros(0)).values
    strain, nu = np.cos(angle) - 1.0, 0.3
    lam, mu = nu / ((1 + nu) * (1 - 2 * nu)), 1 / (2 * (1 + nu))
    density = 0.5 * lam * (2 * strain) ** 2 + mu * 2 * strain**2
    assert 0.5 * u @ model.forces(np.array([1.0]), u[:, None])[:, 0] == pytest.approx(density * 1000.0, rel=1e-10)


@pytest.mark.parametrize("law", ["neo-hookean", "mooney-rivlin"])
@pytest.mark.parametrize("dilatation", Dilatation)
def test_an_affine_finite_strain_is_reproduced_on_a_distorted_mesh(meshes, law, dilatation):
    space = lagrange_space(
        meshes.box_mesh(3, size=30.0, distortion=0.25, tissues=[meshes.known("block", nu=0.49)]), "P2"
    )
    exact = 10.0 * space.points @ GRADIENT.T
    given = meshes.every_node_prescribed(space, lambda x: 10.0 * x @ GRADIENT.T)
    model = finite_strain_model(space, outer_constraint(space, outer="free", **given), LAWS[law], dilatation=dilatation)
    found = model.solve(np.array([3.0]), np.zeros(0)).displacement
    assert abs(found - exact).max() < 1e-8 * abs(exact).max()


@pytest.mark.parametrize("law", ["neo-hookean", "mooney-rivlin"])
@pytest.mark.parametrize("degrees", [30.0, 90.0])
def test_a_superposed_rotation_adds_no_stress(meshes, law, degrees):
    """A strained body, then turned as a whole: forces turn with it, energy stays."""
    space = lagrange_space(meshes.box_mesh(2, size=10.0, distortion=0.2), "P2")
    model = finite_strain_model(
        space, outer_constraint(space, outer="fixed", **meshes.every_node_prescribed(space, np.zeros_like)), LAWS[law]
    )
    angle = np.deg2rad(degrees)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    strained = 5.0 * space.points @ GRADIENT.T + 0.05 * np.sin(space.points)
    turned = (space.points + strained) @ turn.T - space.points
    balance = model.balance(np.array([3.0]))
    forces, size = balance.residual(strained.ravel())
    after, _ = balance.residual(turned.ravel())
    assert np.allclose(after.reshape(-1, 3), forces.reshape(-1, 3) @ turn.T, atol=1e-11 * size)
    moduli = model.moduli_of(np.array([3.0]))
    assert model.elements.energy(turned, moduli) == pytest.approx(model.elements.energy(strained, moduli), rel=1e-11)
