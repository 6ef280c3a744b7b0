"""The search's loop, on patients without a mesh: where it ends, what stays on the way, and what it does not hang on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import EstimationError, NotConverged
from palpate.inversion import (
    REPORTED,
    Bounds,
    InverseProblem,
    LaterState,
    Objective,
    Outcome,
    StopRule,
    begun,
    cheapest_posterior,
    first_noise_of,
    gauss_newton,
    invert,
    mixture_of,
    scenarios_of,
    searched,
)
from palpate.inversion.search import NEAR, RIVAL
from palpate.progress import silent
from palpate.unknowns import Acts, Alternative, Block, Choice, ParameterMap

LEARNED = (1e-3, 10.0)  # bounds of a scale that residuals tell
FRAME = 4


@pytest.fixture(scope="module")
def bent(patients):
    """A body that bends, whose frame has moved, and what was read with a noise that is not known."""
    rng = np.random.default_rng(2)
    of = patients.with_unknowns(patients.patient(rng, bend=0.6), FRAME, [1.0, -1.5])
    return of, of.problem(rng, bounds=LEARNED, scale=2.0)


@pytest.fixture(scope="module")
def found(patients, bent):
    return invert(bent[1], patients.settings(), progress=silent)


def begin(problem, theta=(0.0, 0.0)):
    unknowns = np.concatenate([theta, np.zeros(problem.parameters.n_coefficients)])
    return begun(Objective(problem.states, problem.parameters), unknowns)


def one_more(patients, now, rule=REPORTED):
    once = replace(rule, iterations=1)
    return searched(now, patients.WIDE, once, progress=silent, title="")


def way(patients, now, rule=REPORTED):
    """Where a search is after each iteration."""
    places = [now]
    while places[-1].minimum.outcome is Outcome.STEPS and len(places) < 12:
        places.append(one_more(patients, places[-1], rule))
    return places


def sd_of(mixture):
    return np.sqrt(np.diag(mixture.covariance))


def scales(objective):
    return [(o.weighting.sd, o.weighting.count) for o in objective.observations]


def test_it_ends_near_the_truth_in_few_iterations(bent, found):
    of, _ = bent
    assert found.minimum.converged
    assert len(found.minimum.history) <= 6
    assert np.all(np.abs(found.mixture.mean - of.truth[:2]) < 3.0 * sd_of(found.mixture))
    assert np.all(np.abs(found.minimum.unknowns[:2] - found.mixture.mean) < REPORTED.step_sd * sd_of(found.mixture))


@pytest.mark.parametrize("gain", [1.0, 0.08])
@pytest.mark.parametrize("seed", range(4))
def test_of_a_linear_body_the_estimate_is_the_exact_posterior(patients, gain, seed):
    """Over all explanations, those that are left out for being too unlikely included; a frame hardly moves."""
    rng = np.random.default_rng(seed)
    of = patients.with_unknowns(patients.patient(rng, gain=(gain, gain)), FRAME, [0.25, -0.3])
    problem = of.problem(rng)
    found = invert(problem, patients.settings(), progress=silent).mixture
    mean, covariance = patients.exact_posterior(of, patients.seen_in(Objective(problem.states, problem.parameters)))
    sd = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(found.mean - mean) < REPORTED.step_sd * sd)
    assert sd_of(found) == pytest.approx(sd, rel=0.02)


@pytest.mark.parametrize("seed", range(6))
def test_so_it_is_of_several_images_none_of_which_tells_whether_its_frame_has_moved(patients, seed):
    """Frames move organs nearly as their moduli do: the weight lies on many combinations of the three images."""
    rng = np.random.default_rng(seed)
    of = patients.patient(rng, 3)
    of = patients.without(of, [i for i, block in enumerate(of.parameters.blocks) if block.cause != "frame"])
    bodies, truth = [], of.truth.copy()
    for body in of.bodies:
        slopes = body.slopes.copy()
        slopes[:, 4:6] = slopes[:, :2] + 0.3 * slopes[:, 4:6]
        bodies.append(replace(body, slopes=slopes))
    truth[2:] = 0.06 * rng.standard_normal(len(truth) - 2)
    of = replace(of, bodies=tuple(bodies), truth=truth)
    problem = of.problem(rng)
    found = invert(problem, patients.settings(), progress=silent).mixture
    mean, covariance = patients.exact_posterior(of, patients.seen_in(Objective(problem.states, problem.parameters)))
    sd = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(found.mean - mean) < REPORTED.step_sd * sd)
    assert sd_of(found) == pytest.approx(sd, rel=0.05)


def test_the_noise_is_that_of_the_readings(patients, found):
    sds = [sd for sd, _ in scales(found.objective)]
    assert sds == pytest.approx([sds[0]] * 2)
    assert sds[0] == pytest.approx(2.0 * patients.SD, rel=0.4)  # of 18 readings


def test_the_objective_stays_once_it_is_settled(patients, bent):
    """Its noise before, and where models are exact J at any place under any explanation."""
    places = way(patients, begin(bent[1], theta=(2.0, 2.0)), StopRule(step_sd=1e-3))
    assert places[-1].minimum.converged
    for _ in range(2):
        end = places[-1]
        places.append(one_more(patients, replace(end, minimum=replace(end.minimum, outcome=Outcome.STEPS))))
    settled = [place for place in places if place.settled]
    assert len(settled) > 2
    assert scales(places[1].objective) != scales(places[0].objective)
    assert all(scales(place.objective) == scales(settled[0].objective) for place in settled)
    first = settled[0]
    chosen = first.posterior.explanations[0].chosen
    body = bent[0].bodies[0]
    values = []
    for place in settled:
        whole = place.objective.with_approximations([patients.Whole(body)])
        values.append(whole.with_prior(whole.parameters.choosing(chosen))(first.minimum.unknowns).value)
    assert values == pytest.approx([values[0]] * len(values), rel=1e-12)


def test_convergence_is_a_property_of_where_it_ends(patients, bent, found):
    """A search that goes on from there, or begins there with that noise, moves no more."""
    end = way(patients, begin(bent[1]))[-1]
    again = one_more(patients, replace(end, minimum=replace(end.minimum, outcome=Outcome.STEPS)))
    assert again.minimum.outcome is Outcome.CONVERGED
    assert np.all(np.abs(again.posterior.mean - end.posterior.mean) < REPORTED.step_sd * sd_of(end.posterior))
    anew = searched(begun(end.objective, end.minimum.unknowns), patients.WIDE, REPORTED, progress=silent, title="again")
    assert np.all(np.abs(anew.posterior.mean - found.mixture.mean) < 2.0 * REPORTED.step_sd * sd_of(found.mixture))


@pytest.mark.parametrize("theta", [(2.0, 2.0), (-1.0, 1.0), (-0.8, -1.0), (3.0, 0.0)])
def test_the_way_does_not_show(patients, bent, found, theta):
    """Of a body that answers ever more to a larger modulus."""
    end = way(patients, begin(bent[1], theta))[-1]
    assert end.minimum.converged
    assert np.all(np.abs(end.posterior.mean - found.mixture.mean) < 2.0 * REPORTED.step_sd * sd_of(found.mixture))
    assert sd_of(end.posterior) == pytest.approx(sd_of(found.mixture), rel=0.03)
    assert end.posterior.explanations[0].chosen == found.mixture.explanations[0].chosen
    assert scales(end.objective)[0][0] == pytest.approx(scales(found.objective)[0][0], rel=0.02)


@pytest.mark.parametrize("number", range(6))
def test_it_ends_at_the_same_mean_whichever_group_of_explanations_it_begins_with(patients, bent, found, number):
    groups = list(dict.fromkeys(of.group for of in scenarios_of(bent[1].parameters.blocks)))
    assert len(groups) == 6  # three levels of patchiness, each with a frame that moves or does not
    start = replace(begin(bent[1]), group=groups[number])
    end = searched(start, patients.WIDE, REPORTED, progress=silent, title="")
    assert end.minimum.converged
    assert np.all(np.abs(end.posterior.mean - found.mixture.mean) < 2.0 * REPORTED.step_sd * sd_of(found.mixture))
    assert end.posterior.explanations[0].chosen == found.mixture.explanations[0].chosen


def test_it_ends_at_the_mean_with_all_else_at_its_best_under_the_likeliest_explanation(found):
    """As the decrement of all else tells, 1/2 s_y^T H_yy^-1 s_y."""
    there, n = found.objective(found.minimum.unknowns), found.objective.n_parameters
    assert found.minimum.unknowns[:n] == pytest.approx(found.mixture.mean, abs=1e-12)
    chosen = found.mixture.explanations[0].chosen
    assert found.objective.parameters.prior_matrix.diagonal == pytest.approx(
        found.objective.parameters.choosing(chosen).prior_matrix.diagonal
    )
    score, matrix = there.score[n:], there.matrix.dense[n:, n:]
    assert 0.5 * score @ np.linalg.solve(matrix, score) < NEAR


def flattering(patients):
    """A body whose frame has moved by 0.5, and what still frames seem to explain from there: 0.5 of ln E does as much.

    But for a bend, which nothing tells where ln E is 0.
    """
    along, aside, bend = np.eye(9)[:3]
    body = patients.Response(np.column_stack([along, 0.8 * along + 0.5 * aside]), 8.0 * bend[:, None], 1)
    levels = Alternative(np.full((1, 1), 1e-4), 1.5, "still"), Alternative(np.eye(1), 0.0, "moves")
    frame = Block("frame", "frame", Acts.BOUNDARY, (0,), levels, Choice.FRAME)
    parameters = ParameterMap(np.ones(1), np.ones((1, 1)), ("gland",), "rest", True, (frame,))
    seen = body.solve(np.ones(1), np.array([0.5])).values
    state = LaterState(body, (patients.readings("gland", np.arange(9), seen),))
    return InverseProblem((state.with_approximation(patients.approximated(body)),), parameters), patients.Whole(body)


LINE = Bounds(np.full(1, -4.0), np.full(1, 4.0))


def at_their_best(problem, whole):
    """Of the still and the moving frame: level, by Laplace's approximation at its own best, and all unknowns there."""
    objective, found = Objective(problem.states, problem.parameters).with_approximations([whole]), []
    for k, alternative in enumerate(problem.parameters.blocks[0].alternatives):
        own = objective.with_prior(objective.parameters.choosing({0: k}))
        minimum = gauss_newton(own, np.zeros(2), bounds=LINE, tolerance=1e-10)
        there = minimum.evaluation
        determinants = alternative.log_determinant - np.linalg.slogdet(there.matrix.dense)[1]
        found.append((alternative.log_odds - there.value + 0.5 * determinants, minimum.unknowns))
    return found


