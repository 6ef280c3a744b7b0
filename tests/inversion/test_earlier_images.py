"""An image that is added to a finished estimate counts as if it had been there from the beginning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import ConfigurationError
from palpate.inversion import (
    Bounds,
    Explanation,
    InverseProblem,
    Mixture,
    Objective,
    cheapest_posterior,
    earlier_images,
    gauss_newton,
    invert,
)
from palpate.progress import silent
from palpate.unknowns.likelihood import Likelihood

NOTHING = {"wider": np.ones(2), "beside": np.zeros((2, 2))}


def of_images(problem, kept):
    """The problem of some of its later images, in the same order."""
    own, blocks, every = problem.parameters, [], tuple(range(len(kept)))
    for block in own.blocks:
        alone = len(block.states) == 1 and len(problem.states) > 1
        if not alone:
            blocks.append(replace(block, states=every))
        elif block.states[0] in kept:
            blocks.append(replace(block, states=(kept.index(block.states[0]),)))
    return InverseProblem(tuple(problem.states[k] for k in kept), replace(own, blocks=tuple(blocks), priors=()))


def known(problem, settings, n_images, **changes):
    """What the images of a problem tell, and its posterior."""
    found = invert(problem, settings, progress=silent)
    own = {"n_images": n_images, **NOTHING, **changes}
    return earlier_images(found.mixture, found.objective.parameters, settings.bounds, **own), found


def added(patients, problem, first, later):
    """The posterior of images that are seen first, and then of later ones, which are added to them."""
    law, before = known(of_images(problem, first), patients.settings(), len(first))
    return before, invert(law.known_in(of_images(problem, later)), patients.settings(law.theta), progress=silent)


def scenarios(mixture):
    """Probability of each scenario of the tissues."""
    found = {}
    for of in mixture.explanations:
        tissues = of.scenario[:2]  # how the frame moves belongs to the images
        found[tissues] = found.get(tissues, 0.0) + of.weight
    return found


def one_scenario(of):
    """The same with one alternative for everything."""
    blocks = [replace(b, alternatives=b.alternatives[-1:]) for b in of.parameters.blocks]
    blocks = [b if b.choice.value == "there is one" else replace(b, choice=type(b.choice).NONE) for b in blocks]
    return replace(of, parameters=replace(of.parameters, blocks=tuple(blocks), priors=(), levels=()))


def minimum_of(problem):
    """The one explanation of a problem with its exact minimum, robust weights as near the truth."""
    parameters = problem.parameters
    near = np.concatenate([[0.5, -0.3], np.zeros(parameters.n_coefficients)])
    objective = Objective(problem.states, parameters)
    posterior = cheapest_posterior(objective, near, objective(near))
    found = gauss_newton(posterior, near, bounds=Bounds(np.full(2, -4.0), np.full(2, 4.0)), tolerance=1e-20)
    covariance = found.evaluation.covariance_columns(2)[:2]
    return Mixture((Explanation({}, (), (), 1.0, found.unknowns[:2], covariance, found),)), parameters


@pytest.mark.parametrize("seed", range(3))
def test_of_linear_bodies_under_one_scenario_it_is_the_joint_posterior(patients, seed):
    rng = np.random.default_rng(seed)
    of = one_scenario(patients.patient(rng, 3))
    # a layer is in series with its tissue: not linear
    of = patients.without(of, [i for i, b in enumerate(of.parameters.blocks) if b.cause == "layer"])
    problem = of.problem(rng)
    together = minimum_of(problem)[0].explanations[0]
    law = earlier_images(*minimum_of(of_images(problem, [0, 1])), patients.WIDE, n_images=2, **NOTHING)
    found = minimum_of(law.known_in(of_images(problem, [2])))[0].explanations[0]
    sd = np.sqrt(np.diag(together.covariance))
    assert np.all(np.abs(found.theta - together.theta) < 1e-6 * sd)
    assert found.covariance == pytest.approx(together.covariance, rel=1e-6)


@pytest.mark.parametrize("bend", [0.0, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_an_added_image_counts_as_one_that_was_always_there(patients, bend, seed):
    rng = np.random.default_rng(seed)
    problem = patients.patient(rng, 3, bend=bend).problem(rng)
    together = invert(problem, patients.settings(), progress=silent).mixture
    _, found = added(patients, problem, [0, 1], [2])
    sd = np.sqrt(np.diag(together.covariance))
    assert np.all(np.abs(found.mixture.mean - together.mean) < 0.1 * sd)
    assert np.sqrt(np.diag(found.mixture.covariance)) == pytest.approx(sd, rel=0.1)
    weights = scenarios(found.mixture)
    assert all(weights.get(key, 0.0) == pytest.approx(of, abs=0.05) for key, of in scenarios(together).items())


def test_images_can_be_added_one_after_the_other_or_several_at_once(patients):
    rng = np.random.default_rng(7)
    problem = patients.patient(rng, 4).problem(rng)
    law, _ = known(of_images(problem, [0, 1]), patients.settings(), 2)
    at_once = invert(law.known_in(of_images(problem, [2, 3])), patients.settings(), progress=silent).mixture
    longer, _ = known(law.known_in(of_images(problem, [2])), patients.settings(), 3)
    in_turn = invert(longer.known_in(of_images(problem, [3])), patients.settings(), progress=silent).mixture
    sd = np.sqrt(np.diag(at_once.covariance))
    assert np.all(np.abs(in_turn.mean - at_once.mean) < 0.1 * sd)
    assert longer.n_images == 3


def test_an_image_that_tells_nothing_changes_nothing(patients):
    """Its readings move with no unknown of the body."""
    rng = np.random.default_rng(3)
    of = patients.patient(rng, 3)
    slopes = of.bodies[2].slopes.copy()
    slopes[:, :4], slopes[:, 4 + patients.N_FRAME :] = 0.0, 0.0
    blind = replace(of.bodies[2], slopes=slopes, bends=0.0 * of.bodies[2].bends)
    problem = replace(of, bodies=(*of.bodies[:2], blind)).problem(rng)
    before, found = added(patients, problem, [0, 1], [2])
    sd = np.sqrt(np.diag(before.mixture.covariance))
    assert np.all(np.abs(found.mixture.mean - before.mixture.mean) < 0.05 * sd)
    assert np.sqrt(np.diag(found.mixture.covariance)) == pytest.approx(sd, rel=0.02)
    weights = scenarios(found.mixture)
    assert all(weights.get(key, 0.0) == pytest.approx(w, abs=0.01) for key, w in scenarios(before.mixture).items())


def test_a_modulus_that_nothing_has_moved_yet_is_told_by_the_added_image_alone(patients):
    rng = np.random.default_rng(2)
    of = patients.patient(rng, 3)
    bodies = []
    for body in of.bodies[:2]:
        slopes = body.slopes.copy()
        slopes[:, [1, 3]] = 0.0
        bodies.append(replace(body, slopes=slopes))
    problem = replace(of, bodies=(*bodies, of.bodies[2])).problem(rng)
    together = invert(problem, patients.settings(), progress=silent).mixture
    before, found = added(patients, problem, [0, 1], [2])
    assert np.isinf(before.mixture.covariance[1, 1])
    sd = np.sqrt(np.diag(together.covariance))
    assert np.all(np.abs(found.mixture.mean - together.mean) < 0.1 * sd)


def test_what_the_posterior_leaves_out_of_the_errors_is_left_out_once(patients):
    """Standard deviations that are larger, and errors beside, are those of the law of earlier images."""
    rng = np.random.default_rng(5)
    problem = of_images(patients.patient(rng, 3).problem(rng), [0, 1])
    beside, wider = np.diag([0.02, 0.03]), np.array([1.2, 1.4])
    law, found = known(problem, patients.settings(), 2, beside=beside, wider=wider)
    first = law.laws[0]
    parameters = replace(found.objective.parameters, earlier={})
    numbers = parameters.shared
    chosen = next(
        of.chosen for of in found.mixture.explanations if parameters.choosing(of.chosen).levels == first.levels
    )
    prior = parameters.choosing(chosen).prior_of_blocks.block(numbers, numbers)
    got = np.linalg.inv(first.likelihood.matrix + prior)[:2, :2]
    own = [of for of in found.mixture.explanations if parameters.choosing(of.chosen).levels == first.levels]
    shares = np.array([of.weight for of in own]) / sum(of.weight for of in own)
    theta = np.stack([of.theta for of in own])
    away = theta - shares @ theta
    plain = np.tensordot(shares, np.stack([of.covariance for of in own]), axes=1) + (away.T * shares) @ away
    assert got == pytest.approx(np.outer(wider, wider) * plain + beside, rel=1e-6)


def test_what_combinations_leave_open_is_integrated_out(rng):
    """exp(-w^T A w / 2 + b^T w) of w given z, by draws of the prior's own law."""
    root = rng.standard_normal((5, 5))
    covariance, rows = 0.2 * root @ root.T / 5.0, rng.standard_normal((2, 5))
    seen = rng.standard_normal((3, 5))
    whole = Likelihood(seen.T @ seen, rng.standard_normal(5), 0.3)
    found = whole.of_combinations(rows, covariance)
    prior, of_z = np.linalg.inv(covariance), np.linalg.inv(rows @ covariance @ rows.T)
    assert found.log_evidence(of_z, np.zeros(2)) == pytest.approx(whole.log_evidence(prior, np.zeros(5)), rel=1e-9)
    posterior = np.linalg.inv(whole.matrix + prior)
    there = np.linalg.inv(found.matrix + of_z)
    assert there == pytest.approx(rows @ posterior @ rows.T, rel=1e-9)
    assert there @ found.pull == pytest.approx(rows @ posterior @ whole.pull, rel=1e-9)


