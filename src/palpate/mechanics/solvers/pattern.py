"""Structure of a sparse matrix: unknowns that belong to one node, and the order in which they are eliminated."""

from __future__ import annotations

import numpy as np
import pymetis
from numpy.typing import NDArray
from scipy import sparse

__all__ = ["dissection", "nested_dissection", "node_graph", "twin_rows"]


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
