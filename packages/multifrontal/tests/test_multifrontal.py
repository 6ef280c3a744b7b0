"""The multifrontal solver: right for every pattern, on any number of threads, within the memory that it announces."""

from __future__ import annotations

import threading
import tracemalloc

import numpy as np
import pytest
import threadpoolctl
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

import multifrontal
from multifrontal import NotPositiveDefinite, dense, plan, symbolic
from multifrontal.numeric import FEW, LARGEST_BLOCK, SHARED
from multifrontal.plan import make_plan


def stiffness(pairs, sizes, seed, *, shift=0.1):
    """A positive definite matrix of nodes with `sizes` unknowns, with full blocks where `pairs` (m, 2) are joined."""
    rng = np.random.default_rng(seed)
    offset = np.concatenate([[0], np.cumsum(sizes)])
    rows, columns, data = [np.arange(offset[-1])], [np.arange(offset[-1])], [np.full(offset[-1], shift)]
    for i, j in [*pairs, *((k, k) for k in range(len(sizes)))]:
        members = np.unique(np.concatenate([np.arange(offset[i], offset[i + 1]), np.arange(offset[j], offset[j + 1])]))
        root = rng.standard_normal((len(members), len(members)))
        rows.append(np.repeat(members, len(members)))
        columns.append(np.tile(members, len(members)))
        data.append((root @ root.T).ravel())
    n = int(offset[-1])
    return sparse.csr_matrix((np.concatenate(data), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n))


def cube(n):
    """Neighbours of a grid of n^3 nodes, diagonals of cells included."""
    index = np.arange(n**3).reshape(n, n, n)
    steps = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1)]
    found = [np.stack([index[: n - a, : n - b, : n - c].ravel(), index[a:, b:, c:].ravel()], 1) for a, b, c in steps]
    return np.concatenate(found)


def mixed_blocks(n, seed):
    """Nodes with one, two or three unknowns, as sliding boundaries leave them."""
    return np.random.default_rng(seed).integers(1, 4, n)


def scattered(n, m, seed):
    """Random pairs, many nodes alone or in small components."""
    return np.random.default_rng(seed).integers(0, n, (m, 2))


PATTERNS = {
    "one unknown": lambda: stiffness([], [1], 0),
    "one node": lambda: stiffness([], [3], 0),
    "no couplings": lambda: stiffness([], np.ones(30, int), 0),
    "full": lambda: stiffness([(0, j) for j in range(30)] + [(i, j) for i in range(30) for j in range(i)], [3] * 30, 1),
    "a dense row": lambda: stiffness([(7, j) for j in range(60)], np.ones(60, int), 2),
    "a chain": lambda: stiffness([(i, i + 1) for i in range(400)], np.full(401, 2), 3),
    "components": lambda: stiffness(scattered(300, 200, 4), mixed_blocks(300, 4), 4),
    "random": lambda: stiffness(scattered(200, 500, 5), mixed_blocks(200, 5), 5),
    "a cube": lambda: stiffness(cube(7), np.full(343, 3), 6),
    "a sliding cube": lambda: stiffness(cube(6), mixed_blocks(216, 7), 7),
    "two cubes": lambda: stiffness(np.concatenate([cube(5), cube(5) + 125]), np.full(250, 3), 8),
}


@pytest.fixture(params=list(PATTERNS), scope="module")
def matrix(request):
    return PATTERNS[request.param]()


@pytest.fixture(scope="module")
def body():
    return PATTERNS["a cube"]()


def relative_residual(matrix, found, rhs):
    return np.max(np.linalg.norm(matrix @ found - rhs, axis=0) / np.linalg.norm(rhs, axis=0))


def factor_of(matrix, threads, dtype=np.float64):
    return multifrontal.factorise(matrix, dtype=dtype, plan=make_plan(matrix, threads))


