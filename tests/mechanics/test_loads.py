"""Known loads: their resultants, their derivatives, and the kilopascals that they bring."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.errors import ConfigurationError, GeometryError
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.laws.registry import LAWS
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.loads import boundary_named, gravity, pressure, traction
from palpate.mechanics.newton import NewtonSettings
from palpate.mechanics.reduced import projection
from palpate.mesh.space import lagrange_space

SIZE = 20.0


def column(meshes, element="P2", n=2, *, beyond=-1):
    """A block that stands on the cut of the image, or on what is `beyond`; its top and sides face air."""
    mesh = meshes.box_mesh(
        n,
        size=SIZE,
        distortion=0.15,
        tissues=[meshes.known("fat", nu=0.4), meshes.unknown("organ", nu=0.45), meshes.VOID],
        region=lambda c: (c[:, 2] > 0.5 * SIZE).astype(int),
        beyond=lambda c: np.where(c[:, 2] < 1e-9, beyond, 2),
    )
    return lagrange_space(mesh, element)


def top(space):
    faces = space.mesh.boundary
    return faces[np.all(space.mesh.nodes[faces][:, :, 2] > SIZE - 1e-9, axis=1)]


def standing(meshes, space):
    nothing = meshes.prescribe(space, np.zeros(0, int), np.zeros((0, 3)))
    return outer_constraint(space, outer="fixed", **nothing)


def bent(space):
    """A large smooth displacement (n_points, 3)."""
    x = space.points / SIZE
    return 3.0 * np.stack([x[:, 2] ** 2, x[:, 0] * x[:, 2], np.sin(x[:, 1])], axis=1)


@pytest.mark.parametrize("element", ["P1", "P2"])
@pytest.mark.parametrize("following", [True, False])
def test_a_pressure_pushes_along_the_inward_normal_with_pressure_times_area(meshes, element, following):
    space = column(meshes, element)
    load = pressure(space, top(space), 2.5, following=following)
    total = load.forces(np.zeros_like(space.points)).reshape(-1, 3).sum(axis=0)
    assert np.allclose(total, [0.0, 0.0, -2.5 * SIZE**2])


def test_a_following_pressure_on_a_closed_surface_has_no_resultant_and_no_moment(meshes):
    space = column(meshes)
    u = bent(space)
    forces = pressure(space, space.mesh.boundary, 2.0).forces(u).reshape(-1, 3)
    size = abs(forces).sum()
    assert np.allclose(forces.sum(axis=0), 0.0, atol=1e-12 * size)
    assert np.allclose(np.cross(space.points + u, forces).sum(axis=0), 0.0, atol=1e-12 * size * SIZE)


def test_a_following_pressure_turns_with_the_body(meshes):
    space = column(meshes)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    load = pressure(space, space.mesh.boundary[:10], 2.0)
    rest = load.forces(np.zeros_like(space.points)).reshape(-1, 3)
    assert np.allclose(load.forces(space.points @ (turn - np.eye(3)).T).reshape(-1, 3), rest @ turn.T)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_the_stiffness_of_a_following_pressure_is_its_derivative(meshes, element, rng):
    space = column(meshes, element)
    load, u = pressure(space, top(space), 2.0), bent(space)
    for _ in range(3):
        d, h = rng.standard_normal(u.shape), 1e-5
        expected = (load.forces(u + h * d) - load.forces(u - h * d)) / (2.0 * h)
        assert np.allclose(load.stiffness(u) @ d.ravel(), expected, atol=1e-8 * abs(expected).max())


def test_a_dead_load_stays(meshes):
    space = column(meshes)
    load = pressure(space, top(space), 2.0, following=False)
    assert np.array_equal(load.forces(bent(space)), load.forces(np.zeros_like(space.points)))
    assert load.stiffness(bent(space)).nnz == 0


def test_a_traction_sums_to_traction_times_area(meshes):
    space = column(meshes)
    total = traction(space, top(space), np.array([1.0, -2.0, 0.5])).nodal.reshape(-1, 3).sum(axis=0)
    assert np.allclose(total, SIZE**2 * np.array([1.0, -2.0, 0.5]))


def test_gravity_weighs_a_litre_of_water_with_9810_millinewtons(meshes):
    """20 x 20 x 20 mm = 8 ml."""
    space = column(meshes)
    load = gravity(space, np.array([1000.0, 1000.0, 0.0]), np.array([0.0, -9.81, 0.0]))
    assert np.allclose(load.nodal.reshape(-1, 3).sum(axis=0), [0.0, -9810.0 * 8e-3, 0.0])


def test_each_tissue_weighs_by_its_own_density(meshes):
    space = column(meshes)
    light = gravity(space, np.array([500.0, 1500.0, 0.0]), np.array([0.0, 0.0, -10.0]))
    volumes = [space.mesh.volumes[space.mesh.region == r].sum() for r in range(2)]
    expected = -10.0 * (500.0 * volumes[0] + 1500.0 * volumes[1]) * 1e-6
    assert light.nodal.reshape(-1, 3)[:, 2].sum() == pytest.approx(expected)


@pytest.mark.parametrize("following", [True, False])
def test_with_a_known_load_the_displacement_tells_the_scale(meshes, following):
    """Twice the moduli under twice the load is the same; the modulus columns no longer sum to zero."""
    space = column(meshes, "P1")
    constraint, settings = standing(meshes, space), NewtonSettings(tolerance=1e-12)
    moduli = np.array([8.0, 20.0])
    found = []
    for scale in (1.0, 2.0):
        load = pressure(space, top(space), 1.5 * scale, following=following)
        model = finite_strain_model(space, constraint, LAWS["neo-hookean"], loads=(load,), settings=settings)
        found.append(model.solve(scale * moduli, np.zeros(0)))
    assert np.allclose(found[0].values, found[1].values, atol=1e-8)
    assert found[0].values.min() < -1.0
    step = 1e-4
    model = found[0].model
    ahead, behind = (model.solve(np.exp(s * step) * moduli, np.zeros(0)).values for s in (1, -1))
    summed = found[0].tangent().sum(axis=1)
    assert np.allclose(summed, (ahead - behind) / (2.0 * step), atol=1e-5 * abs(summed).max())
    gradient = np.cos(np.arange(len(summed)))
    assert np.allclose(found[0].adjoint(gradient), found[0].tangent().T @ gradient, rtol=1e-8)


def test_the_modulus_of_a_loaded_column_comes_out_in_kilopascals(meshes):
    """Newton on ln E from far off, for the sinking of the top under a known pressure: no tissue's modulus is known."""
    space = column(meshes, "P1")
    load = pressure(space, top(space), 1.5)
    model = finite_strain_model(space, standing(meshes, space), LAWS["neo-hookean"], loads=(load,))
    rows = 3 * np.unique(top(space)) + 2
    truth = 14.0
    target = model.solve(np.full(2, truth), np.zeros(0)).values[rows].mean()
    theta = np.log(25.0)
    for _ in range(5):
        equilibrium = model.solve(np.full(2, np.exp(theta)), np.zeros(0))
        slope = equilibrium.tangent()[rows].sum(axis=1).mean()
        theta -= (equilibrium.values[rows].mean() - target) / slope
    assert np.exp(theta) == pytest.approx(truth, rel=1e-6)


