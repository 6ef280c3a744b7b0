"""What the images prescribe: the modes of drivers' walls and of the frame, and the measured motion of the bones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.images.alignment import Motion
from palpate.images.tissue import Role
from palpate.mesh.gaussian_process import karhunen_loeve, kernel_factor
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.surface import cut_faces, tissue_surface, triangle_normals
from palpate.observation.wall_modes import Wall, fine_modes, wall_modes, wall_of

FRAME_LENGTHS = (0.7, 1.0)  # times the kernel of the frame's smooth motion
FRAME_SHARE, FRAME_MODES = 0.99, 60  # share of the frame's variance in its scalar modes; their largest number


@dataclass(frozen=True, slots=True)
class PrescribedMotion:
    """Displacement `modes q + offset` of the marked points.

    modes (3 n_points, n_modes) mm, offset (3 n_points,) mm, prescribed (n_points,); `walls`: what the first modes move;
    after theirs come the smooth modes of the frame and n_rigid ones. smooth: covariances (n_smooth, n_smooth) of the
    former's coefficients, one for each of `FRAME_LENGTHS`, none without a frame; smooth_mm: the motion's standard
    deviation where theirs is 1.
    """

    modes: NDArray[np.float64]
    offset: NDArray[np.float64]
    prescribed: NDArray[np.bool_]
    walls: tuple[Wall, ...] = ()
    smooth: tuple[NDArray[np.float64], ...] = ()
    n_rigid: int = 0
    smooth_mm: float = 1.0


@dataclass(frozen=True, slots=True)
class FrameMotion:
    """How the frame, the body's faces on the cut of the image, may move.

    motion_mm: standard deviation of each component of a smooth motion with a Gaussian kernel of kernel_mm;
    translation_mm, rotation_deg: those of its rigid motion along and about each axis.
    """

    motion_mm: float
    kernel_mm: float
    translation_mm: float = 10.0
    rotation_deg: float = 5.0


def prescribed_motion(
    space: LagrangeSpace,
    bones: Mapping[int, Motion],
    *,
    n_modes: int,
    kernel_mm: float,
    prior_mm: float,
    fine: bool = False,
    frame: FrameMotion | None = None,
) -> PrescribedMotion:
    """Modes of every driver's wall and the offset of every rigid tissue (by index in `bones`; held where absent).

    fine: whether each has modes of a finer motion along its normals, too. With a `frame` the points on the image's cut
    that neither a wall nor a bone moves follow modes of their own.

    A point that a driver and a bone share follows the bone. Each driver has its own `n_modes` modes (see
    `wall_modes` for kernel_mm and prior_mm, mm).
    """
    n, prescribed = len(space.points), np.zeros(len(space.points), dtype=bool)
    blocks, walls = list[NDArray[np.float64]](), list[Wall]()
    roles = [tissue.role for tissue in space.mesh.tissues]
    for points in _rigid_points(space).values():
        prescribed[points] = True
    held = prescribed.copy()
    for tissue in (i for i, role in enumerate(roles) if role is Role.DRIVER):
        triangles = tissue_surface(space.mesh, tissue).triangles
        facets = space.facets(triangles)
        sums = np.zeros((n, 3))
        np.add.at(sums, facets, triangle_normals(space.mesh.nodes, triangles)[:, None])
        points = np.unique(facets)
        points = points[~held[points]]
        normals = sums[points] / np.maximum(np.linalg.norm(sums[points], axis=1, keepdims=True), np.finfo(float).tiny)
        own = {"kernel_mm": kernel_mm, "prior_mm": prior_mm}
        local = wall_modes(space.points[points], n_modes=n_modes, **own)
        finer = fine_modes(space.points[points], normals) if fine else np.zeros((3 * len(points), 0))
        first, n_local = sum(b.shape[1] for b in blocks), local.shape[1]
        if n_local:
            walls.append(
                wall_of(
                    space.points[points],
                    normals,
                    local,
                    np.arange(first, first + n_local),
                    name=space.mesh.tissues[tissue].name,
                    n_fine=finer.shape[1],
                    **own,
                )
            )
        blocks.append(_among(points, n, np.concatenate([local, finer], axis=1)))
        prescribed[points] = True
    covariances, n_rigid = tuple[NDArray[np.float64], ...](), 0
    if frame is not None:
        points = np.unique(space.facets(cut_faces(space.mesh)))
        points = points[~prescribed[points]]
        smooth, rigid, covariances = _frame_modes(space.points[points], frame)
        blocks.append(_among(points, n, np.concatenate([smooth, rigid], axis=1)))
        n_rigid = rigid.shape[1]
        prescribed[points] = True
    modes = np.concatenate(blocks, axis=1) if blocks else np.zeros((3 * n, 0))
    smooth_mm = frame.motion_mm if frame else 1.0
    offset = bone_offset(space, bones)
    return PrescribedMotion(modes, offset, prescribed, tuple(walls), covariances, n_rigid, smooth_mm)


def bone_offset(space: LagrangeSpace, bones: Mapping[int, Motion]) -> NDArray[np.float64]:
    """Displacement (3 n_points,) mm of the points of every rigid tissue, by index in `bones`; 0 elsewhere."""
    offset = np.zeros((len(space.points), 3))
    for tissue, points in _rigid_points(space).items():
        if tissue in bones:
            offset[points] = bones[tissue].apply(space.points[points]) - space.points[points]
    return offset.ravel()


def _rigid_points(space: LagrangeSpace) -> dict[int, NDArray[np.int64]]:
    """Numbers of the points of each rigid tissue's surface, by the tissue's index; of two that meet the last wins."""
    rigid = [i for i, tissue in enumerate(space.mesh.tissues) if tissue.role is Role.RIGID]
    return {i: np.unique(space.facets(tissue_surface(space.mesh, i).triangles)) for i in rigid}


def _among(points: NDArray[np.int64], n: int, local: NDArray[np.float64]) -> NDArray[np.float64]:
    """Modes (3 n, k) mm of all n points, of which `points` (n_points,) move by local modes (3 n_points, k) mm."""
    modes = np.zeros((n, 3, local.shape[1]))
    modes[points] = local.reshape(len(points), 3, local.shape[1])
    return modes.reshape(3 * n, -1)


def _frame_modes(
    points: NDArray[np.float64], frame: FrameMotion
) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[NDArray[np.float64], ...]]:
    """Smooth modes (3 n_points, k) mm, rigid ones (3 n_points, 6) mm and covariances (k, k) of the smooth ones.

    Motion finer than the smooth modes does not reach into the body (Saint-Venant). Rotations are about the mean of the
    frame's points (n_points, 3) mm, to first order, because images are aligned before. Covariances are those of
    Gaussian processes with several kernel lengths, projected on the modes: too long a kernel excludes real motions.
    """
    if not len(points):
        return np.zeros((0, 0)), np.zeros((0, 0)), ()
    weights = np.ones(len(points))
    scalar = karhunen_loeve(points, weights, kernel_mm=frame.kernel_mm, share=FRAME_SHARE, most=FRAME_MODES)
    inverse, rank = np.linalg.pinv(scalar), min(len(points), 6 * scalar.shape[1])
    amounts = [inverse @ kernel_factor(points, multiple * frame.kernel_mm, rank) for multiple in FRAME_LENGTHS]
    arms, turn = points - points.mean(axis=0), np.deg2rad(frame.rotation_deg)
    rotations = [turn * np.cross(axis, arms).ravel() for axis in np.eye(3)]
    translations = [frame.translation_mm * np.tile(axis, len(points)) for axis in np.eye(3)]
    smooth = np.asarray(frame.motion_mm * np.kron(scalar, np.eye(3)))
    covariances = tuple(np.asarray(np.kron(a @ a.T, np.eye(3))) for a in amounts)
    return smooth, np.stack(translations + rotations, axis=1), covariances
