"""The prior of a driver's motion, learned from what its wall shows."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from scipy import linalg

from palpate.inversion import LaterState, Objective, hyper_parameters
from palpate.observation.wall_modes import Wall, fine_modes, wall_modes, wall_of
from palpate.unknowns import Acts, Alternative, Arrowhead, Block, ParameterMap, unit_blocks, wall_blocks
from palpate.unknowns.blocks import only

N_MODES = 90


class Ball(NamedTuple):
    """A ball's wall with its modes (3 n_points, n_modes) mm."""

    points: np.ndarray
    normals: np.ndarray
    modes: np.ndarray
    wall: Wall


def ball(*, prior_mm=5.0, kernel_mm=20.0):
    points = np.random.default_rng(0).normal(size=(400, 3))
    points *= 30.0 / np.linalg.norm(points, axis=1, keepdims=True)
    own = {"kernel_mm": kernel_mm, "prior_mm": prior_mm}
    modes = wall_modes(points, n_modes=N_MODES, **own)
    wall = wall_of(points, points / 30.0, modes, np.arange(modes.shape[1]), name="tube", **own)
    return Ball(points, points / 30.0, modes, wall)


def learned(ball, motion, *, sd_mm):
    """Prior covariance (n_points, n_points) mm^2 of the x component, after a motion (n_points, 3) mm was seen."""
    precision = learned_precision(ball, motion, sd_mm=sd_mm)
    return ball.modes[::3] @ np.linalg.solve(precision, ball.modes[::3].T)


def learned_precision(ball, motion, *, sd_mm, seen=None):
    """Prior precision (n_modes, n_modes), all of the motion or its part along the unit vectors `seen` shown."""
    modes = ball.modes
    if seen is not None:
        rows = modes.reshape(len(seen), 3, -1)
        modes, motion = np.einsum("pa,pam->pm", seen, rows), np.einsum("pa,pa->p", seen, motion)
    data = modes.T @ modes / sd_mm**2
    score = -modes.T @ motion.ravel() / sd_mm**2  # at no motion
    prior = arrow(len(data))
    shown = Arrowhead.of(data, prior.places.images)
    evaluation = SimpleNamespace(matrix=shown + prior, prior=prior, score=score, prior_score=np.zeros(len(data)))
    found = hyper_parameters.with_amplitudes(moved_by(ball.wall), evaluation, np.zeros(len(data)))
    return found.parameters.prior_matrix.dense


def arrow(n, size=1.0):
    """That many unknowns of one image, each with a precision of this size."""
    return Arrowhead.of(size * np.eye(n), (np.arange(n),))


def moved_by(*walls):
    """An objective of no moduli and one state whose modes move the walls."""
    blocks = tuple(block for wall in walls for block in wall_blocks(wall, 0))
    return Objective((LaterState(None, ()),), ParameterMap(np.ones(1), np.zeros((1, 0)), (), "rest", True, blocks))


def drawn(ball, *, sd_mm, kernel_mm, seed):
    distance2 = np.sum((ball.points[:, None] - ball.points[None]) ** 2, axis=2)
    covariance = np.exp(-distance2 / (2.0 * kernel_mm**2)) + 1e-9 * np.eye(len(distance2))
    return sd_mm * np.linalg.cholesky(covariance) @ np.random.default_rng(seed).normal(size=(len(distance2), 3))


@pytest.mark.parametrize("sd_mm", [0.4, 2.0, 8.0])
def test_the_amplitude_is_that_of_the_motion(sd_mm):
    here = ball()
    found = [
        np.sqrt(learned(here, drawn(here, sd_mm=sd_mm, kernel_mm=20.0, seed=seed), sd_mm=0.05).diagonal().mean())
        for seed in range(6)
    ]
    assert np.exp(np.mean(np.log(found))) == pytest.approx(sd_mm, rel=0.2)


def test_a_wall_that_moves_as_one_may_not_slide_in_parts():
    here = ball()
    gradient = np.array([[0.06, 0.02, 0.0], [0.02, -0.09, 0.01], [0.0, 0.01, 0.03]])
    stiff = learned(here, here.points @ gradient, sd_mm=0.05)
    rough = learned(here, drawn(here, sd_mm=1.5, kernel_mm=20.0, seed=1), sd_mm=0.05)
    near = np.linalg.norm(here.points[0] - here.points, axis=1).argsort()[60]
    correlation = [c[0, near] / np.sqrt(c[0, 0] * c[near, near]) for c in (stiff, rough)]
    assert correlation[0] > 0.9 > correlation[1] + 0.1