def test_another_body_is_refused(patients):
    rng = np.random.default_rng(1)
    of = patients.patient(rng, 3)
    law, _ = known(of_images(of.problem(rng), [0, 1]), patients.settings(), 2)
    other = patients.without(patients.patient(rng, 1), [0])
    with pytest.raises(
        ConfigurationError, match=r"knows 2 moduli and 4 groups .* has 2 and 3, for example heterogeneity"
    ):
        law.known_in(other.problem(rng))


def test_the_drawing_of_the_reference_image_is_shared_with_an_added_image_and_its_amplitudes_stay(patients):
    """One that is believed counts as in the joint posterior; of one that is learned nothing is learned anew."""
    rng = np.random.default_rng(4)
    plain, modes = patients.patient(rng, 3), rng.standard_normal((patients.N_READ, 2))
    covariances = [0.02 * np.eye(2), 0.01 * np.ones((2, 2))]
    problem = patients.drawn_at_rest(plain, modes, covariances).problem(rng)
    together = invert(problem, patients.settings(), progress=silent).mixture
    _, found = added(patients, problem, [0, 1], [2])
    assert np.all(np.abs(found.mixture.mean - together.mean) < 0.1 * np.sqrt(np.diag(together.covariance)))
    learning = patients.drawn_at_rest(plain, modes, covariances, learned=True).problem(rng)
    law, before = known(of_images(learning, [0, 1]), patients.settings(), 2)
    after = invert(law.known_in(of_images(learning, [2])), patients.settings(), progress=silent)
    for own, other in zip(*(of.objective.parameters.priors[-2:] for of in (before, after)), strict=True):
        assert len(own.variances) == 2
        assert other.variances == own.variances
        assert other.covariance == pytest.approx(own.covariance, rel=1e-12)
