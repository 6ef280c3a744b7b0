"""Systems of all unknowns, solved image by image: the same answers as of the whole matrix."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.inversion.by_image import among, log_determinant, shared_by, solve_by_image
from palpate.inversion.objective import Evaluation

SIZES = (2, 4, 3, 5)  # of the shared unknowns, and of those of three images


@pytest.fixture
def images():
    """Numbers of the images' unknowns, which stand mixed with the shared ones."""
    order, ends = np.random.default_rng(3).permutation(sum(SIZES)), np.cumsum(SIZES)
    return tuple(np.sort(part) for part in np.split(order, ends[:-1])[1:])


@pytest.fixture
def arrow(images):
    """A positive definite matrix in which unknowns of two images never meet."""
    rng, n = np.random.default_rng(7), sum(SIZES)
    shared, matrix = shared_by(images, n), np.eye(n)
    for own in images:
        together = np.concatenate([shared, own])
        root = rng.normal(size=(20, len(together)))
        matrix[np.ix_(together, together)] += root.T @ root
    return matrix


def test_a_solution_is_that_of_the_whole_matrix(arrow, images):
    rhs = np.random.default_rng(1).normal(size=(len(arrow), 3))
    assert solve_by_image(arrow, rhs, images) == pytest.approx(np.linalg.solve(arrow, rhs), rel=1e-10)


def test_so_is_a_determinant(arrow, images):
    assert log_determinant(arrow, images) == pytest.approx(np.linalg.slogdet(arrow)[1], rel=1e-12)


def test_unknowns_keep_their_image_where_some_are_left_out(arrow, images):
    kept = np.arange(len(arrow)) % 4 != 1
    within = arrow[np.ix_(kept, kept)]
    assert log_determinant(within, among(images, kept)) == pytest.approx(np.linalg.slogdet(within)[1], rel=1e-12)


def test_a_posterior_is_that_of_the_whole_matrix(arrow, images):
    """Of unknowns that images share, as the log-moduli are: the first ones here."""
    n, k = len(arrow), 2
    order = np.concatenate([shared_by(images, n), *images])
    matrix, nothing = arrow[np.ix_(order, order)], np.zeros(n)
    own = tuple(np.flatnonzero(np.isin(order, numbers)) for numbers in images)
    evaluations = [
        Evaluation(0.0, 0.0, nothing, matrix, (), np.zeros((n, n)), nothing, numbers) for numbers in (own, ())
    ]
    by_image, at_once = (evaluation.covariance_columns(k) for evaluation in evaluations)
    assert by_image == pytest.approx(at_once, rel=1e-10)


@pytest.mark.parametrize("still", [[0], [1], [0, 1]])
def test_a_modulus_that_moves_nothing_leaves_the_others_their_variance(arrow, images, still):
    n, k = len(arrow), 2
    order = np.concatenate([shared_by(images, n), *images])
    own = tuple(np.flatnonzero(np.isin(order, numbers)) for numbers in images)
    matrix, nothing = arrow[np.ix_(order, order)], np.zeros(n)
    matrix[still], matrix[:, still] = 0.0, 0.0
    found = Evaluation(0.0, 0.0, nothing, matrix, (), 0.0 * matrix, nothing, own).covariance_columns(k)
    kept = np.setdiff1d(np.arange(n), still)
    moved = np.setdiff1d(np.arange(k), still)
    assert np.isinf(found[still, still]).all()
    inverse = np.linalg.inv(matrix[np.ix_(kept, kept)])
    assert found[np.ix_(kept, moved)] == pytest.approx(inverse[:, : len(moved)], rel=1e-10)
