"""The distance of surfaces as an observation: how its residuals count, and whose image points are compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import EstimationError
from palpate.images.distance import distance_map
from palpate.images.label_image import VoxelGrid
from palpate.observation.noise_model import EXACT_NOISE, NoiseModel
from palpate.observation.observed_surface import ObservedSurface
from palpate.observation.robust_loss import PowerLaw
from palpate.observation.surface_distance import robust_loss, surface_distance
from palpate.observation.target import surface_target, target_from
from palpate.phantoms.shapes import ball

STATED = NoiseModel(np.array([0.2**2]), np.array([4.0]))


def surface_of(sphere, radius=9.0, *, driver=False):
    vertices, triangles = sphere(3)
    everywhere, rim = np.ones(len(triangles), dtype=bool), np.zeros((len(triangles), 3), dtype=bool)
    points = np.arange(len(vertices))
    return ObservedSurface(0, "ball", points, radius * vertices, triangles, everywhere, rim, 1.0, driver=driver)


def voxels_of(radius):
    grid = VoxelGrid((34, 34, 34), np.array([[1.0, 0, 0, -16.6], [0, 1, 0, -16.3], [0, 0, 1, -16.4], [0, 0, 0, 1.0]]))
    centres = grid.world(np.indices(grid.shape).reshape(3, -1).T.astype(float))
    inside = np.linalg.norm(centres, axis=1).reshape(grid.shape) < radius
    return distance_map(inside, grid, smoothing_mm=0.6)


def seen_of(sphere, radius=9.0, **others):
    return surface_distance(surface_target(surface_of(sphere, radius), voxels_of(radius), voxels_of(radius)), **others)


@pytest.fixture(scope="module")
def seen(sphere):
    """A ball in voxels that has not moved."""
    return seen_of(sphere)


def exact(sphere, *, radius=9.0, later=9.0, driver=False, **others):
    """A ball that has grown, without voxels."""
    surface = surface_of(sphere, radius, driver=driver)
    points = later / radius * surface.rest
    shapes = [ball(np.zeros(3), size) for size in (radius, later)]
    target = target_from(surface, *shapes, level=0.0, image=(points, np.ones(len(points))))
    return surface_distance(target, **others)


def still(seen):
    return seen.residuals(np.zeros(len(seen.dofs)))


def test_surfaces_count_by_their_area(sphere):
    """Under one noise model the precision of the mean square is that of so many independent residuals."""
    noise = NoiseModel(STATED.variances, 0.5 * STATED.lengths)
    small, large = seen_of(sphere, 6.0).with_noise(noise), seen_of(sphere, 12.0).with_noise(noise)
    areas = [o.target.area.sum() for o in (small, large)]
    assert areas[1] > 3.5 * areas[0]
    assert small.weighting.precision / areas[0] == pytest.approx(large.weighting.precision / areas[1])
    assert large.weighting.precision == pytest.approx(areas[1] / noise.correlation_area / noise.sd**2)


def test_errors_alike_over_most_of_a_surface_leave_as_many_residuals_as_a_rigid_motion_has_freedoms(sphere):
    """More alike they would be motion of the surface, and each fit weaker than the one before."""
    wide = NoiseModel(STATED.variances, 10.0 * STATED.lengths)
    assert seen_of(sphere, 6.0).with_noise(wide).weighting.count == 6.0


def test_without_voxels_the_first_noise_is_that_of_exact_surfaces(sphere):
    seen = exact(sphere)
    assert seen.first_noise((seen,)) is EXACT_NOISE
    assert seen.noise_model is EXACT_NOISE


def test_stated_noise_holds_whatever_the_residuals_say(sphere):
    for seen in (seen_of(sphere, stated_noise=STATED), exact(sphere, stated_noise=STATED)):
        assert seen.noise_model is STATED
        assert seen.first_noise((seen,)) is STATED
        assert seen.fitted_noise([still(seen)]) is STATED


def test_a_scale_is_no_smaller_than_what_is_stated(sphere):
    assert exact(sphere, stated_noise=STATED).sd_bounds == (STATED.sd, np.inf)
    assert exact(sphere).sd_bounds[0] < STATED.sd


def test_no_part_of_a_drivers_wall_is_left_to_its_prior(sphere):
    """However far it lies from its image it pulls: an organ's outliers do so less and less."""
    far = np.array([-50.0, 50.0])
    driver, organ = (exact(sphere, later=9.3, driver=of).with_sd(0.3) for of in (True, False))
    pulls = [o.weighting.loss.weight(far) * np.abs(far) for o in (driver, organ)]
    assert pulls[0] == pytest.approx([pulls[0][0]] * 2)
    assert pulls[0][0] > 0.3
    assert np.all(pulls[1] < 0.1 * pulls[0])


