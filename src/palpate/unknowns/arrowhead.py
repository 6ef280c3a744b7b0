"""Arrowhead matrices: the structure of every matrix of all unknowns, bordered and block-diagonal.

A later image has unknowns of its own: how its walls and its frame move, how it is drawn. Unknowns of two images are
coupled through moduli and tissues only. With each image's own unknowns eliminated, a small system of the shared ones is
left (Golub & Van Loan 2013, Matrix Computations, section 4.5): time and memory are linear in the number of images.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics.solvers.cholesky import backward, forward, lower_factor

SHARED = -1  # in the place of an image's number


@dataclass(frozen=True, slots=True)
class Places:
    """Where unknowns stand: numbers among all n of the `shared` (s,) ones, and of those of each image alone (n_k,)."""

    shared: NDArray[np.int64]
    images: tuple[NDArray[np.int64], ...] = ()
    _image: NDArray[np.int64] = field(init=False, repr=False, compare=False)
    _within: NDArray[np.int64] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        image, within = np.full(self.size, SHARED), np.empty(self.size, dtype=np.int64)
        within[self.shared] = np.arange(len(self.shared))
        for k, own in enumerate(self.images):
            image[own], within[own] = k, np.arange(len(own))
        object.__setattr__(self, "_image", image)
        object.__setattr__(self, "_within", within)

    @classmethod
    def of(cls, size: int, images: Iterable[NDArray[np.int64]] = ()) -> Places:
        """Those of so many unknowns, of which all are shared that are in no image; images without any are left out."""
        every, kept = np.ones(size, dtype=bool), tuple(own for own in images if len(own))
        for own in kept:
            every[own] = False
        return cls(np.flatnonzero(every), kept)

    @property
    def size(self) -> int:
        """Number n of all unknowns."""
        return len(self.shared) + sum(len(own) for own in self.images)

    def split(self, numbers: NDArray[np.int64]) -> list[tuple[int, NDArray[np.int64], NDArray[np.int64]]]:
        """Of unknowns with these numbers (m,): each image's, or `SHARED`, which among `numbers`, where in its block."""
        image, within = self._image[numbers], self._within[numbers]
        found = []
        for k in np.unique(image).tolist():
            which = np.flatnonzero(image == k)
            found.append((k, which, within[which]))
        return found

    def among(self, kept: NDArray[np.bool_]) -> Places:
        """Those of the unknowns that are `kept` (n,), numbered among these."""
        numbers = np.cumsum(kept) - 1
        return Places.of(int(np.count_nonzero(kept)), (numbers[own[kept[own]]] for own in self.images))


