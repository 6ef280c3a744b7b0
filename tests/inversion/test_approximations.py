"""The contract of approximations: every class that has its members keeps it, without a test of its own."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from dataclasses import FrozenInstanceError, dataclass, fields, replace

import numpy as np
import pytest

import palpate.approximation
from palpate.approximation import (
    Approximation,
    ExactApproximation,
    LinearisationPoint,
    ReducedBasis,
    exact_approximation,
    reduced_basis,
)
from palpate.approximation.expansion import Expansion, coarse_equilibrium, expansion_around
from palpate.mechanics.boundary import Conditions
from palpate.mechanics.equilibrium import ACCURACY
from palpate.mechanics.finite_strain import FiniteStrainModel, finite_strain_model
from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.laws.registry import law_named
from palpate.mechanics.linear_model import LinearModel

MEMBERS = [name for name in vars(Approximation) if not name.startswith("_")]


def implementations():
    """All classes among the approximations that have every member of the contract."""
    found = set()
    for module in pkgutil.walk_packages(palpate.approximation.__path__, "palpate.approximation."):
        for _, kind in inspect.getmembers(importlib.import_module(module.name), inspect.isclass):
            own = kind.__module__ == module.name and kind is not Approximation
            if own and all(hasattr(kind, member) for member in MEMBERS):
                found.add(kind)
    return found


@dataclass(frozen=True)
class Body:
    """A body under the linear law and under another one, and which of them is approximated."""

    linear: LinearModel
    finite: FiniteStrainModel
    law: str

    def solve(self, at):
        model = self.linear if self.law == "linear" else self.finite
        return model.solve(at.moduli, at.coefficients)

    def under(self, constraint):
        conditions = Conditions(constraint)
        return Body(self.linear.with_conditions(conditions), self.finite.with_conditions(conditions), self.law)


def of_reduced_basis(body, at):
    return reduced_basis(body.linear, at.moduli)


def of_expansion(body, at):
    return expansion_around(coarse_equilibrium(body.finite, of_reduced_basis(body, at), at), tolerance=ACCURACY)


def of_exact(body, at):
    return exact_approximation(body.linear, None if body.law == "linear" else body.finite, at)


MAKERS = {
    ReducedBasis: {"linear": of_reduced_basis},
    Expansion: {"neo-hookean": of_expansion},
    ExactApproximation: {"linear": of_exact, "neo-hookean": of_exact},
}
# by how much a stated error may exceed the true one, and fall below it: a bound, and estimates
FACTORS = {ReducedBasis: (50.0, 1.0), Expansion: (1.5, 1.5), ExactApproximation: (1.5, 1.5)}
CASES = [(kind, law) for kind, makers in MAKERS.items() for law in makers]


def test_every_implementation_is_tested_here():
    assert implementations() == set(MAKERS) == set(FACTORS)


@pytest.fixture(scope="module", params=CASES, ids=[f"{kind.__name__}-{law}" for kind, law in CASES])
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def body(kind, twin):
    model = twin.model
    return Body(model, finite_strain_model(model.space, model.constraint, law_named("neo-hookean")), kind[1])


@pytest.fixture(scope="module")
def here(twin):
    return LinearisationPoint(np.array([16.0, 14.0, 10.0]), 0.5 * twin.coefficients)


@pytest.fixture(scope="module")
def there(twin):
    """Ten per cent from `here` in the moduli and in the motion."""
    return LinearisationPoint(np.array([17.6, 12.6, 10.0]), 0.55 * twin.coefficients)


@pytest.fixture(scope="module")
def made(kind, body, here):
    """The approximation made at `here`."""
    return MAKERS[kind[0]][kind[1]](body, here)


@pytest.fixture(scope="module")
def deciding(there, rng_of):
    """The other place with two directions of (ln E, q) and a positive metric."""
    n = 3 + len(there.coefficients)
    root = rng_of.normal(size=(n, n))
    return replace(there, directions=rng_of.normal(size=(n, 2)), metric=root @ root.T + np.eye(n))


@pytest.fixture(scope="module")
def rng_of():
    return np.random.default_rng(20240511)


def stated(approximation, at):
    return approximation.model.solve(at.moduli, at.coefficients).values


def off(body, approximation, at):
    """True relative error in energy at a place, by the linear law's stiffness."""
    truth = body.solve(at).values
    vectors = (stated(approximation, at) - truth, truth)
    energies = [v @ body.linear.forces(at.moduli, v[:, None])[:, 0] for v in vectors]
    return float(np.sqrt(energies[0] / energies[1]))