@pytest.mark.parametrize(("threads", "columns"), [(1, 1), (2, 1), (2, 7), (5, 91)])
def test_every_pattern_is_solved_to_rounding(matrix, threads, columns):
    rhs = np.random.default_rng(1).standard_normal((matrix.shape[0], columns))
    before = rhs.copy()
    plan_of_it = multifrontal.analyse(matrix, threads=threads)
    found = multifrontal.factorise(matrix, plan=plan_of_it).solve(rhs)
    assert relative_residual(matrix, found, rhs) < 1e-12
    assert np.array_equal(rhs, before)


def test_single_precision_is_near_and_refined_by_conjugate_gradients(body):
    factor, rhs = multifrontal.factorise(body, dtype=np.float32), np.ones(body.shape[0])
    near = factor.solve(rhs)
    assert near.dtype == np.float64
    assert 1e-9 < relative_residual(body, near[:, None], rhs[:, None]) < 1e-2
    found, steps = cg(body, rhs, rtol=1e-12, M=LinearOperator(body.shape, factor.solve), maxiter=8)
    assert steps == 0
    assert relative_residual(body, found[:, None], rhs[:, None]) < 1e-11


@pytest.mark.parametrize("unit", [1e-60, 1.0, 1e60])
@pytest.mark.parametrize("columns", [3, 9])
def test_single_precision_has_the_range_of_double(body, unit, columns):
    rhs = np.random.default_rng(5).standard_normal((body.shape[0], columns)) * np.logspace(-80.0, 80.0, columns)
    found = multifrontal.factorise(unit * body, dtype=np.float32).solve(rhs)
    assert relative_residual(unit * body, found, rhs) < 1e-3


def test_a_right_hand_side_of_nothing_has_no_answer_but_nothing(body):
    assert not np.any(multifrontal.factorise(body, dtype=np.float32).solve(np.zeros((body.shape[0], 2))))


def test_one_right_hand_side_may_be_a_vector(body):
    factor, rhs = multifrontal.factorise(body), np.random.default_rng(2).standard_normal((body.shape[0], 3))
    assert np.allclose(factor.solve(rhs[:, 1]), factor.solve(rhs)[:, 1], rtol=1e-12, atol=0)


@pytest.mark.parametrize(("dtype", "limit"), [(np.float64, 1e-11), (np.float32, 1e-4)])
@pytest.mark.parametrize("columns", [1, FEW, FEW + 1, SHARED - 1, SHARED, 2 * LARGEST_BLOCK + 1])
def test_any_number_of_right_hand_sides_is_served(columns, dtype, limit):
    matrix = stiffness(cube(11), np.full(1331, 3), 9)
    factor = factor_of(matrix, 2, dtype)
    roots = [factor.plan.fronts[subtree.stop - 1] for step in factor.plan.steps for subtree in step.subtrees]
    assert sum(len(root.rows) > 0 for root in roots) > 1
    rhs = np.random.default_rng(4).standard_normal((matrix.shape[0], columns))
    assert relative_residual(matrix, factor.solve(rhs), rhs) < limit


def test_columns_instead_of_rows_are_taken_too(body):
    rhs = np.ones((body.shape[0], 1))
    assert relative_residual(body, multifrontal.factorise(sparse.csc_array(body)).solve(rhs), rhs) < 1e-12


def test_threads_change_nothing_but_rounding(body):
    rhs = np.random.default_rng(3).standard_normal((body.shape[0], SHARED + 8))
    found = [factor_of(body, threads).solve(rhs) for threads in (1, 2, 3, 8)]
    for other in found[1:]:
        assert np.allclose(other, found[0], rtol=1e-11, atol=1e-13 * np.abs(found[0]).max())


def test_the_same_threads_give_the_same_bits(body):
    first, second = (factor_of(body, 3).numbers for _ in range(2))
    assert np.array_equal(first, second)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("threads", [1, 4])
def test_an_indefinite_matrix_is_refused_with_its_pivot(body, dtype, threads):
    shifted = body.copy()
    shifted.setdiag(body.diagonal() - 20.0)
    with pytest.raises(NotPositiveDefinite, match="pivot") as refused:
        factor_of(shifted, threads, dtype)
    assert refused.value.n == body.shape[0]
    assert 0 < refused.value.pivot <= body.shape[0]