def expected_sliding(ball, motion):
    """Mean tangential motion, mm, that the prior expects of a wall whose normal motion alone was seen."""
    precision = learned_precision(ball, motion, sd_mm=0.05, seen=ball.normals)
    normal = np.einsum("pa,pam->pm", ball.normals, ball.modes.reshape(len(ball.normals), 3, -1))
    shown = np.einsum("pa,pa->p", ball.normals, motion)
    q = np.linalg.solve(normal.T @ normal / 0.05**2 + precision, normal.T @ shown / 0.05**2)
    moved = (ball.modes @ q).reshape(-1, 3)
    along = np.einsum("pa,pa->p", ball.normals, moved)
    return float(np.linalg.norm(moved - along[:, None] * ball.normals, axis=1).mean())


def test_a_wall_that_swells_is_not_taken_for_one_that_slides():
    """Where its modes can follow: the swelling varies over more than their kernel's 20 mm."""
    here = ball()
    waves = 3.0 * (1.0 + 0.6 * np.cos(here.points @ np.array([0.03, 0.04, 0.02])))
    assert expected_sliding(here, waves[:, None] * here.normals) < 0.3


def test_a_wall_that_shifts_as_one_is_not_taken_for_one_that_swells():
    here = ball()
    shift = np.tile([2.0, -1.0, 0.5], (len(here.points), 1))
    across = shift - np.einsum("pa,pa->p", here.normals, shift)[:, None] * here.normals
    assert expected_sliding(here, shift) == pytest.approx(np.linalg.norm(across, axis=1).mean(), rel=0.1)


def test_the_first_guess_of_the_amplitude_does_not_matter():
    """As long as it is no limit: the amplitude learned here, 5.5 mm, is under twice the smaller guess."""
    motion = drawn(ball(), sd_mm=2.0, kernel_mm=25.0, seed=3)
    first, second = (learned(ball(prior_mm=prior), motion, sd_mm=0.2) for prior in (4.0, 8.0))
    allowed = np.maximum(0.05 * np.abs(first), 0.02 * np.abs(first).max())
    assert np.all(np.abs(second - first) <= allowed)  # 160 000 entries, over which pytest.approx takes two seconds


def test_what_is_learned_of_a_wall_does_not_hang_on_what_was_believed_of_it():
    """Drift, swelling and finer motion explain a part of each other: whichever begins wide would else keep it."""
    here = ball()
    fine = fine_modes(here.points, here.normals)
    modes, n = np.concatenate([here.modes, fine], axis=1), here.modes.shape[1]
    motion = drawn(here, sd_mm=0.5, kernel_mm=14.0, seed=2)
    data, score = modes.T @ modes / 0.1**2, -modes.T @ motion.ravel() / 0.1**2
    objective, found = moved_by(replace(here.wall, n_fine=fine.shape[1])), list[np.ndarray]()
    for sds in ((1.0, 0.01), (0.01, 1.0)):
        prior = Arrowhead.of(np.diag(np.repeat(sds, [n, fine.shape[1]]) ** -2.0), (np.arange(len(data)),))
        shown = Arrowhead.of(data, prior.places.images)
        seen = SimpleNamespace(matrix=shown + prior, prior=prior, score=score, prior_score=np.zeros(len(data)))
        learned = hyper_parameters.with_amplitudes(objective, seen, np.zeros(len(data)))
        found.append(np.diag(learned.parameters.priors[0].covariance))
    assert found[0] == pytest.approx(found[1], rel=1e-6)


@pytest.mark.parametrize("sd_mm", [0.05, 1.0])
def test_no_other_amplitude_has_more_evidence(sd_mm):
    """d/ds of 1/2 (b^T (A + P / s)^-1 b - ln det(A + P / s) + ln det(P / s)) at s = 1, the prior's variance times s."""
    here = ball()
    motion = drawn(here, sd_mm=2.0, kernel_mm=20.0, seed=1)
    precision = learned_precision(here, motion, sd_mm=sd_mm)
    data, pull = here.modes.T @ here.modes / sd_mm**2, here.modes.T @ motion.ravel() / sd_mm**2

    def log_evidence(scale):
        prior = precision / scale
        total = data + prior
        return 0.5 * (pull @ np.linalg.solve(total, pull) - np.linalg.slogdet(total)[1] + np.linalg.slogdet(prior)[1])

    slope = (log_evidence(1.01) - log_evidence(0.99)) / 0.02
    curvature = (log_evidence(1.1) - 2.0 * log_evidence(1.0) + log_evidence(0.9)) / 0.01
    assert curvature < -1.0
    assert abs(slope / curvature) < 2e-3  # the variance is found to two thousandths


