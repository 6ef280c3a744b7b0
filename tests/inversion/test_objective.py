"""Gradients of every objective are exact, and its Gauss-Newton system is that of a smooth surface."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from dataclasses import replace

import numpy as np
import pytest
from palpate.inversion.surrogate import first_surrogate, with_modulus_series
from palpate.inversion.tukey import Tukey
from palpate.observation.misfit import Correspondence

import palpate.inversion
from palpate.inversion.objective import Objective, State, Weighting

NO_OUTLIERS = Tukey()
MEMBERS = ("__call__", "value", "n_parameters", "n_unknowns")


def surrogate_of(model, moduli, columns):
    """A reduced model exact at `moduli`, with series of the moduli along one motion of the driver."""
    return with_modulus_series(first_surrogate(model, moduli), np.ones(model.n_modes), columns).reduced


def everything(target):
    """All image points count; the maps' smoothing draws nothing in."""
    n = len(target.image_points)
    return Correspondence(np.ones(n, bool), np.zeros(n), np.zeros(len(target.surface.rest)))


def objective_of(problem, *, loss=NO_OUTLIERS, precision=30.0) -> Objective:
    moduli = problem.modulus_map.moduli(np.zeros(2))
    states, weighting = [], []
    for model, targets in zip(problem.models, problem.targets, strict=True):
        reduced = surrogate_of(model, moduli, problem.modulus_map.columns)
        states.append(State(reduced.at(np.concatenate([t.surface.dofs for t in targets])), targets))
        every = [everything(t) for t in targets]
        weighting.append(tuple(Weighting(precision, loss, use) for use in every))
    return Objective(tuple(states), problem.modulus_map, tuple(weighting))


def one_image(twins, twin):
    return objective_of(twins.voxel_problem(twin))


def robust(twins, twin):
    return objective_of(twins.voxel_problem(twin), loss=Tukey(0.5, 0.3))


def two_images(twins, twin):
    return objective_of(twins.voxel_problem(twin, twins.deformed(twin.model, seed=6)))


FACTORIES = {"one image": one_image, "robust": robust, "two images": two_images}


def test_every_objective_is_tested_here():
    found = set()
    for module in pkgutil.walk_packages(palpate.inversion.__path__, "palpate.inversion."):
        for _, kind in inspect.getmembers(importlib.import_module(module.name), inspect.isclass):
            if kind.__module__ == module.name and all(member in vars(kind) for member in MEMBERS):
                found.add(kind)
    assert found == {Objective}


@pytest.fixture(scope="module", params=sorted(FACTORIES))
def objective(request, twins, twin):
    return FACTORIES[request.param](twins, twin)


def place(objective, seed):
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(size=2), 0.5 * rng.standard_normal(objective.n_unknowns - 2)])


def whole(line, unknowns):
    """The derivative (n, n_unknowns) of a surface's residuals by all unknowns."""
    jacobian = np.zeros((len(line.jacobian), len(unknowns)))
    jacobian[:, line.columns] = line.jacobian
    return jacobian


@pytest.mark.parametrize("seed", [1, 2])
def test_the_gradient_is_that_of_central_differences(objective, seed):
    unknowns, h = place(objective, seed), 1e-6
    fresh = objective.with_fresh_correspondence(unknowns)
    steps = h * np.eye(len(unknowns))
    differences = [(fresh.value(unknowns + s) - fresh.value(unknowns - s)) / (2.0 * h) for s in steps]
    gradient = fresh(unknowns).gradient
    assert np.linalg.norm(gradient - differences) < 1e-6 * np.linalg.norm(gradient)
    assert np.abs(gradient[:2]).min() > 1e-4 * np.linalg.norm(gradient)


def test_a_trial_value_is_that_of_the_whole_evaluation(objective):
    unknowns = place(objective, 3)
    assert objective.value(unknowns) == pytest.approx(objective(unknowns).value, rel=1e-12)


def test_the_matrix_is_that_of_weighted_residuals_and_the_prior(objective):
    unknowns = place(objective, 4)
    now = objective(unknowns)
    prior = np.diag(np.repeat([0.0, 1.0], [2, len(unknowns) - 2]))
    rows = np.concatenate([np.sqrt(s.precision * s.weights)[:, None] * whole(s, unknowns) for s in now.surfaces])
    assert now.matrix == pytest.approx(rows.T @ rows + prior, rel=1e-10, abs=1e-8)
    assert np.linalg.eigvalsh(now.matrix).min() > 0.0


def test_the_modes_of_one_image_do_not_move_the_other(twins, twin):
    objective = two_images(twins, twin)
    now = objective(place(objective, 5))
    n = twin.model.n_modes
    assert all(s.columns.tolist() == [*range(2 + n)] for s in now.surfaces[:3])
    assert all(s.columns.tolist() == [0, 1, *range(2 + n, 2 + 2 * n)] for s in now.surfaces[3:])


def test_at_the_truth_only_the_prior_pulls(twin, exact):
    snapshots = surrogate_of(twin.model, twin.moduli, exact.modulus_map.columns)
    objective = objective_of(exact)
    outputs = np.concatenate([t.surface.dofs for t in exact.targets[0]])
    objective = replace(objective, states=(State(snapshots.at(outputs), exact.targets[0]),))
    now = objective(twin.unknowns)
    prior = np.concatenate([np.zeros(2), twin.coefficients])
    assert now.misfit_mm2 < 1e-16
    assert now.score == pytest.approx(prior, abs=1e-5)
    assert now.gradient == pytest.approx(prior, abs=1e-5)
    assert now.value == pytest.approx(0.5 * prior @ prior, rel=1e-9)


def test_residuals_beyond_the_cutoff_have_no_weight(twins, twin):
    objective = robust(twins, twin)
    now = objective(np.concatenate([[0.0, 0.0], -twin.coefficients]))
    values = np.concatenate([s.residuals.values for s in now.surfaces])
    weights = np.concatenate([s.weights for s in now.surfaces])
    assert np.any(np.abs(values) > 0.8)
    assert np.array_equal(weights == 0.0, np.abs(values) >= 0.8)


@pytest.mark.parametrize("make", FACTORIES.values(), ids=FACTORIES.keys())
def test_the_gradient_alone_is_that_of_the_whole_evaluation(twins, twin, make, rng):
    objective = make(twins, twin)
    unknowns = 0.3 * rng.standard_normal(objective.n_unknowns)
    value, gradient = objective.value_and_gradient(unknowns)
    whole = objective(unknowns)
    assert value == pytest.approx(whole.value, rel=1e-12)
    assert gradient == pytest.approx(whole.gradient, rel=1e-9, abs=1e-9 * np.abs(whole.gradient).max())
