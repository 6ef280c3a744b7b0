"""Rigid motion between voxelised bodies is found to hundredths of a voxel; moving an image resamples nothing."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from palpate.errors import InputDataError
from palpate.images.alignment import RigidMotion, align, fit_rigid_motion, moved
from palpate.images.distance import DistanceMap, distance_map
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue

BONE = (40.0, 26.0, 18.0)
ORIGIN = np.zeros((1, 3))


def motion_of(rng: np.random.Generator, *, degrees: float, mm: float) -> RigidMotion:
    turn = Rotation.from_rotvec(np.deg2rad(rng.uniform(-degrees, degrees, 3))).as_matrix()
    return RigidMotion(turn, rng.uniform(-mm, mm, 3))


def grid_of(
    shape: tuple[int, int, int], rng: np.random.Generator, spacing: tuple[float, ...] = (1.0, 1.0, 1.0)
) -> VoxelGrid:
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = -np.array(spacing) * (np.array(shape) - 1.0) / 2.0 + rng.uniform(-0.5, 0.5, 3)
    return VoxelGrid(shape, affine)


def ellipsoid(grid: VoxelGrid, axes: tuple[float, ...], motion: RigidMotion) -> NDArray[np.bool_]:
    index = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1).reshape(-1, 3).astype(float)
    places = motion.inverse().apply(grid.world(index))
    return np.asarray(((places / axes) ** 2).sum(axis=1) < 1.0).reshape(grid.shape)


def map_of(grid: VoxelGrid, axes: tuple[float, ...], motion: RigidMotion) -> DistanceMap:
    return distance_map(ellipsoid(grid, axes, motion), grid, smoothing_mm=0.6 * grid.spacing.max())


def test_motions_form_a_group() -> None:
    rng = np.random.default_rng(1)
    first, second = (motion_of(rng, degrees=90.0, mm=50.0) for _ in range(2))
    points = rng.normal(size=(7, 3))
    np.testing.assert_allclose(second.compose(first).apply(points), second.apply(first.apply(points)), atol=1e-12)
    np.testing.assert_allclose(first.inverse().apply(first.apply(points)), points, atol=1e-12)
    np.testing.assert_allclose(RigidMotion.identity().apply(points), points)
    homogeneous = np.hstack([points, np.ones((7, 1))])
    np.testing.assert_allclose((homogeneous @ first.matrix.T)[:, :3], first.apply(points), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-3, 30.0, 180.0])
def test_the_angle_is_that_of_the_rotation(angle: float) -> None:
    turn = Rotation.from_rotvec(np.deg2rad(angle) * np.array([0.6, 0.0, 0.8])).as_matrix()
    assert RigidMotion(turn, np.zeros(3)).angle_deg == pytest.approx(angle, abs=1e-6)


@pytest.mark.parametrize("matrix", [np.diag([1.0, 1.0, -1.0]), 2.0 * np.eye(3), np.full((3, 3), np.nan)])
def test_a_mirror_or_a_stretch_is_no_rotation(matrix: NDArray[np.float64]) -> None:
    with pytest.raises(InputDataError, match="no rotation"):
        RigidMotion(matrix, np.zeros(3))


def test_the_motion_of_a_bone_is_found_to_hundredths_of_a_voxel() -> None:
    shifts, angles = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        pose, motion = motion_of(rng, degrees=15.0, mm=0.5), motion_of(rng, degrees=6.0, mm=4.0)
        grid = grid_of((100, 76, 66), rng)
        found = fit_rigid_motion([(map_of(grid, BONE, pose), map_of(grid, BONE, motion.compose(pose)))]).motion
        error = found.compose(motion.inverse())
        centre = motion.compose(pose).apply(ORIGIN)
        shifts.append(np.linalg.norm(error.apply(centre) - centre))
        angles.append(error.angle_deg)
    assert np.sqrt(np.mean(np.square(shifts))) < 0.02
    assert np.sqrt(np.mean(np.square(angles))) < 0.06


def test_the_grids_of_the_two_images_may_differ() -> None:
    rng = np.random.default_rng(5)
    motion = RigidMotion(Rotation.from_euler("z", 4.0, degrees=True).as_matrix(), np.array([120.0, -3.0, 40.0]))
    far = grid_of((60, 64, 34), rng, (1.6, 1.2, 2.0))
    far = VoxelGrid(far.shape, motion.matrix @ far.affine)
    before = map_of(grid_of((100, 70, 60), rng), BONE, RigidMotion.identity())
    error = fit_rigid_motion([(before, map_of(far, BONE, motion))]).motion.compose(motion.inverse())
    centre = motion.apply(ORIGIN)
    assert np.linalg.norm(error.apply(centre) - centre) < 0.05
    assert error.angle_deg < 0.2


@pytest.mark.parametrize("degrees", [35.0, 60.0])
def test_large_turns_are_found_too(degrees: float) -> None:
    rng = np.random.default_rng(2)
    motion = RigidMotion(Rotation.from_rotvec(np.deg2rad(degrees) * np.array([0.0, 0.6, 0.8])).as_matrix(), np.zeros(3))
    grid = grid_of((72, 72, 72), rng)
    axes = (28.0, 18.0, 12.0)
    found = fit_rigid_motion([(map_of(grid, axes, RigidMotion.identity()), map_of(grid, axes, motion))]).motion
    assert found.compose(motion.inverse()).angle_deg < 0.3


def test_a_bias_of_both_maps_changes_nothing() -> None:
    rng = np.random.default_rng(7)
    motion = motion_of(rng, degrees=4.0, mm=2.0)
    grid = grid_of((72, 56, 48), rng)
    before, after = map_of(grid, (28.0, 18.0, 12.0), RigidMotion.identity()), map_of(grid, (28.0, 18.0, 12.0), motion)
    plain = fit_rigid_motion([(before, after)]).motion
    shifted = fit_rigid_motion([(before.shifted(0.3), after.shifted(0.3))]).motion
    np.testing.assert_allclose(shifted.apply(ORIGIN), plain.apply(ORIGIN), atol=0.03)
    assert shifted.compose(plain.inverse()).angle_deg < 0.15


def test_turns_that_a_ball_does_not_show_are_reported_and_left_out() -> None:
    rng = np.random.default_rng(3)
    grid = grid_of((44, 44, 44), rng)
    shift = RigidMotion(np.eye(3), np.array([2.0, -1.0, 0.5]))
    fit = fit_rigid_motion([(map_of(grid, (12.0,) * 3, RigidMotion.identity()), map_of(grid, (12.0,) * 3, shift))])
    assert len(fit.undetermined) == 3
    assert fit.motion.angle_deg == 0.0
    np.testing.assert_allclose(fit.motion.translation, shift.translation, atol=0.03)


def test_a_body_of_revolution_leaves_one_turn_open() -> None:
    rng = np.random.default_rng(4)
    grid = grid_of((44, 44, 60), rng)
    motion = RigidMotion(Rotation.from_euler("x", 6.0, degrees=True).as_matrix(), np.zeros(3))
    fit = fit_rigid_motion([(map_of(grid, (12, 12, 22), RigidMotion.identity()), map_of(grid, (12, 12, 22), motion))])
    assert len(fit.undetermined) == 1
    assert abs(fit.undetermined[0] @ motion.rotation[:, 2]) > 0.99
    assert fit.motion.compose(motion.inverse()).angle_deg < 0.4


def test_a_body_cut_by_the_image_does_not_pull_the_motion() -> None:
    rng = np.random.default_rng(9)
    grid = grid_of((60, 64, 56), rng)
    grid = VoxelGrid(grid.shape, grid.affine + np.array([[0, 0, 0, 25], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]))
    motion = RigidMotion(Rotation.from_euler("z", 3.0, degrees=True).as_matrix(), np.array([3.0, 1.0, -2.0]))
    found = fit_rigid_motion([(map_of(grid, BONE, RigidMotion.identity()), map_of(grid, BONE, motion))]).motion
    point = np.array([[25.0, 0.0, 0.0]])
    assert np.linalg.norm(found.apply(point) - motion.apply(point)) < 0.05
    assert found.compose(motion.inverse()).angle_deg < 0.3


def two_bones(grid: VoxelGrid, motions: tuple[RigidMotion, RigidMotion]) -> Segmentation:
    index = np.zeros(grid.shape, dtype=np.int16)
    for number, (motion, x) in enumerate(zip(motions, (-24.0, 24.0), strict=True), start=1):
        index[ellipsoid(grid, (20.0, 14.0, 9.0), motion.compose(RigidMotion(np.eye(3), np.array([x, 0, 0]))))] = number
    tissues = (
        Tissue("rest", Role.KNOWN, (), youngs_modulus_kpa=10.0),
        Tissue("hip", Role.RIGID, (1,)),
        Tissue("femur", Role.RIGID, (2,)),
    )
    return Segmentation(index, grid, tissues)


def test_aligned_images_keep_only_each_bones_own_motion() -> None:
    rng = np.random.default_rng(12)
    common = RigidMotion(Rotation.from_euler("z", 5.0, degrees=True).as_matrix(), np.array([3.0, -2.0, 1.0]))
    own = RigidMotion(Rotation.from_euler("y", 4.0, degrees=True).as_matrix(), np.array([0.0, 0.0, 2.0]))
    grid = grid_of((110, 60, 56), rng)
    before = two_bones(grid, (RigidMotion.identity(), RigidMotion.identity()))
    after = two_bones(grid, (common, common.compose(own)))
    measured = align(before, after)
    for name, point, truth in [("hip", -24.0, common), ("femur", 24.0, common.compose(own))]:
        place = np.array([[point, 0.0, 0.0]])
        found = measured.tissues[name].motion
        assert np.linalg.norm(found.apply(place) - truth.apply(place)) < 0.06
        aligned = moved(after, measured.overall.motion.inverse())
        again = align(before, aligned)
        np.testing.assert_allclose(
            again.tissues[name].motion.apply(place), measured.remaining(name).apply(place), atol=0.01
        )
        assert again.overall.motion.angle_deg < 0.01


def test_pieces_of_a_tissue_that_move_by_themselves_are_told() -> None:
    rng = np.random.default_rng(12)
    still, own = RigidMotion.identity(), RigidMotion(np.eye(3), np.array([-3.0, 0.0, 0.0]))
    grid = grid_of((110, 60, 56), rng)
    one = (two_bones(grid, (still, still)).tissues[0], Tissue("bones", Role.RIGID, (1, 2)))

    def bones(*motions: RigidMotion) -> Segmentation:
        both = two_bones(grid, (motions[0], motions[1]))
        return Segmentation(np.minimum(both.index, 1), grid, one)

    assert not align(bones(still, still), bones(own, own)).loose
    assert align(bones(still, still), bones(still, own)).loose["bones"] > 0.5


def test_moving_an_image_changes_its_affine_and_no_voxel() -> None:
    rng = np.random.default_rng(13)
    motion = motion_of(rng, degrees=40.0, mm=30.0)
    image = two_bones(grid_of((60, 30, 30), rng), (RigidMotion.identity(), RigidMotion.identity()))
    result = moved(image, motion)
    assert np.array_equal(result.index, image.index)
    index = rng.uniform(0.0, 29.0, (5, 3))
    np.testing.assert_allclose(result.grid.world(index), motion.apply(image.grid.world(index)), atol=1e-10)
    np.testing.assert_allclose(result.grid.spacing, image.grid.spacing)


def test_what_cannot_be_aligned_is_refused() -> None:
    rng = np.random.default_rng(14)
    grid = grid_of((30, 30, 30), rng)
    soft = Segmentation(np.zeros(grid.shape, dtype=np.int16), grid, (Tissue("a", Role.ESTIMATE, (1,)),))
    with pytest.raises(InputDataError, match="no tissue is `rigid`"):
        align(soft, soft)
    tiny = map_of(grid, (1.2, 1.2, 1.2), RigidMotion.identity())
    with pytest.raises(InputDataError, match="surface points"):
        fit_rigid_motion([(tiny, tiny)])
