"""Layers round organs: found where the images tell of them, in the interval alone where they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.inversion import InverseProblem, LaterState, MarginalPosterior, cheapest_posterior, invert
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.linear_model import linear_model
from palpate.mesh.layers import layer_thickness_mm, layered_space, layers_round_organs
from palpate.observation.noise_model import NoiseModel
from palpate.observation.observed_surface import observed_surface
from palpate.observation.prescribed_motion import prescribed_motion
from palpate.observation.surface_distance import surface_distance
from palpate.phantoms.scene import Scene
from palpate.statement.conclusion import Observed, conclude
from palpate.statement.discrepancy import discrepancy_findings, discrepancy_of, fitted_materials
from palpate.uncertainty import FittedState
from palpate.uncertainty.profile import Ray
from palpate.unknowns import layer_blocks, parameter_map, unit_blocks
from palpate.unknowns.blocks import LAYER_ODDS
from palpate_validation.truth import exact_target

SHARP = NoiseModel(np.array([1e-4]), np.array([3.0]))
SOFT = -3.0  # ln E of a layer over its tissue's: a twentieth
THICK_MM = 3.0
REST = 3  # number of the tissue round both organs, after which those of the layers come


def posed(twins, twin, of_gland: float):
    """The problem, with its truth, of a twin whose gland lies in a layer with such ln E over its tissue's."""
    plain, coefficients = twin.model.space, twin.coefficients
    layers = layers_round_organs(plain.mesh)
    space = layered_space(plain, layers)
    motion = prescribed_motion(space, {}, n_modes=12, kernel_mm=12.0, prior_mm=twins.WALL_MM)
    given = {"modes": motion.modes, "offset": motion.offset, "prescribed": motion.prescribed}
    model = linear_model(space, outer_constraint(space, outer="fixed", **given))
    numbered = enumerate(layers, start=len(plain.mesh.tissues))
    round_organs = [
        (
            plain.mesh.tissues[layer.organ].name,
            (model.regions.index(number),),
            layer_thickness_mm(plain.mesh, layers, layer.organ),
        )
        for number, layer in numbered
    ]
    blocks = (*unit_blocks(model.n_modes), *layer_blocks(round_organs, (0,), sd=1.5, thickness_mm=THICK_MM))
    mapping = parameter_map(space.mesh.tissues, model.regions, blocks)
    truth = np.concatenate([twin.unknowns, [of_gland, 0.0]])
    displacement = model.solve(mapping.moduli(truth), coefficients).displacement
    scene = Scene(space, displacement, twin.scene.before, twin.scene.after, {}, 0)
    surfaces = [observed_surface(space, tissue) for tissue in range(3)]
    seen = tuple(surface_distance(exact_target(scene, surface), stated_noise=SHARP) for surface in surfaces)
    return InverseProblem((LaterState(model, seen),), mapping), truth


def fitted(inversion, twin):
    """The later state as the estimate has it."""
    state, parameters, unknowns = (
        inversion.objective.states[0],
        inversion.objective.parameters,
        inversion.minimum.unknowns,
    )
    (coefficients,) = parameters.coefficients(unknowns)
    moved, grid = state.displacement(parameters.moduli(unknowns), coefficients), twin.scene.before.grid
    return FittedState(state.model.space, moved, grid, grid)


def estimated(twins, twin, of_gland: float):
    problem, truth = posed(twins, twin, of_gland)
    return invert(problem, twins.settings(0.5, 2.0), progress=twins.silent), truth


@pytest.fixture(scope="module")
def sheathed(twins, twin):
    return estimated(twins, twin, SOFT)


@pytest.fixture(scope="module")
def bonded(twins, twin):
    return estimated(twins, twin, 0.0)


def layered(inversion):
    """Probability of layers round organs."""
    return sum(of.weight for of in inversion.mixture.explanations if "layers" in of.scenario)


def test_a_soft_layer_is_found_with_the_organ_in_it(sheathed):
    inversion, truth = sheathed
    assert inversion.minimum.converged
    assert layered(inversion) > 0.99
    assert inversion.minimum.unknowns[:2] == pytest.approx(truth[:2], abs=0.05)
    assert inversion.minimum.unknowns[-2] == pytest.approx(SOFT, abs=0.3)


