"""What may be: scenarios of the tissues, and in every later image how its frame moves and its surfaces are drawn.

A scenario says how patchy all tissues are, and whether thin layers lie round organs. In every later image the frame
stands still, hardly moves or moves, and surfaces are drawn alike or otherwise. Each is a normal prior of some blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from palpate.unknowns.blocks import Block, Choice


@dataclass(frozen=True, slots=True)
class Alternatives:
    """One choice of the priors of several blocks: numbers of block and alternative, log prior odds, and words."""

    chosen: tuple[tuple[int, int], ...]
    log_odds: float
    words: tuple[str, ...]


def scenarios_of(blocks: Sequence[Block]) -> tuple[Alternatives, ...]:
    """The scenarios of the tissues: all have one level of patchiness, and all organs layers or none."""
    return _products([_together(blocks, choice) for choice in (Choice.PATCHINESS, Choice.LAYERS)])


def alternatives_of(blocks: Sequence[Block], state: int) -> tuple[Alternatives, ...]:
    """What may be in one later image: how its frame moves, and which of its surfaces are drawn otherwise."""
    own = [i for i, block in enumerate(blocks) if block.states == (state,)]
    frames = [
        [
            Alternatives(((i, k),), a.log_odds, (f"{blocks[i].of} {a.name}",))
            for k, a in enumerate(blocks[i].alternatives)
        ]
        for i in own
        if blocks[i].choice is Choice.FRAME
    ]
    drawn = [i for i in own if blocks[i].choice is Choice.DRAWING]
    which = [(), *((i,) for i in drawn), *([tuple(drawn)] if len(drawn) > 1 else [])]
    drawings = [
        Alternatives(
            tuple((i, int(i in otherwise)) for i in drawn),
            float(np.mean([blocks[i].alternatives[1].log_odds for i in otherwise])) if otherwise else 0.0,
            tuple(f"{blocks[i].of} drawn otherwise" for i in otherwise),
        )
        for otherwise in which
    ]
    return _products([*frames, drawings])


def _together(blocks: Sequence[Block], choice: Choice) -> list[Alternatives]:
    """The alternatives of blocks that have the same one."""
    own = [i for i, block in enumerate(blocks) if block.choice is choice]
    if not own:
        return [Alternatives((), 0.0, ())]
    levels = blocks[own[0]].alternatives
    return [Alternatives(tuple((i, k) for i in own), a.log_odds, (a.name,)) for k, a in enumerate(levels)]


def _products(groups: Sequence[Sequence[Alternatives]]) -> tuple[Alternatives, ...]:
    """Every combination of one of each group."""
    return tuple(
        Alternatives(
            tuple(pair for one in of for pair in one.chosen),
            sum(one.log_odds for one in of),
            tuple(word for one in of for word in one.words),
        )
        for of in product(*groups)
    )
