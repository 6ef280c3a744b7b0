"""Matrices of all unknowns, kept and solved image by image: the same answers as of the whole matrix."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.inversion.objective import Evaluation
from palpate.unknowns import Arrowhead, Places

SIZES = (2, 4, 3, 5)  # of the shared unknowns, and of those of three images
N = sum(SIZES)


def several(seed=3):
    """Numbers of the images' unknowns, which stand mixed with the shared ones."""
    order, ends = np.random.default_rng(seed).permutation(N), np.cumsum(SIZES)
    return tuple(np.sort(part) for part in np.split(order, ends[:-1])[1:])


ONE = (np.arange(2, N),)
LAYOUTS = {"three images": several(), "one image": ONE, "no image": (), "one of nothing": (np.zeros(0, dtype=int),)}


@pytest.fixture(params=LAYOUTS, ids=str)
def images(request):
    return LAYOUTS[request.param]


def drawn(images, seed=7):
    """A positive definite matrix in which unknowns of two images never meet."""
    rng, matrix = np.random.default_rng(seed), np.eye(N)
    shared = np.setdiff1d(np.arange(N), np.concatenate([np.zeros(0, dtype=int), *images]))
    for own in images or [shared[:0]]:
        together = np.concatenate([shared, own])
        root = rng.normal(size=(20, len(together)))
        matrix[np.ix_(together, together)] += root.T @ root
    return matrix


@pytest.fixture
def dense(images):
    return drawn(images)


@pytest.fixture
def arrow(dense, images):
    return Arrowhead.of(dense, images)


def values(*shape):
    return np.random.default_rng(1).normal(size=(N, *shape))


def test_it_holds_all_of_a_matrix_and_its_sums(arrow, dense, images):
    other, along = drawn(images, 8), values()
    second = Arrowhead.of(other, images)
    assert np.array_equal(arrow.dense, dense)
    assert np.array_equal(arrow.diagonal, np.diag(dense))
    assert (arrow + second).dense == pytest.approx(dense + other)
    assert (arrow - second).dense == pytest.approx(dense - other)
    assert arrow.plus_diagonal(along).dense == pytest.approx(dense + np.diag(along))
    assert not Arrowhead.zeros(arrow.places).dense.any()


@pytest.mark.parametrize("shape", [(), (3,)])
def test_products_and_solutions_are_those_of_the_whole_matrix(arrow, dense, shape):
    rhs = values(*shape)
    assert arrow @ rhs == pytest.approx(dense @ rhs, rel=1e-10)
    assert arrow.solve(rhs) == pytest.approx(np.linalg.solve(dense, rhs), rel=1e-10)


def test_so_is_a_determinant(arrow, dense):
    assert arrow.log_determinant() == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-12)


def test_so_is_every_part_of_it_and_of_its_inverse(arrow, dense):
    rng = np.random.default_rng(2)
    rows, columns = rng.permutation(N)[:9], rng.permutation(N)[:7]
    assert np.array_equal(arrow.block(rows, columns), dense[np.ix_(rows, columns)])
    inverse = np.linalg.inv(dense)[np.ix_(rows, rows)]
    assert arrow.eliminated().inverse_among(rows) == pytest.approx(inverse, rel=1e-10)


def test_unknowns_keep_their_image_where_some_are_left_out(arrow, dense):
    kept = np.arange(N) % 4 != 1
    within, rhs = dense[np.ix_(kept, kept)], values()[kept]
    assert np.array_equal(arrow.among(kept).dense, within)
    assert arrow.among(kept).solve(rhs) == pytest.approx(np.linalg.solve(within, rhs), rel=1e-10)


def test_what_observations_of_an_image_add_is_added_to_its_unknowns_and_the_shared_ones(arrow, dense, images):
    blocks, expected = [], dense.copy()
    for own in images or [np.zeros(0, dtype=int)]:
        numbers = np.random.default_rng(5).permutation(np.concatenate([arrow.places.shared, own[1:]]))
        root = values(len(numbers))
        blocks.append((numbers, root.T @ root))
        expected[np.ix_(numbers, numbers)] += root.T @ root
    assert arrow.plus(blocks).dense == pytest.approx(expected)
    assert np.array_equal(arrow.dense, dense)


def test_others_are_eliminated_from_what_is_left_of_some_unknowns(arrow, dense, images):
    rhs = values()
    for own in (numbers[1:] for numbers in (*images, arrow.places.shared) if len(numbers) > 1):
        rest = np.setdiff1d(np.arange(N), own)
        across = np.linalg.solve(dense[np.ix_(rest, rest)], dense[np.ix_(rest, own)])
        matrix, right = arrow.complement(own, rhs)
        assert matrix == pytest.approx(dense[np.ix_(own, own)] - dense[np.ix_(own, rest)] @ across, rel=1e-9)
        assert right == pytest.approx(rhs[own] - across.T @ rhs[rest], rel=1e-9)


def test_other_coordinates_of_the_shared_unknowns_are_those_of_the_whole_matrix(arrow, dense):
    shared = arrow.places.shared
    turn, whole = np.random.default_rng(4).normal(size=(len(shared),) * 2), np.eye(N)
    whole[np.ix_(shared, shared)] = turn
    assert arrow.turned(turn).dense == pytest.approx(whole.T @ dense @ whole, rel=1e-10, abs=1e-10)


def test_an_unknown_that_nothing_depends_on_stands_alone(images):
    dense = drawn(images)
    dense[3], dense[:, 3] = 0.0, 0.0
    arrow, kept = Arrowhead.of(dense, images), np.arange(N) != 3
    within = np.linalg.slogdet(dense[np.ix_(kept, kept)])[1]
    assert arrow.grounded().log_determinant() == pytest.approx(within, rel=1e-12)


def test_a_singular_matrix_has_no_solution(images):
    with pytest.raises(np.linalg.LinAlgError):
        Arrowhead.zeros(Places.of(N, images)).solve(values())


def ordered():
    """The dense matrix with the unknowns that three images share first, as the log-moduli are; the images' numbers."""
    images = several()
    order = np.concatenate([np.setdiff1d(np.arange(N), np.concatenate(images)), *images])
    return drawn(images)[np.ix_(order, order)], tuple(np.flatnonzero(np.isin(order, own)) for own in images)


def posterior(matrix, images):
    arrow, nothing = Arrowhead.of(matrix, images), np.zeros(N)
    return Evaluation(0.0, 0.0, nothing, arrow, (), Arrowhead.zeros(arrow.places), nothing)


def test_a_posterior_is_that_of_the_whole_matrix():
    """Of unknowns that images share, as the log-moduli are."""
    matrix, images = ordered()
    by_image, at_once = (posterior(matrix, own).covariance_columns(2) for own in (images, ()))
    assert by_image == pytest.approx(at_once, rel=1e-10)


@pytest.mark.parametrize("still", [[0], [1], [0, 1]])
def test_a_modulus_that_moves_nothing_leaves_the_others_their_variance(still):
    matrix, images = ordered()
    matrix[still], matrix[:, still] = 0.0, 0.0
    found = posterior(matrix, images).covariance_columns(2)
    kept, moved = np.setdiff1d(np.arange(N), still), np.setdiff1d(np.arange(2), still)
    assert np.isinf(found[still, still]).all()
    inverse = np.linalg.inv(matrix[np.ix_(kept, kept)])
    assert found[np.ix_(kept, moved)] == pytest.approx(inverse[:, : len(moved)], rel=1e-10)