def seen_from(problem, unknowns):
    """Levels of the still and the moving frame, where the model is exact at unknowns (2,)."""
    objective = Objective(problem.states, problem.parameters)
    points = objective.linearisation_points(unknowns)
    objective = objective.with_approximations(
        [of.update(at) for of, at in zip(objective.approximations, points, strict=True)]
    )
    there = objective(unknowns)
    mixture = mixture_of(cheapest_posterior(objective, unknowns, there), unknowns, there, LINE)
    return {of.chosen[0]: of.level for of in mixture.explanations}


@pytest.mark.parametrize("number", [None, 0, 1])
def test_what_only_looks_likelier_from_the_best_of_another_explanation_does_not_win(patients, number):
    """Each explanation weighs what it does at its own best, whichever the search begins with."""
    problem, whole = flattering(patients)
    (still, _), (moves, best) = at_their_best(problem, whole)
    seen = seen_from(problem, best)
    assert seen[1] == pytest.approx(moves, abs=0.01)
    assert seen[0] > moves > still + RIVAL  # or there would be nothing to show
    start = begun(Objective(problem.states, problem.parameters), np.zeros(2))
    if number is not None:
        start = replace(start, group=scenarios_of(problem.parameters.blocks)[number].group)
    end = searched(start, LINE, REPORTED, progress=silent, title="")
    assert end.minimum.converged
    first, second = end.posterior.explanations
    assert first.chosen == {0: 1}
    assert first.level - second.level == pytest.approx(moves - still, abs=0.1)
    assert first.theta == pytest.approx(best[:1], abs=REPORTED.step_sd * np.sqrt(first.covariance[0, 0]))


