"""The distance between a surface of the model and an image's, as a difference to the rest state: an `Observation`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.errors import EstimationError
from palpate.images.alignment import within_border
from palpate.images.checks import later_names
from palpate.images.distance import DistanceMap, NearMaps, tissue_distance_map
from palpate.images.segmentation import Segmentation
from palpate.mesh.surface import vertex_normals
from palpate.observation.contract import Fit, ImagedBody, Observation, Residuals, Weighting
from palpate.observation.noise_model import (
    EXACT_NOISE,
    SEGMENTATION_NOISE,
    FitResponse,
    NoiseModel,
    fit_noise_model,
)
from palpate.observation.observed_surface import ObservedSurface, field_of_view, observed_surfaces, seen_in
from palpate.observation.robust_loss import FAR, HUBER, Huber, PowerLaw, RobustLoss
from palpate.observation.surface_residuals import Correspondence, correspondence, surface_residuals
from palpate.observation.target import SurfaceTarget, surface_target
from palpate.parallel import mapped

FLOOR = 1e-3  # mm, the least standard deviation of a surface in an image
LEAST_POINTS = 30  # needed to compare a surface that is neither an organ's nor a driver's
RIGID = 6.0  # freedoms of a rigid motion
AROUND = 8.0  # widths of the Gaussian around a surface within which an imaged model's maps are made


@dataclass(frozen=True, slots=True)
class SurfaceDistance:
    """Signed distances between one surface of the model and both images of it; implements `Observation`.

    model -> image: r = d_after(x + u) - d_before(x) - b(x)        at quadrature points of the observed triangles;
    image -> model: r = s(y) - (d_before(X) - level) - b(X)        where s is the signed distance of the closest model
    point x = X + u(X) from the image point y, positive when the model lies outside; b is `held.excess`. Each direction
    has half of the weight, shared out by area and, where voxels' terraces add to the noise n (mm^4, its variance times
    its correlation area), as n / (n + terraces). stated_noise: that of the case, which holds whatever the residuals
    say.
    """

    target: SurfaceTarget
    held: Correspondence
    noise_model: NoiseModel
    weighting: Weighting
    stated_noise: NoiseModel | None = None

    @property
    def kind(self) -> str:
        """What is compared."""
        return "surface distance"

    @property
    def description(self) -> str:
        """What the misfit is, for a methods section."""
        return (
            "the symmetric surface distance between model and later image, taken as a difference to the rest state, so"
            " that what smoothing, voxels and facets do to both images drops out, without the faces on drivers, bones"
            " and the image's border, and with its full weight up to the edge of a voxel"
        )

    @property
    def name(self) -> str:
        """The tissue's name."""
        return self.target.surface.name

    @property
    def dofs(self) -> NDArray[np.int64]:
        """Numbers (n_dofs,) of the surface's unknowns."""
        return self.target.surface.dofs

    @property
    def tissue(self) -> int:
        """Index of the tissue."""
        return self.target.surface.tissue

    @property
    def unit(self) -> str:
        """Millimetre."""
        return "mm"

    @property
    def of_driver(self) -> bool:
        """Whether the surface is a driver's wall."""
        return self.target.surface.driver

    @property
    def observed_share(self) -> float:
        """Share of the surface's area that both images show, and that touches neither driver, bone nor their border."""
        area = self.target.area
        return self.target.surface.share * float(self.held.of_model(area).sum() / area.sum())

    def residuals(self, displacement: NDArray[np.float64], offset: float = 0.0) -> Residuals:
        """Residuals and their derivative at a displacement (n_dofs,) mm: model -> image first, then image -> model.

        A surface that is drawn by an offset (mm) further out is the deformed one moved so far along its normals: both
        are compared where they meet. Added to the distance instead, it would be rewarded for leading away from the
        surface, where a distance map has less of the voxels' noise.
        Their derivative is that of a smooth surface without noise, n . du. An exact one would also hold how voxel noise
        and facets change as the surface slides along itself, which tells nothing of how it slides.
        """
        found = surface_residuals(self.target, self._drawn(displacement, offset), self.held)
        places = found.places - offset * found.normals  # in the body, not on what is drawn of it
        return self.weighed(replace(found, places=places, shares=found.weights))

    def weighed(self, residuals: Residuals) -> Residuals:
        """The same residuals, those where terraces add to the noise with less weight."""
        noise, shares = self.noise_model.sd**2 * self.noise_model.correlation_area, residuals.shares
        assert shares is not None, "residuals of a surface have weights by area"
        terraces = np.concatenate([self.held.of_model(self.target.terraces), self.held.terraces[self.held.kept]])
        weights = shares * noise / (noise + terraces)
        return replace(residuals, weights=weights * (shares.sum() / weights.sum()))

    def rematched(self, displacement: NDArray[np.float64], offset: float = 0.0) -> SurfaceDistance:
        """The same with the points that both images show chosen at a displacement (n_dofs,) mm and an offset, mm.

        Those of the later image that face the observed part, and those of the model that come to lie in its field of
        view. Raises `EstimationError` when there are none.
        """
        held = correspondence(self.target, self._drawn(displacement, offset))
        if not held.kept.any() or not held.of_model(self.target.area).any():
            raise EstimationError(
                f"'{self.name}': none of the {len(held.kept)} points of its surface in the later image faces the"
                " observed part of the model; check that it is the same organ, and that the images are aligned"
            )
        return replace(self, held=held)

    def with_noise(self, noise: NoiseModel) -> SurfaceDistance:
        """All residuals and all image points count, its independent ones by their variance."""
        count = self._count(noise)
        weighting = Weighting(count / noise.sd**2, PowerLaw(), count)
        return replace(self, held=_everywhere(self.target), noise_model=noise, weighting=weighting)

    @property
    def sd_bounds(self) -> tuple[float, float]:
        """From what no image knows better, or the case states, on."""
        return (FLOOR if self.stated_noise is None else self.stated_noise.sd), np.inf

    def with_sd(self, sd: float) -> SurfaceDistance:
        """The same with the loss of that scale (see `robust_loss`)."""
        count = self.weighting.count
        return replace(self, weighting=Weighting(count / sd**2, robust_loss(sd, self.target), count))

    def with_correlation(self, noise: NoiseModel) -> SurfaceDistance:
        """The same with another number of independent residuals, and its terraces beside that noise."""
        count = self._count(noise)
        weighting = replace(self.weighting, precision=count / self.weighting.sd**2, count=count)
        return replace(self, noise_model=noise, weighting=weighting)

    def first_noise(self, peers: Sequence[SurfaceDistance]) -> NoiseModel:
        """The rounding of both images' voxels; without any, `EXACT_NOISE`; what is stated, where it is.

        Voxels of edge h round a surface by a variance of h^2 / 12 a voxel, which a Gaussian of width sigma spreads:
        h^4 / (48 pi sigma^2) for each image, with the correlation length sqrt(2) sigma. Residuals that are left put too
        small a noise right; too large a one leaves motion of the drivers in them, which then passes for noise.
        """
        if self.stated_noise is not None:
            return self.stated_noise
        maps = [image for peer in peers for image in peer.target.voxels or ()]
        if not maps:
            return EXACT_NOISE
        variances = [m.grid.voxel_volume ** (4.0 / 3.0) / (48.0 * np.pi * m.smoothing_mm**2) for m in maps]
        width = float(np.mean([m.smoothing_mm for m in maps]))
        return NoiseModel(np.array([2.0 * float(np.mean(variances))]), np.array([np.sqrt(2.0) * width]))

    def fitted_noise(self, residuals: Sequence[Residuals], response: FitResponse | None = None) -> NoiseModel:
        """What the residuals tell (see `fit_noise_model`); what is stated, where it is."""
        if self.stated_noise is not None:
            return self.stated_noise
        return fit_noise_model(
            [r.values for r in residuals], [r.material for r in residuals], [r.normals for r in residuals], response
        )

    def imaging_error(self, residuals: Residuals, before: NearMaps, after: NearMaps) -> NDArray[np.float64]:
        """Errors (n,) mm of the residuals when the fitted model itself is imaged.

        Both directions of the distance see the same error and have half the weight each: that of the direction model ->
        image counts twice, and the other one not. Within a voxel of an image's border there is none: what a grid that
        lies elsewhere shows there ends elsewhere, as no pair of images does.
        """
        target, surface = self.target, self.target.surface
        if target.voxels is None:
            return np.zeros(len(residuals.values))
        width = target.voxels[1].smoothing_mm
        corners, barycentric = (self.held.of_model(of) for of in (target.triangle, target.barycentric))
        corners = surface.triangles[corners]
        rest = np.einsum("qk,qka->qa", barycentric, surface.rest[corners])
        excess = np.einsum("qk,qk->q", barycentric, self.held.excess[corners])
        maps = [images.of(surface.tissue, smoothing_mm=width, reach_mm=AROUND * width) for images in (before, after)]
        errors, n = np.zeros(len(residuals.values)), len(rest)
        places = residuals.places[:n]
        shown = within_border(before.image.grid, rest, 1.0) & within_border(after.image.grid, places, 1.0)
        errors[:n] = np.where(shown, 2.0 * (maps[1].at(places) - maps[0].at(rest) - excess), 0.0)
        return errors

    def growth_error(self, residuals: Residuals, tissue: str, peers: Sequence[Observation]) -> NDArray[np.float64]:
        """Change (n,) of the residuals: -1 on the tissue's own surface, 1 where it touches this one, and draws it in.

        Both directions of the distance see the same: d_after falls by what the surface moves outwards, and so does the
        signed distance of the model from it.
        """
        if tissue == self.name:
            return np.full(len(residuals.values), -1.0)
        errors = np.zeros(len(residuals.values))
        for peer in peers:
            if peer.name == tissue and isinstance(peer, SurfaceDistance) and peer.target.voxels is not None:
                reach = 0.5 * float(np.sqrt(np.mean(peer.target.voxels[1].grid.spacing ** 2)))
                errors[np.abs(peer.target.after.at(residuals.places)) < reach] = 1.0
        return errors

    def fit(self, residuals: Residuals) -> Fit:
        """Distances by area."""
        distance, weights = np.abs(residuals.values), residuals.weights
        order = np.argsort(distance)
        share = np.cumsum(weights[order]) / float(weights.sum())
        return Fit(
            mean_mm=float(np.average(distance, weights=weights)),
            rms_mm=float(np.sqrt(np.average(distance**2, weights=weights))),
            hd95_mm=float(distance[order][np.searchsorted(share, 0.95)]),
            dice=None,
        )

    def _drawn(self, displacement: NDArray[np.float64], offset: float) -> NDArray[np.float64]:
        """Displacement (n_vertices, 3) mm from rest to the surface as an image draws it, an offset (mm) further out."""
        moved, surface = displacement.reshape(-1, 3), self.target.surface
        if offset == 0.0:
            return moved
        return moved + offset * vertex_normals(surface.rest + moved, surface.triangles)

    def _count(self, noise: NoiseModel) -> float:
        """Number of independent residuals: the area that is compared by that over which errors are alike.

        It is at least 6, the freedoms of a rigid motion: what is alike over more of a surface is its motion.
        """
        return max(float(self.held.of_model(self.target.area).sum()) / noise.correlation_area, RIGID)


