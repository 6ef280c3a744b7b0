"""Structure of a sparse matrix: unknowns that belong to one node, and the order in which they are eliminated."""

from __future__ import annotations

import numpy as np
import pymetis
from numpy.typing import NDArray
from scipy import sparse

__all__ = ["nested_dissection", "twin_rows"]


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


def nested_dissection(matrix: sparse.csr_matrix[np.float64]) -> NDArray[np.int64]:
    """Fill-reducing order (n,) of the unknowns of a symmetric pattern; those of one node, its twins, stay together.

    METIS on the graph of the nodes: Karypis & Kumar, SIAM J. Sci. Comput. 20 (1998) 359-392.
    """
    group = twin_rows(matrix)
    first = np.flatnonzero(np.diff(group, prepend=-1))
    n = len(first)
    seen = matrix[first]
    half = sparse.csr_matrix((np.ones(seen.nnz, dtype=np.int32), group[seen.indices], seen.indptr), shape=(n, n))
    graph = sparse.csr_matrix(half + half.T)  # an entry that rounding cancelled on one side only is there on both
    rows = np.repeat(np.arange(n), np.diff(graph.indptr))
    keep = graph.indices != rows
    starts = np.append(0, np.cumsum(np.bincount(rows[keep], minlength=n)))
    adjacency = pymetis.CSRAdjacency(adj_starts=starts.astype(np.int32), adjacent=graph.indices[keep].astype(np.int32))
    order, _ = pymetis.nested_dissection(adjacency)
    place = np.empty(n, dtype=np.int64)
    place[np.asarray(order)] = np.arange(n)
    return np.asarray(np.argsort(place[group], kind="stable"))
