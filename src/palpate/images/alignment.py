"""Rigid motion between two images, measured on the surfaces of rigid tissues; images are moved by their affine only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from palpate.errors import InputDataError
from palpate.images.distance import (
    DistanceMap,
    IsosurfacePoints,
    isosurface_points,
    smoothing_width,
    tissue_distance_map,
)
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.parallel import mapped

BORDER_VOXELS = 3.0  # nearer to the image's border a map is extrapolated
MAX_POINTS = 20_000
MIN_POINTS = 30
MAX_STEPS = 50
STEP_TOLERANCE_MM = 1e-5
TUKEY = 4.685  # 95 % efficiency for Gaussian residuals
EXTRA_SMOOTHING = 0.8  # voxels; a rigid surface keeps its shape, so that smoothing its voxel steps makes no bias
LOOSE_VOXELS = 0.5  # distance from the whole tissue's motion, beyond which a piece moves by itself
UNDETERMINED = 4e-3  # (lever / radius)^2 below which a rotation is undetermined; voxel steps on a ball give 2e-3


class Motion(Protocol):
    """A motion of points of the body."""

    def apply(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where points (n, 3) mm go, (n, 3) mm."""
        ...


@dataclass(frozen=True, slots=True)
class RigidMotion:
    """x -> rotation x + translation in RAS mm: rotation (3, 3) orthogonal with determinant 1, translation (3,) mm."""

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name, shape in (("rotation", (3, 3)), ("translation", (3,))):
            array = np.array(getattr(self, name), dtype=np.float64).reshape(shape)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if not np.allclose(self.rotation.T @ self.rotation, np.eye(3), atol=1e-6) or np.linalg.det(self.rotation) < 0.0:
            raise InputDataError(
                f"{self.rotation.tolist()} is no rotation: its columns must be a right-handed unit frame"
            )

    @classmethod
    def identity(cls) -> RigidMotion:
        """The motion that leaves every point where it is."""
        return cls(np.eye(3), np.zeros(3))

    @property
    def angle_deg(self) -> float:
        """Angle of the rotation about its axis, degrees, 0 to 180."""
        return float(np.rad2deg(Rotation.from_matrix(self.rotation).magnitude()))

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The motion as a matrix (4, 4) on homogeneous coordinates, mm."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation
        return matrix

    def apply(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) RAS mm after the motion."""
        return np.asarray(points @ self.rotation.T + self.translation)

    def inverse(self) -> RigidMotion:
        """The motion back."""
        return RigidMotion(self.rotation.T, -self.rotation.T @ self.translation)

    def compose(self, first: RigidMotion) -> RigidMotion:
        """The motion that applies `first` and then this one."""
        return RigidMotion(self.rotation @ first.rotation, self.rotation @ first.translation + self.translation)


@dataclass(frozen=True, slots=True)
class RigidFit:
    """A measured motion with what it rests on.

    rms_mm: robust root mean square of the remaining distance; n_points: surface points that took part;
    undetermined (k, 3): unit axes about which the surface does not show a rotation, so that none was given to it.
    """

    motion: RigidMotion
    rms_mm: float
    n_points: int
    undetermined: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Alignment:
    """Motion before -> after: `overall` of all rigid tissues as one body, `tissues` of each by its name.

    loose: of a tissue with pieces that move by themselves, how far (mm, median) the worst lies off the tissue's motion.
    """

    overall: RigidFit
    tissues: Mapping[str, RigidFit]
    loose: Mapping[str, float] = field(default_factory=dict)

    def remaining(self, tissue: str, overall: RigidFit | None = None) -> RigidMotion:
        """The tissue's own motion once the after image has been moved back by `overall`, by default that of all."""
        return (overall or self.overall).motion.inverse().compose(self.tissues[tissue].motion)


@dataclass(frozen=True, slots=True)
class _Match:
    """Surface points of the first image with their rest distance (n,) mm, and the later map to match them with."""

    surface: IsosurfacePoints
    rest: NDArray[np.float64]
    after: DistanceMap


