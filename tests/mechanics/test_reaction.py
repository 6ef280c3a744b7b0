"""The force that holds a surface: known answers, balance, and derivatives whose remainders have their order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import SolverError
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.equilibrium import equilibrium
from palpate.mechanics.laws.registry import LAWS
from palpate.mechanics.loads import traction
from palpate.mechanics.material import material_modes
from palpate.mechanics.reaction import surface_reaction
from palpate.mesh.space import lagrange_space

SIZE, STRAIN, MODULUS = 20.0, 0.05, 30.0  # mm, -, kPa
STEPS = np.array([1e-2, 1e-3, 1e-4])


@pytest.fixture(scope="module")
def space(meshes):
    tissues = [meshes.known("soft", 0.3), meshes.known("hard", 0.3)]
    mesh = meshes.box_mesh(3, size=SIZE, tissues=tissues, region=lambda c: (c[:, 0] > 0.4 * SIZE).astype(int))
    return lagrange_space(mesh, "P2")


def face(space, *, top):
    """Triangles of the box's upper or lower face."""
    mesh = space.mesh
    flat = np.ptp(mesh.nodes[mesh.boundary][:, :, 2], axis=1) < 1e-9
    at = mesh.nodes[mesh.boundary][:, 0, 2] > 0.5 * SIZE
    return mesh.boundary[flat & (at == top)]


def pulled(space, meshes, strain=STRAIN):
    """Both faces given along z, one corner and one direction held: free to narrow."""
    points = space.points
    held = np.zeros((len(points), 3), dtype=bool)
    held[:, 2] = (points[:, 2] < 1e-9) | (points[:, 2] > SIZE - 1e-9)
    corner = np.argmin(np.linalg.norm(points, axis=1))
    along = np.argmin(np.linalg.norm(points - [SIZE, 0.0, 0.0], axis=1))
    held[corner], held[along, 1] = True, True
    value = np.zeros_like(points)
    value[:, 2] = np.where(held[:, 2], strain * points[:, 2], 0.0)
    return meshes.held_components(held, value)


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_the_force_is_what_it_takes_by_hand(space, meshes, law):
    """E A e of a bar that may narrow; of a neo-Hookean one mu A (l - 1 / l) with J from the free sides."""
    constraint = pulled(space, meshes)
    moduli = np.full(2, MODULUS)
    found = equilibrium(space, constraint, moduli, law=LAWS[law], dilatation=Dilatation.POINTWISE)
    reaction = surface_reaction(space, face(space, top=True), np.eye(3)[2], LAWS[law], dilatation=Dilatation.POINTWISE)
    force, _, _ = reaction.at(found.values[reaction.dofs], moduli, np.zeros(0))
    expected = MODULUS * SIZE**2 * STRAIN * 1e-3
    if law == "neo-hookean":
        mu, lame = MODULUS / 2.6, MODULUS * 0.3 / (1.3 * 0.4)
        stretch = 1.0 + STRAIN
        wide = 1.0
        for _ in range(200):  # mu (w^2 - 1) + lambda ln(l w^2) = 0 on the free sides
            wide -= (mu * (wide**2 - 1.0) + lame * np.log(stretch * wide**2)) / (2.0 * mu * wide + 2.0 * lame / wide)
        expected = 1e-3 * SIZE**2 * (mu * (stretch**2 - 1.0) + lame * np.log(stretch * wide**2)) / stretch
    assert force == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_the_forces_on_both_ends_are_in_balance(space, meshes, law):
    moduli = np.array([10.0, 40.0])
    found = equilibrium(space, pulled(space, meshes), moduli, law=LAWS[law], dilatation=Dilatation.BLENDED)
    both = [surface_reaction(space, face(space, top=top), np.eye(3)[2], LAWS[law]) for top in (True, False)]
    up, down = (r.at(found.values[r.dofs], moduli, np.zeros(0))[0] for r in both)
    assert up > 0.0
    assert up == pytest.approx(-down, rel=1e-6)


def test_moduli_scaled_together_scale_the_force(space, meshes):
    moduli = np.array([10.0, 40.0])
    found = equilibrium(space, pulled(space, meshes), moduli, law=LAWS["neo-hookean"], dilatation=Dilatation.BLENDED)
    reaction = surface_reaction(space, face(space, top=True), np.eye(3)[2], LAWS["neo-hookean"])
    once, twice = (reaction.at(found.values[reaction.dofs], s * moduli, np.zeros(0)) for s in (1.0, 2.0))
    assert twice[0] == pytest.approx(2.0 * once[0], rel=1e-12)
    assert once[2].sum() == pytest.approx(once[0], rel=1e-12)