@dataclass(frozen=True, slots=True)
class Arrowhead:
    """A symmetric matrix (n, n) of all unknowns in which those of two images never meet.

    shared A (s, s); own D_k (n_k, n_k) and across B_k (n_k, s) of each image. Matrices of one sum have the same places.
    """

    places: Places
    shared: NDArray[np.float64]
    own: tuple[NDArray[np.float64], ...] = ()
    across: tuple[NDArray[np.float64], ...] = ()

    @classmethod
    def zeros(cls, places: Places) -> Arrowhead:
        """That of zeros."""
        s, sizes = len(places.shared), [len(own) for own in places.images]
        own, across = tuple(np.zeros((n, n)) for n in sizes), tuple(np.zeros((n, s)) for n in sizes)
        return cls(places, np.zeros((s, s)), own, across)

    @classmethod
    def of(cls, matrix: NDArray[np.float64], images: Sequence[NDArray[np.int64]] = ()) -> Arrowhead:
        """That of a dense matrix (n, n), of which nothing is read that stands between two images."""
        places = Places.of(len(matrix), images)
        pairs = [(matrix[np.ix_(own, own)], matrix[np.ix_(own, places.shared)]) for own in places.images]
        return cls(
            places,
            matrix[np.ix_(places.shared, places.shared)],
            tuple(own for own, _ in pairs),
            tuple(across for _, across in pairs),
        )

    @property
    def size(self) -> int:
        """Number n of its rows."""
        return self.places.size

    @property
    def diagonal(self) -> NDArray[np.float64]:
        """(n,)."""
        found = np.empty(self.size)
        found[self.places.shared] = np.diag(self.shared)
        for numbers, own in zip(self.places.images, self.own, strict=True):
            found[numbers] = np.diag(own)
        return found

    @property
    def dense(self) -> NDArray[np.float64]:
        """The whole matrix (n, n)."""
        every = np.arange(self.size)
        return self.block(every, every)

    def __add__(self, other: Arrowhead) -> Arrowhead:
        return self._with(other, 1.0)

    def __sub__(self, other: Arrowhead) -> Arrowhead:
        return self._with(other, -1.0)

    def _with(self, other: Arrowhead, sign: float) -> Arrowhead:
        own = zip(self.own, other.own, strict=True)
        across = zip(self.across, other.across, strict=True)
        return Arrowhead(
            self.places,
            self.shared + sign * other.shared,
            tuple(a + sign * b for a, b in own),
            tuple(a + sign * b for a, b in across),
        )

    def __matmul__(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """A x (n,) or (n, k) for x (n,) or (n, k)."""
        shared = values[self.places.shared]
        found, of_shared = np.empty(values.shape), self.shared @ shared
        for numbers, own, across in self._images():
            found[numbers] = own @ values[numbers] + across @ shared
            of_shared = of_shared + across.T @ values[numbers]
        found[self.places.shared] = of_shared
        return found

    def block(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.float64]:
        """The entries (m, k) of rows (m,) and columns (k,) with these numbers."""
        found, right = np.zeros((len(rows), len(columns))), self.places.split(columns)
        for i, down, row in self.places.split(rows):
            for j, along, column in right:
                if i == j:
                    found[np.ix_(down, along)] = (self.shared if i == SHARED else self.own[i])[np.ix_(row, column)]
                elif j == SHARED:
                    found[np.ix_(down, along)] = self.across[i][np.ix_(row, column)]
                elif i == SHARED:
                    found[np.ix_(down, along)] = self.across[j][np.ix_(column, row)].T
        return found

    def among(self, kept: NDArray[np.bool_]) -> Arrowhead:
        """Rows and columns that are `kept` (n,)."""
        if kept.all():
            return self
        of_shared, own, across = kept[self.places.shared], list[NDArray[np.float64]](), list[NDArray[np.float64]]()
        for numbers, block, border in self._images():
            of_image = kept[numbers]
            if of_image.any():
                own.append(block[np.ix_(of_image, of_image)])
                across.append(border[np.ix_(of_image, of_shared)])
        shared = self.shared[np.ix_(of_shared, of_shared)]
        return Arrowhead(self.places.among(kept), shared, tuple(own), tuple(across))

    def plus(self, blocks: Iterable[tuple[NDArray[np.int64], NDArray[np.float64]]]) -> Arrowhead:
        """The sum with symmetric blocks (m, m) of unknowns with numbers (m,) each, of one image and shared ones."""
        shared, own, across = self.shared.copy(), [block.copy() for block in self.own], [b.copy() for b in self.across]
        for numbers, block in blocks:
            border = list[tuple[slice, slice]]()
            for k, which, within in self.places.split(numbers):
                runs = _runs(which, within)
                if k == SHARED:
                    border = runs
                for among, to in runs:
                    for other, beside in runs:
                        (shared if k == SHARED else own[k])[to, beside] += block[among, other]
                    for other, beside in border if k != SHARED else ():
                        across[k][to, beside] += block[among, other]
        return Arrowhead(self.places, shared, tuple(own), tuple(across))

    def plus_diagonal(self, values: NDArray[np.float64]) -> Arrowhead:
        """The sum with diag(values (n,))."""
        own = [_plus_diagonal(block, values[numbers]) for numbers, block, _ in self._images()]
        return Arrowhead(self.places, _plus_diagonal(self.shared, values[self.places.shared]), tuple(own), self.across)

    def turned(self, turn: NDArray[np.float64]) -> Arrowhead:
        """T^T A T for T (s, s) of the shared unknowns alone."""
        return Arrowhead(self.places, turn.T @ self.shared @ turn, self.own, tuple(b @ turn for b in self.across))

    def grounded(self) -> Arrowhead:
        """The same with 1 on the diagonal of unknowns that nothing depends on, which then stand alone."""
        empty = ~(self.diagonal > 0.0)
        return self.plus_diagonal(empty.astype(np.float64)) if empty.any() else self

    def eliminated(self) -> Eliminated:
        """With each image's own unknowns eliminated; raises `LinAlgError` where one of D_k is not positive definite."""
        factors, borders, left = list[NDArray[np.float64]](), list[NDArray[np.float64]](), self.shared
        for own, across in zip(self.own, self.across, strict=True):
            factors.append(lower_factor(own))
            borders.append(forward(factors[-1], across))
            left = left - borders[-1].T @ borders[-1]
        return Eliminated(self.places, tuple(factors), tuple(borders), left)

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solution (n,) or (n, k) for rhs (n,) or (n, k); raises `LinAlgError` for a singular matrix."""
        eliminated = self.eliminated()
        halves, right = eliminated.right(rhs)
        return eliminated.followed(halves, np.asarray(np.linalg.solve(eliminated.left, right)))

    def log_determinant(self) -> float:
        """Ln det. Raises as `eliminated` does."""
        return self.eliminated().log_determinant()

    def complement(
        self, numbers: NDArray[np.int64], rhs: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Schur complement (m, m), and what is left of rhs (n,), of unknowns with these numbers (m,), of one image.

        All others are eliminated. Raises `LinAlgError` where their matrix is not positive definite.
        """
        kept = {k for k, _, _ in self.places.split(numbers)}
        others = Places.of(self.size, (own for k, own in enumerate(self.places.images) if k not in kept))
        matrix, right = self.block(others.shared, others.shared), rhs[others.shared]
        at = np.searchsorted(others.shared, self.places.shared)
        for k, (of_image, own, across) in enumerate(self._images()):
            if k not in kept:
                factor = lower_factor(own)
                border = forward(factor, across)
                matrix[np.ix_(at, at)] -= border.T @ border
                right[at] -= border.T @ forward(factor, rhs[of_image])
        which = np.searchsorted(others.shared, numbers)
        rest = np.setdiff1d(np.arange(len(right)), which)
        factor = lower_factor(matrix[np.ix_(rest, rest)])
        border, half = forward(factor, matrix[np.ix_(rest, which)]), forward(factor, right[rest])
        return matrix[np.ix_(which, which)] - border.T @ border, right[which] - border.T @ half

    def _images(self) -> Iterable[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]]:
        """Of each image the numbers (n_k,) of its unknowns, D_k and B_k."""
        return zip(self.places.images, self.own, self.across, strict=True)


