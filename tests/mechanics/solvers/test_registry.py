"""Linear solvers: they agree, check themselves, and refuse what has no one solution."""

from __future__ import annotations

import gc
from functools import cache, partial

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import splu

from multifrontal import nested_dissection, twin_rows
from palpate.errors import ConfigurationError, SolverError
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.linear_model import linear_model, weighted_sum
from palpate.mechanics.rigid import linear_displacements, rigid_modes
from palpate.mechanics.solvers import registry
from palpate.mechanics.solvers.conjugate_gradients import conjugate_gradients, times
from palpate.mechanics.solvers.contract import Expectation, Hints, Solver
from palpate.mechanics.solvers.registry import SOLVERS, factorise
from palpate.mechanics.stiffness import tissue_stiffness
from palpate.mesh.space import lagrange_space

AVAILABLE = list(SOLVERS)


@pytest.fixture(scope="module", params=["fixed", "sliding"])
def problem(request, meshes):
    """Matrix of a stiff ball in a soft block, its rigid motions, loads, and its linear displacements."""
    mesh = meshes.box_mesh(
        6,
        size=50.0,
        tissues=[meshes.known("fat", nu=0.45), meshes.unknown("organ", nu=0.45)],
        region=lambda c: (np.linalg.norm(c - 25.0, axis=1) < 15.0).astype(int),
    )
    space = lagrange_space(mesh, "P2")
    nothing = meshes.prescribe(space, np.zeros(0, int), np.zeros((0, 3)))
    constraint = outer_constraint(space, outer=request.param, **nothing)
    matrix = weighted_sum(np.array([1.0, 20.0]), linear_model(space, constraint).free_stiffness)
    loads = np.random.default_rng(3).standard_normal((matrix.shape[0], 4))
    return matrix, constraint.free.T @ rigid_modes(space.points), loads, linear_displacements(space, constraint)


@pytest.fixture(scope="module")
def ready(problem):
    """The problem's factorisation by a solver's name."""
    return cache(lambda solver: factorise(problem[0], solver=solver, near_nullspace=problem[1]))


def laplacian(n):
    """A one-dimensional chain held at its first node."""
    matrix = sparse.diags_array([-np.ones(n - 1), 2 * np.ones(n), -np.ones(n - 1)], offsets=[-1, 0, 1]).tolil()
    matrix[n - 1, n - 1] = 1.0
    return sparse.csr_matrix(matrix)


@pytest.mark.parametrize("solver", AVAILABLE)
def test_every_solver_inverts_the_stiffness(problem, ready, solver):
    matrix, _, loads, _ = problem
    solution = ready(solver).solve(matrix @ loads)
    assert np.linalg.norm(solution - loads) < 1e-7 * np.linalg.norm(loads)


class Rough:
    """A factorisation whose quick answers are wrong in one column."""

    def __init__(self, inner, wrong):
        self.solve, self.inner, self.wrong = inner.solve, inner, wrong

    def nearly(self, rhs):
        solution = self.inner.nearly(rhs)
        solution[:, self.wrong] *= 1.001
        return solution


@pytest.mark.parametrize("wrong", range(4))
def test_one_quick_answer_that_is_wrong_is_found_among_many(problem, ready, wrong):
    matrix, _, loads, _ = problem
    rough = registry.CheckedFactorisation(
        matrix, Rough(ready("multifrontal-single").inner, wrong), "multifrontal-single"
    )
    missed = np.linalg.norm(matrix @ rough.solve(loads, tolerance=1e-5) - loads, axis=0)
    assert np.all(missed < 1e-5 * np.linalg.norm(loads, axis=0))


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("solver", AVAILABLE)
def test_a_solution_is_as_exact_as_it_was_asked_for(problem, ready, solver, tolerance):
    matrix, _, loads, _ = problem
    solution = ready(solver).solve(loads, tolerance=tolerance)
    missed = np.linalg.norm(matrix @ solution - loads, axis=0) / np.linalg.norm(loads, axis=0)
    assert missed.max() < 1.01 * tolerance


@pytest.mark.parametrize("solver", AVAILABLE)
def test_a_zero_load_gives_a_zero_solution_and_leaves_its_neighbours_alone(solver):
    matrix, loads = laplacian(40), np.random.default_rng(0).standard_normal((40, 3))
    loads[:, 1] = 0.0
    before = loads.copy()
    solution = factorise(matrix, solver=solver, near_nullspace=np.ones((40, 1))).solve(loads)
    assert np.all(solution[:, 1] == 0.0)
    assert np.allclose(matrix @ solution, loads, atol=1e-8)
    assert np.array_equal(loads, before)