def test_where_it_is_made_it_is_the_full_model(body, made, here):
    assert off(body, made, here) < 1e-5


def test_where_it_is_updated_it_is_the_full_model_and_states_no_error(body, made, there):
    updated = made.update(there)
    assert off(body, made, there) > 1e-4  # or there would be nothing to show
    assert off(body, updated, there) < 1e-5
    assert updated.error(there).relative < 1e-5


def test_elsewhere_its_error_is_stated(kind, body, made, there):
    over, under = FACTORS[kind[0]]
    true = off(body, made, there)
    assert true / under * (1.0 - 1e-6) < made.error(there).relative < over * true


def test_along_the_directions_wanted_its_derivatives_are_those_of_the_full_model(body, made, deciding):
    made = replace(made, few=0) if isinstance(made, Expansion) else made  # or all of them were made exact
    updated = made.update(deciding)
    exactly = body.solve(deciding).tangent() @ deciding.directions
    before, after = (
        a.model.solve(deciding.moduli, deciding.coefficients).tangent() @ deciding.directions for a in (made, updated)
    )
    assert np.linalg.norm(after - exactly) < 0.01 * np.linalg.norm(exactly)
    assert np.linalg.norm(after - exactly) < 0.2 * np.linalg.norm(before - exactly)
    assert np.array_equal(updated.derivatives_at, deciding.moduli)
    assert off(body, updated, deciding) < 1e-5


def test_nothing_that_it_is_asked_changes_it(made, deciding):
    before, counts, at = stated(made, deciding), made.counts, made.derivatives_at
    made.update(deciding)
    made.error(deciding)
    assert np.array_equal(stated(made, deciding), before)
    assert made.counts == counts
    assert made.derivatives_at is at or np.array_equal(made.derivatives_at, at)
    for member in fields(made):
        with pytest.raises(FrozenInstanceError):
            setattr(made, member.name, None)


def test_what_it_cost_grows_with_an_update_and_not_where_it_is_exact_already(made, there):
    updated = made.update(there)
    again = updated.update(there)
    assert total(updated.counts) > total(made.counts)
    assert total(again.counts) == total(updated.counts)
    assert made.trust_radius > 0.0


@dataclass(frozen=True)
class Asked:
    """Another factorisation, which writes down how many right-hand sides it is asked for."""

    of: object
    asked: list[int]

    def solve(self, rhs, **named):
        self.asked.append(rhs.shape[1])
        return self.of.solve(rhs, **named)

    def __getattr__(self, name):
        return getattr(self.of, name)


def watched(of, asked):
    """The same with every factorisation in it one that writes down what it is asked for."""
    changes, own = {}, {member.name for member in fields(of)}
    for name in own & {"factorisation", "system", "equilibrium", "path"}:
        value = getattr(of, name)
        changes[name] = Asked(value, asked) if name == "factorisation" else watched(value, asked)
    return replace(of, **changes)


def test_what_its_error_costs_is_stated(made, there):
    """Right-hand sides with the factorisation that is there; no approximation solves the model anew to be checked."""
    asked = list[int]()
    watched(made, asked).error(there)
    assert asked
    assert made.error_counts == SolveCounts(forward=sum(asked))


def total(counts):
    return sum(getattr(counts, member.name) for member in fields(counts))