def test_a_loaded_body_that_floats_is_refused_with_its_rigid_motions(meshes):
    space = column(meshes)
    nothing = meshes.prescribe(space, np.zeros(0, int), np.zeros((0, 3)))
    with pytest.raises(GeometryError, match=r"the body floats.*translation along x \(right\).*rotation about z"):
        outer_constraint(space, outer="free", **nothing)


@pytest.mark.parametrize("outer", ["free", "sliding", "fixed", "moving"])
def test_a_body_that_floats_is_told_to_be_fixed_at_its_cut_only_where_it_has_one_that_is_not(meshes, outer):
    nothing = meshes.prescribe(column(meshes), np.zeros(0, int), np.zeros((0, 3)))
    bodies = {"cut": column(meshes), "not cut": column(meshes, beyond=2)}
    for name in bodies if outer in ("free", "sliding") else ["not cut"]:
        with pytest.raises(GeometryError, match="the body floats") as refused:
            outer_constraint(bodies[name], outer=outer, **nothing)
        assert ("outer_boundary = 'fixed'" in str(refused.value)) == (name == "cut")


def test_surfaces_have_the_names_of_what_lies_behind_them(meshes):
    mesh = column(meshes).mesh
    assert len(boundary_named(mesh, "void")) + len(boundary_named(mesh, "outer")) == len(mesh.boundary)
    with pytest.raises(ConfigurationError, match=r"called 'rectum'.*'outer', 'void'"):
        boundary_named(mesh, "rectum")


@pytest.mark.parametrize("densities", [[1000.0], [1000.0, -1.0, 0.0], [1000.0, np.nan, 0.0]])
def test_impossible_densities_are_refused(meshes, densities):
    with pytest.raises(ConfigurationError, match=r"densit(y|ies)"):
        gravity(column(meshes), np.array(densities), np.array([0.0, 0.0, -9.81]))


def test_a_pressure_must_be_a_number(meshes):
    space = column(meshes)
    with pytest.raises(ConfigurationError, match="pressure of a load"):
        pressure(space, top(space), np.nan)


@pytest.fixture(scope="module")
def loaded(meshes):
    """A linear model under dead pressure and weight, and the same body in the finite-strain model's linear law."""
    space = column(meshes, n=3)
    constraint = standing(meshes, space)
    loads = (
        pressure(space, top(space), 0.5, following=False),
        gravity(space, np.array([900.0, 1100.0, 0.0]), np.array([0.0, -9.81, 0.0])),
    )
    law = LAWS["linear"]
    finite = finite_strain_model(space, constraint, law, dilatation=Dilatation.POINTWISE, loads=loads)
    return linear_model(space, constraint, loads=loads), finite


def test_the_linear_model_bears_loads_as_the_linear_law_does(loaded):
    linear, finite = loaded
    moduli, still = np.array([5.0, 12.0]), np.zeros(0)
    expected = finite.solve(moduli, still).values
    assert abs(expected).max() > 0.1
    assert linear.solve(moduli, still).values == pytest.approx(expected, abs=1e-8)
    assert linear.responses(moduli)[:, -1] == pytest.approx(expected, abs=1e-8)


def test_a_load_brings_a_scale(loaded):
    linear, _ = loaded
    moduli, still = np.array([5.0, 12.0]), np.zeros(0)
    once, twice = (linear.solve(factor * moduli, still) for factor in (1.0, 2.0))
    assert twice.values == pytest.approx(0.5 * once.values, rel=1e-9, abs=1e-12)
    assert once.tangent().sum(axis=1) == pytest.approx(-once.values, rel=1e-9, abs=1e-12)


def test_the_reduced_model_bears_the_loads_of_its_model(loaded):
    linear, _ = loaded
    places = [np.array([1.0, r]) for r in (0.5, 2.0, 8.0)]
    snapshots = np.concatenate([linear.responses(place)[:, -1:] for place in places], axis=1)
    reduced = projection(linear, linear.constraint.free.T @ snapshots).reduced
    still = np.zeros(0)
    for moduli in (np.array([1.0, 2.0]), np.array([3.0, 6.0])):
        assert reduced.solve(moduli, still).values == pytest.approx(linear.solve(moduli, still).values, abs=1e-9)
