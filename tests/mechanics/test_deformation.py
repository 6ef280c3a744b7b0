"""Strains of known deformations: stretch, rotation, shear."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.element import deformation_determinants, largest_strains, volumes_after
from palpate.mesh.space import lagrange_space

TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])  # a proper rotation


@pytest.fixture(params=["P1", "P2"])
def space(request, meshes):
    return lagrange_space(meshes.box_mesh(2, size=10.0, distortion=0.2), request.param)


def affine(space, gradient):
    """u = (F - I) X."""
    return space.points @ (np.asarray(gradient) - np.eye(3)).T


@pytest.mark.parametrize("stretch", [0.7, 1.05, 1.4])
def test_a_simple_stretch_strains_by_half_its_square_less_one(space, stretch):
    strains = largest_strains(space, affine(space, np.diag([1.0, stretch, 1.0])))
    assert strains.shape == (len(space.mesh.tets),)
    np.testing.assert_allclose(strains, abs(stretch**2 - 1.0) / 2.0, rtol=1e-12)


def test_a_rigid_motion_strains_nothing(space):
    displacement = affine(space, TURN) + np.array([3.0, -2.0, 40.0])
    assert largest_strains(space, displacement).max() < 1e-12


def test_a_rotation_after_a_stretch_leaves_the_strain(space):
    stretch = np.array([[1.2, 0.1, 0.0], [0.1, 0.9, 0.05], [0.0, 0.05, 1.0]])
    before, after = (largest_strains(space, affine(space, f)) for f in (stretch, TURN @ stretch))
    np.testing.assert_allclose(after, before, rtol=1e-12)


def test_the_larger_of_extension_and_compression_counts(space):
    strains = largest_strains(space, affine(space, np.diag([1.1, 0.6, 1.0])))
    np.testing.assert_allclose(strains, (1.0 - 0.36) / 2.0, rtol=1e-12)


def test_a_displacement_that_is_not_finite_has_no_strain(space):
    displacement = np.zeros_like(space.points)
    displacement[space.cells[0, 0]] = np.nan
    strains = largest_strains(space, displacement)
    touched = np.any(space.cells == space.cells[0, 0], axis=1)
    if space.order == 1:
        assert np.isnan(strains[touched]).all()
    assert (strains[~touched] == 0.0).all()


def test_a_stretch_changes_the_volume_by_its_factor(space):
    found = deformation_determinants(space, affine(space, np.diag([1.0, 1.3, 1.0])))
    np.testing.assert_allclose(found, 1.3, rtol=1e-12)


def test_moved_volumes_add_up_to_that_of_the_moved_box(space):
    bent = np.zeros_like(space.points)
    bent[:, 0] = 0.05 * space.points[:, 0] ** 2  # the face at 10 mm moves by 5 mm
    assert volumes_after(space, bent).sum() == pytest.approx(1500.0, rel=1e-12)
    np.testing.assert_allclose(volumes_after(space, affine(space, 2.0 * TURN)), 8.0 * space.mesh.volumes, rtol=1e-12)
