"""Derivatives of every forward model: Taylor and dot-product tests of whatever implements `ForwardModel`."""

from __future__ import annotations

import importlib
import inspect
import pkgutil

import numpy as np
import pytest

import palpate.mechanics
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.curved import CurvedModel
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.first_order import expanded
from palpate.mechanics.forward import Equilibrium, ForwardModel
from palpate.mechanics.laws.registry import LAWS
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.newton import NewtonSettings
from palpate.mechanics.reduced import projection
from palpate.mesh.space import lagrange_space

MODULI = np.array([3.0, 10.0])
COEFFICIENTS = np.array([0.7, -0.4])


def members(protocol):
    return [name for name in vars(protocol) if not name.startswith("_")]


def implementations():
    """Names of all classes of the package that have every member of `ForwardModel`."""
    found = set()
    for module in pkgutil.walk_packages(palpate.mechanics.__path__, "palpate.mechanics."):
        for name, kind in inspect.getmembers(importlib.import_module(module.name), inspect.isclass):
            own = kind.__module__ == module.name and kind is not ForwardModel
            if own and all(hasattr(kind, member) for member in members(ForwardModel)):
                found.add(name)
    return found


def body(meshes):
    """Two tissues on a floor that moves by two modes and an offset."""
    mesh = meshes.box_mesh(
        2,
        size=30.0,
        distortion=0.2,
        tissues=[meshes.known("fat", nu=0.45), meshes.unknown("organ", nu=0.45)],
        region=lambda c: (c[:, 2] > 15.0).astype(int),
    )
    space = lagrange_space(mesh, "P2")
    floor = np.flatnonzero(space.points[:, 2] < 1e-9)
    x, y, _ = (space.points[floor] / 30.0).T
    bump = np.sin(np.pi * x) * np.sin(np.pi * y)
    modes = np.stack([np.stack([0.3 * bump, 0 * bump, bump], 1), np.stack([bump * x, bump * y, 0 * bump], 1)], axis=2)
    given = meshes.prescribe(space, floor, np.outer(bump, [0.5, 1.0, 4.0]), 3.0 * modes)
    return space, outer_constraint(space, outer="fixed", **given)


def linear(meshes):
    return linear_model(*body(meshes), dilatation=Dilatation.BLENDED)


def finite(law):
    settings = NewtonSettings(tolerance=1e-13)
    return lambda meshes: finite_strain_model(*body(meshes), law, settings=settings)


def reduced(meshes):
    """A basis that is far from exact: the derivatives must be those of the reduced model itself."""
    model = linear(meshes)
    snapshots = [model.responses(moduli) for moduli in (np.array([1.0, 1.0]), np.array([1.0, 20.0]))]
    return projection(model, model.constraint.free.T @ np.concatenate(snapshots, axis=1)).reduced


def first_order(meshes):
    """An expansion around another place than the tests' own."""
    model, moduli, coefficients = linear(meshes), np.array([2.0, 12.0]), np.array([0.5, 0.1])
    equilibrium = model.solve(moduli, coefficients)
    return expanded(equilibrium, names=model.names, moduli=moduli, coefficients=coefficients)


def curved(meshes):
    """A finite-strain expansion around another place, bent as the linear law is."""
    law, moduli, coefficients = finite(LAWS["neo-hookean"])(meshes), np.array([2.0, 12.0]), np.array([0.5, 0.1])
    there = law.solve(moduli, coefficients)
    return CurvedModel.of(expanded(there, names=law.names, moduli=moduli, coefficients=coefficients), linear(meshes))


FACTORIES = {"LinearModel": linear, "ReducedModel": reduced, "FirstOrderModel": first_order, "CurvedModel": curved}
FACTORIES |= {f"FiniteStrainModel {name}": finite(law) for name, law in LAWS.items()}


def test_every_forward_model_has_a_factory_here():
    assert implementations() == {name.split()[0] for name in FACTORIES}


@pytest.fixture(scope="module", params=sorted(FACTORIES))
def model(request, meshes):
    return FACTORIES[request.param](meshes)


def values(model, parameters):
    return model.solve(MODULI * np.exp(parameters[:2]), COEFFICIENTS + parameters[2:]).values


def test_the_equilibrium_has_every_member_of_its_protocol(model):
    equilibrium = model.solve(MODULI, COEFFICIENTS)
    assert all(hasattr(equilibrium, member) for member in members(Equilibrium))
    assert np.array_equal(equilibrium.displacement.ravel(), equilibrium.values)


def test_the_tangent_leaves_a_remainder_of_second_order(model, rng):
    equilibrium = model.solve(MODULI, COEFFICIENTS)
    tangent = equilibrium.tangent()
    for _ in range(3):
        direction = rng.standard_normal(4)
        steps = np.array([1e-1, 1e-2, 1e-3])
        remainders = [
            np.linalg.norm(values(model, h * direction) - equilibrium.values - h * (tangent @ direction)) for h in steps
        ]
        exact = max(remainders) < 1e-12 * np.linalg.norm(equilibrium.values)  # a model that is linear itself
        orders = np.diff(np.log(np.maximum(remainders, 1e-300))) / np.diff(np.log(steps))
        assert exact or np.all(orders > 1.9)


def test_the_adjoint_is_the_transpose_of_the_tangent(model, rng):
    equilibrium = model.solve(MODULI, COEFFICIENTS)
    tangent = equilibrium.tangent()
    for _ in range(5):
        direction, gradient = rng.standard_normal(4), rng.standard_normal(len(equilibrium.values))
        forward, backward = gradient @ (tangent @ direction), equilibrium.adjoint(gradient) @ direction
        scale = np.linalg.norm(gradient) * np.linalg.norm(tangent @ direction)
        assert abs(forward - backward) < 1e-11 * scale


def test_modulus_columns_of_the_tangent_sum_to_zero(model):
    tangent = model.solve(MODULI, COEFFICIENTS).tangent()
    assert abs(tangent[:, :2].sum(axis=1)).max() < 1e-11 * abs(tangent).max()


def test_solving_writes_into_nothing_that_it_was_given(model):
    moduli, coefficients = MODULI.copy(), COEFFICIENTS.copy()
    model.solve(moduli, coefficients)
    assert np.array_equal(moduli, MODULI)
    assert np.array_equal(coefficients, COEFFICIENTS)
    assert moduli.flags.writeable