@pytest.mark.parametrize("solver", AVAILABLE)
def test_several_factorisations_live_side_by_side(solver):
    loads = np.ones((60, 1))
    first = factorise(laplacian(60), solver=solver, near_nullspace=np.ones((60, 1)))
    second = factorise(5.0 * laplacian(60), solver=solver, near_nullspace=np.ones((60, 1)))
    dropped = factorise(7.0 * laplacian(60), solver=solver, near_nullspace=np.ones((60, 1)))
    del dropped
    gc.collect()
    assert np.allclose(first.solve(loads), 5.0 * second.solve(loads), rtol=1e-7)


@pytest.mark.parametrize("solver", AVAILABLE)
def test_an_indefinite_matrix_is_refused_with_what_to_do(solver):
    matrix = laplacian(40) - 0.5 * sparse.eye_array(40)
    with pytest.raises(SolverError, match="inverted tetrahedra"):
        factorise(sparse.csr_matrix(matrix), solver=solver, near_nullspace=np.ones((40, 1))).solve(np.ones((40, 1)))


@pytest.mark.parametrize("solver", [name for name in AVAILABLE if SOLVERS[name].direct])
@pytest.mark.parametrize("element", ["P1", "P2"])
def test_a_floating_body_is_refused(solver, element, meshes):
    stiffness = tissue_stiffness(lagrange_space(meshes.box_mesh(4, distortion=0.2), element), 0, 0.45)
    with pytest.raises(SolverError, match="hold"):
        factorise(stiffness, solver=solver)


def test_a_solver_that_misses_its_tolerance_is_found_out(registered):
    class Sloppy:
        def solve(self, rhs, **_):
            return 0.4 * rhs

    solver = Solver("sloppy", lambda *_: Sloppy(), False, lambda *_: Expectation(0.0, 0.0), SOLVERS["multigrid"].expect)
    registered(SOLVERS, "sloppy", solver)
    with pytest.raises(SolverError, match="'sloppy' left a relative residual of"):
        factorise(laplacian(10), solver="sloppy").solve(np.ones((10, 1)))


def test_a_load_that_is_no_number_is_refused():
    with pytest.raises(SolverError, match="not finite"):
        factorise(laplacian(10)).solve(np.full((10, 1), np.nan))


def test_a_body_with_no_free_point_is_refused():
    with pytest.raises(SolverError, match="every point of the mesh is prescribed"):
        factorise(sparse.csr_matrix((0, 0)))


def test_an_unknown_solver_is_refused_with_the_known_ones():
    with pytest.raises(ConfigurationError, match="multifrontal"):
        factorise(laplacian(5), solver="magic")


def expecting(monkeypatch, **expected):
    """As if the solvers took so many (seconds, bytes)."""
    for name, (seconds, needed) in expected.items():
        full = name.replace("_", "-")
        known = SOLVERS[full]
        said = Expectation(seconds, needed)
        other = Solver(full, known.factorise, known.direct, lambda *_, said=said: said, lambda *_, said=said: said)
        monkeypatch.setitem(registry.SOLVERS, full, other)


@pytest.mark.parametrize(
    ("free", "chosen"), [(1e9, "multifrontal"), (0.9e9, "multifrontal-single"), (2e6, "multigrid"), (1.0, "multigrid")]
)
def test_the_fastest_solver_that_finds_its_memory_is_chosen(monkeypatch, free, chosen):
    expecting(monkeypatch, multifrontal=(1.0, 0.8e9), multifrontal_single=(2.0, 0.4e9), multigrid=(9.0, 1e6))
    monkeypatch.setattr(registry, "available_memory", lambda: free)
    assert factorise(laplacian(5)).solver == chosen
    monkeypatch.setattr(registry, "available_memory", lambda: 1e12)
    monkeypatch.setattr(registry, "total_memory", lambda: free * registry.USABLE / registry.SHARE)
    assert factorise(laplacian(5)).solver == chosen
    assert registry.expected_of_size(5, 1)[0] == chosen
    assert factorise(laplacian(5), solver="multigrid").solver == "multigrid"


def test_small_bodies_are_factorised_in_double_and_many_solutions_never_iterated():
    assert factorise(laplacian(500)).solver == "multifrontal"
    assert registry.expected_of_size(120_000, 130)[0].startswith("multifrontal")
    assert registry.expected_of_size(3_000_000, 1)[0] == "multigrid"


@pytest.mark.parametrize("solver", AVAILABLE)
def test_what_is_expected_grows_with_the_matrix_and_the_solutions(solver):
    small, large, more = (
        SOLVERS[solver].expect(matrix, Hints(right_hand_sides=m))
        for matrix, m in ((laplacian(100), 1), (laplacian(4000), 1), (laplacian(4000), 50))
    )
    assert small.seconds < large.seconds < more.seconds
    assert small.bytes < large.bytes <= more.bytes


