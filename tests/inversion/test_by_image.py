"""Systems of all unknowns, solved image by image: the same answers as of the whole matrix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.inversion.by_image import among, log_determinant, shared_by, solve_by_image
from palpate.inversion.hyper_parameters import normal_model
from palpate.inversion.objective import Evaluation
from palpate.unknowns import Block, ParameterMap
from palpate.unknowns.blocks import Acts

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


def block(of, n, states, **more):
    terms = tuple((share * np.eye(n),) for share in (1.0, 9.0))
    return Block(of, "frame", Acts.BOUNDARY, states, np.eye(n), terms, odds=(0.0, -1.0), **more)


def problem(states):
    """A map of one modulus, a block of each of two images in `states`, and one that both share; its evaluation."""
    blocks = (block("a", 3, states[0]), block("b", 2, states[1]), block("tissue", 2, (0, 1)))
    base = np.array([10.0, 10.0])
    parameters = ParameterMap(base, np.array([[1.0], [0.0]]), ("organ",), "rest", True, blocks)
    rng, n = np.random.default_rng(5), parameters.n_unknowns
    data, score = np.zeros((n, n)), np.zeros(n)
    for own in ((0, 1, 2, 3, 6, 7), (0, 4, 5, 6, 7)):  # what each image depends on
        root = rng.normal(size=(30, len(own)))
        data[np.ix_(own, own)] += root.T @ root
        score[list(own)] += root.T @ rng.normal(size=30)
    prior = parameters.prior_matrix
    x = rng.normal(size=n)
    pull = prior @ (x - parameters.prior_centre)
    return parameters, Evaluation(0.0, 0.0, score + pull, data + prior, (), prior, pull, parameters.images), x


def test_what_data_say_of_a_block_is_the_same_image_by_image():
    """The evidence of every alternative of every block, before and after another block has got another prior."""
    alone, whole = (normal_model(*problem(states)) for states in (((0,), (1,)), ((0, 1), (0, 1))))
    assert len(alone.parameters.images) == 2
    assert whole.parameters.images == ()
    for models in ((alone, whole), tuple(model.believing(1, 0.3 * np.eye(2)) for model in (alone, whole))):
        for i in range(3):
            by_image, at_once = (model.beliefs(i, (None,) * 3) for model in models)
            assert [b.evidence for b in by_image] == pytest.approx([b.evidence for b in at_once], rel=1e-6)
            for one, other in zip(by_image, at_once, strict=True):
                assert one.covariance == pytest.approx(other.covariance, rel=1e-4)


def test_a_prior_mean_is_not_dropped_where_an_image_follows():
    (parameters, evaluation, x), _ = problem(((0,), (1,))), None
    shifted = parameters.with_prior(np.array([0.7]), np.array([0.1]))
    prior = shifted.prior_matrix
    pull, matrix = prior @ (x - shifted.prior_centre), evaluation.matrix - evaluation.prior + prior
    score = evaluation.score - evaluation.prior_score + pull
    there = replace(evaluation, score=score, matrix=matrix, prior=prior, prior_score=pull)
    model = normal_model(shifted, there, x)
    best = solve_by_image(model.data + model.prior, model.pull[:, None], parameters.images)[:, 0]
    assert best == pytest.approx(x - np.linalg.solve(there.matrix, there.score), rel=1e-8)