def row_of_springs(n):
    """Held at one end: a force of 1 at the other moves that by n."""
    stiff = np.append(np.full(n - 1, 2.0), 1.0)
    return sparse.csr_matrix(sparse.diags_array([stiff, -np.ones(n - 1), -np.ones(n - 1)], offsets=[0, 1, -1]))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("coupling", [1.0, 1e-6])
@pytest.mark.parametrize("part", [sparse.tril, sparse.triu])
def test_one_triangle_alone_is_refused_however_weak_its_couplings(part, coupling, dtype):
    """Else a row of 20 springs would give 3 or 1 for 20, as the triangle is the lower or the upper one."""
    springs, end = row_of_springs(20), np.eye(20)[-1]
    assert multifrontal.factorise(springs).solve(end)[-1] == pytest.approx(20.0, rel=1e-12)
    diagonal = sparse.diags_array(springs.diagonal())
    one = sparse.csr_matrix(diagonal + coupling * (part(springs) - diagonal))
    for plan_of_it in (None, multifrontal.analyse(one)):
        with pytest.raises(ValueError, match="one triangle alone of the matrix of 20 unknowns"):
            multifrontal.factorise(one, dtype=dtype, plan=plan_of_it)


def test_a_matrix_whose_triangles_differ_is_refused(body):
    """Zeros stored in one triangle, one entry that its mirror image has not, another sign: none is symmetric."""
    zeros, lost, turned = body.copy(), body.tolil(), body.tolil()
    zeros.data[body.indices > np.repeat(np.arange(body.shape[0]), np.diff(body.indptr))] = 0.0
    row = 100
    column = int(np.argmax(np.abs(body[[row]].toarray()[0, :row])))
    lost[row, column] = 0.0
    turned[row, column] *= -1.0
    for matrix in (zeros, sparse.csr_matrix(lost), sparse.csr_matrix(turned)):
        with pytest.raises(ValueError, match="of 1029 unknowns is not symmetric: row and column"):
            multifrontal.factorise(matrix)


def test_one_pattern_is_analysed_once(body):
    first = multifrontal.analyse(body)
    assert multifrontal.analyse(2.0 * body) is first
    assert multifrontal.factorise(3.0 * body).plan is first
    assert multifrontal.analyse(PATTERNS["random"]()) is not first


def test_an_entry_that_is_missing_on_one_side_is_taken_from_neither_or_both(body):
    far = np.flatnonzero(np.abs(body.data) < 1e-2)[:40]
    lost = body.copy()
    lost.data[far[::2]] = 0.0
    lost.eliminate_zeros()
    rhs = np.ones((body.shape[0], 1))
    found = multifrontal.factorise(lost).solve(rhs)
    assert relative_residual(body, found, rhs) < 0.1


def test_entries_in_any_order_and_in_parts_are_summed():
    matrix = PATTERNS["random"]()
    entries = sparse.coo_matrix(matrix)
    order = np.random.default_rng(4).permutation(2 * entries.nnz)
    rows, columns = np.tile(entries.row, 2)[order], np.tile(entries.col, 2)[order]
    bounds = np.searchsorted(np.sort(rows), np.arange(matrix.shape[0] + 1))
    by_row = np.argsort(rows, kind="stable")
    parts = (np.tile(0.5 * entries.data, 2)[order][by_row], columns[by_row], bounds)
    rhs = np.ones((matrix.shape[0], 1))
    found = multifrontal.factorise(sparse.csr_matrix(parts, shape=matrix.shape)).solve(rhs)
    assert relative_residual(matrix, found, rhs) < 1e-12


@pytest.mark.parametrize("threads", [1, 3])
def test_the_memory_announced_is_the_memory_taken(threads):
    matrix = stiffness(cube(12), np.full(1728, 3), 10)
    ready = multifrontal.analyse(matrix, threads=threads)
    needed = ready.bytes(np.float64)
    tracemalloc.start()
    try:
        factor = multifrontal.factorise(matrix, plan=ready)
        taken = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert needed < taken < 1.15 * needed
    assert factor.numbers.nbytes < needed


def blas_threads():
    return [library["num_threads"] for library in threadpoolctl.threadpool_info() if library["user_api"] == "blas"]