@dataclass(frozen=True, slots=True)
class Eliminated:
    """An arrowhead matrix without its images' own unknowns.

    factors L_k (n_k, n_k), lower, of D_k = L_k L_k^T; borders L_k^-1 B_k (n_k, s); left (s, s): A - sum_k B_k^T D_k^-1
    B_k, the matrix of the shared unknowns.
    """

    places: Places
    factors: tuple[NDArray[np.float64], ...]
    borders: tuple[NDArray[np.float64], ...]
    left: NDArray[np.float64]

    def log_determinant(self) -> float:
        """Ln det: of each D_k, and of what is left of the shared unknowns."""
        of_images = sum(2.0 * float(np.log(np.diag(factor)).sum()) for factor in self.factors)
        return of_images + float(np.linalg.slogdet(self.left)[1])

    def right(self, rhs: NDArray[np.float64]) -> tuple[tuple[NDArray[np.float64], ...], NDArray[np.float64]]:
        """Of rhs b (n,) or (n, k): h_k = L_k^-1 b_k of each image, and b_s - sum_k B_k^T D_k^-1 b_k."""
        pairs = zip(self.places.images, self.factors, strict=True)
        halves = tuple(forward(factor, rhs[own]) for own, factor in pairs)
        left = rhs[self.places.shared]
        for border, half in zip(self.borders, halves, strict=True):
            left = left - border.T @ half
        return halves, left

    def followed(self, halves: Sequence[NDArray[np.float64]], of_shared: NDArray[np.float64]) -> NDArray[np.float64]:
        """All unknowns (n,) or (n, k) from the shared ones x_s (s,) or (s, k): x_k = L_k^-T (h_k - L_k^-1 B_k x_s)."""
        found = np.empty((self.places.size, *of_shared.shape[1:]))
        found[self.places.shared] = of_shared
        for own, factor, border, half in zip(self.places.images, self.factors, self.borders, halves, strict=True):
            found[own] = backward(factor, half - border @ of_shared)
        return found

    def inverse_among(self, numbers: NDArray[np.int64]) -> NDArray[np.float64]:
        """The inverse's entries (m, m) of unknowns with these numbers (m,); raises `LinAlgError` for a singular one."""
        by_shared, found = np.zeros((len(numbers), len(self.places.shared))), np.zeros((len(numbers),) * 2)
        for k, which, within in self.places.split(numbers):
            if k == SHARED:
                by_shared[which, within] = 1.0
                continue
            unit = np.zeros((len(self.factors[k]), len(which)))
            unit[within, np.arange(len(which))] = 1.0
            root = forward(self.factors[k], unit)
            by_shared[which] = -root.T @ self.borders[k]
            found[np.ix_(which, which)] = root.T @ root
        return np.asarray(found + by_shared @ np.linalg.inv(self.left) @ by_shared.T)


def _plus_diagonal(matrix: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The sum of a matrix (n, n) with diag(values (n,))."""
    found = matrix.copy()
    found[np.diag_indices_from(found)] += values
    return found


def _runs(which: NDArray[np.int64], within: NDArray[np.int64]) -> list[tuple[slice, slice]]:
    """Parts of two lists of numbers (m,) in which both count up by one: they are many times faster than numbers."""
    ends = np.flatnonzero((np.diff(which) != 1) | (np.diff(within) != 1)) + 1
    bounds = [0, *ends.tolist(), len(which)]
    return [
        (slice(int(which[a]), int(which[b - 1]) + 1), slice(int(within[a]), int(within[b - 1]) + 1))
        for a, b in pairwise(bounds)
        if b > a
    ]
