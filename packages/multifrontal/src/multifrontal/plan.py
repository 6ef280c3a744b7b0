"""What a factorisation does and where it puts it, known from the pattern alone: fronts, places in memory, steps."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from multifrontal.symbolic import Supernodes, children_of, dissection, node_graph, supernodes, twin_rows

__all__ = ["Front", "Plan", "blocks_of", "make_plan", "panel_of"]

Integers = NDArray[np.int64]

BLOCK = 192  # columns of a contribution that are kept together with what lies above the diagonal among them
SHARE = 0.03  # of a thread's part of the operations: subtrees up to it are eliminated side by side, each by one thread
AHEAD = 2  # such subtrees a thread, that are eliminated before the fronts above them


@dataclass(frozen=True, slots=True)
class Front:
    """The dense matrix of one supernode: its own `width` unknowns, from place `first` on, and those at `rows` (below,).

    panel: where its columns of the factor begin; contribution: where the columns of what it adds to its parent (below,
    below) begin in the working memory, see `blocks_of`; children: fronts; runs: (start among its rows, start in the
    parent's front, length) of each; entries: those of the matrix that belong to its columns.
    """

    first: int
    width: int
    rows: Integers
    panel: int
    contribution: int
    children: tuple[int, ...]
    runs: tuple[tuple[int, int, int], ...]
    entries: slice

    @property
    def size(self) -> int:
        """Rows of its columns."""
        return self.width + len(self.rows)


@dataclass(frozen=True, slots=True)
class Step:
    """Ranges of fronts, subtrees that may be eliminated side by side, and then fronts (m,) one after the other."""

    subtrees: tuple[range, ...]
    then: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Plan:
    """For all matrices of one pattern, by so many `threads`.

    order (n,): unknown that is eliminated at each place; source (m,): entries of the matrix, target (m,): their places
    in their front's columns; factor_size, work_size: numbers that the factor and the working memory hold;
    operations: of one factorisation.
    """

    order: Integers
    fronts: tuple[Front, ...]
    source: NDArray[np.int32]
    target: NDArray[np.int32]
    threads: int
    steps: tuple[Step, ...]
    factor_size: int
    work_size: int
    operations: float

    def bytes(self, dtype: type) -> int:
        """Memory that a factorisation in numbers of this type takes, the working memory included."""
        return (self.factor_size + self.work_size) * np.dtype(dtype).itemsize


def panel_of(factor: NDArray[Any], front: Front) -> NDArray[Any]:
    """The factor's columns (n_rows, n_columns) of a front, in Fortran's order; factor (n,): all fronts' entries."""
    return factor[front.panel : front.panel + front.size * front.width].reshape(front.width, front.size).T


def _block_bounds(below: int) -> list[tuple[int, int]]:
    """Ranges of columns in which a contribution (below, below) is kept, each from its diagonal downwards."""
    number = max(round(below / BLOCK), 1)
    ends = [below * k // number for k in range(number + 1)]
    return list(pairwise(ends))


def blocks_of(memory: NDArray[Any], front: Front) -> list[tuple[int, int, NDArray[Any]]]:
    """First and last column of each block of a front's contribution, and the block (n_rows, n_columns) in `memory`.

    Its rows begin at the first column. memory (n,): where contributions lie.
    """
    begin, m, found = front.contribution, len(front.rows), []
    for low, high in _block_bounds(m):
        size = (m - low) * (high - low)
        found.append((low, high, memory[begin : begin + size].reshape(high - low, m - low).T))
        begin += size
    return found


def make_plan(matrix: sparse.csr_matrix[np.float64], threads: int) -> Plan:
    """The plan for matrices with the pattern of `matrix` (n, n), sorted and without duplicates."""
    group = twin_rows(matrix)
    first = np.flatnonzero(np.diff(group, prepend=-1))
    weight = np.bincount(group).astype(np.int64)
    graph = node_graph(matrix, group)
    nodes = supernodes(graph, dissection(graph), weight)
    own = weight[nodes.order]
    offset = np.concatenate([[0], np.cumsum(own)])
    order = _spread(first[nodes.order], own)
    below = [int(own[rows].sum()) for rows in nodes.rows]
    width = np.diff(offset[nodes.start])
    w, m = width.astype(np.float64), np.array(below, dtype=np.float64)
    work = w**3 / 3.0 + w**2 * m + w * m**2
    steps = elimination_steps(nodes.parent, work, threads)
    places, work_size = memory_places(nodes.parent, [_kept(m) for m in below], steps)
    source, target, bounds = _entries(matrix, nodes, group, first, weight)
    panel = np.concatenate([[0], np.cumsum(width * (width + below))])
    children = children_of(nodes.parent)
    fronts = tuple(
        Front(
            first=int(offset[nodes.start[s]]),
            width=int(width[s]),
            rows=_spread(offset[nodes.rows[s]], own[nodes.rows[s]]),
            panel=int(panel[s]),
            contribution=places[s],
            children=tuple(children[s]),
            runs=_runs(nodes, own, s),
            entries=slice(int(bounds[s]), int(bounds[s + 1])),
        )
        for s in range(len(nodes.parent))
    )
    return Plan(order, fronts, source, target, threads, steps, int(panel[-1]), work_size, float(work.sum()))


def _kept(below: int) -> int:
    """Numbers that a contribution (below, below) takes."""
    return sum((below - low) * (high - low) for low, high in _block_bounds(below))


def _spread(first: Integers, count: Integers) -> Integers:
    """first, first + 1 ... (count of them) for each of first (n,), count (n,)."""
    ends = np.cumsum(count)
    return np.repeat(first - ends + count, count) + np.arange(int(ends[-1]) if len(ends) else 0)


def _runs(nodes: Supernodes, own: Integers, s: int) -> tuple[tuple[int, int, int], ...]:
    """Where the rows of supernode s, of `own` (n_nodes,) unknowns each, lie in its parent's front."""
    parent, rows = int(nodes.parent[s]), nodes.rows[s]
    if parent < 0 or not len(rows):
        return ()
    columns = np.arange(nodes.start[parent], nodes.start[parent + 1])
    front = np.concatenate([columns, nodes.rows[parent]])
    there = np.concatenate([[0], np.cumsum(own[front])])
    here = np.concatenate([[0], np.cumsum(own[rows])])
    place = np.searchsorted(front, rows)
    breaks = np.flatnonzero((np.diff(place) != 1) | (place[1:] == len(columns))) + 1
    starts = np.concatenate([[0], breaks])
    ends = np.append(breaks, len(rows))
    table = np.stack([here[starts], there[place[starts]], here[ends] - here[starts]], axis=1)
    return tuple((a, b, c) for a, b, c in table.tolist())


def _entries(
    matrix: sparse.csr_matrix[np.float64], nodes: Supernodes, group: Integers, first: Integers, weight: Integers
) -> tuple[NDArray[np.int32], NDArray[np.int32], Integers]:
    """Entries of the matrix (m,) in the factor's columns, their places (m,) in their front, and bounds by front.

    Column j of the lower triangle is read from row j of the symmetric matrix. The rows of a node have the same columns.
    """
    n = len(first)
    own = weight[nodes.order]
    offset = np.concatenate([[0], np.cumsum(own)])
    place = np.argsort(nodes.order)
    rows = first[nodes.order]  # of each node in turn, its first
    lengths = matrix.indptr[rows + 1] - matrix.indptr[rows]
    entry = _spread(matrix.indptr[rows].astype(np.int64), lengths.astype(np.int64))
    node = np.repeat(np.arange(n), lengths)
    column = matrix.indices[entry]
    other = place[group[column]]
    kept = np.flatnonzero(other >= node)
    entry, node, column, other = entry[kept], node[kept], column[kept], other[kept]
    member = np.repeat(np.arange(len(nodes.parent)), np.diff(nodes.start))
    row = _local_rows(nodes, own, offset, member[node], other) + column - first[group[column]]
    size = np.diff(offset[nodes.start]) + [int(own[below].sum()) for below in nodes.rows]
    here = member[node]
    target = (offset[node] - offset[nodes.start[here]]) * size[here] + row
    count = own[node]  # the node's other rows have the same columns
    further = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
    target = np.repeat(target, count) + further * np.repeat(size[here], count)
    stride = np.repeat(lengths[node], count)
    source = np.repeat(entry, count) + further * stride
    bounds = np.searchsorted(np.repeat(here, count), np.arange(len(nodes.parent) + 1))
    return source.astype(np.int32), target.astype(np.int32), bounds


def _local_rows(nodes: Supernodes, own: Integers, offset: Integers, member: Integers, other: Integers) -> Integers:
    """First row (m,) in the front of supernode `member` (m,) of the node at place `other` (m,)."""
    n = len(own)
    inside = other < nodes.start[member + 1]
    result = offset[other] - offset[nodes.start[member]]
    counts = [len(rows) for rows in nodes.rows]
    keys = np.repeat(np.arange(len(counts)) * n, counts) + np.concatenate(nodes.rows)
    sums = np.concatenate([[0], np.cumsum(own[keys % n])])
    begins = np.concatenate([[0], np.cumsum(counts)])[:-1]
    outside = np.flatnonzero(~inside)
    s = member[outside]
    found = np.searchsorted(keys, s * n + other[outside])
    width = offset[nodes.start[s + 1]] - offset[nodes.start[s]]
    result[outside] = width + sums[found] - sums[begins[s]]
    return result


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