def test_no_changed_number_of_blas_threads_is_left_behind(body):
    with threadpoolctl.threadpool_limits(2, user_api="blas"):  # this thread's, so the limits below are nested
        before = blas_threads()
        assert set(before) == {2}
        multifrontal.factorise(body).solve(np.ones((body.shape[0], 4)))
        with pytest.raises(NotPositiveDefinite):
            multifrontal.factorise(-body)
        assert blas_threads() == before


def test_calls_side_by_side_and_nested_share_the_limit_and_restore_the_number_of_blas_threads():
    together, seen = threading.Barrier(4), list[int]()

    def work():
        with dense.blas_on_one_thread():
            together.wait(timeout=60.0)  # all of them inside at once
            with dense.blas_on_one_thread():
                seen.extend(blas_threads())
            together.wait(timeout=60.0)

    workers = [threading.Thread(target=work) for _ in range(4)]
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        assert set(blas_threads()) == {2}
    assert len(seen) >= 4
    assert set(seen) == {1}


def test_a_limit_that_one_thread_sets_another_one_lifts_while_the_first_lives():
    inside, leave, left, end = (threading.Event() for _ in range(4))

    def first():
        with dense.blas_on_one_thread():
            inside.set()
            leave.wait(timeout=60.0)
        left.set()
        end.wait(timeout=60.0)

    worker = threading.Thread(target=first)
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        worker.start()
        inside.wait(timeout=60.0)
        with dense.blas_on_one_thread():
            leave.set()
            left.wait(timeout=60.0)
            assert set(blas_threads()) == {1}
        assert set(blas_threads()) == {2}
    end.set()
    worker.join()


def eliminated(matrix):
    """Pattern (n, n) of the factor, by elimination step by step."""
    filled = np.tril(matrix.toarray() != 0.0)
    for j in range(len(filled)):
        below = np.flatnonzero(filled[:, j])
        below = below[below > j]
        filled[np.ix_(below, below)] |= np.tril(np.ones((len(below), len(below)), bool))
    return filled


def test_tree_and_counts_are_those_of_elimination():
    matrix = PATTERNS["random"]()
    lower = sparse.csr_matrix(sparse.tril(matrix, -1))
    filled = eliminated(matrix)
    n = matrix.shape[0]
    below = [np.flatnonzero(filled[j + 1 :, j]) + j + 1 for j in range(n)]
    parent = symbolic.elimination_tree(lower)
    assert parent.tolist() == [int(rows[0]) if len(rows) else -1 for rows in below]
    order = symbolic.postorder(parent)
    again = sparse.csr_matrix(sparse.tril(matrix[order][:, order], -1))
    again.sort_indices()
    tree = symbolic.elimination_tree(again)
    weight = np.random.default_rng(5).integers(1, 4, n)
    expected = (eliminated(matrix[order][:, order]) * weight[:, None]).sum(axis=0)
    assert np.array_equal(symbolic.column_counts(again, tree, weight), expected)


def test_fronts_hold_all_that_elimination_fills_and_little_more():
    matrix = PATTERNS["a cube"]()
    steps = make_plan(matrix, 1)
    filled = eliminated(matrix[steps.order][:, steps.order])
    held = np.zeros_like(filled)
    for front in steps.fronts:
        columns = np.arange(front.first, front.first + front.width)
        held[np.ix_(np.concatenate([columns, front.rows]), columns)] = True
    assert not np.any(filled & ~held)
    assert np.tril(held).sum() < 1.6 * filled.sum()


def test_supernodes_come_after_their_children_with_each_node_once():
    graph = sparse.csr_matrix(stiffness(cube(6), np.ones(216, int), 12))
    graph.setdiag(0.0)
    graph.eliminate_zeros()
    found = symbolic.supernodes(graph, np.random.default_rng(6).permutation(216), np.full(216, 3))
    assert np.array_equal(np.sort(found.order), np.arange(216))
    parents = found.parent
    assert all(above == -1 or above > s for s, above in enumerate(parents))
    for s, rows in enumerate(found.rows):
        assert np.all(rows >= found.start[s + 1])
        if parents[s] >= 0:
            above = np.concatenate(
                [np.arange(found.start[parents[s]], found.start[parents[s] + 1]), found.rows[parents[s]]]
            )
            assert np.isin(rows, above).all()


