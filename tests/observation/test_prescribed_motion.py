"""What bones and drivers prescribe: bones their measured motion, drivers smooth modes, bones first."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate.images.alignment import RigidMotion
from palpate.images.tissue import Role, Tissue
from palpate.mesh.space import lagrange_space
from palpate.observation.prescribed_motion import prescribed_motion

MOTION = RigidMotion(Rotation.from_rotvec([0.05, -0.1, 0.02]).as_matrix(), np.array([0.5, 1.0, -0.3]))


def behind(faces):
    """Tissue 1 is a driver below, 2 a bone at the left, 3 another driver above; the rest is the image's cut."""
    sides = [faces[:, 2] < 1e-9, faces[:, 0] < 1e-9, faces[:, 2] > 30.0 - 1e-9]
    return np.select(sides, [1, 2, 3], default=-1)


@pytest.fixture(scope="module", params=["P1", "P2"])
def space(request, meshes):
    tissues = [
        meshes.known("fat"),
        Tissue("below", Role.DRIVER),
        Tissue("bone", Role.RIGID),
        Tissue("above", Role.DRIVER),
    ]
    return lagrange_space(meshes.box_mesh(3, size=30.0, tissues=tissues, beyond=behind), request.param)


def motion_of(space, bones):
    return prescribed_motion(space, bones, n_modes=12, kernel_mm=15.0, prior_mm=4.0)


def places(space):
    below, left, above = (
        space.points[:, 2] < 1e-9,
        space.points[:, 0] < 1e-9,
        space.points[:, 2] > 30.0 - 1e-9,
    )
    return below, left, above


def test_walls_and_bones_are_prescribed_and_nothing_else(space):
    below, left, above = places(space)
    assert np.array_equal(motion_of(space, {}).prescribed, below | left | above)


def test_a_bone_moves_as_measured(space):
    left = places(space)[1]
    motion = motion_of(space, {2: MOTION})
    offset = motion.offset.reshape(-1, 3)
    assert offset[left] == pytest.approx(MOTION.apply(space.points[left]) - space.points[left], abs=1e-12)
    assert not offset[~left].any()


def test_a_bone_without_a_motion_is_held(space):
    assert not motion_of(space, {}).offset.any()


def test_where_a_driver_meets_a_bone_the_bone_wins(space):
    below, left, above = places(space)
    assert np.any(below & left)
    moving = np.any(motion_of(space, {2: MOTION}).modes.reshape(len(space.points), -1) != 0.0, axis=1)
    assert np.array_equal(moving, (below | above) & ~left)


def test_each_driver_has_modes_of_its_own(space):
    below, left, above = places(space)
    modes = motion_of(space, {}).modes.reshape(len(space.points), 3, -1)
    assert modes.shape[2] == 24
    assert not modes[above, :, :12].any()
    assert not modes[below, :, 12:].any()
    assert np.abs(modes[below & ~left, :, :12]).max() > 1.0


def test_a_body_without_drivers_has_no_modes(meshes):
    space = lagrange_space(meshes.box_mesh(2, size=30.0), "P1")
    motion = motion_of(space, {})
    assert motion.modes.shape == (3 * len(space.points), 0)
    assert not motion.prescribed.any()