def surface_distance(target: SurfaceTarget, *, stated_noise: NoiseModel | None = None) -> SurfaceDistance:
    """The observation of one surface; all its residuals count by the stated noise, or by what voxels leave of it."""
    noise = stated_noise or SEGMENTATION_NOISE
    made = SurfaceDistance(target, _everywhere(target), noise, Weighting(1.0, PowerLaw()), stated_noise)
    return made.with_noise(made.first_noise((made,)))


def surface_distances(
    imaged: ImagedBody, surfaces: Sequence[ObservedSurface] | None = None
) -> tuple[tuple[SurfaceDistance, ...], ...]:
    """Those of each later image, by default of every surface that it and the reference image show.

    Raises `GeometryError` where too little is seen of an `estimate` tissue or a driver; other surfaces are left out.
    """
    seen = observed_surfaces(imaged.space, imaged.before) if surfaces is None else tuple(surfaces)

    def maps(image: Segmentation, of: Sequence[ObservedSurface]) -> list[DistanceMap]:
        """The distance map of each surface's tissue."""
        return mapped(lambda s: tissue_distance_map(image, s.tissue, smoothing_mm=imaged.smoothing_mm), of)

    before = dict(zip([s.tissue for s in seen], maps(imaged.before, seen), strict=True))
    found = []
    for name, image in zip(later_names(len(imaged.after)), imaged.after, strict=True):
        view = field_of_view(imaged.before.grid, image.grid, smoothing_mm=imaged.smoothing_mm)
        both = [s for s in seen if surfaces is not None or seen_in(s, image, view, name=name)]
        pairs = zip(both, maps(image, both), strict=True)
        targets = [surface_target(s, before[s.tissue], after, view) for s, after in pairs]
        needed = [t for t in targets if t.surface.needed or min(len(t.area), len(t.image_points)) >= LEAST_POINTS]
        found.append(tuple(surface_distance(target, stated_noise=imaged.stated_noise) for target in needed))
    return tuple(found)