def test_refinement_lays_what_descendants_fill_side_by_side():
    rng = np.random.default_rng(7)
    places = rng.permutation(40)
    halves = [np.sort(4 + places[low : low + 20]) for low in (0, 15)]
    quarter = np.sort(4 + places[2:9])
    below = [quarter, halves[0], halves[1], np.zeros(0, int)]
    below[0] = np.sort(np.concatenate([[1], quarter]))
    start = np.array([0, 1, 2, 4, 44])
    order = symbolic.refined_order(start, [[], [0], [], [1, 2]], below)
    assert np.array_equal(np.sort(order[4:]), np.arange(4, 44))
    for rows in (halves[0], halves[1], quarter):
        found = np.sort(np.argsort(order)[rows])
        assert np.all(np.diff(found) == 1)


def test_subtrees_and_the_fronts_above_are_each_eliminated_once_and_in_order():
    matrix = stiffness(cube(9), np.full(729, 3), 13)
    for threads in (1, 2, 4):
        steps = make_plan(matrix, threads)
        seen = []
        for step in steps.steps:
            for number in [*(s for subtree in step.subtrees for s in subtree), *step.then]:
                assert set(steps.fronts[number].children) <= set(seen)
                seen.append(number)
        assert sorted(seen) == list(range(len(steps.fronts)))
        assert threads == 1 or any(len(step.subtrees) > 1 for step in steps.steps)


def test_contributions_never_share_memory_while_they_live():
    matrix = stiffness(cube(9), np.full(729, 3), 14)
    for threads in (1, 2, 4):
        steps = make_plan(matrix, threads)
        owner = np.full(steps.work_size, -1)
        for step in steps.steps:
            for number in [*(s for subtree in step.subtrees for s in subtree), *step.then]:
                front = steps.fronts[number]
                size = plan._kept(len(front.rows))
                for child in front.children:
                    low = steps.fronts[child].contribution
                    kept = owner[low : low + plan._kept(len(steps.fronts[child].rows))]
                    assert np.all(kept == child)
                low = front.contribution
                assert low + size <= steps.work_size
                overwritten = set(owner[low : low + size].tolist()) - {-1}
                assert not overwritten & set(front.children)
                owner[low : low + size] = number


class Libraries:
    """One number of threads for the whole process, as a BLAS has it."""

    threads = 2
    lib_controllers = ()

    def limit(self, *, limits, user_api):
        assert user_api == "blas"
        before, self.threads = self.threads, limits
        return Limit(self, before)


class Limit:
    """What sets back the number of threads that it found."""

    def __init__(self, libraries, before):
        self.libraries, self.before = libraries, before

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.libraries.threads = self.before


@pytest.fixture
def libraries(monkeypatch):
    found = Libraries()
    monkeypatch.setattr(dense, "_libraries", lambda: found)
    return found


def test_blas_computes_on_one_thread_until_the_last_of_several_callers_has_ended(libraries):
    """The first one sets the limit, and ends before the second."""
    inside, over = threading.Event(), threading.Event()

    def first():
        with dense.blas_on_one_thread():
            inside.set()
            over.wait(10.0)

    other = threading.Thread(target=first)
    other.start()
    assert inside.wait(10.0)
    with dense.blas_on_one_thread():
        over.set()
        other.join(10.0)
        assert libraries.threads == 1
    assert libraries.threads == 2


def test_an_error_inside_lifts_the_limit():
    controller = threadpoolctl.ThreadpoolController().select(user_api="blas")

    def threads():
        return {library["num_threads"] for library in controller.info()}

    @dense.blas_on_one_thread()
    def failing():
        with dense.blas_on_one_thread():
            assert threads() == {1}
            raise ZeroDivisionError

    with controller.limit(limits=2):
        with pytest.raises(ZeroDivisionError):
            failing()
        assert threads() == {2}