def test_models_are_exact_where_it_ends(bent, found):
    of, _ = bent
    objective, x = found.objective, found.minimum.unknowns
    moduli, (q,) = objective.parameters.moduli(x), objective.parameters.coefficients(x)
    stated, exact = (model.solve(moduli, q) for model in (objective.approximations[0].model, of.bodies[0]))
    assert stated.values == pytest.approx(exact.values, abs=1e-12)
    assert stated.tangent() == pytest.approx(exact.tangent(), abs=1e-12)


def test_it_ends_where_the_body_itself_would(patients, bent, found):
    of, _ = bent
    rng = np.random.default_rng(2)
    patients.patient(rng, bend=0.6)  # the same errors
    whole = invert(of.problem(rng, bounds=LEARNED, scale=2.0, whole=True), patients.settings(), progress=silent)
    assert whole.minimum.converged
    assert np.all(np.abs(whole.mixture.mean - found.mixture.mean) < 3.0 * REPORTED.step_sd * sd_of(found.mixture))


def test_every_start_is_told_and_none_moves_a_single_minimum(patients, bent, found):
    starts = [0.4, 0.1], [-0.9, 0.5], [1.5, 1.5]
    several = invert(bent[1], patients.settings(*starts), progress=silent)
    assert [run.theta.tolist() for run in several.starts] == list(starts)
    assert all(run.candidate == 0 for run in several.starts if run.minimum.converged)
    assert np.all(np.abs(several.mixture.mean - found.mixture.mean) < 2.0 * REPORTED.step_sd * sd_of(found.mixture))


