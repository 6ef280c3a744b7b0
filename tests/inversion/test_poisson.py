"""Poisson's ratio of a tissue as an unknown: its derivative, the mean of its prior, and that it is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.body.poisson_ratios import eta_of_ratio, eta_slope, sought_ratios, with_ratios
from palpate.inversion import InverseProblem, LaterState, Objective, frozen_posterior, invert
from palpate.inversion.starts import informed_start
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.material import material_modes
from palpate.observation.noise_model import NoiseModel
from palpate.uncertainty.covariance import covariance_among, covariance_of
from palpate.unknowns import parameter_map, sought_ratio_blocks, unit_blocks

NOISE = NoiseModel(np.array([0.03**2]), np.array([3.0]))
KINDS = [("P1", Dilatation.POINTWISE), ("P2", Dilatation.MEAN), ("P2", Dilatation.BLENDED)]
RATIOS = [0.2, 0.45, 0.499]
MODULI = 10.0 * np.exp([0.9, 0.5, 0.0])
GIVEN, WIDTH = 0.42, 2.1  # what is believed of eta


@pytest.fixture(scope="module", params=KINDS, ids=lambda kind: f"{kind[0]}-{kind[1]}")
def kind(request, twins):
    element, dilatation = request.param
    return twins.make_twin(element=element, edge_length_mm=8.0), dilatation


def model_at(twin, ratio, dilatation=Dilatation.POINTWISE):
    """The twin's model with this Poisson's ratio of the gland, which may be another one."""
    space = with_ratios(twin.model.space, {"gland": ratio})
    gland = [tissue.name for tissue in space.mesh.tissues].index("gland")
    modes = material_modes(space.mesh, (), length_mm=9.0, poisson=((gland,),))
    return linear_model(space, twin.model.constraint, dilatation=dilatation, material=modes)


def problem_at(twin, ratio, observations):
    """That of a gland whose ratio is sought, from a model that has one."""
    model, slope = model_at(twin, ratio), eta_slope(ratio)
    mean = (eta_of_ratio(GIVEN) - eta_of_ratio(ratio)) / slope
    blocks = (*unit_blocks(model.constraint.n_modes), *sought_ratio_blocks([("gland", mean, WIDTH / slope)], (0,)))
    return InverseProblem(
        (LaterState(model, observations),), parameter_map(model.space.mesh.tissues, model.regions, blocks)
    )


@pytest.mark.parametrize("ratio", RATIOS)
def test_the_derivative_of_the_displacement_leaves_a_remainder_of_second_order(kind, ratio, rng):
    """Of models that are assembled with other ratios, near incompressibility too; the adjoint is transposed."""
    twin, dilatation = kind
    q = np.append(np.full(twin.model.n_modes, 0.3), 0.0)
    here = model_at(twin, ratio, dilatation).solve(MODULI, q)
    tangent = here.tangent()[:, -1]
    lengths = 2.0 ** -np.arange(3.0, 7.0) / eta_slope(ratio)
    there = [model_at(twin, ratio + h, dilatation).solve(MODULI, q).values for h in lengths]
    rest = [np.linalg.norm(values - here.values - h * tangent) for values, h in zip(there, lengths, strict=True)]
    orders = np.log2(np.array(rest[:-1]) / rest[1:])
    assert np.all(np.abs(orders - 2.0) < 0.2)
    pull = rng.normal(size=len(here.values))
    assert here.adjoint(pull)[-1] == pytest.approx(tangent @ pull, rel=1e-6)


def test_the_score_of_the_objective_knows_the_mean_of_the_prior(twin):
    """Without images the posterior is the prior: normal about the given ratio, wherever the model is made."""
    parameters = problem_at(twin, 0.3, ()).parameters
    found = Objective((), parameters)(np.zeros(parameters.n_unknowns))
    step = np.linalg.solve(found.matrix.dense[2:, 2:], -found.score[2:])
    assert step[:-1] == pytest.approx(0.0)
    assert eta_of_ratio(0.3) + eta_slope(0.3) * step[-1] == pytest.approx(eta_of_ratio(GIVEN))
    assert np.linalg.inv(found.matrix.dense[2:, 2:])[-1, -1] ** 0.5 * eta_slope(0.3) == pytest.approx(WIDTH)


def test_a_search_begins_at_the_ratio_of_the_model(twins, twin):
    """However far the given one is: at moduli that are wrong yet, a ratio would take what these miss."""
    problem = problem_at(twin, 0.2, twins.exact_problem(twin, noise=NOISE).states[0].observations)
    begun = informed_start(problem, np.zeros(2), progress=twins.silent)
    assert abs(begun.minimum.unknowns[-1]) * eta_slope(0.2) < 1e-3
    assert begun.objective.parameters.prior_centre[-1] == problem.parameters.prior_centre[-1]


def test_the_frozen_posterior_knows_the_mean_of_the_prior_as_the_objective_does(twins, twin):
    problem = problem_at(twin, 0.2, twins.exact_problem(twin, noise=NOISE).states[0].observations)
    begun = informed_start(problem, np.zeros(2), progress=twins.silent)
    objective, place = begun.objective, begun.minimum.unknowns + 0.05
    evaluation, frozen = objective(place), frozen_posterior(objective, place)(place)
    assert abs(evaluation.prior_score[-1]) > 0.1
    assert frozen.value == pytest.approx(evaluation.value, rel=1e-9)
    assert frozen.score == pytest.approx(evaluation.score, rel=1e-8, abs=1e-8 * np.abs(evaluation.score).max())


def test_the_covariance_with_a_ratio_is_that_of_the_moduli_and_then_of_the_ratio(twins, twin):
    problem = problem_at(twin, 0.3, twins.exact_problem(twin, noise=NOISE).states[0].observations)
    begun = informed_start(problem, np.zeros(2), progress=twins.silent)
    objective, evaluation = begun.objective, begun.minimum.evaluation
    own = objective.parameters.columns(len(objective.parameters.blocks) - 1)
    errors = [[np.full(len(term.weights), 0.01 * draw) for term in evaluation.linearisations] for draw in range(4)]
    alone, every = (covariance_of(objective, evaluation, errors, further=more) for more in ([], [own]))
    assert every.of_first(2).total == pytest.approx(alone.total, rel=1e-9)
    assert every.given_model == pytest.approx(alone.given_model, rel=1e-9)
    among = covariance_among(objective, evaluation, np.concatenate([[0, 1], own]))
    assert every.noise + every.prior == pytest.approx(among, rel=1e-9)


@pytest.mark.parametrize("begin", [0.3, 0.48])
def test_poissons_ratio_is_found_with_the_moduli(twins, twin, begin):
    """The phantom has 0.45 everywhere: models made at the found ratio lead there, and stay."""
    observations, ratio = twins.exact_problem(twin, noise=NOISE).states[0].observations, begin
    for _ in range(6):
        inversion = invert(problem_at(twin, ratio, observations), twins.settings(2.0, 24.0), progress=twins.silent)
        assert inversion.minimum.converged
        (found,) = sought_ratios(inversion)
        if found.settled:
            break
        ratio = found.next_model
    assert found.settled
    off = (found.eta - eta_of_ratio(0.45)) / found.sd
    assert abs(off) < 0.1
    assert inversion.minimum.unknowns[:2] == pytest.approx(twins.TRUTH, abs=0.02)


def test_a_block_keeps_its_mean_in_combinations():
    (block,) = sought_ratio_blocks([("gland", 0.1, 0.2)], (0,))
    assert block.sought
    assert block.combined(np.array([[2.0]])).mean == (0.2,)
    assert not replace(block, mean=()).sought
