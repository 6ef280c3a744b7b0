"""Errors of a drawing are a Gaussian process along a surface's normals, of the stated standard deviation."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from palpate.observation.drawn_at_rest import LENGTHS_MM, MODES, SHARE, UNIT_MM, modes_at_rest

RADIUS = 15.0


@pytest.fixture(scope="module")
def ball(sphere):
    """A ball's surface, its modes (n, 3, m) and their covariances."""
    vertices, triangles = sphere(3)
    surface = SimpleNamespace(rest=RADIUS * vertices, triangles=triangles)
    modes, covariances = modes_at_rest(surface)
    return vertices, modes.reshape(len(vertices), 3, -1), covariances


def test_modes_are_along_the_normals(ball):
    normals, modes, _ = ball
    along = np.einsum("pai,pa->pi", modes, normals)
    assert 5 < modes.shape[2] <= MODES
    assert modes == pytest.approx(along[:, None] * normals[:, :, None], abs=1e-3 * np.abs(along).max())


@pytest.mark.parametrize("which", range(len(LENGTHS_MM)))
def test_their_field_has_the_stated_standard_deviation_and_is_alike_over_its_length(ball, which):
    """Over a surface that is as fine as it is: exp(-d^2 / (2 l^2)), a tenth of the variance of the shorter left out."""
    normals, modes, covariances = ball
    along, length = np.einsum("pai,pa->pi", modes, normals), LENGTHS_MM[which]
    field = along @ covariances[which] @ along.T
    assert 1.0 - 1.1 * (1.0 - SHARE) < np.trace(field) / (len(field) * UNIT_MM**2) < 1.001
    far = RADIUS**2 * np.sum((normals[:, None] - normals) ** 2, axis=2)
    expected = UNIT_MM**2 * np.exp(-far / (2.0 * length**2))
    assert np.abs(field - expected).mean() < 0.03 * UNIT_MM**2
    nearly_a_length = np.abs(np.sqrt(far) - length) < 0.05 * length
    assert np.mean(field[nearly_a_length]) == pytest.approx(np.exp(-0.5) * UNIT_MM**2, rel=0.1)


def test_a_surface_twice_as_fine_has_the_same_field(sphere, ball):
    _, modes, covariances = ball
    vertices, triangles = sphere(4)
    finer, of_finer = modes_at_rest(SimpleNamespace(rest=RADIUS * vertices, triangles=triangles))
    n = len(modes)
    for coarse, fine in zip(covariances, of_finer, strict=True):
        sds = [
            np.einsum("pai,ij,paj->p", m, c, m)
            for m, c in ((modes, coarse), (finer.reshape(len(vertices), 3, -1)[:n], fine))
        ]
        assert np.sqrt(sds[1]) == pytest.approx(np.sqrt(sds[0]), rel=0.03)