def test_a_second_minimum_that_a_start_leads_to_is_in_the_posterior(patients):
    """Of a body that answers to ln E as to 2 - ln E."""
    rng = np.random.default_rng(12)
    of = patients.without(patients.patient(rng, bend=-1.0), (0, 1, 2, 3))
    found = invert(of.problem(rng, whole=True), patients.settings([0.4, -0.3], [1.7, -0.3]), progress=silent)
    assert {run.candidate for run in found.starts} == {0, 1}
    assert found.mixture.mean[0] == pytest.approx(1.0, abs=0.01)
    assert sd_of(found.mixture)[0] > 0.25


@pytest.mark.parametrize("gain", [0.0, 1e-9, 1e-4])
@pytest.mark.parametrize("n_images", [1, 2])
def test_a_modulus_that_moves_next_to_nothing_is_left_open(patients, gain, n_images):
    rng = np.random.default_rng(3)
    of = patients.patient(rng, n_images, gain=(1.0, gain))
    found = invert(of.problem(rng, bounds=LEARNED), patients.settings(), progress=silent)
    assert found.minimum.converged
    assert len(found.minimum.history) <= 6
    assert sd_of(found.mixture)[1] > 50.0
    assert sd_of(found.mixture)[0] < 0.1
    assert abs(found.mixture.mean[0] - of.truth[0]) < 4.0 * sd_of(found.mixture)[0]


def test_a_body_that_does_not_move_at_all_is_no_error(patients):
    of = patients.patient(np.random.default_rng(3), gain=(0.0, 0.0))
    found = invert(of.problem(bounds=LEARNED), patients.settings(), progress=silent)
    assert found.minimum.converged
    assert np.isinf(sd_of(found.mixture)).all()


def test_too_few_iterations_are_not_called_convergence(patients, bent):
    found = invert(bent[1], patients.settings(), progress=silent, rule=StopRule(iterations=1))
    assert found.minimum.outcome is Outcome.STEPS
    assert not found.minimum.converged
    assert found.mixture.weights.sum() == pytest.approx(1.0)


def test_bounds_hold_on_the_way_and_at_the_end(patients, bent):
    narrow = replace(patients.settings(), bounds=Bounds(np.full(2, -0.1), np.full(2, 0.1)))
    found = invert(bent[1], narrow, progress=silent)
    assert found.minimum.converged
    assert all(np.all(np.abs(iterate.theta) <= 0.1) for iterate in found.minimum.history)
    assert narrow.bounds.reached(found.minimum.unknowns[:2]).any()


