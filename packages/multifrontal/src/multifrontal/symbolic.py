"""Which unknowns are eliminated together, in which order, and where that fills the factor.

The order is METIS' nested dissection. Elimination tree, column counts and supernodes are found on the graph of the
nodes (groups of unknowns with equal columns), in time nearly linear in its edges: Liu, SIAM Review 34 (1992) 82-109;
Gilbert, Ng & Peyton, SIAM J. Matrix Anal. Appl. 15 (1994) 1075-1091; supernodes with few explicit zeros are merged as
by Ashcraft & Grimes, ACM TOMS 15 (1989) 291-309. Inside a supernode nodes are ordered by partition refinement:
Jacquelin, Ng & Peyton, SIAM Workshop on Combinatorial Scientific Computing (2018) 1-10. Without it METIS' order leaves
seventy times as many pieces to add, the Morton order of the nodes' places four times as many.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pymetis
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import minimum_spanning_tree

__all__ = ["Supernodes", "children_of", "dissection", "nested_dissection", "node_graph", "supernodes", "twin_rows"]

Integers = NDArray[np.int64]

SMALL = 48  # unknowns, up to which supernodes are merged whatever zeros that makes
ZEROS = ((96, 0.5), (256, 0.2), (1 << 40, 0.05))  # share of explicit zeros allowed up to so many unknowns


def twin_rows(matrix: sparse.csr_matrix[np.float64]) -> NDArray[np.int64]:
    """Group number (n,), from 0 upwards, of each row; neighbouring rows with the same columns are in one group.

    The three unknowns of a node are such twins, and so are the two of a node that slides on a plane. Two patterns are
    compared by the sum of random 64-bit numbers of their columns: a chance of 2^-64 a row to be wrong, which would
    cost speed, not correctness.
    """
    tickets = np.random.default_rng(0).integers(-(2**62), 2**62, size=matrix.shape[1])
    entries = np.append(tickets[matrix.indices], 0)
    sums = np.add.reduceat(entries, matrix.indptr[:-1])
    lengths = np.diff(matrix.indptr)
    different = (np.diff(sums) != 0) | (np.diff(lengths) != 0) | (lengths[1:] == 0)
    return np.concatenate([[0], np.cumsum(different)])


def node_graph(matrix: sparse.csr_matrix[np.float64], group: NDArray[np.int64]) -> sparse.csr_matrix[np.float64]:
    """Which of the nodes (n, n), groups (n_rows,) of twin rows, share an entry; symmetric, without loops, sorted."""
    first = np.flatnonzero(np.diff(group, prepend=-1))
    n = len(first)
    seen = matrix[first]
    half = sparse.csr_matrix((np.ones(seen.nnz), group[seen.indices], seen.indptr), shape=(n, n))
    half.setdiag(0.0)
    graph = sparse.csr_matrix(half + half.T)  # an entry that rounding cancelled on one side only is there on both
    graph.eliminate_zeros()
    graph.sort_indices()
    return graph


def dissection(graph: sparse.csr_matrix[np.float64]) -> NDArray[np.int64]:
    """Fill-reducing order (n,) of the nodes of a symmetric graph (n, n) without loops.

    METIS: Karypis & Kumar, SIAM J. Sci. Comput. 20 (1998) 359-392.
    """
    if graph.nnz == 0:  # METIS wants an edge
        return np.arange(graph.shape[0])
    starts, adjacent = graph.indptr.astype(np.int32), graph.indices.astype(np.int32)
    order, _ = pymetis.nested_dissection(pymetis.CSRAdjacency(adj_starts=starts, adjacent=adjacent))
    return np.asarray(order, dtype=np.int64)


def nested_dissection(matrix: sparse.csr_matrix[np.float64]) -> NDArray[np.int64]:
    """Fill-reducing order (n,) of the unknowns of a symmetric pattern; those of one node, its twins, stay together."""
    group = twin_rows(matrix)
    return np.asarray(np.argsort(np.argsort(dissection(node_graph(matrix, group)))[group], kind="stable"))


@dataclass(frozen=True, slots=True)
class Supernodes:
    """Supernodes in an order in which each comes after its children, its descendants right before it.

    order (n_nodes,): nodes in the order of elimination; start (n + 1,): place of each supernode's first node in it;
    parent (n,): supernode or -1; rows: for each the places in `order` of the nodes below its own that it fills, sorted.
    """

    order: Integers
    start: Integers
    parent: Integers
    rows: tuple[Integers, ...]


def elimination_tree(lower: sparse.csr_matrix[np.float64]) -> Integers:
    """Parent (n,), or -1, of each column; lower (n, n): strictly lower triangle of the pattern in elimination order.

    The tree depends on which of the first i columns hang together, for every i, and a spanning forest that is minimal
    for max(row, column) keeps exactly that: so Liu's algorithm runs over n - 1 edges.
    """
    n = lower.shape[0]
    rows = np.repeat(np.arange(n), np.diff(lower.indptr))
    weighted = sparse.csr_matrix((rows.astype(np.float64), lower.indices, lower.indptr), shape=lower.shape)
    forest = sparse.coo_matrix(minimum_spanning_tree(weighted))
    ends = np.stack([forest.row, forest.col])
    first, last = ends.min(axis=0), ends.max(axis=0)
    by_last = np.argsort(last, kind="stable")
    parent, ancestor = [-1] * n, [-1] * n
    for k, i in zip(first[by_last].tolist(), last[by_last].tolist(), strict=True):
        node = k
        while ancestor[node] != -1 and ancestor[node] != i:
            ancestor[node], node = i, ancestor[node]
        if ancestor[node] == -1:
            ancestor[node] = parent[node] = i
    return np.array(parent, dtype=np.int64)


def postorder(parent: Integers, weight: Integers | None = None) -> Integers:
    """Order (n,) in which every node follows all of its descendants; children by `weight` (n,), the largest first."""
    n = len(parent)
    ranked = np.arange(n) if weight is None else np.argsort(-weight, kind="stable")
    by_parent = ranked[np.argsort(parent[ranked], kind="stable")]
    bounds = np.searchsorted(parent[by_parent], np.arange(-1, n + 1)).tolist()
    children = by_parent.tolist()
    stack, preorder = children[: bounds[1]], []
    while stack:  # a node, then its last child with all below that: backwards, it is a postorder
        node = stack.pop()
        preorder.append(node)
        stack += children[bounds[node + 1] : bounds[node + 2]]
    return np.array(preorder[::-1], dtype=np.int64)


def children_of(parent: Integers) -> list[list[int]]:
    """Children of each node of a tree."""
    found: list[list[int]] = [[] for _ in range(len(parent))]
    for node, above in enumerate(parent.tolist()):
        if above >= 0:
            found[above].append(node)
    return found


def column_counts(lower: sparse.csr_matrix[np.float64], parent: Integers, weight: Integers) -> Integers:
    """Unknowns (n,) in each column of the factor, its own included, of a postordered tree; weight (n,) of each row.

    Row i fills the paths from its entries up to i. The length of their union: +1 where a path begins, -1 where two of
    them, neighbours in postorder, meet, summed over subtrees.
    """
    n = len(parent)
    counts = np.diff(lower.indptr)
    row = np.repeat(np.arange(n), counts)
    delta = np.bincount(lower.indices, weight[row], minlength=n)
    same = np.flatnonzero(np.diff(row) == 0)
    meet = _lowest_common_ancestors(
        parent, lower.indices[same].astype(np.int64), lower.indices[same + 1].astype(np.int64)
    )
    delta -= np.bincount(meet, weight[row[same]], minlength=n)
    delta -= np.where(counts > 0, weight, 0)
    sums = np.concatenate([[0.0], np.cumsum(delta)])
    sizes = [1] * len(parent)
    for node, above in enumerate(parent.tolist()):
        if above >= 0:
            sizes[above] += sizes[node]
    below = sums[1:] - sums[np.arange(n) + 1 - np.array(sizes, dtype=np.int64)]
    return np.asarray(np.rint(below).astype(np.int64) + weight)


def _lowest_common_ancestors(parent: Integers, first: Integers, last: Integers) -> Integers:
    """Lowest common ancestors (m,) of first < last (m,) in a postordered tree.

    Of the nodes from first to last the leftmost of least depth is `last` itself, if it is above `first`, and else a
    child of the ancestor; least depths come from a table of those of 1, 2, 4 ... nodes.
    """
    n = len(parent)
    depths = [0] * len(parent)
    above = parent.tolist()
    for node in range(len(above) - 1, -1, -1):
        if above[node] >= 0:
            depths[node] = depths[above[node]] + 1
    table = [np.array(depths, dtype=np.int64) * n + np.arange(n)]
    while 2 ** len(table) <= n:
        before, half = table[-1], 2 ** (len(table) - 1)
        table.append(np.minimum(before, before[np.minimum(np.arange(n) + half, n - 1)]))
    level = np.frexp((last - first + 1).astype(np.float64))[1] - 1
    levels = np.stack(table)
    least = np.minimum(levels[level, first], levels[level, last + 1 - 2**level]) % n
    return np.where(least == last, last, parent[least])


def supernodes(graph: sparse.csr_matrix[np.float64], order: Integers, weight: Integers) -> Supernodes:
    """Supernodes of a symmetric graph (n, n) of nodes of `weight` (n,) unknowns each, eliminated along `order`."""
    nodes = order[postorder(elimination_tree(_reordered(graph, order)))]
    lower = _reordered(graph, nodes)
    tree, own = elimination_tree(lower), weight[nodes]
    counts = column_counts(lower, tree, own)
    # A column continues the supernode of the one before if it is its parent and fills the same rows.
    begins = (tree[:-1] != np.arange(1, len(tree))) | (counts[:-1] != counts[1:] + own[:-1])
    member = np.concatenate([[0], np.cumsum(begins)])
    first = np.flatnonzero(np.diff(member, prepend=-1))
    last = np.append(first[1:], len(tree)) - 1
    parent = np.where(tree[last] >= 0, member[tree[last]], -1)
    width = np.bincount(member, own).astype(np.int64)
    into = _merged(parent, width, counts[first])
    kept, number = np.unique(into, return_inverse=True)
    parent = np.where(parent[kept] >= 0, number[parent[kept]], -1)
    return _in_order(lower, nodes, own, number[member], parent)


def _in_order(
    lower: sparse.csr_matrix[np.float64], nodes: Integers, weight: Integers, member: Integers, parent: Integers
) -> Supernodes:
    """Supernodes in the postorder of least memory, and their nodes where contributions come in long runs."""
    below = _structures(sparse.csc_matrix(lower), member, parent)
    sizes = np.array([int(weight[rows].sum()) for rows in below])
    kept = sizes * sizes
    peak, left = kept.tolist(), kept.tolist()
    for s, children in enumerate(children_of(parent)):
        held, most = 0, 0
        for child in sorted(children, key=lambda c: left[c] - peak[c]):
            most = max(most, held + peak[child])
            held += left[child]
        peak[s] = max(most, held + left[s])
    order = postorder(parent, np.array(peak, dtype=np.int64) - kept)
    place = np.argsort(order)
    parent, below = np.append(place, -1)[parent[order]], [below[s] for s in order]
    by_member = np.argsort(place[member], kind="stable")
    start = np.searchsorted(place[member][by_member], np.arange(len(order) + 1))
    below = _renumbered(below, by_member)
    refined = refined_order(start, children_of(parent), below)
    return Supernodes(nodes[by_member][refined], start, parent, tuple(_renumbered(below, refined)))


def _renumbered(sets: list[Integers], order: Integers) -> list[Integers]:
    """Sets of numbers after those have been put in `order`, sorted."""
    place = np.argsort(order)
    return [np.sort(place[numbers]) for numbers in sets]


def _reordered(graph: sparse.csr_matrix[np.float64], order: Integers) -> sparse.csr_matrix[np.float64]:
    """Strictly lower triangle of the graph with its nodes along `order`, columns sorted."""
    lower = sparse.tril(graph[order][:, order], -1, format="csr")
    lower.sort_indices()
    return lower


def _merged(parent: Integers, width: Integers, front: Integers) -> Integers:
    """Supernode (n,) into which each is merged, itself or a later one; parent, width, front (n,): in unknowns.

    Merging a child with its parent makes its columns as long as the front of both: explicit zeros, of which a bounded
    share is allowed.
    """
    n = len(parent)
    widths, fronts, zeros = width.tolist(), front.tolist(), [0] * n
    into = list(range(n))
    children: list[list[int]] = [[] for _ in range(n)]
    for s, above in enumerate(parent.tolist()):
        for child in sorted(children[s], key=lambda c: widths[c] * (fronts[s] - fronts[c])):
            both = widths[child] + widths[s]
            empty = zeros[child] + zeros[s] + widths[child] * (widths[child] + fronts[s] - fronts[child])
            size = both * (widths[child] + fronts[s]) - both * both // 2
            if both <= SMALL or empty <= next(share for limit, share in ZEROS if both <= limit) * size:
                into[child], widths[s], zeros[s] = s, both, empty
                fronts[s] += widths[child]
        if above >= 0:
            children[above].append(s)
    for s in range(n - 1, -1, -1):
        into[s] = into[into[s]]
    return np.array(into, dtype=np.int64)


def _structures(lower: sparse.csc_matrix[np.float64], member: Integers, parent: Integers) -> list[Integers]:
    """For each supernode the nodes that it fills outside itself; member (n_nodes,), parent (n,)."""
    n = len(parent)
    by_member = np.argsort(member, kind="stable")
    bounds = np.searchsorted(member[by_member], np.arange(n + 1))
    ordered = sparse.csc_matrix(lower[:, by_member])
    inherited: list[list[Integers]] = [[] for _ in range(n)]
    found = []
    for s in range(n):
        direct = ordered.indices[ordered.indptr[bounds[s]] : ordered.indptr[bounds[s + 1]]]
        reached = np.unique(np.concatenate([direct, *inherited[s]]))
        below = reached[member[reached] != s]
        inherited[s] = []
        found.append(below)
        if parent[s] >= 0:
            inherited[parent[s]].append(below)
    return found


def refined_order(start: Integers, children: list[list[int]], below: list[Integers]) -> Integers:
    """Order (n_nodes,) inside supernodes such that what descendants fill there lies in few runs.

    start (n + 1,): first node of each supernode; children: supernodes; below: the nodes that each fills outside itself,
    sorted. The nodes of a supernode are divided by whether its first child fills them, each part by its next one, and
    so on down the tree; neighbouring parts meet with the sides that are filled.
    """
    part = np.zeros(int(start[-1]), dtype=np.int64)
    for s in range(len(children)):
        low, high, queue, n_parts = int(start[s]), int(start[s + 1]), children[s], 1
        while queue and n_parts < high - low:
            following: list[int] = []
            for child in sorted(queue, key=lambda c: -len(below[c])):
                rows = below[child]
                hit = rows[np.searchsorted(rows, low) : np.searchsorted(rows, high)] - low
                if len(hit) > 0:
                    following += children[child]
                    if len(hit) < high - low:
                        part[low:high], n_parts = _divided(part[low:high], n_parts, hit)
            queue = following
    return np.lexsort((part, np.repeat(np.arange(len(children)), np.diff(start))))


def _divided(part: Integers, n_parts: int, hit: Integers) -> tuple[Integers, int]:
    """Each part (n,) divided by whether its nodes are among `hit` (m,), and how many parts there are then."""
    inside = np.zeros(len(part), dtype=np.int64)
    inside[hit] = 1
    hits = np.bincount(part[hit], minlength=n_parts)
    mixed = (hits > 0) & (hits < np.bincount(part, minlength=n_parts))
    if not mixed.any():
        return part, n_parts
    # From left to right: whether the part's end towards the next one is filled; a divided one turns it round.
    filled_first = np.zeros(n_parts, dtype=np.int64)
    filled = False
    for number in np.flatnonzero(hits).tolist():
        if number and not hits[number - 1]:
            filled = False
        if mixed[number]:
            filled_first[number] = filled
            filled = not filled
        else:
            filled = True
    ahead: Integers = np.cumsum(mixed) - mixed
    second = mixed[part] & (inside != filled_first[part])
    return part + ahead[part] + second, n_parts + int(mixed.sum())
