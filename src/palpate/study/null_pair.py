"""Two drawings of one state: how well surfaces are drawn, as a case states it under [noise] and [discrepancy]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.case.schema import nearest
from palpate.errors import ConfigurationError, InputDataError
from palpate.findings import Finding, warning_rows
from palpate.images.alignment import RigidMotion, fit_rigid_motion, moved, seen_surface, within_border
from palpate.images.checks import check_pair, refuse_unit
from palpate.images.distance import DistanceMap, IsosurfacePoints, observation_width, tissue_distance_map
from palpate.images.label_image import LabelImage
from palpate.images.segmentation import Segmentation, segment
from palpate.images.tissue import Role, Tissue
from palpate.observation.jacobian import Jacobian
from palpate.observation.noise_model import FitResponse, NoiseModel, fit_noise_model
from palpate.uncertainty import NORMAL_95

ALIGNMENTS = ("auto", "surfaces", "none")
MOST_POINTS = 20_000  # of a surface
LEAST_POINTS = 100


@dataclass(frozen=True, slots=True)
class DrawnSurface:
    """How one organ was drawn: the noise of one drawing, and how much larger the second one is on all sides.

    surface_sd_mm: standard deviation of the surface's place in one drawing; correlation_length_mm: l of its correlation
    exp(-d^2 / (2 l^2)); offset_mm: mean distance of the second surface outwards, with its 95 % interval; n_points: of
    the first surface.
    """

    organ: str
    surface_sd_mm: float
    correlation_length_mm: float
    offset_mm: float
    offset_interval95: tuple[float, float]
    n_points: int


@dataclass(frozen=True, slots=True)
class NullPair:
    """What two drawings of one state say: of each organ, and of all together, as a case has it.

    motion: of the whole, that was taken out; left_out: organs of one drawing alone, or of too small a surface.
    """

    organs: tuple[DrawnSurface, ...]
    surface_sd_mm: float
    correlation_length_mm: float
    surface_offset_mm: float
    motion: RigidMotion
    left_out: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()

    @property
    def toml(self) -> str:
        """The blocks [noise] and [discrepancy] of a case."""
        return (
            f"[noise]\nsurface_sd_mm = {self.surface_sd_mm:.3g}\n"
            f"correlation_length_mm = {self.correlation_length_mm:.2g}\n\n"
            f"[discrepancy]\nsurface_offset_mm = {self.surface_offset_mm:.2g}\n"
        )

    def to_dict(self) -> dict[str, Any]:
        """A JSON document, schema palpate.noise/1."""
        return {
            "schema": "palpate.noise/1",
            "organs": {
                each.organ: {
                    "surface_sd_mm": round(each.surface_sd_mm, 4),
                    "correlation_length_mm": round(each.correlation_length_mm, 3),
                    "offset_mm": round(each.offset_mm, 4),
                    "offset_interval95": [round(end, 4) for end in each.offset_interval95],
                    "points": each.n_points,
                }
                for each in self.organs
            },
            "noise": {
                "surface_sd_mm": round(self.surface_sd_mm, 4),
                "correlation_length_mm": round(self.correlation_length_mm, 3),
            },
            "discrepancy": {"surface_offset_mm": round(self.surface_offset_mm, 4)},
            "alignment": {
                "translation_mm": [round(float(part), 4) for part in self.motion.translation],
                "rotation_deg": round(self.motion.angle_deg, 4),
            },
            "left_out": list(self.left_out),
            "toml": self.toml,
            "warnings": warning_rows(self.findings),
        }


def noise_of_drawings(first: LabelImage, second: LabelImage, *, align: str = "auto") -> NullPair:
    """The noise with which the organs of two label images of one state were drawn.

    r_i = -phi_2(x_i) + phi_1(x_i) at points x_i of the first drawing's surface, phi the signed distances; their mean by
    area, o, is the second one's offset, and r - o has twice the variance of one drawing. Its covariance C(d) n_i.n_j
    is fitted as an estimate fits it (`fit_noise_model`, with what the mean, and the alignment, have taken out); that of
    o follows from it. surface_offset_mm is the root mean square of all offsets, their errors included.

    align: "surfaces" brings the second image to the first, all organs as one rigid body, which also takes the rigid
    part of the noise out; "none" does not, "auto" only where their grids differ. Raises `ConfigurationError` for any
    other, `InputDataError` when an image is in another unit of length, or the images are the same, show no organ that
    both have, or cannot be of one state (`check_pair`).
    """
    if align not in ALIGNMENTS:
        raise ConfigurationError(f"align is '{align}': {nearest(align, ALIGNMENTS)}")
    refuse_unit(first.grid, "the first")
    refuse_unit(second.grid, "the second")
    before, after, left_out = _organs(first, second)
    grids = (before.grid, after.grid)
    alike = grids[0].shape == grids[1].shape and np.allclose(grids[0].affine, grids[1].affine, atol=1e-3)
    motion = RigidMotion.identity()
    if align == "surfaces" or (align == "auto" and not alike):
        organs = range(1, len(before.tissues))
        motion = fit_rigid_motion([_maps(before, after, i, observation_width(*grids)) for i in organs]).motion
        after = moved(after, motion.inverse())
    findings = check_pair(before, after, name="the second")
    aligned = motion.angle_deg > 0.0 or bool(motion.translation.any())
    width = observation_width(*grids)
    seen = []
    for i, tissue in enumerate(before.tissues[1:], start=1):
        residual, surface = _distances(before, after, i, width)
        if len(residual) < LEAST_POINTS:
            left_out = (*left_out, tissue.name)
            continue
        seen.append((tissue.name, residual, surface))
    if not seen:
        raise InputDataError(
            f"no organ shows {LEAST_POINTS} points of its surface in both images, away from their borders: use larger"
            " or finer images"
        )
    surfaces = [surface for _, _, surface in seen]
    centre = np.average(np.concatenate([s.places for s in surfaces]), axis=0)
    found, deviations, variances = [], [], []
    for name, residual, surface in seen:
        share = surface.area / surface.area.sum()
        offset = float(share @ residual)
        noise = _fitted([residual - offset], [surface], centre, aligned=aligned)
        variance = float(noise.covariance(share[None], surface.places, surface.normals)[0, 0])
        half = NORMAL_95 * float(np.sqrt(variance))
        one, interval = _one_drawing(noise), (offset - half, offset + half)
        found.append(DrawnSurface(name, *one, offset, interval, len(residual)))
        deviations.append(residual - offset)
        variances.append(variance)
    whole = _one_drawing(_fitted(deviations, surfaces, centre, aligned=aligned))
    offsets = np.array([each.offset_mm for each in found])
    rms = float(np.sqrt(np.mean(offsets**2 + variances)))
    return NullPair(tuple(found), *whole, rms, motion, left_out, findings)


def _organs(first: LabelImage, second: LabelImage) -> tuple[Segmentation, Segmentation, tuple[str, ...]]:
    """Both images in the organs that both have, after the rest; and the names of organs that only one has.

    An organ is a label by its name, or where an image has none by its number, other than 0 and the one that covers most
    of the image's border.
    """
    numbers = list[dict[str, int]]()  # the label of each organ of an image
    for image in (first, second):
        layers = [np.take(image.labels, end, axis).ravel() for axis in range(3) for end in (0, -1)]
        values, counts = np.unique(np.concatenate(layers), return_counts=True)
        around = {0, int(values[np.argmax(counts)])}
        present = sorted({int(n) for layer in image.labels for n in np.unique(layer)} - around)
        numbers.append({image.names.get(n, f"label {n}"): n for n in present})
    both = [name for name in numbers[0] if name in numbers[1]]
    alone = tuple(sorted(set(numbers[0]) ^ set(numbers[1])))
    if not both:
        raise InputDataError(
            f"the two images have no organ in common: the first has {list(numbers[0])[:8]}, the second"
            f" {list(numbers[1])[:8]}; give a label table (--labels), or the same labels in both"
        )
    rest = Tissue("the rest", Role.VOID)
    tissues = [(rest, *(Tissue(name, Role.ESTIMATE, (found[name],)) for name in both)) for found in numbers]
    before, after = (segment(image, own) for image, own in zip((first, second), tissues, strict=True))
    return before, after, alone


def _maps(before: Segmentation, after: Segmentation, tissue: int, width: float) -> tuple[DistanceMap, DistanceMap]:
    """The distance maps of one organ in both images."""
    one, other = (tissue_distance_map(image, tissue, smoothing_mm=width) for image in (before, after))
    return one, other


def _distances(
    before: Segmentation, after: Segmentation, tissue: int, width: float
) -> tuple[NDArray[np.float64], IsosurfacePoints]:
    """How far the second surface lies outside the first one's points, (n,) mm, and these points."""
    one, other = _maps(before, after, tissue, width)
    surface = seen_surface(one)
    keep = np.flatnonzero(within_border(other.grid, surface.places))
    keep = keep[:: -(-len(keep) // MOST_POINTS) or 1]
    chosen = IsosurfacePoints(surface.places[keep], surface.normals[keep], surface.area[keep])
    return one.at(chosen.places) - other.at(chosen.places), chosen


def _fitted(
    deviations: Sequence[NDArray[np.float64]],
    surfaces: Sequence[IsosurfacePoints],
    centre: NDArray[np.float64],
    *,
    aligned: bool,
) -> NoiseModel:
    """The noise of deviations (n,) mm from each surface's mean, of which a motion of the whole was taken out, too."""
    ends = np.cumsum([0, *(len(surface.area) for surface in surfaces)])
    columns = np.zeros((ends[-1], len(surfaces) + 6 * aligned))
    for k, surface in enumerate(surfaces):
        rows = slice(ends[k], ends[k + 1])
        columns[rows, k] = 1.0
        if aligned:
            columns[rows, -6:] = np.hstack([np.cross(surface.places - centre, surface.normals), surface.normals])
    weights = np.concatenate([surface.area for surface in surfaces])
    gains = weights[:, None] * columns @ np.linalg.pinv(columns.T @ (weights[:, None] * columns), hermitian=True)
    parts = [slice(start, end) for start, end in pairwise(ends)]
    places, normals = [s.places for s in surfaces], [s.normals for s in surfaces]
    response = FitResponse(
        [Jacobian.of(columns[part]) for part in parts], [Jacobian.of(gains[part]) for part in parts], places, normals
    )
    return fit_noise_model(deviations, places, normals, response)


def _one_drawing(noise: NoiseModel) -> tuple[float, float]:
    """Standard deviation and correlation length, mm, of one of two drawings whose difference has this noise.

    The length is that of one Gaussian with the same correlation area.
    """
    return noise.sd / np.sqrt(2.0), float(np.sqrt(noise.correlation_area / (2.0 * np.pi)))
