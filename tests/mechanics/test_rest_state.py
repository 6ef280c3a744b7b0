"""The state without stress of a body that was seen under loads: loaded forward it is what was seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from palpate.mechanics.boundary import Conditions
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.equilibrium import equilibrium
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.laws.registry import LAWS
from palpate.mechanics.loads import DeadLoad, gravity
from palpate.mechanics.newton import NewtonSettings
from palpate.mechanics.reaction import surface_reaction
from palpate.mechanics.rest_state import unloaded_displacement
from palpate.mesh.space import Constraint, lagrange_space

NEO_HOOKEAN, MODULUS, LENGTH = LAWS["neo-hookean"], np.array([200.0]), 60.0
NONE = np.zeros(0)


def beam(meshes, element):
    """A beam of 60 x 10 x 10 mm, clamped at one end, with its weight of 9.81 m/s^2 across."""
    mesh = meshes.box_mesh(3, tissues=[meshes.known("gel"), meshes.VOID], beyond=lambda c: np.ones(len(c), int))
    nodes = mesh.nodes * [LENGTH, 10.0, 10.0]
    space = lagrange_space(replace(mesh, nodes=nodes), element)
    n = space.points.size
    free = sparse.eye_array(n, format="csc")[:, np.repeat(space.points[:, 0] > 1e-9, 3)]
    constraint = Constraint(sparse.csr_matrix(free), np.zeros((n, 0)), np.zeros(n))
    return space, constraint, gravity(space, np.array([1000.0, 0.0]), np.array([0.0, 0.0, -9.81]))


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_the_rest_state_loaded_is_what_was_seen(meshes, element):
    space, constraint, weight = beam(meshes, element)
    model = finite_strain_model(space, constraint, NEO_HOOKEAN, settings=NewtonSettings(tolerance=1e-10))
    moved = unloaded_displacement(model, MODULUS, NONE, (weight,))
    if element == "P1":  # on a mesh of its own, whose nodes lie at rest
        rest = lagrange_space(replace(space.mesh, nodes=space.points - moved), "P1")
        again = equilibrium(
            rest, constraint, MODULUS, law=NEO_HOOKEAN, dilatation=Dilatation.BLENDED, loads=(DeadLoad(weight.nodal),)
        ).displacement
        assert np.abs(again - moved).max() < 1e-6 * LENGTH
    seen = replace(model, elements=model.elements.unloaded(moved))
    relieved = replace(seen, conditions=Conditions(constraint, (DeadLoad(-weight.nodal),)))
    assert relieved.solve(MODULUS, NONE).displacement == pytest.approx(-moved, abs=1e-6 * LENGTH)
    assert seen.solve(MODULUS, NONE).displacement == pytest.approx(0.0, abs=1e-6)


def test_the_force_on_a_strained_body_is_what_is_added(meshes):
    """A clamp that bears the weight already bears as much again of twice the weight."""
    space, constraint, weight = beam(meshes, "P1")
    model = finite_strain_model(space, constraint, NEO_HOOKEAN, settings=NewtonSettings(tolerance=1e-10))
    moved = unloaded_displacement(model, MODULUS, NONE, (weight,))
    loaded = finite_strain_model(space, constraint, NEO_HOOKEAN, loads=(weight,), strained=moved)
    found = loaded.to_tolerance(1e-10).solve(MODULUS, NONE)
    boundary = space.mesh.boundary
    clamp = boundary[(space.points[boundary][:, :, 0] < 1e-9).all(axis=1)]
    reaction = surface_reaction(space, clamp, np.array([0.0, 0.0, 1.0]), NEO_HOOKEAN, strained=moved)
    force, *_ = reaction.at(found.values[reaction.dofs], MODULUS, NONE)
    on_free = weight.nodal.reshape(-1, 3)[space.points[:, 0] > 1e-9, 2].sum()
    assert force == pytest.approx(-1e-3 * on_free, rel=1e-6)
    assert reaction.at(np.zeros(len(reaction.dofs)), MODULUS, NONE)[0] == pytest.approx(0.0, abs=1e-12)