def robust_loss(sd: float, target: SurfaceTarget) -> RobustLoss:
    """The loss of residuals of scale sd (mm) of one surface: with a power law's tails of an organ, Huber's of a driver.

    A cutoff is 3 or 1.345 scales, and at least the edge of a voxel (half of each image's; root mean square of the three
    edges): so far can rounding move a surface that runs along the grids, and terraces that flip as a whole are no
    outliers. They are rare and large and carry the motion of a surface that else seems to stand still: if they counted
    less than what is quiet, every motion would be found too small.

    A driver's wall moves by modes that its own residuals hold, beside a prior that is learned from them. A part of it
    that no longer pulls is held by the prior alone, which then seems to say more and moves the wall further off.
    """
    rounding = float(sum(0.5 * np.sqrt(np.mean(image.grid.spacing**2)) for image in target.voxels or ()))
    return Huber(max(HUBER * sd, rounding)) if target.surface.driver else PowerLaw(max(FAR * sd, rounding))


def _everywhere(target: SurfaceTarget) -> Correspondence:
    """Every image point in the later image's field of view, until the model is near enough to choose."""
    n = len(target.image_points)
    shown = None if target.view is None else target.shown(np.zeros_like(target.surface.rest))
    return Correspondence(np.ones(n, dtype=bool), np.zeros(n), np.zeros(len(target.surface.rest)), shown)
