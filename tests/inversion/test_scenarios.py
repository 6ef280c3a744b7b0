"""What may be: scenarios that all later images share, and how each image is drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.inversion import Candidates, alternatives_of, cheapest_posterior, mixture_of, scenarios_of
from palpate.inversion.scenarios import frames_of
from palpate.unknowns import Acts, Alternative, Block, Choice


@pytest.fixture
def blocks(patients):
    """Those of a patient with three later images."""
    return patients.blocks_of(3)


def of_choice(blocks, choice):
    return [i for i, block in enumerate(blocks) if block.choice is choice]


@pytest.mark.parametrize("choice", [Choice.PATCHINESS, Choice.LAYERS, Choice.FRAME])
def test_what_is_the_same_of_all_is_the_same_in_every_scenario(blocks, choice):
    own = of_choice(blocks, choice)
    assert len(own) > 1
    for scenario in scenarios_of(blocks):
        chosen = dict(scenario.chosen)
        assert len({chosen[i] for i in own}) == 1


def test_scenarios_are_every_combination_once_with_odds_that_add_up(blocks):
    """A choice's odds count once, however many tissues or images it is of."""
    every = scenarios_of(blocks)
    assert len({of.chosen for of in every}) == len(every) == 3 * 2 * 3
    for of in every:
        first = {choice: of_choice(blocks, choice)[0] for choice in (Choice.PATCHINESS, Choice.LAYERS, Choice.FRAME)}
        chosen = dict(of.chosen)
        assert of.log_odds == pytest.approx(sum(blocks[i].alternatives[chosen[i]].log_odds for i in first.values()))


def test_a_frame_moves_smoothly_and_as_a_whole_by_choices_of_their_own(patients):
    """Two blocks of each image: still, hardly or not, and as a whole or not, the same in all images."""
    whole = Alternative(1e-4 * np.eye(1), 0.0, "still as a whole"), Alternative(np.eye(1), 0.0, "moves as a whole")
    both = [
        *patients.blocks_of(2),
        *(Block("frame", "frame", Acts.BOUNDARY, (s,), whole, Choice.FRAME) for s in range(2)),
    ]
    every = scenarios_of(both)
    assert len(every) == 3 * 2 * 3 * 2
    smooth, rigid = ([i for i in of_choice(both, Choice.FRAME) if both[i].size == n] for n in (patients.N_FRAME, 1))
    pairs = set()
    for of in every:
        chosen = dict(of.chosen)
        pairs.add((*{chosen[i] for i in smooth}, *{chosen[i] for i in rigid}))
    assert pairs == {(a, b) for a in range(3) for b in range(2)}
    assert len({of.group for of in every}) == 3 * 2 * 2


def test_groups_tell_apart_how_patchy_tissues_are_and_whether_the_frame_moves(blocks):
    """Layers, and a frame that hardly moves beside one that stands still, are of one group."""
    patchy, frame = of_choice(blocks, Choice.PATCHINESS)[0], of_choice(blocks, Choice.FRAME)[0]
    told = {(of.group, dict(of.chosen)[patchy], dict(of.chosen)[frame] == 2) for of in scenarios_of(blocks)}
    assert len({group for group, *_ in told}) == len(told) == 3 * 2


def test_motions_of_several_lengths_are_of_one_group(blocks):
    frames = of_choice(blocks, Choice.FRAME)
    more = [
        replace(block, alternatives=(*block.alternatives, replace(block.alternatives[-1], covariance=9.0 * np.eye(2))))
        if i in frames
        else block
        for i, block in enumerate(blocks)
    ]
    assert len(scenarios_of(more)) == 3 * 2 * 4
    assert {of.group for of in scenarios_of(more)} == {of.group for of in scenarios_of(blocks)}


def test_words_of_the_frame_are_the_scenario_s_and_those_of_drawings_the_image_s(blocks):
    assert {of.words[-1] for of in scenarios_of(blocks)} == {"frame still", "frame hardly moves", "frame moves"}
    for state in range(3):
        assert [of.words for of in alternatives_of(blocks, state)] == [
            (),
            ("gland drawn otherwise",),
            ("sac drawn otherwise",),
            ("gland drawn otherwise", "sac drawn otherwise"),
        ]


def test_an_image_is_eliminated_under_each_motion_that_a_scenario_gives_its_frame(blocks):
    for state in range(3):
        (frame,) = [i for i in of_choice(blocks, Choice.FRAME) if blocks[i].states == (state,)]
        assert frames_of(blocks, state) == (((frame, 0),), ((frame, 1),), ((frame, 2),))
    none = [block for block in blocks if block.choice is not Choice.FRAME]
    assert frames_of(none, 0) == ((),)


def mixture_at(objective, patients, candidates):
    x = np.zeros(objective.parameters.n_unknowns)
    there = objective(x)
    return mixture_of(cheapest_posterior(objective, x, there), x, there, patients.WIDE, candidates)


def test_what_one_image_shows_of_the_frame_is_believed_of_all(patients):
    """One of three frames has moved far: all may, and each has moved as far as its own image shows."""
    rng = np.random.default_rng(3)
    of = patients.patient(rng, 3)
    frames = of_choice(of.parameters.blocks, Choice.FRAME)
    of = patients.with_unknowns(of, frames[1], [1.5, -2.0])
    first = mixture_at(of.objective(rng), patients, Candidates()).explanations[0]
    assert [first.chosen[i] for i in frames] == [2, 2, 2]
    motions = [np.abs(first.minimum.unknowns[of.parameters.columns(i)]).max() for i in frames]
    assert motions[1] > 1.0
    assert max(motions[0], motions[2]) < 0.3


def test_images_that_each_leave_it_open_tell_together_whether_the_frame_moves(patients):
    """The log-odds of one motion over another of three alike images are three times those of one image.

    Where the moduli are known, which images else tell together.
    """

    def odds(n_images):
        """Ln of by how much a frame that hardly moves is likelier than one that is still, less what the prior says."""
        rng = np.random.default_rng(4)
        of = patients.patient(rng, n_images)
        of = replace(of, bodies=of.bodies[:1] * n_images)
        frames = of_choice(of.parameters.blocks, Choice.FRAME)
        for i in frames:
            of = patients.with_unknowns(of, i, [0.065, -0.065])
        of = patients.without(of, [i for i, b in enumerate(of.parameters.blocks) if b.choice is not Choice.FRAME])
        known = replace(of.parameters, prior_mean=of.truth[:2], prior_precision=1e8 * np.eye(2))
        of = replace(of, parameters=known)
        levels = {e.chosen[0]: e.level for e in mixture_at(of.objective(), patients, Candidates(most=99)).explanations}
        return levels[1] - levels[0] + 0.7

    alone, three = odds(1), odds(3)
    assert 0.0 < alone < 2.0
    assert three == pytest.approx(3.0 * alone, rel=0.01)


def test_only_the_kept_scenarios_are_compared_and_so_many_of_each_group(patients):
    rng = np.random.default_rng(5)
    of = patients.patient(rng)
    objective, frame = of.objective(rng), of_choice(of.parameters.blocks, Choice.FRAME)[0]
    moving = mixture_at(objective, patients, Candidates(lambda scenario: dict(scenario.chosen)[frame] == 2, most=99))
    assert {e.chosen[frame] for e in moving.explanations} == {2}
    few = mixture_at(objective, patients, Candidates(of_group=2))
    groups = [e.group for e in few.explanations]
    assert len(set(groups)) > 1
    assert max(groups.count(group) for group in groups) == 2