@pytest.mark.parametrize("solver", ["multifrontal", "multifrontal-single"])
def test_sizes_from_unknowns_alone_are_near_those_of_a_mesh(solver, meshes):
    space = lagrange_space(meshes.box_mesh(8, distortion=0.2), "P2")
    constraint = outer_constraint(space, outer="fixed", **meshes.prescribe(space, np.zeros(0, int), np.zeros((0, 3))))
    matrix = weighted_sum(np.array([1.0]), linear_model(space, constraint).free_stiffness)
    exact = SOLVERS[solver].expect(matrix, Hints())
    rough = SOLVERS[solver].expect_of_size(matrix.shape[0], 100)
    assert 0.4 < rough.seconds / exact.seconds < 2.5
    assert 0.4 < rough.bytes / exact.bytes < 2.5


@pytest.mark.parametrize("solver", AVAILABLE)
def test_a_rough_solution_preconditions_conjugate_gradients(problem, solver):
    matrix, motions, loads, coarser = problem
    ready = factorise(matrix, solver=solver, near_nullspace=motions, coarser=coarser)
    _, steps = conjugate_gradients(
        partial(times, 1.3 * matrix), loads, ready.nearly, tolerance=1e-10, max_iterations=50
    )
    assert steps <= 3


def test_each_column_of_conjugate_gradients_has_its_tolerance(problem):
    matrix, _, loads, _ = problem
    two = np.column_stack([loads[:, 0], loads[:, 0]])
    nearly = 1.0 / matrix.diagonal()[:, None]
    tolerances = np.array([1e-2, 1e-8])
    found, _ = conjugate_gradients(
        partial(times, matrix), two, lambda r: nearly * r, tolerance=tolerances, max_iterations=4000
    )
    left = np.linalg.norm(two - matrix @ found, axis=0) / np.linalg.norm(two, axis=0)
    assert np.all(left < 1.01 * tolerances)
    assert left[0] > 1e-5  # it stopped where it was asked to


def test_twin_rows_are_the_unknowns_of_one_node(problem, meshes):
    space = lagrange_space(meshes.box_mesh(2), "P2")
    assert np.array_equal(twin_rows(tissue_stiffness(space, 0, 0.3)), np.repeat(np.arange(len(space.points)), 3))
    assert np.all(np.bincount(twin_rows(problem[0])) <= 3)


def test_nested_dissection_orders_every_unknown_once_and_spares_fill(problem):
    assert np.array_equal(np.sort(nested_dissection(problem[0])), np.arange(problem[0].shape[0]))
    part = problem[0].shape[0] // 3  # a factor of all in their natural order takes ten seconds
    matrix = problem[0][:part][:, :part]
    order = nested_dissection(matrix)
    options = {"permc_spec": "NATURAL", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    natural, dissected = (splu(sparse.csc_matrix(m), **options).L.nnz for m in (matrix, matrix[order][:, order]))
    assert dissected < 0.7 * natural


def test_a_pattern_that_lost_an_entry_on_one_side_is_ordered_all_the_same(problem):
    matrix = problem[0].copy()
    row = matrix.indices[matrix.indptr[7] : matrix.indptr[8]]
    matrix.data[matrix.indptr[7] + int(np.flatnonzero(row > 7)[0])] = 0.0
    matrix.eliminate_zeros()
    assert np.array_equal(np.sort(nested_dissection(matrix)), np.arange(matrix.shape[0]))


def test_linear_displacements_are_linear_between_the_corners(meshes):
    space = lagrange_space(meshes.box_mesh(3), "P2")
    nothing = meshes.prescribe(space, np.zeros(0, int), np.zeros((0, 3)))
    constraint = outer_constraint(space, outer="sliding", **nothing)
    coarser = linear_displacements(space, constraint)
    assert np.array_equal(coarser.prolongation[coarser.kept].toarray(), np.eye(len(coarser.kept)))
    inner = np.all((space.points > 1e-6) & (space.points < space.points.max() - 1e-6), axis=1)
    bent = space.points**3 * np.where(inner, 1.0, 0.0)[:, None]
    ends = bent.ravel()[: 3 * len(space.mesh.nodes)]
    made = constraint.free @ coarser.prolongation @ (constraint.free[: len(ends)][:, coarser.kept].T @ ends)
    middles = bent[space.edges].mean(axis=1)
    free = np.asarray(abs(constraint.free).sum(axis=1)).ravel()[len(ends) :].reshape(-1, 3) > 0
    assert np.allclose(made.reshape(-1, 3)[len(space.mesh.nodes) :][free], middles[free])
    assert linear_displacements(lagrange_space(space.mesh, "P1"), constraint) is None


def test_multigrid_through_linear_elements_takes_fewer_steps_to_the_same_answer(problem, ready):
    matrix, motions, loads, coarser = problem
    steps = []
    for found in (
        ready("multigrid"),
        factorise(matrix, solver="multigrid", near_nullspace=motions, coarser=coarser),
    ):
        assert np.allclose(found.solve(matrix @ loads), loads, atol=1e-6 * np.abs(loads).max())
        steps.append(
            conjugate_gradients(partial(times, matrix), loads, found.inner.cycle, tolerance=1e-8, max_iterations=200)[1]
        )
    assert steps[1] < steps[0]