def test_without_a_layer_the_estimate_has_none(bonded, twin):
    """The explanation with layers stands beside it, for the interval, less likely than it was believed before."""
    inversion, truth = bonded
    assert inversion.minimum.converged
    assert inversion.minimum.unknowns[:2] == pytest.approx(truth[:2], abs=0.02)
    assert inversion.minimum.unknowns[-2:] == pytest.approx(0.0, abs=1e-5)
    assert layered(inversion) < 1.0 / (1.0 + np.exp(-LAYER_ODDS))
    assert discrepancy_of(inversion, (fitted(inversion, twin),)).layers == ()


def test_an_interval_holds_the_organ_in_its_layer(sheathed, twin, twins):
    inversion, truth = sheathed
    observed = Observed((fitted(inversion, twin),), (None,))
    result = conclude(inversion, twins.settings(2.0), observed, truth={}, seed=1)
    for estimate, theta in zip(result.estimates, truth, strict=False):
        low, high = estimate.interval95
        assert low < 10.0 * np.exp(theta) < high
        assert estimate.verdict == "identified"
    gland, sac = (estimate.variance_shares["layer"] for estimate in result.estimates)
    assert gland > sac > 0.0


def test_a_layer_is_said_in_words_and_stands_in_the_material(sheathed, twin):
    inversion, _ = sheathed
    found = discrepancy_of(inversion, (fitted(inversion, twin),))
    gland, sac = found.layers
    assert (gland.tissue, sac.tissue) == ("gland", "sac")
    assert gland.interval95[0] < np.exp(SOFT) < gland.interval95[1]
    assert (gland.told, sac.told) == (True, False)
    (finding,) = [finding for finding in discrepancy_findings(found) if finding.code == "layer"]
    assert f"a layer around 'gland' that is {gland.ratio:.2g} times as stiff" in finding.message
    (material,) = fitted_materials(inversion)
    model, parameters = inversion.objective.states[0].model, inversion.objective.parameters
    moduli = dict(zip(model.regions, parameters.moduli(inversion.minimum.unknowns), strict=True))
    layers = [number for number in model.regions if number > REST]
    for number in (REST, *layers):
        inside = model.space.mesh.region == number
        assert np.exp(material.log_ratio[inside]) == pytest.approx(moduli[number] / moduli[REST])
    assert np.all(material.log_ratio[model.space.mesh.region <= REST] == 0.0)


def test_with_a_layer_the_others_are_at_their_best_along_a_ray_of_all_moduli(sheathed, twins):
    """Of a layer that is free no posterior is a parabola, not even at held moduli."""
    inversion, _ = sheathed
    frozen = cheapest_posterior(inversion.objective, inversion.minimum.unknowns, inversion.minimum.evaluation)
    assert len(frozen.parameters.free_on_moduli)
    bounds, way = twins.settings(2.0).bounds, np.array([1.0, 0.5])
    least = MarginalPosterior.of(frozen).minimum(inversion.minimum.unknowns, bounds)
    ray = Ray(MarginalPosterior.of(frozen), least, way, np.ones(2, dtype=bool), bounds, 1.0)
    points, _ = ray.to_level(2.0, first=0.3)
    layers = frozen.parameters.free_on_moduli
    others = np.setdiff1d(np.arange(2, len(inversion.minimum.unknowns)), layers)
    plain = frozen.with_prior(replace(frozen.parameters, volume=None))

    def left(x):
        """J and the room of all but moduli and layers, these being held."""
        there = plain(x)
        step = np.linalg.solve(there.matrix.dense[np.ix_(others, others)], -there.score[others])
        room = 0.5 * np.linalg.slogdet(there.matrix.dense[np.ix_(others, others)])[1]
        return there.value + 0.5 * there.score[others] @ step + room

    for distance, root, unknowns in points:
        assert unknowns[:2] == pytest.approx(least.minimum.unknowns[:2] + distance * way)
        assert root**2 == pytest.approx(2.0 * (left(unknowns) - least.least), abs=1e-2)
        for layer in layers:
            for away in (-0.2, 0.2):
                aside = unknowns.copy()
                aside[layer] += away
                assert left(aside) > left(unknowns) - 1e-2
    assert len(points) > 1
