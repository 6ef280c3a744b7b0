"""The contract of observations: every class that has its members keeps it, without a test of its own."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from dataclasses import FrozenInstanceError, dataclass, fields, is_dataclass

import numpy as np
import pytest

import palpate.observation
from palpate.images.distance import distance_map
from palpate.images.label_image import VoxelGrid
from palpate.mesh.locate import located
from palpate.mesh.space import lagrange_space
from palpate.observation.contract import DataFile, Observation, OfMaterial, OfPoints, Rematched, n_seen
from palpate.observation.force import Force
from palpate.observation.noise_model import NoiseModel
from palpate.observation.observed_surface import ObservedSurface
from palpate.observation.point_displacement import PointDisplacement, point_displacement
from palpate.observation.point_table import PointTable, stated_sd
from palpate.observation.stated_noise import stated_noise
from palpate.observation.surface_distance import SurfaceDistance, surface_distance
from palpate.observation.target import surface_target, target_from
from palpate.phantoms.shapes import Ellipsoid, rotation_about
from palpate_validation.structured_meshes import box_mesh

MEMBERS = [name for name in vars(Observation) if not name.startswith("_")]
STEPS = np.array([1e-2, 1e-3, 1e-4])
NOISE = NoiseModel(np.array([0.2**2]), np.array([4.0]))


FIELD = DataFile("displacement-field", "field", (), 1, 0.2, correlation_mm=3.0)
MARKERS = DataFile("landmarks", "markers", (), 1, 0.2, covariance_mm2=np.diag([0.04, 0.04, 0.25]) + 0.01)


def rematched(case):
    """The same with what belongs together chosen anew, of those that choose."""
    return case.seen.rematched(case.place) if isinstance(case.seen, Rematched) else case.seen


def implementations():
    """All classes of the observations that have every member of the contract."""
    found = set()
    for module in pkgutil.walk_packages(palpate.observation.__path__, "palpate.observation."):
        for _, kind in inspect.getmembers(importlib.import_module(module.name), inspect.isclass):
            own = kind.__module__ == module.name and kind is not Observation
            if own and all(hasattr(kind, member) for member in MEMBERS):
                found.add(kind)
    return found


def ball(sphere, *, driver):
    vertices, triangles = sphere(2)
    everywhere, rim = np.ones(len(triangles), dtype=bool), np.zeros((len(triangles), 3), dtype=bool)
    points = np.arange(len(vertices))
    return ObservedSurface(0, "ball", points, 10.0 * vertices, triangles, everywhere, rim, 1.0, driver=driver)


def of_smooth_surfaces(sphere, _point_motion):
    """Two ellipsoids that are neither the model nor each other, without voxels."""
    turned = rotation_about(np.array([1.0, 2.0, 3.0]), 30.0)
    before = Ellipsoid(np.zeros(3), np.array([10.6, 9.7, 10.2]), turned)
    after = Ellipsoid(np.array([0.8, -0.5, 0.3]), np.array([9.4, 10.9, 10.4]), turned)
    towards = np.random.default_rng(3).standard_normal((400, 3))
    points = after.surface(towards / np.linalg.norm(towards, axis=1, keepdims=True))
    target = target_from(ball(sphere, driver=True), before, after, level=0.1, image=(points, np.full(400, 3.0)))
    return surface_distance(target)


def of_voxels(sphere, _point_motion, bias=0.0):
    """A ball that has shifted and shrunk, in voxels whose distance maps have a bias."""
    grid = VoxelGrid((34, 34, 34), np.array([[1.0, 0, 0, -16.6], [0, 1, 0, -16.3], [0, 0, 1, -16.4], [0, 0, 0, 1.0]]))
    centres = grid.world(np.indices(grid.shape).reshape(3, -1).T.astype(float))
    maps = []
    for middle, radius in ((np.zeros(3), 10.3), (np.array([1.2, 0.0, 0.0]), 10.0)):
        inside = np.linalg.norm(centres - middle, axis=1).reshape(grid.shape) < radius
        maps.append(distance_map(inside, grid, smoothing_mm=0.6).shifted(bias))
    return surface_distance(surface_target(ball(sphere, driver=False), *maps))


def of_point(_sphere, point_motion):
    return point_motion.point_motion(4, np.array([1.0, 2.0, 3.0]), np.array([0.3, -0.2, 0.5]), sd_mm=0.1)


def of_points(_sphere, _point_motion, *, file=FIELD, cells=None):
    """Points in a box of two tissues whose measured motion the model does not have."""
    space = lagrange_space(box_mesh(2), "P2")
    rng = np.random.default_rng(5)
    low, high = space.points.min(axis=0), space.points.max(axis=0)
    points = rng.uniform(low, high, (40, 3))
    moved = 0.5 * rng.standard_normal((40, 3))
    places = located(space.mesh, points)
    assert places.inside.all()
    table = PointTable(points, points + moved, stated_sd(file, len(points)), ("",) * len(points), ())
    return point_displacement(space, table, places, file=file, description="points", cells=cells)


def of_markers(sphere, point_motion):
    return of_points(sphere, point_motion, file=MARKERS)


def of_means(sphere, point_motion):
    return of_points(sphere, point_motion, cells=np.arange(40)[:, None] // 4)


@dataclass(frozen=True)
class Spring:
    """A force that is k_r u of the moduli k_r, as a reaction is to first order."""

    dofs: np.ndarray
    centre: np.ndarray

    def combined(self, _fields):
        return self

    def at(self, displacement, moduli, coefficients):
        stretch = displacement[2] - displacement[5]
        slope = moduli.sum() * np.eye(len(displacement))[2] - moduli.sum() * np.eye(len(displacement))[5]
        return moduli.sum() * stretch, slope, np.concatenate([moduli * stretch, 0.0 * coefficients])

    def by_poisson(self, displacement, moduli, _coefficients):
        return 2.0 * moduli * (displacement[2] - displacement[5])


def of_force(_sphere, _point_motion):
    spring = Spring(np.arange(6), np.zeros(3))
    term = Force("force", *stated_noise(0.2, 1), spring, np.eye(3)[2], 1.5)
    return term.with_material(np.array([2.0, 3.0]), np.zeros(2))


MAKERS = {
    Force: {"spring": of_force},
    SurfaceDistance: {"smooth surfaces": of_smooth_surfaces, "voxels": of_voxels},
    PointDisplacement: {"field": of_points, "markers": of_markers, "means": of_means},
}
TOY = {"toy": of_point}
CASES = {f"{kind.__name__}-{name}": make for kind, makers in MAKERS.items() for name, make in makers.items()} | TOY


def test_every_implementation_is_tested_here(point_motion):
    assert implementations() == set(MAKERS)
    assert all(hasattr(point_motion.PointMotion, member) for member in MEMBERS)


@dataclass(frozen=True)
class Case:
    """An observation, and a displacement (n_dofs,) mm at which it is asked."""

    seen: Observation
    place: np.ndarray

    @property
    def residuals(self):
        return self.seen.residuals(self.place)


@pytest.fixture(params=CASES)
def case(request, sphere, point_motion, rng):
    seen = CASES[request.param](sphere, point_motion)
    return Case(seen, 0.3 * rng.standard_normal(n_seen(seen)))


def test_residuals_have_the_shapes_that_are_promised(case):
    found, n = case.residuals, len(case.residuals.values)
    assert found.weights.shape == (n,)
    for triple in (found.places, found.normals, found.material):
        assert triple.shape == (n, 3)
    assert np.linalg.norm(found.normals, axis=1) == pytest.approx(np.ones(n))
    assert found.jacobian.shape == (n, n_seen(case.seen))
    assert case.seen.kind
    assert case.seen.name
    assert 0.0 < case.seen.observed_share <= 1.0


@pytest.mark.parametrize("make", [of_point, of_points, of_markers, of_means, of_force])
def test_the_jacobian_is_that_of_central_differences(make, sphere, point_motion, rng):
    """Of all kinds but surfaces, whose sliding it leaves out (see test_surface_residuals.py)."""
    seen, h = make(sphere, point_motion), 1e-3
    place, direction = 0.3 * rng.standard_normal((2, n_seen(seen)))
    high, low = (seen.residuals(place + sign * h * direction).values for sign in (1.0, -1.0))
    slope = seen.residuals(place).jacobian @ direction
    assert np.linalg.norm(slope) > 0.0
    assert (high - low) / (2.0 * h) == pytest.approx(slope, rel=1e-8, abs=1e-10)


def test_the_jacobian_and_its_transpose_are_adjoint(case, rng):
    found = case.residuals
    motion, pull = (rng.standard_normal(n) for n in found.jacobian.shape[::-1])
    assert (found.jacobian @ motion) @ pull == pytest.approx(motion @ (found.jacobian.T @ pull), rel=1e-10)


def test_weights_sum_to_one_whatever_has_been_done(case):
    seen = case.seen
    others = [rematched(case), seen.with_noise(NOISE), seen.with_correlation(NOISE), seen.with_sd(0.2)]
    for one in (seen, *others):
        weights = one.residuals(case.place).weights
        assert weights.sum() == pytest.approx(1.0)
        assert np.all(weights >= 0.0)


def test_nothing_that_it_is_asked_changes_it(case):
    seen, before = case.seen, case.residuals
    held = {member.name: getattr(seen, member.name) for member in fields(seen)}
    others = [rematched(case), seen.with_noise(NOISE), seen.with_correlation(NOISE), seen.with_sd(0.2)]
    seen.fitted_noise([before])
    assert all(type(one) is type(seen) for one in others)
    assert all(getattr(seen, name) is value for name, value in held.items())
    assert np.array_equal(case.residuals.values, before.values)
    assert np.array_equal(case.residuals.weights, before.weights)
    assert is_dataclass(seen)
    for name in held:
        with pytest.raises(FrozenInstanceError):
            setattr(seen, name, None)


def test_residuals_count_by_the_variance_of_their_noise(case):
    fine, rough = (case.seen.with_noise(NoiseModel(np.array([v]), np.array([4.0]))) for v in (0.01, 0.04))
    assert fine.noise_model.sd == pytest.approx(0.1)
    assert fine.weighting.precision == pytest.approx(4.0 * rough.weighting.precision)
    assert fine.weighting.loss.weight(np.array([-1e3, 1e3])).tolist() == [1.0, 1.0]


def test_another_scale_is_another_weight_and_the_same_number_of_residuals(case):
    low, high = case.seen.sd_bounds
    assert 0.0 < low <= high
    one, two = (case.seen.with_sd(sd).weighting for sd in (0.1, 0.2))
    assert one.sd == pytest.approx(0.1)
    assert one.count == two.count == case.seen.weighting.count
    assert one.precision == pytest.approx(4.0 * two.precision)
    assert case.seen.with_sd(0.2).with_correlation(NOISE).weighting.sd == pytest.approx(0.2)


def test_residuals_are_weighed_as_they_are_made(case):
    there = case.seen.with_correlation(NOISE)
    assert there.weighed(case.residuals).weights == pytest.approx(there.residuals(case.place).weights)


def test_noise_is_known_before_residuals_tell_and_after(case):
    first, fitted = case.seen.first_noise((case.seen, case.seen)), case.seen.fitted_noise([case.residuals])
    assert first.sd > 0.0
    assert fitted.sd > 0.0
    assert case.seen.noise_model.sd == pytest.approx(first.sd)


def test_the_fit_is_a_length(case):
    fit = case.seen.fit(case.residuals)
    assert 0.0 < fit.mean_mm <= fit.rms_mm <= fit.hd95_mm
    assert fit.dice is None


@pytest.mark.parametrize("make", [make for make in CASES.values() if "bias" in inspect.signature(make).parameters])
def test_a_bias_of_both_distance_maps_changes_nothing(make, sphere, point_motion, rng):
    """Of every observation that is made of them."""
    plain, biased = (make(sphere, point_motion, bias) for bias in (0.0, 0.35))
    place = 0.3 * rng.standard_normal(n_seen(plain)) + np.tile([1.0, 0.0, 0.0], n_seen(plain) // 3)
    for change in (lambda o: o, lambda o: o.rematched(place)):
        found = [change(seen).residuals(place) for seen in (plain, biased)]
        assert found[1].values == pytest.approx(found[0].values, abs=1e-9)
        assert found[1].weights == pytest.approx(found[0].weights, abs=1e-9)
        assert abs(found[1].jacobian - found[0].jacobian).max() < 1e-9
        assert np.std(found[0].values) > 0.1


@pytest.mark.parametrize("make", [of_points, of_markers, of_means])
def test_points_that_are_drawn_move_as_their_residuals_say(make, sphere, point_motion, rng):
    """Displacements that the points were measured to have leave none."""
    seen = make(sphere, point_motion)
    assert isinstance(seen, OfPoints)
    place = 0.3 * rng.standard_normal(n_seen(seen))
    motions, found = seen.point_motions(place), seen.residuals(place)
    n = len(motions.rest)
    assert motions.rest.shape == motions.observed.shape == motions.fitted.shape == (n, 3)
    assert np.linalg.norm(motions.fitted - motions.observed, axis=1) == pytest.approx(found.distances)
    shift = np.array([0.3, -0.1, 0.2])
    uniform = seen.point_motions(np.tile(shift, n_seen(seen) // 3)).fitted
    assert uniform == pytest.approx(np.tile(shift, (n, 1)))
    assert not isinstance(of_smooth_surfaces(sphere, point_motion), OfPoints)


def test_what_depends_on_the_moduli_says_how(sphere, point_motion):
    """Taylor by ln E at a held displacement, and nothing before moduli are known."""
    seen = of_force(sphere, point_motion)
    assert isinstance(seen, OfMaterial)
    place, change = np.linspace(0.1, 0.9, 6), np.array([0.3, -0.2])
    start = seen.residuals(place)
    remainders = [
        abs(
            seen.with_material(np.array([2.0, 3.0]) * np.exp(h * change), np.zeros(2)).residuals(place).values[0]
            - start.values[0]
            - h * (start.direct[0, :2] @ change)
        )
        for h in STEPS
    ]
    assert np.all(np.diff(np.log(remainders)) / np.diff(np.log(STEPS)) > 1.9)
