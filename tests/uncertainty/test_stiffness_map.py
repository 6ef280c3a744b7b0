"""Maps of stiffness: their posterior is that of all elements' moduli, and a part that does not differ is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse
from scipy.spatial.distance import cdist

from palpate.images.tissue import FieldPrior
from palpate.inversion import InverseProblem, LaterState, invert
from palpate.mechanics.equilibrium import from_start
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.laws.neo_hookean import NeoHookean
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.material import MaterialModes, material_modes
from palpate.mesh.locate import located, point_interpolation
from palpate.observation import DataFile, DisplacementField, PointTable, stated_sd
from palpate.uncertainty import NORMAL_95, sandwich_covariance, stiffness_maps
from palpate.unknowns import material_blocks, parameter_map, unit_blocks

PRIOR = FieldPrior(0.5, 6.0)
SD_MM, LATTICE_MM = 0.02, 4.0


def no_force(_name, _direction):
    raise AssertionError("a field needs no force")


@pytest.fixture(scope="module")
def body(twin):
    """The twin's space with a gland whose modulus is a field, its number and elements, and places in and round it."""
    space = twin.model.space
    tissues = tuple(replace(t, field=PRIOR) if t.name == "gland" else t for t in space.mesh.tissues)
    space = replace(space, mesh=replace(space.mesh, tissues=tissues))
    own = np.flatnonzero(space.mesh.region == 0)
    centres = space.mesh.nodes[space.mesh.tets].mean(axis=1)
    lattice = np.stack(np.meshgrid(*[np.arange(-12.0, 12.0, LATTICE_MM)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    places = centres[own].mean(axis=0) + lattice
    return space, own, centres, places[located(space.mesh, places).inside]


def observed(body, displacement, rng, sd_mm=SD_MM):
    space, _, _, places = body
    moved = point_interpolation(space, located(space.mesh, places)) @ displacement
    moved = moved + sd_mm * rng.normal(size=moved.shape)
    file = DataFile("field", "displacement-field", (Path("simulated.csv"),), 1, sd_mm)
    return DisplacementField(
        file, PointTable(places, places + moved, stated_sd(file, len(places)), ("",) * len(places), ())
    ).on(space, no_force)[0]


def mapped(twins, twin, body, displacement, rng, sd_mm=SD_MM, law=None):
    """The map of a displacement (n_points, 3) mm that is seen with errors, and the inversion it is of."""
    space, constraint = body[0], twin.model.constraint
    modes = material_modes(space.mesh, (0,), length_mm=20.0)
    model = linear_model(space, constraint, material=modes)
    finite = law and finite_strain_model(space, constraint, law, material=modes)
    state = LaterState(model, (observed(body, displacement, rng, sd_mm),), finite)
    blocks = material_blocks(modes, space.mesh, (0,), heterogeneity_sd=0.3, poisson_sd=0.0)
    parameters = parameter_map(space.mesh.tissues, model.regions, [*unit_blocks(model.constraint.n_modes), *blocks])
    problem = InverseProblem((state,), parameters)
    inversion = invert(problem, twins.settings(3.0), progress=twins.silent)
    variances = np.diag(sandwich_covariance(inversion.objective, inversion.minimum.evaluation))
    (found,) = stiffness_maps(inversion, variances)
    return found, inversion


def each_element(body):
    """Modes of the material, one for each element of the gland."""
    space, own = body[0], body[1]
    shape = (len(space.mesh.tets), len(own))
    return MaterialModes(sparse.csr_matrix((np.ones(len(own)), (own, np.arange(len(own)))), shape=shape))


def true_displacement(twin, body, log_ratio, law=None, share=1.0):
    """(n_points, 3) mm of a share of the motion, where ln E of the gland's elements is log_ratio (n,) over its own."""
    space, constraint, every = body[0], twin.model.constraint, each_element(body)
    coefficients = np.concatenate([share * twin.coefficients, log_ratio])
    linear = linear_model(space, constraint, material=every)
    if law is None:
        return linear.solve(twin.moduli, coefficients).displacement
    start = linear.solve(twin.moduli, coefficients)
    model = finite_strain_model(space, constraint, law, material=every)
    return from_start(model, twin.moduli, coefficients, start=start.displacement, nearby=None).displacement


def test_the_posterior_is_that_of_every_elements_modulus_by_brute_force(twins, twin, body, rng):
    space, own, centres, places = body
    n_boundary = twin.model.constraint.n_modes
    displacement = true_displacement(twin, body, np.zeros(len(own)))
    found, inversion = mapped(twins, twin, body, displacement, rng)

    unknowns = inversion.minimum.unknowns
    moduli = inversion.objective.parameters.moduli(unknowns)
    model = linear_model(space, twin.model.constraint, material=each_element(body))
    coefficients = np.concatenate([unknowns[2 : 2 + n_boundary], np.zeros(len(own))])
    tangent = model.solve(moduli, coefficients).tangent()
    at = sparse.kron(point_interpolation(space, located(space.mesh, places)), sparse.identity(3))
    seen = np.asarray(at @ tangent)  # by ln E of gland, sac, rest, boundary, elements
    jacobian = np.delete(seen, 2, axis=1) / SD_MM
    weights = space.mesh.volumes[own] / space.mesh.volumes[own].sum()
    centred = np.eye(len(own)) - weights
    distance = np.sqrt(3.0) * cdist(centres[own], centres[own]) / PRIOR.length_mm
    kernel = (1.0 + distance) * np.exp(-distance)
    field = PRIOR.sd**2 * centred @ kernel @ centred.T
    prior = np.zeros((jacobian.shape[1],) * 2)
    prior[0, 0] = prior[1, 1] = 1e4
    prior[2 : 2 + n_boundary, 2 : 2 + n_boundary] = np.eye(n_boundary)
    prior[2 + n_boundary :, 2 + n_boundary :] = field
    gain = prior @ jacobian.T @ np.linalg.inv(jacobian @ prior @ jacobian.T + np.eye(len(jacobian)))
    posterior = prior - gain @ jacobian @ prior
    along = np.zeros((len(own), len(prior)))
    along[:, 0] = 1.0
    along[:, 2 + n_boundary :] = np.eye(len(own))
    exact = np.sqrt(np.diag(along @ posterior @ along.T))
    assert 0.3 < found.resolved < 0.99
    assert found.sd == pytest.approx(exact, rel=0.05)


def test_a_homogeneous_organ_has_no_region_in_any_draw(twins, twin, body):
    displacement = true_displacement(twin, body, np.zeros(len(body[1])))
    for seed in range(6):
        found, inversion = mapped(twins, twin, body, displacement, np.random.default_rng([seed, 1]))
        assert found.region is None
        theta = inversion.minimum.unknowns[0] - np.log(twin.moduli[0] / 10.0)
        assert (np.abs(theta + found.log_ratio) < NORMAL_95 * found.sd).mean() > 0.9


def test_intervals_of_elements_hold_what_was_drawn_from_the_prior(twins, twin, body):
    own, centres, inside = body[1], body[2], []
    distance = np.sqrt(3.0) * cdist(centres[own], centres[own]) / PRIOR.length_mm
    root = np.linalg.cholesky((1.0 + distance) * np.exp(-distance) + 1e-9 * np.eye(len(own)))
    for seed in range(6):
        rng = np.random.default_rng([seed, 2])
        truth = PRIOR.sd * root @ rng.normal(size=len(own))
        found, inversion = mapped(twins, twin, body, true_displacement(twin, body, truth), rng)
        theta = inversion.minimum.unknowns[0] - np.log(twin.moduli[0] / 10.0)
        inside.append((np.abs(theta + found.log_ratio - truth) < NORMAL_95 * found.sd).mean())
    assert 0.90 < np.mean(inside) < 0.98


def test_a_part_is_found_under_a_law_of_finite_strain(twins, twin, body, rng):
    own, centres = body[1], body[2]
    middle = centres[own].mean(axis=0) + np.array([3.0, 0.0, 0.0])
    log_ratio = np.log(3.0) * (np.linalg.norm(centres[own] - middle, axis=1) < 4.5)
    displacement = true_displacement(twin, body, log_ratio, NeoHookean(), share=0.4)
    found, inversion = mapped(twins, twin, body, displacement, rng, 0.004, NeoHookean())
    assert inversion.minimum.converged
    assert found.region is not None
    assert np.linalg.norm(found.region.centre_mm - middle) < 3.0
    low, high = found.region.interval95
    assert low < 3.0 < high


def test_a_part_three_times_as_stiff_is_found_where_the_field_tells_and_not_where_it_does_not(twins, twin, body, rng):
    _, own, centres, _ = body
    middle = centres[own].mean(axis=0) + np.array([3.0, 0.0, 0.0])
    log_ratio = np.log(3.0) * (np.linalg.norm(centres[own] - middle, axis=1) < 4.5)
    displacement = true_displacement(twin, body, log_ratio)
    found, _ = mapped(twins, twin, body, displacement, rng, 0.01)
    region = found.region
    assert region is not None
    assert region.probability > 0.95
    assert np.linalg.norm(region.centre_mm - middle) < 3.0
    low, high = region.interval95
    assert 2.0 < low < 3.0 < high < 5.0
    blind, _ = mapped(twins, twin, body, displacement, rng, 1.0)
    assert blind.region is None
    assert blind.resolved < 0.1
