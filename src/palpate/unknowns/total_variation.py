"""Total variation of a field, rounded: a prior under which a map may have edges."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from palpate.images.tissue import FieldPrior
from palpate.mesh.tet_mesh import FACES, TetMesh

ROUNDING = 0.2  # of the stated standard deviation: the variation of smaller jumps is quadratic
WEAK = 4.0  # standard deviation of the underlying normal law, in stated ones: so wide that it does not smooth edges
SETTLED = 1e-3  # of ln E: largest change of a jump at which the iteration ends
REWEIGHTINGS = 60


@dataclass(frozen=True, slots=True)
class TotalVariation:
    """-ln p(x) = sum_f w_f sqrt((J x)_f^2 + e^2) + 1/2 x^T P x + a constant, of coefficients x (n,) of a field.

    jumps (n_faces, n): J, by how much the field jumps across each face between two elements; weights (n_faces,): w;
    rounding: e; weak (n, n): P. Convex, and proper by P. All dimensionless. (Rudin, Osher & Fatemi 1992, Physica D 60,
    259-268; rounded as by Vogel & Oman 1996, SIAM J. Sci. Comput. 17, 227-238.)
    """

    jumps: NDArray[np.float64]
    weights: NDArray[np.float64]
    rounding: float
    weak: NDArray[np.float64]

    def value(self, x: NDArray[np.float64]) -> float:
        """-ln p at x (n,)."""
        return float(self.weights @ self._sizes(x) + 0.5 * x @ self.weak @ x)

    def gradient(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Its gradient (n,)."""
        return np.asarray(self.jumps.T @ (self.weights * (self.jumps @ x) / self._sizes(x)) + self.weak @ x)

    def curvature(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Its second derivative (n, n): w e^2 / (j^2 + e^2)^(3/2) of a jump j, almost none across an edge."""
        return self._weighted(self.weights * self.rounding**2 / self._sizes(x) ** 3)

    def lagged(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Precision (n, n) of the normal law that touches p at x and is nowhere above it: w / sqrt(j^2 + e^2)."""
        return self._weighted(self.weights / self._sizes(x))

    def reweighted(
        self, information: NDArray[np.float64], pull: NDArray[np.float64], x: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Where 1/2 x^T A x - b^T x, A (n, n) and b (n,), is least with the touching law at x (n,): lower than x.

        Lagged diffusivity, by Vogel and Oman.
        """
        return np.asarray(linalg.solve(information + self.lagged(x), pull, assume_a="pos", check_finite=False))

    def least(
        self, information: NDArray[np.float64], pull: NDArray[np.float64], start: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Where 1/2 x^T A x - b^T x - ln p(x) is least (n,), sought from a start (n,)."""
        x = start
        for _ in range(REWEIGHTINGS):
            before, x = x, self.reweighted(information, pull, x)
            if np.abs(self.jumps @ (x - before)).max(initial=0.0) < SETTLED:
                break
        return x

    def combined(self, basis: NDArray[np.float64]) -> TotalVariation:
        """That of combinations x = basis z, basis (n, k)."""
        return replace(self, jumps=self.jumps @ basis, weak=basis.T @ self.weak @ basis)

    def _sizes(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.sqrt((self.jumps @ x) ** 2 + self.rounding**2))

    def _weighted(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((self.jumps.T * weights) @ self.jumps + self.weak)


def total_variation(mesh: TetMesh, fields: sparse.csr_matrix[np.float64], prior: FieldPrior) -> TotalVariation:
    """That of a field with modes (n_tets, n), of independent coefficients, in the elements where these are given.

    w = A / (s l^2) of a face of the area A, s and l the prior's standard deviation and length: a wall as large as the
    square of the length across which ln E jumps by a standard deviation counts 1, whatever the mesh.
    """
    own = np.flatnonzero(np.diff(fields.indptr))
    faces = np.sort(mesh.tets[own][:, FACES].reshape(-1, 3), axis=1)
    different, face, count = np.unique(faces, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(face.ravel(), kind="stable")  # the two elements of a face follow each other
    inner = np.flatnonzero(count == 2)
    first = (np.cumsum(count) - count)[inner]
    owner = np.repeat(own, len(FACES))[order]
    corner = mesh.nodes[different[inner]]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    jumps = (fields[owner[first]] - fields[owner[first + 1]]).toarray()
    weak = np.eye(fields.shape[1]) / (WEAK * prior.sd) ** 2
    return TotalVariation(jumps, area / (prior.sd * prior.length_mm**2), ROUNDING * prior.sd, weak)