def test_terraces_count_the_less_the_finer_the_noise(seen):
    """Their own noise adds to what all residuals have; the sum of the weights stays."""
    coarse, fine = (still(seen.with_noise(NoiseModel(np.array([v]), np.array([3.0])))) for v in (1.0, 1e-4))
    n = len(seen.target.area)
    rough = np.argsort(seen.target.terraces)[-20:]
    plain = 0.5 * seen.target.area / seen.target.area.sum()
    assert coarse.weights[:n] == pytest.approx(plain, rel=0.05)
    assert np.all(fine.weights[rough] < 0.2 * plain[rough])
    assert fine.weights.sum() == pytest.approx(1.0)


def test_an_image_without_a_point_that_faces_the_model_is_refused_by_name(seen):
    hidden = replace(seen.target.surface, observed=np.zeros(len(seen.target.surface.triangles), dtype=bool))
    lost = replace(seen, target=replace(seen.target, surface=hidden))
    with pytest.raises(EstimationError, match="'ball': none of the"):
        lost.rematched(np.zeros(len(seen.dofs)))


def test_the_fit_is_by_area(sphere):
    seen = exact(sphere, later=9.5)
    fit = seen.fit(still(seen))
    assert (fit.mean_mm, fit.rms_mm, fit.hd95_mm) == pytest.approx((0.5, 0.5, 0.5), abs=0.02)


def test_the_first_noise_is_what_rounding_leaves_of_a_plane(seen):
    """h^4 / (24 pi sigma^2) of two images: the scatter of voxelised planes of any direction, which lie anywhere."""
    noise = seen.first_noise((seen,))
    image = seen.target.voxels[0]
    edge, width = float(image.grid.spacing[0]), image.smoothing_mm
    assert noise.lengths == pytest.approx([np.sqrt(2.0) * width])
    grid = VoxelGrid((24, 24, 24), np.diag([edge] * 3 + [1.0]))
    centres = grid.world(np.indices(grid.shape).reshape(3, -1).T.astype(float))
    rng, errors = np.random.default_rng(3), []
    for _ in range(40):
        normal = rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        depth = centres @ normal - centres.mean(axis=0) @ normal - edge * rng.uniform(-0.5, 0.5)
        found = distance_map((depth < 0.0).reshape(grid.shape), grid, smoothing_mm=width).node_values().ravel()
        inner = (np.abs(centres - centres.mean(axis=0)).max(axis=1) < 5.0 * edge) & (np.abs(depth) < 0.5 * edge)
        errors.append(found[inner] - depth[inner])
    rounding = 2.0 * float(np.mean(np.concatenate(errors) ** 2))  # of both images
    assert rounding == pytest.approx(noise.variances[0], rel=0.5)


def test_terraces_that_flip_as_a_whole_are_no_outliers(seen, rng):
    """Surfaces along the grid that move by a fifth of a voxel: a fifth of them is seen one voxel further, the rest not.

    The best motion is that fifth; with a cutoff by the quiet residuals alone it would be nearly zero.
    """
    target = seen.target
    edge = float(target.voxels[0].grid.spacing[0])
    seen = np.where(rng.random(4000) < 0.2, edge, 0.0) + 0.03 * edge * rng.standard_normal(4000)

    def fitted(loss):
        motions = np.linspace(-0.2, 0.6, 161) * edge
        return motions[np.argmin([loss.rho(motion - seen).mean() for motion in motions])]

    assert fitted(robust_loss(0.03 * edge, target)) == pytest.approx(seen.mean(), abs=0.01 * edge)
    assert abs(fitted(PowerLaw(3.0 * 0.03 * edge))) < 0.05 * edge


def test_what_no_voxel_explains_counts_less(seen, rng):
    target = seen.target
    edge = float(target.voxels[0].grid.spacing[0])
    values = np.append(0.1 * edge * rng.standard_normal(1000), [-2.0 * edge, 2.0 * edge])
    loss = robust_loss(0.1 * edge, target)
    assert (loss.weight(values) < 0.3).nonzero()[0].tolist() == [1000, 1001]