def test_what_is_not_seen_at_all_keeps_a_bounded_prior():
    here = ball()
    variance = learned(here, np.zeros_like(here.points), sd_mm=1e6).diagonal()
    assert np.all(variance > 0.0)
    assert np.all(np.isfinite(variance))
    assert variance.max() < 2.0 * (2.0 * 5.0 * 1.1) ** 2


@pytest.mark.parametrize("n_terms", [1, 2])
def test_where_nothing_is_seen_the_evidence_asks_for_nothing(n_terms, capfd):
    """A block's prior is then as it begins, and no library complains."""
    terms = tuple(np.diag([1.0, 2.0, 0.5]) ** (k + 1) for k in range(n_terms))
    block = Block("b", "driver", Acts.BOUNDARY, (0,), only(np.eye(3)), terms=terms)
    given = Objective((LaterState(None, ()),), ParameterMap(np.ones(1), np.zeros((1, 0)), (), "rest", True, (block,)))
    evaluation = SimpleNamespace(matrix=arrow(3), prior=arrow(3), score=np.zeros(3), prior_score=np.zeros(3))
    found = hyper_parameters.with_amplitudes(given, evaluation, np.zeros(3))
    believed = found.parameters.priors[0].covariance
    assert believed == pytest.approx(sum(terms), abs=0.01)
    assert capfd.readouterr() == ("", "")


def test_walls_that_are_not_given_keep_the_modes_own_prior():
    own = unit_blocks(N_MODES)
    given = Objective((LaterState(None, ()),), ParameterMap(np.ones(1), np.zeros((1, 0)), (), "rest", True, own))
    evaluation = SimpleNamespace(matrix=arrow(N_MODES, 2.0), prior=arrow(N_MODES))
    evaluation.score = evaluation.prior_score = np.zeros(N_MODES)
    found = hyper_parameters.with_amplitudes(given, evaluation, np.zeros(N_MODES))
    assert found.parameters.prior_matrix.dense == pytest.approx(np.eye(N_MODES))


def test_what_is_believed_of_the_others_follows_their_prior_mean_too(rng):
    """The evidence of a block is that of the whole normal model: moduli with a prior of their own are marginalised."""
    n, k = 5, 3
    design = rng.normal(size=(40, n))
    values = rng.normal(size=40) - design @ np.array([0.5, 0.1, 1.5, -2.0, 1.0])
    mean, precision = np.array([0.7, -0.4]), np.diag([3.0, 5.0])
    term = np.diag([1.0, 2.0, 0.5])
    parameters = ParameterMap(
        np.ones(2), np.eye(2), ("a", "b"), "c", True, (), prior_mean=mean, prior_precision=precision
    )
    block = Block("b", "driver", Acts.BOUNDARY, (0,), only(np.eye(k)), terms=(term,))
    parameters = replace(parameters, blocks=(block,), priors=(Alternative(np.eye(k)),))
    prior, data = parameters.prior_matrix, Arrowhead.of(design.T @ design, parameters.places.images)
    x = rng.normal(size=n)
    score = design.T @ (values + design @ x)
    evaluation = SimpleNamespace(matrix=data + prior, prior=prior, score=score, prior_score=np.zeros(n))
    objective = Objective((LaterState(None, ()),), parameters)
    found = hyper_parameters.with_amplitudes(objective, evaluation, x).parameters.priors[0].precision

    def log_evidence(amplitude):
        """ln N(values; -design mean, 1 + design C design^T), all unknowns marginalised."""
        covariance = linalg.block_diag(np.linalg.inv(precision), amplitude**2 * (term + 1e-3 * np.eye(k)))
        total = np.eye(40) + design @ covariance @ design.T
        away = values + design @ np.append(mean, np.zeros(k))
        return -0.5 * (away @ np.linalg.solve(total, away) + np.linalg.slogdet(total)[1])

    amplitude = np.sqrt(1.0 / (found[0, 0] * (1.0 + 1e-3)))
    assert log_evidence(amplitude) > max(log_evidence(0.98 * amplitude), log_evidence(1.02 * amplitude))