def test_no_posterior_is_known_before_the_first_iteration(bent):
    with pytest.raises(EstimationError, match="first iteration"):
        _ = begin(bent[1]).posterior


def test_every_iteration_is_reported_with_the_moduli(patients, bent):
    said = list[str]()
    found = invert(bent[1], patients.settings(), progress=said.append)
    told = [line for line in said if "iteration" in line]
    assert len(told) == len(found.minimum.history) - 1  # an estimate begins before the first of them
    assert all("gland" in line and "sac" in line for line in told)


def test_the_first_noise_is_that_with_which_an_estimate_ends(patients, bent, found):
    objective, minimum = first_noise_of(bent[1], patients.settings(), progress=silent)
    assert scales(objective)[0][0] == pytest.approx(scales(found.objective)[0][0], rel=0.02)
    assert np.all(np.abs(minimum.unknowns[:2] - found.mixture.mean) < sd_of(found.mixture))


def folded(patients, bent, times):
    """A search's begin with an approximation that cannot be made exact so many times."""
    failures = list[int]()

    class Folded(patients.Expanded):
        def update(self, at):
            if len(failures) < times:
                failures.append(1)
                raise NotConverged("folded")
            return super().update(at)

    start = begin(bent[1])
    (whole,) = start.objective.approximations
    approximation = Folded(whole.body, whole.model)
    return replace(start, objective=start.objective.with_approximations([approximation]))


def test_a_step_to_where_nothing_can_be_solved_is_halved(patients, bent):
    lengths = [
        np.abs(one_more(patients, folded(patients, bent, times)).minimum.unknowns[:2]).max() for times in (0, 1, 2)
    ]
    assert lengths[1:] == pytest.approx([lengths[0] / 2.0, lengths[0] / 4.0])


def test_where_every_shorter_one_fails_too_the_reason_is_told(patients, bent):
    with pytest.raises(NotConverged, match="folded"):
        one_more(patients, folded(patients, bent, 99))


def test_what_it_cost_is_counted(found):
    assert found.evaluations == 2 + len(found.minimum.history)  # one for the first noise
    assert found.counts.forward == len(found.minimum.history) - 1  # exact anew at every place but the first


@pytest.mark.parametrize("at_rest", [False, True], ids=["alone", "drawn at rest"])
def test_the_order_of_images_does_not_show(patients, at_rest):
    """Of three images, one of whose frames has moved, with a noise that is not known, and a common error at rest."""
    rng = np.random.default_rng(7)
    of = patients.with_unknowns(patients.patient(rng, 3, bend=0.3), FRAME, [1.0, 1.4])
    if at_rest:
        modes = 0.2 * rng.standard_normal((patients.N_READ, 3))
        of = patients.drawn_at_rest(of, modes, [np.eye(3), np.diag([1.0, 0.1, 0.1])], learned=True)
        of = patients.with_unknowns(of, len(of.parameters.blocks) - 1, [1.0, -0.8, 0.5])
    problem, found = of.problem(rng, bounds=LEARNED, scale=1.5), []
    for order in ((0, 1, 2), (2, 0, 1)):
        end = invert(patients.reordered(problem, order), patients.settings(), progress=silent)
        assert end.minimum.converged
        found.append(end)
    one, other = (end.mixture for end in found)
    assert np.all(np.abs(other.mean - one.mean) < 0.2 * REPORTED.step_sd * sd_of(one))
    assert sd_of(other) == pytest.approx(sd_of(one), rel=0.01)
    assert other.explanations[0].weight == pytest.approx(one.explanations[0].weight, rel=0.02)
    assert [other.explanations[0].images[i] for i in (1, 2, 0)] == list(one.explanations[0].images)
    noise = [sd for sd, _ in scales(found[1].objective)]
    assert [noise[i] for i in (2, 3, 4, 5, 0, 1)] == pytest.approx(
        [sd for sd, _ in scales(found[0].objective)], rel=1e-3
    )
