"""What grey values tell of motion: as much as a least-squares fit of their motion then finds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from palpate.images.grey_field import grey_fields
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue

SIZE, SPACING_MM = 64, 2.0
GRID = VoxelGrid((SIZE,) * 3, np.diag([SPACING_MM] * 3 + [1.0]))
MODULI = {"organ": None, "rest": 10.0}
CUBE = 5  # voxels: 1 mL


def segmentation(grid=GRID):
    """Two halves."""
    index = np.zeros(grid.shape, dtype=np.int16)
    index[: grid.shape[0] // 2] = 1
    roles = (Role.ESTIMATE, Role.KNOWN)
    names = zip(MODULI.items(), roles, strict=True)
    tissues = [Tissue(name, role, (k,), youngs_modulus_kpa=kpa) for k, ((name, kpa), role) in enumerate(names, start=1)]
    return Segmentation(index, grid, tuple(tissues))


def texture(seed, amplitude):
    values = gaussian_filter(np.random.default_rng(seed).standard_normal((SIZE,) * 3), 4.0)
    return amplitude * values / values.std()


def noise(seed, sd, width):
    values = np.random.default_rng(seed).standard_normal((SIZE,) * 3)
    values = gaussian_filter(values, width) if width else values
    return sd * values / values.std()


def scatter_mm(clean, of_noise):
    """Standard deviation of the mean motion of cubes of 1 mL along an axis, by least squares on the true gradient."""
    found = []
    for axis in range(3):
        slope = np.gradient(clean, SPACING_MM, axis=axis)
        n = SIZE // CUBE
        cubes = [of[: n * CUBE, : n * CUBE, : n * CUBE].reshape(n, CUBE, n, CUBE, n, CUBE) for of in (slope, of_noise)]
        squares, moved = ((cubes[0] * of).sum(axis=(1, 3, 5)) for of in cubes)
        found.append((moved / squares.mean()).ravel())
    return float(np.std(found))


@pytest.mark.parametrize("width", [0.0, 0.7])
def test_the_error_is_that_of_a_fit_also_where_noise_is_correlated(width):
    """Or up to a half more: a gradient that is not alike over three voxels counts as none."""
    clean, first, second = texture(1, 30.0), noise(2, 12.0, width), noise(3, 12.0, width)
    both = [(clean + own, GRID, segmentation()) for own in (first, second)]
    for field in grey_fields(*both):
        assert not field.at_least
        assert field.noise == pytest.approx(12.0, rel=0.15)
        assert 0.9 < field.mean_mm / scatter_mm(clean, second - first) < 1.5


def test_noise_alone_tells_no_motion():
    """Its gradients are as steep as those of a texture, but not alike in any two voxels."""
    found = grey_fields((noise(4, 12.0, 0.7), GRID, segmentation()))
    assert [field.at_least for field in found] == [True, True]
    textured = grey_fields((texture(1, 30.0) + noise(2, 12.0, 0.7), GRID, segmentation()))
    assert all(of.mean_mm > seen.mean_mm for of, seen in zip(found, textured, strict=True))


def test_labels_may_have_a_grid_of_their_own():
    values = texture(1, 30.0) + noise(2, 12.0, 0.0)
    coarse = VoxelGrid((SIZE // 2,) * 3, np.diag([2.0 * SPACING_MM] * 3 + [1.0]))
    same, other = (grey_fields((values, GRID, of)) for of in (segmentation(), segmentation(coarse)))
    assert [of.mean_mm for of in other] == pytest.approx([of.mean_mm for of in same], rel=0.25)
    assert [of.wave_mm for of in other] == pytest.approx([of.wave_mm for of in same], rel=0.25)


def test_a_tissue_with_too_few_voxels_inside_has_no_row():
    index = np.zeros(GRID.shape, dtype=np.int16)
    index[30:35, 30:35, 30:35] = 1
    found = grey_fields((texture(1, 30.0), GRID, Segmentation(index, GRID, segmentation().tissues)))
    assert [of.tissue for of in found] == ["organ"]


@pytest.mark.parametrize("values", [np.zeros(GRID.shape), np.full(GRID.shape, np.nan), np.full(GRID.shape, np.inf)])
def test_an_image_without_noise_or_numbers_has_no_row(values):
    assert grey_fields((values.astype(np.float32), GRID, segmentation())) == ()
