"""What may be: scenarios that all later images share, and in every later image how its surfaces are drawn.

A scenario says how patchy all tissues are, whether thin layers lie round organs, and whether the frame stands still,
hardly moves or moves. In every later image surfaces are drawn alike or otherwise. Each is a normal prior of blocks.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from palpate.unknowns.blocks import Block, Choice


@dataclass(frozen=True, slots=True)
class Alternatives:
    """One choice of the priors of several blocks: numbers of block and alternative, log prior odds, and words.

    group: what tells apart those whose motions and tissues are so unlike that each is linearised at its own best: how
    patchy tissues are, and whether the frame moves.
    """

    chosen: tuple[tuple[int, int], ...]
    log_odds: float
    words: tuple[str, ...]
    group: tuple[str, ...] = ()


def scenarios_of(blocks: Sequence[Block]) -> tuple[Alternatives, ...]:
    """The scenarios: all tissues have one level of patchiness, all organs layers or none, all frames move or none.

    Whether the frame moves is a matter of the body and of how it lies, which is the same in all later images: each of
    them would else have to speak for it alone.
    """
    patchiness, layers = (_together(blocks, _numbers(blocks, of)) for of in (Choice.PATCHINESS, Choice.LAYERS))
    frames = dict[tuple[str, ...], list[int]]()
    for i in _numbers(blocks, Choice.FRAME):
        frames.setdefault(tuple(of.name for of in blocks[i].alternatives), []).append(i)
    moves = [_together(blocks, own, f"{blocks[own[0]].of} ") for own in frames.values()]
    groups = [_apart(patchiness, {of.words for of in patchiness}), layers]
    return _products([*groups, *(_apart(of, {of[-1].words}) for of in moves)])


def _apart(alternatives: Sequence[Alternatives], unlike: Collection[tuple[str, ...]]) -> list[Alternatives]:
    """The same, those with words that are `unlike` the others' in groups of their own."""
    return [replace(of, group=of.words if of.words in unlike else ("",)) for of in alternatives]


def alternatives_of(blocks: Sequence[Block], state: int) -> tuple[Alternatives, ...]:
    """What may be in one later image, beside the scenario: which of its surfaces are drawn otherwise."""
    drawn = [i for i, b in enumerate(blocks) if b.states == (state,) and b.choice is Choice.DRAWING]
    which = [(), *((i,) for i in drawn), *([tuple(drawn)] if len(drawn) > 1 else [])]
    return tuple(
        Alternatives(
            tuple((i, int(i in otherwise)) for i in drawn),
            float(np.mean([blocks[i].alternatives[1].log_odds for i in otherwise])) if otherwise else 0.0,
            tuple(f"{blocks[i].of} drawn otherwise" for i in otherwise),
        )
        for otherwise in which
    )


def frames_of(blocks: Sequence[Block], state: int) -> tuple[tuple[tuple[int, int], ...], ...]:
    """How the frame may move in one later image: numbers of block and alternative, of every scenario."""
    own = [i for i in _numbers(blocks, Choice.FRAME) if blocks[i].states == (state,)]
    return tuple(product(*([(i, k) for k in range(len(blocks[i].alternatives))] for i in own)))


def _numbers(blocks: Sequence[Block], choice: Choice) -> list[int]:
    """Those of the blocks with a choice."""
    return [i for i, block in enumerate(blocks) if block.choice is choice]


def _together(blocks: Sequence[Block], own: Sequence[int], of: str = "") -> list[Alternatives]:
    """The alternatives of blocks, by their numbers, that have the same one; of: what they are of, in words."""
    if not own:
        return [Alternatives((), 0.0, ())]
    levels = blocks[own[0]].alternatives
    return [Alternatives(tuple((i, k) for i in own), a.log_odds, (f"{of}{a.name}",)) for k, a in enumerate(levels)]


def _products(groups: Sequence[Sequence[Alternatives]]) -> tuple[Alternatives, ...]:
    """Every combination of one of each group."""
    return tuple(
        Alternatives(
            tuple(pair for one in of for pair in one.chosen),
            sum(one.log_odds for one in of),
            tuple(word for one in of for word in one.words),
            tuple(word for one in of for word in one.group),
        )
        for of in product(*groups)
    )
