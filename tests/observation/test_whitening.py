"""Correlated errors made independent: W C W^T is nearly 1, at a cost that grows with the number of points."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.observation.noise_model import AT_ONCE, GROWTH, NEIGHBOURS, correlation, whitener


def covariance_of(groups, length):
    """Covariance (n, n) of the means, in full."""
    apart = np.linalg.norm(groups[:, None, :, None] - groups[None, :, None, :], axis=-1)
    return correlation(apart, length).mean(axis=(2, 3))


@pytest.fixture(params=[1, 4])
def groups(request):
    rng = np.random.default_rng(3)
    centres = rng.uniform(0.0, 30.0, (300, 1, 3))
    return centres + 0.7 * rng.standard_normal((300, request.param, 3))


@pytest.mark.parametrize("length", [2.0, 8.0])
def test_what_is_whitened_is_nearly_independent(groups, length):
    """In the sense of Kullback and Leibler: 1/2 (tr(W C W^T) - n - ln det) a point."""
    mixed = whitener(groups, length).toarray()
    whole = mixed @ covariance_of(groups, length) @ mixed.T
    n = len(groups)
    divergence = 0.5 * (np.trace(whole) - n - np.linalg.slogdet(whole)[1]) / n
    assert np.diag(whole) == pytest.approx(np.ones(n), abs=1e-6)
    assert 0.0 <= divergence < 0.03


def test_plain_errors_would_not_be(groups):
    """The law above can fail: unmixed errors of 8 mm are far from independent."""
    whole = covariance_of(groups, 8.0)
    n = len(groups)
    assert 0.5 * (np.trace(whole) - n - np.linalg.slogdet(whole)[1]) / n > 0.3


def test_independent_errors_are_scaled_by_how_many_are_averaged(groups):
    mixed = whitener(groups, 0.0)
    assert mixed.diagonal() == pytest.approx(np.full(len(groups), np.sqrt(groups.shape[1])))
    assert abs(mixed - np.diag(mixed.diagonal())).max() < 1e-9


def test_its_size_grows_with_the_number_of_points():
    groups = np.random.default_rng(4).uniform(0.0, 60.0, (4000, 1, 3))
    assert whitener(groups, 5.0).nnz <= len(groups) * (NEIGHBOURS + 1)


def test_more_means_than_are_looked_at_at_once_have_unit_variances_all():
    groups = np.random.default_rng(6).uniform(0.0, 60.0, (10 * AT_ONCE, 1, 3))
    assert (1.0 - 1.0 / GROWTH) * len(groups) > AT_ONCE  # means that are conditioned on those before them together
    mixed = whitener(groups, 5.0)
    for row in range(len(groups)):
        entries = slice(*mixed.indptr[row : row + 2])
        weights = mixed.data[entries]
        assert weights @ covariance_of(groups[mixed.indices[entries]], 5.0) @ weights == pytest.approx(1.0, abs=1e-6)


def test_points_that_stand_twice_in_a_mean_count_as_one(groups):
    """Of a cell with few points some stand twice, whose distance is none."""
    twice = np.repeat(groups, 2, axis=1)
    assert abs(whitener(twice, 5.0) - whitener(groups, 5.0)).max() < 1e-6
