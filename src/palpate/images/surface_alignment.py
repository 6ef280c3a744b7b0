"""Rigid motion between two images without bones, from all surfaces that both show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from palpate.errors import InputDataError
from palpate.images.alignment import (
    TUKEY,
    RigidFit,
    RigidMotion,
    seen_surface,
    tukey,
    within_border,
)
from palpate.images.distance import DistanceMap, IsosurfacePoints, smoothing_width, tissue_distance_map
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.parallel import mapped

SMOOTHER = 2.0  # times the usual smoothing: it takes the stairs of the voxels, and does the same to both images
MOST_POINTS = 400  # points of one surface; those between them add no information
LEAST_POINTS = 30
LENGTH_MM = 40.0  # over which an organ's own motion is alike
OWN_MOTION_MM = {  # standard deviation of each component of a surface's own motion
    Role.ESTIMATE: 1.5,
    Role.KNOWN: 1.5,
    Role.VOID: 1.5,
    Role.DRIVER: 4.0,  # it fills
    Role.RIGID: 0.3,
}
ROUGHNESS_MM = 1.0  # of a surface from place to place
SHIFT_MM, TURN_DEG = 10.0, 10.0  # standard deviation of each component of the motion, before anything is seen
CLEARLY = 5.0  # log of the odds by which a motion must explain the images better than none
LEAST_WEIGHT = 1e-3
NEGLIGIBLE = 1e-4  # variance of a smooth motion of variance 1 that is left out: moves the result by 1e-4 mm
MOST_STEPS = 40
STEP_TOLERANCE_MM = 1e-3


@dataclass(frozen=True, slots=True)
class MappedSurface:
    """The distance map of a tissue in one image, and the points of its surface away from the image's border."""

    map: DistanceMap
    points: IsosurfacePoints

    @classmethod
    def of(cls, distance: DistanceMap) -> MappedSurface:
        """That of a distance map."""
        return cls(distance, seen_surface(distance))


SurfaceMaps = Mapping[int, tuple[MappedSurface, MappedSurface]]  # by a tissue's index: in the first image and the later


@dataclass(frozen=True, slots=True)
class _Shown:
    """Points of one surface of the earlier image, and the later map of its tissue.

    places (n, 3) mm; rest (n,) mm: the earlier map there; own (n, r) mm: a factor F of the covariance F F^T of the
    surface's own motion along its normals.
    """

    places: NDArray[np.float64]
    rest: NDArray[np.float64]
    after: DistanceMap
    own: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _Trial:
    """What the surfaces (n,) points each say of a motion, which turns about `centre` (3,) mm.

    residuals (n,) mm with their derivatives (n, 6) by turn (rad) and shift (mm); seen (n,): in the later image;
    parameters (6,): turn (rad) and shift (mm) of the motion.
    """

    motion: RigidMotion
    parameters: NDArray[np.float64]
    residuals: tuple[NDArray[np.float64], ...]
    jacobians: tuple[NDArray[np.float64], ...]
    seen: tuple[NDArray[np.bool_], ...]

    @property
    def n_seen(self) -> int:
        """Number of points that come to lie inside the later image."""
        return int(sum(map(np.count_nonzero, self.seen)))

    @property
    def misfit(self) -> float:
        """Mean size of the residuals, mm, over the share of points inside: compares the ends of several starts."""
        inside = np.concatenate(self.seen)
        return float(np.abs(np.concatenate(self.residuals)[inside]).mean() / inside.mean())


def shown_tissues(segmentation: Segmentation) -> tuple[int, ...]:
    """Indices of the tissues that have a surface of their own: all but the meshed one that fills what others leave.

    That is the "remaining" one, or else the largest.
    """
    tissues = segmentation.tissues
    meshed = sorted((i for i, t in enumerate(tissues) if t.meshed), key=segmentation.volume)
    filler = [i for i in meshed if not tissues[i].labels] or meshed[-1:]
    return tuple(i for i in range(len(tissues)) if i not in filler)


def surface_maps(before: Segmentation, after: Segmentation, known: SurfaceMaps | None = None) -> SurfaceMaps:
    """Distance maps in both images of every tissue (by its index) with a surface of its own that both have.

    known: those of the same earlier image and another later one, whose maps of the former are not made again.
    """
    tissues = [i for i in shown_tissues(before) if before.mask(i).any() and after.mask(i).any()]
    width = SMOOTHER * smoothing_width(before.grid, after.grid)
    there = {i: first for i, (first, _) in (known or {}).items() if first.map.smoothing_mm == width}

    def mapped_surface(of: tuple[int, bool]) -> MappedSurface:
        """The surface of a tissue in the later image, or in the earlier one."""
        tissue, later = of
        if not later and tissue in there:
            return there[tissue]
        image = after if later else before
        return MappedSurface.of(tissue_distance_map(image, tissue, smoothing_mm=width, far=later))

    found = mapped(mapped_surface, [(i, later) for i in tissues for later in (False, True)])
    return dict(zip(tissues, zip(found[::2], found[1::2], strict=True), strict=True))