def test_a_traction_is_balanced_by_the_force_below(space, meshes):
    """0.5 kPa on the upper face is held by 0.5 A on the lower one."""
    held = np.repeat(space.points[:, 2:] < 1e-9, 3, axis=1)
    constraint = meshes.held_components(held, np.zeros_like(space.points))
    load = traction(space, face(space, top=True), np.array([0.0, 0.0, 0.5]))
    moduli = np.array([10.0, 40.0])
    found = equilibrium(space, constraint, moduli, law=LAWS["linear"], dilatation=Dilatation.BLENDED, loads=(load,))
    reaction = surface_reaction(space, face(space, top=False), np.eye(3)[2], LAWS["linear"])
    force = reaction.at(found.values[reaction.dofs], moduli, np.zeros(0))[0]
    assert force == pytest.approx(-0.5e-3 * SIZE**2, rel=1e-6)


@pytest.mark.parametrize("law", ["linear", "neo-hookean", "mooney-rivlin"])
def test_its_derivatives_leave_remainders_of_second_order(space, law):
    modes = material_modes(space.mesh, [0, 1], length_mm=15.0, poisson=[(0,), (1,)])
    reaction = surface_reaction(space, face(space, top=True), np.array([0.3, 0.2, 1.0]), LAWS[law], material=modes)
    rng = np.random.default_rng(2)
    u, moduli = 0.02 * rng.standard_normal(len(reaction.dofs)), np.array([10.0, 40.0])
    material = 0.05 * rng.standard_normal(modes.n_modes)
    value, by_u, direct = reaction.at(u, moduli, material)
    du, dm = 0.02 * rng.standard_normal(len(u)), np.array([0.3, -0.2])
    dc = 0.1 * rng.standard_normal(modes.n_modes)
    remainders = []
    for h in STEPS:
        there = reaction.at(u + h * du, moduli * np.exp(h * dm), material + h * dc)[0]
        remainders.append(abs(there - value - h * (by_u @ du + direct @ np.concatenate([dm, dc]))))
    assert np.all(np.diff(np.log(remainders)) / np.diff(np.log(STEPS)) > 1.9)


@pytest.mark.parametrize("law", ["neo-hookean", "mooney-rivlin"])
@pytest.mark.parametrize("dilatation", list(Dilatation))
def test_no_force_is_told_of_elements_that_are_turned_inside_out(space, law, dilatation):
    reaction = surface_reaction(space, face(space, top=True), np.eye(3)[2], LAWS[law], dilatation=dilatation)
    mirrored = np.zeros_like(space.points)
    mirrored[:, 2] = -2.0 * space.points[:, 2]
    motion, moduli = mirrored.ravel()[reaction.dofs], np.array([10.0, 40.0])
    with pytest.raises(SolverError, match=r"the force on the surface around .* inside out \(volume ratio -1\)"):
        reaction.at(motion, moduli, np.zeros(0))
    linear = surface_reaction(space, face(space, top=True), np.eye(3)[2], LAWS["linear"], dilatation=dilatation)
    assert np.isfinite(linear.at(motion, moduli, np.zeros(0))[0])


@pytest.mark.parametrize("dilatation", list(Dilatation))
@pytest.mark.parametrize("law", ["linear", "neo-hookean", "mooney-rivlin"])
def test_its_derivatives_by_poissons_ratios_are_those_that_differences_say(space, law, dilatation):
    """At a held displacement, each region's alone."""
    rng, moduli = np.random.default_rng(3), np.array([10.0, 40.0])

    def reaction(soft, hard):
        """Of tissues with these Poisson's ratios, on a face that both of them have."""
        tissues = tuple(replace(t, poisson_ratio=r) for t, r in zip(space.mesh.tissues, (soft, hard), strict=True))
        with_them = replace(space, mesh=replace(space.mesh, tissues=tissues))
        return surface_reaction(with_them, face(space, top=True), np.eye(3)[2], LAWS[law], dilatation=dilatation)

    u, h = 0.02 * rng.standard_normal(len(reaction(0.3, 0.3).dofs)), 1e-4
    found = reaction(0.3, 0.45).by_poisson(u, moduli, np.zeros(0))
    for i, step in enumerate(np.eye(2) * h):
        high, low = (reaction(0.3 + s[0], 0.45 + s[1]).at(u, moduli, np.zeros(0))[0] for s in (step, -step))
        assert found[i] == pytest.approx((high - low) / (2.0 * h), rel=1e-4)
    assert np.abs(found).min() > 0.0