@dataclass(frozen=True, slots=True)
class _State:
    """A trial motion: residuals (n,) mm, their derivative (n, 6) by turn (rad) and shift (mm), area (n,) mm^2."""

    motion: RigidMotion
    residual: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    area: NDArray[np.float64]
    centre: NDArray[np.float64]
    radius: float

    @property
    def misfit(self) -> float:
        """Mean size of the residuals, mm, over the share of points inside: compares the ends of several starts."""
        inside = np.count_nonzero(self.area) / len(self.area)
        return float(self.area @ np.abs(self.residual) / self.area.sum() / inside)


def fit_rigid_motion(pairs: Sequence[tuple[DistanceMap, DistanceMap]]) -> RigidFit:
    """One motion for several surfaces, each given by its (before, after) distance maps.

    Minimises sum_i a_i rho(phi_after(R x_i + t) - phi_before(x_i)) over surface points x_i of area a_i, rho Tukey's, by
    Gauss-Newton from the centroids; from the principal axes too when the first start ends badly. Turns that the
    surfaces do not show (a ball's) are left at zero. Raises `InputDataError` when too few points lie in both images.
    """
    voxel = max(float(surface.grid.spacing.max()) for pair in pairs for surface in pair)
    smooth = [(_smoothed(before, voxel), _smoothed(after, voxel)) for before, after in pairs]
    matches = []
    for before, after in smooth:
        surface = seen_surface(before)
        step = -(-len(surface.area) // MAX_POINTS) or 1
        thinned = IsosurfacePoints(surface.places[::step], surface.normals[::step], surface.area[::step] * step)
        matches.append(_Match(thinned, before.at(thinned.places), after))
    target = [seen_surface(after) for _, after in smooth]
    for where, surfaces in (("before", [match.surface for match in matches]), ("after", target)):
        n = sum(len(surface.area) for surface in surfaces)
        if n < MIN_POINTS:
            raise InputDataError(
                f"the '{where}' image shows only {n} surface points of the rigid tissue away from its border, and"
                f" {MIN_POINTS} are needed; use a larger field of view, or give the tissue another role"
            )
    centre, spread = _moments([match.surface for match in matches])
    aim, aimed = _moments(target)
    best = _descend(RigidMotion(np.eye(3), aim - centre), matches)
    if _scale(best) > 0.25 * voxel:
        # the four proper rotations that map the principal axes of one surface to those of the other
        first, second = (np.linalg.eigh(covariance)[1] for covariance in (spread, aimed))
        turns = [second @ np.diag(signs) @ first.T for signs in product((1.0, -1.0), repeat=3)]
        starts = [RigidMotion(turn, aim - turn @ centre) for turn in turns if np.linalg.det(turn) > 0.0]
        for start in starts:
            inside = [within_border(match.after.grid, start.apply(match.surface.places)) for match in matches]
            if sum(map(np.count_nonzero, inside)) >= MIN_POINTS:
                best = min(best, _descend(start, matches), key=lambda end: end.misfit)
    weight = best.area * tukey(best.residual, TUKEY * _scale(best))
    rms = float(np.sqrt(weight @ best.residual**2 / weight.sum()))
    return RigidFit(best.motion, rms, int(np.count_nonzero(weight)), _shown(best, weight)[1].T)


def align(before: Segmentation, after: Segmentation) -> Alignment:
    """Motion of the `rigid` tissues between two segmentations of the same tissues, together and each by itself.

    A tissue that shows too little of its surface (cut by the image) moves with the others: its fit is the overall one
    with n_points = 0. Raises `InputDataError` when there is no rigid tissue or all of them show too little.
    """
    rigid = [i for i, tissue in enumerate(before.tissues) if tissue.role is Role.RIGID]
    if not rigid:
        raise InputDataError("no tissue is `rigid`, so nothing shows the motion between the images; set align = 'none'")
    pairs = distance_pairs(before, after, rigid, smoothing_mm=smoothing_width(before.grid, after.grid))
    overall = fit_rigid_motion(list(pairs.values()))

    def alone(tissue: int) -> tuple[RigidFit, float]:
        """The fit of one tissue, and the largest median distance of a separate piece of it from that, mm."""
        try:
            fit = fit_rigid_motion([pairs[tissue]]) if len(rigid) > 1 else overall
        except InputDataError:
            fit = replace(overall, n_points=0)
        pieces, count = ndimage.label(before.mask(tissue), structure=np.ones((3, 3, 3)))
        if count < 2:
            return fit, 0.0
        here, there = pairs[tissue]
        places = seen_surface(here).places
        places = places[within_border(there.grid, fit.motion.apply(places))]
        nearest = np.clip(np.rint(here.grid.index(places)).astype(int), 0, np.array(pieces.shape) - 1)
        number = ndimage.grey_dilation(pieces, size=(3, 3, 3))[tuple(nearest.T)]  # the surface lies outside the voxels
        distance = np.abs(there.at(fit.motion.apply(places)) - here.at(places))
        shown = [distance[number == piece] for piece in range(1, count + 1)]
        return fit, max((float(np.median(one)) for one in shown if len(one) >= MIN_POINTS), default=0.0)

    names = [before.tissues[i].name for i in rigid]
    each = dict(zip(names, mapped(alone, rigid), strict=True))
    limit = LOOSE_VOXELS * float(after.grid.spacing.max())
    return Alignment(
        overall,
        {name: fit for name, (fit, _) in each.items()},
        {name: off for name, (_, off) in each.items() if off > limit},
    )


def distance_pairs(
    before: Segmentation, after: Segmentation, tissues: Sequence[int], *, smoothing_mm: float
) -> dict[int, tuple[DistanceMap, DistanceMap]]:
    """Distance maps of tissues (indices) in both images, each smoothed by so much; raises as `tissue_distance_map`."""
    images = product(tissues, (before, after))
    maps = mapped(lambda of: tissue_distance_map(of[1], of[0], smoothing_mm=smoothing_mm), images)
    return dict(zip(tissues, zip(maps[::2], maps[1::2], strict=True), strict=True))


def moved(segmentation: Segmentation, motion: RigidMotion) -> Segmentation:
    """The segmentation after a rigid motion (mm): the voxels are the same, only their affine changes."""
    grid = VoxelGrid(segmentation.grid.shape, motion.matrix @ segmentation.grid.affine)
    return replace(segmentation, grid=grid)


def _smoothed(surface: DistanceMap, voxel: float) -> DistanceMap:
    sigma = EXTRA_SMOOTHING * voxel / surface.grid.spacing
    return replace(surface, coefficients=ndimage.gaussian_filter(surface.coefficients, sigma, mode="mirror"))


def seen_surface(distance: DistanceMap) -> IsosurfacePoints:
    """The zero level of a distance map, away from the image's border."""
    found = isosurface_points(distance)
    keep = within_border(distance.grid, found.places)
    return IsosurfacePoints(found.places[keep], found.normals[keep], found.area[keep])


def _moments(surfaces: Sequence[IsosurfacePoints]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centroid (3,) mm and covariance (3, 3) mm^2 of surfaces, by area."""
    places, area = np.concatenate([s.places for s in surfaces]), np.concatenate([s.area for s in surfaces])
    share = area / area.sum()
    centre = share @ places
    offset = places - centre
    return centre, (offset * share[:, None]).T @ offset


def _descend(motion: RigidMotion, matches: Sequence[_Match]) -> _State:
    """Gauss-Newton with Tukey weights, among the turns that the surface shows.

    A step, (6,) turn (rad) and shift (mm), that does not lower the cost at the weights' scale is halved.
    """
    state = _state(motion, matches)
    for _ in range(MAX_STEPS):
        scale = _scale(state)
        weight = state.area * tukey(state.residual, TUKEY * scale)
        shown, _ = _shown(state, weight)
        basis = np.zeros((6, shown.shape[1] + 3))
        basis[:3, :-3], basis[3:, -3:] = shown / state.radius, np.eye(3)
        reduced = state.jacobian @ basis
        normal = (reduced * weight[:, None]).T @ reduced
        slope = reduced.T @ (weight * state.residual)
        step = np.asarray(-basis @ np.linalg.pinv(normal, rcond=1e-6, hermitian=True) @ slope)
        cost = _cost(state, scale)
        for _ in range(6):
            turn = Rotation.from_rotvec(step[:3]).as_matrix()
            by_step = RigidMotion(turn, state.centre - turn @ state.centre + step[3:])
            trial = _state(by_step.compose(state.motion), matches)
            if _cost(trial, scale) <= cost:
                break
            step = 0.5 * step
        else:
            return state
        state = trial
        if np.abs(step * np.array([state.radius] * 3 + [1.0] * 3)).max() < STEP_TOLERANCE_MM:
            return state
    return state


def _state(motion: RigidMotion, matches: Sequence[_Match]) -> _State:
    """Residuals and derivatives at a motion; points that leave the later image get the area 0."""
    groups = [motion.apply(match.surface.places) for match in matches]
    places = np.concatenate(groups)
    area = np.concatenate([match.surface.area for match in matches])
    centre = area @ places / area.sum()
    radius = float(np.sqrt(area @ ((places - centre) ** 2).sum(axis=1) / area.sum()))
    residual = np.concatenate([m.after.at(x) - m.rest for m, x in zip(matches, groups, strict=True)])
    slope = np.concatenate([m.after.gradient_at(x) for m, x in zip(matches, groups, strict=True)])
    inside = np.concatenate([within_border(m.after.grid, x) for m, x in zip(matches, groups, strict=True)])
    if np.count_nonzero(inside) < MIN_POINTS:
        raise InputDataError(
            f"only {np.count_nonzero(inside)} of {len(places)} surface points of the rigid tissue lie inside the"
            " 'after' image; the images show different parts of the body: check both"
        )
    return _State(motion, residual, np.hstack([np.cross(places - centre, slope), slope]), area * inside, centre, radius)


def within_border(grid: VoxelGrid, points: NDArray[np.float64], voxels: float = BORDER_VOXELS) -> NDArray[np.bool_]:
    """Which of points (n, 3) in RAS mm lie so many voxels inside a grid.

    By default so far that a map on it is measured there, not continued.
    """
    index = grid.index(points)
    return np.asarray(((index >= voxels) & (index <= np.array(grid.shape) - 1.0 - voxels)).all(axis=1))


def _scale(state: _State) -> float:
    """Robust standard deviation of the residuals, mm: 1.4826 times the median of their sizes."""
    return max(1.4826 * float(np.median(np.abs(state.residual[state.area > 0.0]))), 1e-4)


def tukey(residual: NDArray[np.float64], cutoff: float) -> NDArray[np.float64]:
    """Weights (n,), 0 to 1, dimensionless, of residuals (n,) mm by Tukey's biweight: none from `cutoff` (mm) on."""
    return np.asarray(np.maximum(1.0 - (residual / cutoff) ** 2, 0.0) ** 2)


def _cost(state: _State, scale: float) -> float:
    """Mean of Tukey's rho over the area."""
    rho = 1.0 - np.maximum(1.0 - (state.residual / (TUKEY * scale)) ** 2, 0.0) ** 3
    return float(state.area @ rho / state.area.sum())


def _shown(state: _State, weight: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Turns that the surface shows (3, m) and does not show (3, k), as orthonormal columns.

    A turn counts by what is left of its normal matrix when the shifts have been eliminated (Schur complement).
    """
    # J^T W J per weight; turns in mm at the surface's radius of gyration, so that it has no unit
    scaled = state.jacobian / np.array([state.radius] * 3 + [1.0] * 3)
    normal = np.asarray((scaled * (weight / weight.sum())[:, None]).T @ scaled)
    coupling = normal[:3, 3:] @ np.linalg.pinv(normal[3:, 3:], rcond=1e-6, hermitian=True) @ normal[3:, :3]
    values, axes = np.linalg.eigh(normal[:3, :3] - coupling)
    return axes[:, values > UNDETERMINED], axes[:, values <= UNDETERMINED]
