"""Reduced models: exact on their snapshots, converging between them, certified everywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import ConfigurationError, SolverError
from palpate.mechanics import reduced
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.reduced import common_vectors, free_combinations, orthonormal_basis, projection
from palpate.mesh.space import lagrange_space

RATIOS = (0.2, 1.0, 5.0, 25.0)


@pytest.fixture(scope="module")
def model(meshes):
    mesh = meshes.box_mesh(
        4,
        size=40.0,
        tissues=[meshes.known("fat", nu=0.45), meshes.unknown("organ", nu=0.45)],
        region=lambda c: (np.linalg.norm(c - 20.0, axis=1) < 14.0).astype(int),
    )
    space = lagrange_space(mesh, "P2")
    floor = np.flatnonzero(space.points[:, 2] < 1e-9)
    x, y = space.points[floor, 0] / 40.0, space.points[floor, 1] / 40.0
    modes = np.zeros((len(floor), 3, 2))
    modes[:, 2, 0], modes[:, 0, 1] = np.sin(np.pi * x) * np.sin(np.pi * y), x * y
    given = meshes.prescribe(space, floor, np.column_stack([0 * x, 0 * x, x]), modes)
    return linear_model(space, outer_constraint(space, outer="sliding", **given))


def basis(model, ratios=RATIOS):
    snapshots = [model.responses(np.array([1.0, ratio])) for ratio in ratios]
    return model.constraint.free.T @ np.concatenate(snapshots, axis=1)


@pytest.fixture(scope="module")
def small(model):
    return projection(model, basis(model)).reduced


def relative(one, other):
    return float(np.max(np.abs(one - other)) / np.max(np.abs(other)))


@pytest.mark.parametrize("ratio", RATIOS)
def test_a_snapshot_is_reproduced(model, small, ratio):
    moduli = np.array([3.0, 3.0 * ratio])
    assert relative(small.responses(moduli), model.responses(moduli)) < 1e-9


def test_more_snapshots_come_closer_between_them(model):
    moduli, q = np.array([1.0, 2.3]), np.array([1.0, -2.0])
    truth = model.solve(moduli, q).values
    errors = [
        relative(projection(model, basis(model, RATIOS[:k])).reduced.solve(moduli, q).values, truth)
        for k in (1, 2, 3, 4)
    ]
    assert np.all(np.diff(errors) < 0.0)
    assert errors[-1] < 5e-3


def test_derivative_snapshots_make_the_tangent_exact(model):
    moduli, q = np.array([1.0, 4.0]), np.array([1.0, 0.5])
    system = model.system(moduli)
    responses = system.responses()
    enriched = np.concatenate([responses, system.modulus_responses(responses)[1]], axis=1)
    tangent = projection(model, model.constraint.free.T @ enriched).reduced.solve(moduli, q).tangent()
    assert relative(tangent, system.solve(q).tangent()) < 1e-9


def test_the_frozen_factor_certifies_the_reduced_answer(model, small):
    frozen = model.system(np.array([1.0, 3.0]))
    q = np.array([0.3, 1.0])
    for ratio in (0.5, 2.0, 10.0):
        moduli = np.array([1.0, ratio])
        answer, truth = small.solve(moduli, q).values, model.solve(moduli, q).values
        error = answer - truth
        energies = [v @ model.forces(moduli, v[:, None])[:, 0] for v in (error, answer)]
        assert np.sqrt(energies[0] / energies[1]) <= frozen.error_bound(moduli, answer)[0] < 0.1


def test_selected_outputs_are_the_rows_of_all(small, rng):
    moduli, q = np.array([1.0, 6.0]), np.array([1.0, 2.0])
    dofs = rng.permutation(len(small.output_modes))[:30]
    whole, part = small.solve(moduli, q), small.outputs(lambda values: values[dofs]).solve(moduli, q)
    assert np.allclose(part.values, whole.values[dofs], atol=1e-13)
    assert np.allclose(part.tangent(), whole.tangent()[dofs], atol=1e-13)


def test_repeated_and_empty_snapshots_add_no_basis_vector(rng):
    snapshots = rng.standard_normal((50, 3))
    vectors = orthonormal_basis(np.column_stack([snapshots, 1e6 * snapshots, np.zeros(50)]))
    assert vectors.shape == (50, 3)
    assert np.allclose(vectors.T @ vectors, np.eye(3), atol=1e-12)


def test_an_extended_projection_is_that_on_all_vectors(model):
    snapshots = basis(model)
    whole, grown = projection(model, snapshots).reduced, projection(model, snapshots[:, :4])
    for start in range(4, snapshots.shape[1], 3):
        grown = grown.extended(snapshots[:, start : start + 3])
    vectors = grown.spanned(np.eye(grown.reduced.n_basis))
    assert np.allclose(grown.components(vectors), np.eye(grown.reduced.n_basis), atol=1e-12)
    assert np.allclose(vectors.T @ vectors, np.eye(vectors.shape[1]), atol=1e-12)
    assert vectors.shape[1] == whole.n_basis
    moduli, q = np.array([1.0, 3.0]), np.array([0.4, -1.0])
    small, full = grown.reduced.solve(moduli, q), whole.solve(moduli, q)
    assert relative(small.values, full.values) < 1e-9
    assert relative(small.tangent(), full.tangent()) < 1e-8


@pytest.mark.parametrize("threads", ["1", "3"])
def test_what_is_added_copies_nothing_and_spans_with_what_is_there_by_any_threads(
    model, threads, environment, monkeypatch
):
    environment(OMP_NUM_THREADS=threads)
    monkeypatch.setattr(reduced, "WORTH_THREADS", 0)
    snapshots, rng = basis(model), np.random.default_rng(5)
    small = projection(model, snapshots[:, :4])
    grown = small.extended(snapshots[:, 4:7])
    (first,), (same, added) = small.reduced.output_basis, grown.reduced.output_basis
    assert same is first
    whole = np.column_stack([first, added])
    for shape in ((), (3,)):
        amplitudes, values = rng.standard_normal((7, *shape)), rng.standard_normal((len(whole), *shape))
        assert np.allclose(grown.reduced.spanned(amplitudes), whole @ amplitudes, atol=1e-12)
        assert np.allclose(grown.reduced.components(values), whole.T @ values, atol=1e-12)
        some = np.arange(0, len(whole), 3)
        assert np.allclose(grown.reduced.components(values[some], some), whole[some].T @ values[some], atol=1e-12)


def test_a_basis_takes_the_place_of_its_snapshots_where_it_may_alone(rng):
    snapshots = rng.standard_normal((50, 4))
    before = snapshots.copy()
    vectors = orthonormal_basis(snapshots)
    assert np.array_equal(snapshots, before)
    assert np.array_equal(orthonormal_basis(snapshots, overwrite=True), vectors)
    assert np.array_equal(snapshots, vectors)


def test_combinations_of_free_displacements_are_those_in_double_precision(model, rng):
    displacements, combinations = rng.standard_normal((model.constraint.free.shape[0], 5)), rng.standard_normal((5, 3))
    found = free_combinations(model, displacements.astype(np.float32), combinations.astype(np.float32))
    assert np.allclose(found, model.constraint.free.T @ displacements @ combinations, rtol=0.0, atol=1e-5)


def test_a_projection_serves_another_state_of_the_body_on_the_same_vectors(model):
    """Its offset and loads are others, its modes are the same."""
    vectors, moduli, q = basis(model), np.array([1.0, 5.0]), np.array([1.0, -2.0])
    constraint = replace(model.constraint, offset=-0.3 * model.constraint.offset)
    other = model.with_conditions(replace(model.conditions, constraint=constraint))
    first = projection(model, vectors)
    there, anew = first.with_model(other), projection(other, vectors)
    assert there.reduced.output_basis[0] is first.reduced.output_basis[0]
    assert there.reduced.solve(moduli, q).values == pytest.approx(anew.reduced.solve(moduli, q).values, abs=1e-9)


def test_states_of_a_body_with_vectors_of_their_own_share_what_is_common_of_the_factor(model):
    vectors, moduli, q = basis(model), np.array([1.0, 5.0]), np.array([1.0, -2.0])
    constraint = replace(model.constraint, offset=-0.3 * model.constraint.offset)
    other = model.with_conditions(replace(model.conditions, constraint=constraint))
    first = projection(model, vectors[:, :6])
    bent = first.with_model(other).extended(vectors[:, 9:11]).reduced
    first = first.extended(vectors[:, 6:9]).reduced
    assert common_vectors(first, bent) == 6
    assert common_vectors(first, first) == first.n_basis
    assert common_vectors(first, replace(bent, stiffness=2.0 * bent.stiffness)) == 0
    shared, alone = bent.system(moduli, first.system(moduli), 6), bent.system(moduli)
    assert shared.factor == pytest.approx(alone.factor, rel=1e-9, abs=1e-12 * np.abs(alone.factor).max())
    assert shared.solve(q).values == pytest.approx(alone.solve(q).values, rel=1e-9, abs=1e-12)
    assert shared.solve(q).tangent() == pytest.approx(alone.solve(q).tangent(), rel=1e-9, abs=1e-12)


def test_what_is_there_already_extends_nothing(model):
    snapshots = basis(model)
    small = projection(model, snapshots)
    assert small.extended(snapshots @ np.ones((snapshots.shape[1], 2))) is small


def test_a_badly_conditioned_basis_is_orthonormal_all_the_same(rng):
    u, v = (np.linalg.qr(rng.standard_normal((n, 8)))[0] for n in (60, 8))
    for smallest in (1e-3, 1e-8):
        vectors = orthonormal_basis(u * np.geomspace(1.0, smallest, 8) @ v.T)
        assert np.allclose(vectors.T @ vectors, np.eye(8), atol=1e-11)
        assert np.allclose(vectors @ (vectors.T @ u), u, atol=1e-6)


def test_a_basis_of_another_mesh_is_refused(model):
    with pytest.raises(ConfigurationError, match="n_free"):
        projection(model, np.ones((5, 2)))


def test_a_basis_of_nothing_is_refused():
    with pytest.raises(ConfigurationError, match="non-zero"):
        orthonormal_basis(np.zeros((5, 2)))


def test_a_reduced_stiffness_that_is_not_definite_is_refused(small):
    broken = replace(small, stiffness=-small.stiffness)
    with pytest.raises(SolverError, match="not positive definite"):
        broken.solve(np.ones(2), np.zeros(2))
