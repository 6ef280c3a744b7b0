"""In which order fronts are eliminated by several threads, and where they leave what they contribute."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Step", "elimination_steps", "memory_places"]

Integers = NDArray[np.int64]

SHARE = 0.03  # of a thread's part of the operations: subtrees up to it are eliminated side by side, each by one thread
AHEAD = 2  # such subtrees a thread, that are eliminated before the fronts above them


@dataclass(frozen=True, slots=True)
class Step:
    """Ranges of fronts, subtrees that may be eliminated side by side, and then fronts (m,) one after the other."""

    subtrees: tuple[range, ...]
    then: tuple[int, ...]


def elimination_steps(parent: Integers, work: NDArray[np.float64], threads: int) -> tuple[Step, ...]:
    """Subtrees small enough for one of several threads, each as soon as it is its turn, and the fronts above them.

    parent (n,): each front's, -1 for a root; work (n,): operations of each front.
    """
    n = len(parent)
    if threads == 1:
        return (Step((range(n),), ()),)
    below = work.copy()
    first = np.arange(n)
    for s, above in enumerate(parent.tolist()):
        if above >= 0:
            below[above] += below[s]
            first[above] = min(first[above], first[s])
    small = below <= SHARE * work.sum() / threads
    roots = np.flatnonzero(small & ~np.append(small, False)[parent])
    subtrees = [range(int(first[s]), int(s) + 1) for s in roots]
    steps = []
    for begin in range(0, max(len(subtrees), 1), AHEAD * threads):
        batch = subtrees[begin : begin + AHEAD * threads]
        following = begin + AHEAD * threads
        done = batch[0].start if begin and batch else 0
        ready = subtrees[following].start if following < len(subtrees) else n
        steps.append(Step(tuple(batch), tuple(int(s) for s in np.flatnonzero(~small[done:ready]) + done)))
    return tuple(steps)


def memory_places(parent: Integers, sizes: list[int], steps: tuple[Step, ...]) -> tuple[list[int], int]:
    """Where (n,) in the working memory each front's contribution of `sizes` (n,) numbers lies, and all that it needs.

    Each lives from its front to its parent's. The subtrees of a step have a block each for all but their roots.
    """
    places, within = [0] * len(parent), {}
    needs: list[tuple[int, int, int]] = []  # size, first and last moment
    owners: list[int] = []
    moment = 0
    born: dict[int, int] = {}
    for step in steps:
        for subtree in step.subtrees:
            within[subtree[-1]], needed = _stacked([*subtree][:-1], parent, sizes)
            needs.append((needed, moment, moment))
            owners.append(-1 - subtree[-1])
            born[subtree[-1]] = moment
        for s in step.then:
            moment += 1
            born[s] = moment
        moment += 1
    for s, begin in born.items():
        needs.append((sizes[s], begin, born[int(parent[s])] if parent[s] >= 0 else begin))
        owners.append(s)
    offsets, most = _shared(needs)
    for owner, offset in zip(owners, offsets, strict=True):
        if owner >= 0:
            places[owner] = offset
        else:
            for s, place in within[-1 - owner].items():
                places[s] = offset + place
    return places, most


def _shared(needs: list[tuple[int, int, int]]) -> tuple[list[int], int]:
    """Places for needs of (size, first moment, last moment), the largest first, each in the first gap of its time."""
    places = [0] * len(needs)
    placed: list[int] = []
    for i in sorted(range(len(needs)), key=lambda i: -needs[i][0]):
        size, begin, end = needs[i]
        taken = [(places[j], places[j] + needs[j][0]) for j in placed if needs[j][1] <= end and begin <= needs[j][2]]
        for start, stop in sorted(taken):
            if start - places[i] >= size:
                break
            places[i] = max(places[i], stop)
        placed.append(i)
    return places, max((place + need[0] for place, need in zip(places, needs, strict=True)), default=0)


def _stacked(fronts: list[int], parent: Integers, sizes: list[int]) -> tuple[dict[int, int], int]:
    """Places from 0 on of the contributions of `fronts`, in postorder, and how many numbers they need.

    Two stacks grow towards each other, a front's contribution on the other one than its children's, which it uses up.
    """
    depth = [0] * len(parent)
    for s in range(len(parent) - 1, -1, -1):
        depth[s] = depth[parent[s]] + 1 if parent[s] >= 0 else 0
    chosen = set(fronts)
    used = dict.fromkeys(fronts, 0)  # of each front's children
    tops, most, begin = [0, 0], 0, {}
    for s in fronts:
        side = depth[s] % 2
        begin[s] = tops[side]
        tops[side] += sizes[s]
        most = max(most, sum(tops))
        tops[1 - side] -= used[s]
        if parent[s] in chosen:
            used[int(parent[s])] += sizes[s]
    return {s: place if depth[s] % 2 == 0 else most - place - sizes[s] for s, place in begin.items()}, most