def align_surfaces(before: Segmentation, maps: SurfaceMaps) -> RigidFit:
    """The rigid motion before -> after that most surfaces agree on, unless no motion explains the images as well.

    Most probable motion under r_i = phi_after(R x_i + t) - phi_before(x_i) ~ N(0, K) of points x_i of every tissue's
    surface: K is that of a smooth motion of the tissue's own, alike over 40 mm, of 1.5 mm (a driver: 4 mm), and 1 mm
    from place to place, more where a residual is an outlier (Tukey); shifts of 10 mm and turns of 10 degrees are usual.
    It counts where it makes the images e^5 times as probable as no motion. Raises `InputDataError` when the images
    share too few surface points. maps: as of `surface_maps`.
    """
    surfaces, middles = list[_Shown](), list[tuple[NDArray[np.float64], NDArray[np.float64]]]()  # (3,) mm in both
    for tissue, pair in maps.items():
        first, second = (one.points for one in pair)
        if min(len(first.area), len(second.area)) < LEAST_POINTS:
            continue
        step = -(-len(first.area) // MOST_POINTS)
        places, normals = first.places[::step], first.normals[::step]
        alike = np.exp(-0.5 * cdist(places, places, "sqeuclidean") / LENGTH_MM**2) * (normals @ normals.T)
        own = OWN_MOTION_MM[before.tissues[tissue].role] * _factor(alike)
        surfaces.append(_Shown(places, pair[0].map.at(places), pair[1].map, own))
        middles.append((first.area @ first.places / first.area.sum(), second.area @ second.places / second.area.sum()))
    if not surfaces:
        raise InputDataError(
            "no tissue shows enough of its surface in both images, away from their borders, to measure the motion"
            " between them; use larger fields of view, or set align = 'none'"
        )
    centre = np.average([here for here, _ in middles], axis=0)
    shift = np.median([there - here for here, there in middles], axis=0)
    still = _trial(surfaces, centre, np.zeros(6))
    moved = np.linalg.norm(shift) > ROUGHNESS_MM  # else both starts lead to one place
    starts = [still, *([_trial(surfaces, centre, np.concatenate([np.zeros(3), shift]))] if moved else [])]
    found = [_descended(surfaces, centre, start) for start in starts if start.n_seen >= LEAST_POINTS]
    if not found:
        raise InputDataError(
            f"fewer than {LEAST_POINTS} surface points lie inside the later image, so the images show different parts"
            " of the body; check both"
        )
    best = min(found, key=lambda trial: trial.misfit)
    if 2 * still.n_seen > best.n_seen:
        both, prior = [a & b for a, b in zip(still.seen, best.seen, strict=True)], _prior(best.parameters)
        noises = (_noise(surfaces, trial, both) for trial in (still, best))  # at either, whichever says less
        if min(_cost(still, noise, both, prior) - _cost(best, noise, both, prior) for noise in noises) < CLEARLY:
            best = still
    seen = np.concatenate(best.seen)
    residual = np.concatenate(best.residuals)[seen]
    weight = tukey(residual, _cutoff(best))
    rms = float(np.sqrt(weight @ residual**2 / max(float(weight.sum()), 1e-12)))
    return RigidFit(best.motion, rms, int(np.count_nonzero(weight)), np.zeros((0, 3)))


def residuals_by_tissue(before: Segmentation, maps: SurfaceMaps, motion: RigidMotion) -> dict[str, float]:
    """How far each tissue's surface lies from the later image's once it has moved so, mm: root mean square."""
    found = {}
    for tissue, (first, second) in maps.items():
        places = first.points.places
        places = places[within_border(second.map.grid, motion.apply(places))]
        if len(places) >= LEAST_POINTS:
            distance = second.map.at(motion.apply(places)) - first.map.at(places)
            found[before.tissues[tissue].name] = float(np.sqrt(np.mean(distance**2)))
    return found


def _trial(surfaces: Sequence[_Shown], centre: NDArray[np.float64], parameters: NDArray[np.float64]) -> _Trial:
    turn, shift = Rotation.from_rotvec(parameters[:3]).as_matrix(), parameters[3:]
    motion = RigidMotion(turn, centre + shift - turn @ centre)
    residuals, jacobians, seen = [], [], []
    for surface in surfaces:
        places = motion.apply(surface.places)
        distance, slope = surface.after.values_and_gradients(places)
        residuals.append(distance - surface.rest)
        jacobians.append(np.hstack([np.cross(places - centre - shift, slope), slope]))
        seen.append(within_border(surface.after.grid, places))
    return _Trial(motion, parameters, tuple(residuals), tuple(jacobians), tuple(seen))


def _descended(surfaces: Sequence[_Shown], centre: NDArray[np.float64], trial: _Trial) -> _Trial:
    """Gauss-Newton; a step that does not lower the objective at the noise of its beginning is halved."""
    for _ in range(MOST_STEPS):
        noise, prior = _noise(surfaces, trial, trial.seen), _prior(trial.parameters)
        normal, slope = np.diag(prior), prior * trial.parameters
        for each, residual, jacobian, seen in zip(noise, trial.residuals, trial.jacobians, trial.seen, strict=True):
            product = each.product(np.column_stack([jacobian, residual])[seen])
            normal += product[:6, :6]
            slope += product[:6, 6]
        step = -np.linalg.solve(normal, slope)
        for _ in range(6):
            turn = Rotation.from_rotvec(step[:3]) * Rotation.from_rotvec(trial.parameters[:3])
            other = _trial(surfaces, centre, np.concatenate([turn.as_rotvec(), trial.parameters[3:] + step[3:]]))
            if _cost(other, noise, trial.seen, prior) <= _cost(trial, noise, trial.seen, prior):
                break
            step = 0.5 * step
        else:
            return trial
        trial = other
        if np.abs(step * np.array([LENGTH_MM] * 3 + [1.0] * 3)).max() < STEP_TOLERANCE_MM:
            break
    return trial


def _factor(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """F (n, r) of F F^T, a smooth covariance (n, n) but for what is too small to tell.

    By Cholesky's factorisation with pivots, which ends at the rank r (Harbrecht, Peters & Schneider, Appl. Numer. Math.
    62 (2012) 428).
    """
    lower, order, rank, _ = linalg.lapack.dpstrf(covariance, tol=NEGLIGIBLE, lower=1)
    factor = np.zeros((len(covariance), rank))
    factor[order - 1] = np.tril(lower)[:, :rank]
    return factor


@dataclass(frozen=True, slots=True)
class _Noise:
    """Covariance K = S^2 + F F^T of the residuals of n points, by Woodbury's identity.

    rough (n,) mm: the diagonal of S; smooth (n, r) = S^-1 F; lower (r, r): the Cholesky factor of I + smooth^T smooth.
    """

    rough: NDArray[np.float64]
    smooth: NDArray[np.float64]
    lower: NDArray[np.float64]

    def product(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        """A^T K^-1 A (m, m) of columns A (n, m)."""
        scaled = columns / self.rough[:, None]
        along = linalg.solve_triangular(self.lower, self.smooth.T @ scaled, lower=True)
        return np.asarray(scaled.T @ scaled - along.T @ along)


def _noise(surfaces: Sequence[_Shown], trial: _Trial, seen: Sequence[NDArray[np.bool_]]) -> tuple[_Noise, ...]:
    """Covariance of each surface's residuals among the points that are seen; outliers of the trial have more."""
    found, cutoff = [], _cutoff(trial)
    for surface, residual, inside in zip(surfaces, trial.residuals, seen, strict=True):
        rough = ROUGHNESS_MM / np.sqrt(np.maximum(tukey(residual[inside], cutoff), LEAST_WEIGHT))
        smooth = surface.own[inside] / rough[:, None]
        lower = linalg.cholesky(np.eye(smooth.shape[1]) + smooth.T @ smooth, lower=True)
        found.append(_Noise(rough, smooth, lower))
    return tuple(found)


def _cost(
    trial: _Trial, noise: Sequence[_Noise], seen: Sequence[NDArray[np.bool_]], prior: NDArray[np.float64]
) -> float:
    """Minus log probability of the residuals of the points that are seen, and of the motion, up to a constant."""
    misfits = [
        each.product(residual[inside, None])[0, 0]
        for each, residual, inside in zip(noise, trial.residuals, seen, strict=True)
    ]
    return 0.5 * float(sum(misfits) + prior @ trial.parameters**2)


def _prior(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
    """Precision (6,) of turn and shift, less for unusually large ones: images may be in worlds of their own."""
    usual = np.array([np.deg2rad(TURN_DEG)] * 3 + [SHIFT_MM] * 3) ** -2.0
    return np.asarray(usual * min(1.0, len(usual) / max(float(usual @ parameters**2), 1e-12)))


def _cutoff(trial: _Trial) -> float:
    """Size from which a residual is an outlier, mm: 4.685 of their robust standard deviations."""
    residual = np.concatenate(trial.residuals)[np.concatenate(trial.seen)]
    return TUKEY * max(1.4826 * float(np.median(np.abs(residual))), OWN_MOTION_MM[Role.ESTIMATE])
