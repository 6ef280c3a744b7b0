"""Reduced models: Galerkin projection on a basis of displacements, whose online cost forgets the mesh.

u = F V a + M q + o with V^T K_ff(E) V a = V^T F^T (f - K(E) (M q + o) - G(E) c); all blocks are affine in the moduli
and kept densely, one for each region, the loads' once. G(E) c are the forces of a material that differs by c, at one
displacement. Quarteroni, Manzoni & Negri, Reduced Basis Methods (2016), chapter 3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from palpate.errors import ConfigurationError, SolverError
from palpate.mechanics.forward import DenseEquilibrium, Outputs, checked_coefficients, checked_moduli
from palpate.mechanics.linear_model import LinearModel, touched_rows
from palpate.mechanics.material import MaterialForces
from palpate.mechanics.solvers.cholesky import backward, forward, lower_factor
from palpate.mechanics.solvers.conjugate_gradients import WORTH_THREADS, column_norms, times
from palpate.parallel import mapped, processors

RANK_TOLERANCE = 1e-10  # of the largest singular value of the normalised snapshots
WELL_CONDITIONED = 1e-12  # of the Gram matrix' largest eigenvalue; above it Cholesky's factor is safe
ROWS = 2048  # of basis vectors that are processed together, in the cache


@dataclass(frozen=True, slots=True)
class ReducedModel:
    """A linear model on m basis vectors; implements `ForwardModel`.

    Per region at 1 kPa: stiffness (n_regions, m, m) and coupling (n_regions, m, n_modes + 1), mN/mm, of boundary modes,
    material modes and offset; load (m,) mN. Outputs (rows): output_basis (n_outputs, m), in blocks of columns so that
    what is added to it copies nothing of what is there; output_modes (n_outputs, n_boundary), output_offset
    (n_outputs,), mm.
    """

    names: tuple[str, ...]
    stiffness: NDArray[np.float64]
    coupling: NDArray[np.float64]
    load: NDArray[np.float64]
    output_basis: tuple[NDArray[np.float64], ...]
    output_modes: NDArray[np.float64]
    output_offset: NDArray[np.float64]

    @property
    def n_regions(self) -> int:
        """Number of moduli."""
        return len(self.stiffness)

    @property
    def n_modes(self) -> int:
        """Number of boundary modes and material modes."""
        return int(self.coupling.shape[2]) - 1

    @property
    def n_boundary(self) -> int:
        """Number of boundary modes."""
        return int(self.output_modes.shape[1])

    @property
    def n_basis(self) -> int:
        """Number m of basis vectors."""
        return int(self.stiffness.shape[1])

    def spanned(self, amplitudes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Outputs (n_outputs,) or (n_outputs, k) mm of basis coefficients (m,) or (m, k) alone."""
        ends = np.cumsum([block.shape[1] for block in self.output_basis])[:-1]
        pairs = list(zip(self.output_basis, np.split(amplitudes, ends), strict=True))

        def rows(part: slice) -> NDArray[np.float64]:
            """Some of the outputs."""
            return np.asarray(sum((block[part] @ own for block, own in pairs[1:]), pairs[0][0][part] @ pairs[0][1]))

        return np.concatenate(self._by_rows(rows, len(self.output_modes), amplitudes.size))

    def components(self, values: NDArray[np.float64], rows: NDArray[np.int64] | None = None) -> NDArray[np.float64]:
        """Products (m,) or (m, k) of each basis vector's outputs with values (n_outputs,) or (n_outputs, k).

        rows (n,): numbers of the outputs where alone there are values, (n,) or (n, k) then.
        """

        def of_rows(part: slice) -> NDArray[np.float64]:
            """What some outputs add to them."""
            own = part if rows is None else rows[part]
            return np.concatenate([block[own].T @ values[part] for block in self.output_basis])

        found = self._by_rows(of_rows, len(values), self.n_basis * values.size // max(len(values), 1))
        return np.asarray(np.sum(found, axis=0))

    def _by_rows(self, work: Callable[[slice], NDArray[np.float64]], n: int, numbers: int) -> list[NDArray[np.float64]]:
        """Results of `work` for ranges of n rows, by threads where there are enough products."""
        if n * numbers < WORTH_THREADS:
            return [work(slice(0, n))]
        return mapped(
            work, [slice(*ends) for ends in pairwise(np.linspace(0, n, processors() + 1).astype(int).tolist())]
        )

    def outputs(self, seen: Outputs) -> ReducedModel:
        """The same model with the outputs that a linear map makes of the present ones."""
        return replace(
            self,
            output_basis=(np.concatenate([seen(block) for block in self.output_basis], axis=1),),
            output_modes=seen(self.output_modes),
            output_offset=seen(self.output_offset),
        )

    def system(self, moduli: NDArray[np.float64], like: ReducedSystem | None = None, common: int = 0) -> ReducedSystem:
        """The factorised reduced system at moduli (n_regions,) kPa; raises `SolverError`.

        like: one at the same moduli, whose model has as many first basis vectors `common` (see `common_vectors`): their
        part is not factorised again, and their responses to boundary modes are known.
        """
        checked = checked_moduli(moduli, self.names)
        try:
            if like is None or not common:
                forces = _weighted(checked, self.coupling)
                forces[:, -1] -= self.load
                factor = lower_factor(_weighted(checked, self.stiffness))
                halves = forward(factor, forces)
            else:
                factor, halves = self._bordered(checked, like, common)
        except np.linalg.LinAlgError as error:
            raise self._indefinite(checked) from error
        return ReducedSystem(self, checked, factor, halves, -backward(factor, halves))

    def _bordered(
        self, moduli: NDArray[np.float64], like: ReducedSystem, n: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Factor L (m, m) and L^-1 (C E - f) (m, n_modes + 1), n of whose rows are known for boundary modes."""
        rows, known = _weighted(moduli, self.stiffness[:, n:]), self.n_boundary
        forces = _weighted(moduli, self.coupling)
        forces[:, -1] -= self.load
        first = np.asfortranarray(like.factor[:n, :n])
        below = forward(first, rows[:, :n].T).T
        factor, halves = np.zeros((self.n_basis,) * 2, order="F"), np.empty((self.n_basis, forces.shape[1]), order="F")
        factor[:n, :n], factor[n:, :n] = first, below
        factor[n:, n:] = corner = lower_factor(rows[:, n:] - below @ below.T)
        halves[:n, :known], halves[:n, known:] = like.halves[:n, :known], forward(first, forces[:n, known:])
        halves[n:] = forward(corner, forces[n:] - below @ halves[:n])
        return factor, halves

    def solve(self, moduli: NDArray[np.float64], coefficients: NDArray[np.float64]) -> ReducedEquilibrium:
        """Equilibrium at moduli (n_regions,) kPa and mode coefficients (n_modes,); raises `SolverError`."""
        return self.system(moduli).solve(coefficients)

    def amplitude(self, moduli: NDArray[np.float64], given: NDArray[np.float64]) -> NDArray[np.float64]:
        """Basis coefficients (m,) alone, at moduli (n_regions,) kPa and [q, 1] (n_modes + 1,); raises `SolverError`.

        Nothing is checked: it is the fast way of those who ask ten thousands of times.
        """
        force = moduli @ (self.coupling @ given) - self.load
        stiffness = (moduli @ self.stiffness.reshape(len(moduli), -1)).reshape(self.n_basis, -1)
        # a symmetric matrix is its own transpose, which LAPACK takes without a copy
        _, solution, failed = linalg.lapack.dposv(stiffness.T, force, overwrite_a=1, overwrite_b=1)
        if failed:
            raise self._indefinite(moduli)
        return np.asarray(-solution)

    def responses(self, moduli: NDArray[np.float64]) -> NDArray[np.float64]:
        """Outputs (n_outputs, n_modes + 1) mm for each unit mode and, last, for offset and loads; `SolverError`."""
        return self.system(moduli).responses()

    def _indefinite(self, moduli: NDArray[np.float64]) -> SolverError:
        return SolverError(
            f"the reduced stiffness of {self.n_basis} basis vectors is not positive definite: the moduli"
            f" {moduli.tolist()} kPa differ too much, or the basis holds nearly equal displacements"
        )


def common_vectors(model: ReducedModel, other: ReducedModel) -> int:
    """How many first basis vectors two models share, with all that boundary modes do to them."""
    n = min(model.n_basis, other.n_basis)
    if (model.n_regions, model.n_boundary) != (other.n_regions, other.n_boundary):
        return 0
    unlike, boundary = np.any(model.stiffness[:, :n, :n] != other.stiffness[:, :n, :n], axis=0), model.n_boundary
    unlike |= np.diag(np.any(model.coupling[:, :n, :boundary] != other.coupling[:, :n, :boundary], axis=(0, 2)))
    return int(np.maximum(*np.nonzero(unlike)).min(initial=n))


def _weighted(weights: NDArray[np.float64], matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum (m, k) of matrices (n, m, k), each times its weight (n,)."""
    return np.asarray((weights @ matrices.reshape(len(weights), -1)).reshape(matrices.shape[1:]))


@dataclass(frozen=True, slots=True)
class ReducedSystem:
    """A reduced model at fixed moduli (n_regions,) kPa.

    factor L (m, m): lower Cholesky factor; amplitudes -L^-T h (m, n_modes + 1): basis coefficients of every unit
    response, of halves h (m, n_modes + 1).
    """

    model: ReducedModel
    moduli: NDArray[np.float64]
    factor: NDArray[np.float64]
    halves: NDArray[np.float64]
    amplitudes: NDArray[np.float64]

    def responses(self) -> NDArray[np.float64]:
        """Outputs (n_outputs, n_modes + 1) mm for each unit mode without the offset and, last, for the offset."""
        model = self.model
        found = model.spanned(self.amplitudes)
        found[:, : model.n_boundary] += model.output_modes
        found[:, -1] += model.output_offset
        return found

    def solve(self, coefficients: NDArray[np.float64]) -> ReducedEquilibrium:
        """Equilibrium at mode coefficients (n_modes,), dimensionless: no further solve."""
        checked, model = checked_coefficients(coefficients, self.model.n_modes), self.model
        amplitude = self.amplitudes @ np.append(checked, 1.0)
        given = model.output_modes @ checked[: model.n_boundary] + model.output_offset
        values = given + model.spanned(amplitude)
        values.setflags(write=False)
        return ReducedEquilibrium(self, checked, amplitude, values)

    def backward(self, loads: NDArray[np.float64]) -> NDArray[np.float64]:
        """Basis coefficients (m, k) of the responses to reduced loads (m, k) mN."""
        return backward(self.factor, forward(self.factor, loads))


@dataclass(frozen=True, slots=True)
class ReducedEquilibrium(DenseEquilibrium):
    """Outputs (n_outputs,) mm and basis coefficients (m,) at one system; implements `Equilibrium`."""

    system: ReducedSystem
    coefficients: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    values: NDArray[np.float64]

    def amplitude_tangent(self, slopes: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Derivatives (m, k + n_modes) of the basis coefficients by what moves the moduli, then by all modes.

        slopes (n_regions, k): of ln E by the former; None: ln E itself.
        """
        forces = -self._modulus_forces()
        by_modulus = self.system.backward(forces if slopes is None else forces @ slopes)
        return np.concatenate([by_modulus, self.system.amplitudes[:, :-1]], axis=1)

    def tangent(self) -> NDArray[np.float64]:
        """T (n_outputs, n_regions + n_modes), mm: columns du / d ln E_r, then du / dq_k."""
        model = self.system.model
        tangent = model.spanned(self.amplitude_tangent())
        tangent[:, model.n_regions : model.n_regions + model.n_boundary] += model.output_modes
        return tangent

    def adjoint(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """T^T g (n_regions + n_modes,) for g (n_outputs,), by one dense adjoint solve."""
        model = self.system.model
        reduced = model.components(gradient)
        adjoint = self.system.backward(reduced[:, None])[:, 0]
        by_modulus = -self._modulus_forces().T @ adjoint
        by_mode = self.system.amplitudes[:, :-1].T @ reduced
        by_mode[: model.n_boundary] += model.output_modes.T @ gradient
        return np.concatenate([by_modulus, by_mode])

    def _modulus_forces(self) -> NDArray[np.float64]:
        """E_r (A_r a + B_r [q, 1]), (m, n_regions) mN."""
        model = self.system.model
        given = np.append(self.coefficients, 1.0)
        # as one matrix each, for products of several matrices are slow
        forces = model.stiffness.reshape(-1, model.n_basis) @ self.amplitude
        forces += model.coupling.reshape(-1, len(given)) @ given
        return np.asarray((self.system.moduli[:, None] * forces.reshape(model.n_regions, -1)).T)


@dataclass(frozen=True, slots=True)
class Projection:
    """A linear model on the span of orthonormal vectors V (n_free, m): the reduced model, and what extends it.

    by_material: of each region, the derivatives of the nodal forces at 1 kPa by the material's coefficients, at the
    displacement that the responses to them are of; none while that is not known: these then move nothing.
    """

    model: LinearModel
    reduced: ReducedModel
    by_material: tuple[MaterialForces, ...] = ()

    def spanned(self, amplitudes: NDArray[np.float64]) -> NDArray[np.float64]:
        """V a (n_free, k) for amplitudes a (m, k)."""
        # V = F^T (F V) is not kept beside the outputs F V: twice they would be the largest of all
        return np.asarray(self.model.constraint.free.T @ self.reduced.spanned(amplitudes))

    def components(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """V^T f (m, k) of f (n_free, k), of the rows alone that have any where these are few."""
        return self._worked_on(times(self.model.constraint.free, forces))

    def _worked_on(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """Work (m, k) of nodal forces (n_dof, k) on each basis vector; of few rows that have any, by these alone."""
        rows = np.flatnonzero(forces.any(axis=1))
        few = 2 * len(rows) < len(forces)
        return self.reduced.components(forces[rows], rows) if few else self.reduced.components(forces)

    def extended(self, snapshots: NDArray[np.float64]) -> Projection:
        """The projection on the span of the present vectors and of snapshots (n_free, k) mm.

        Only what the snapshots add is multiplied with the stiffness. Raises `ConfigurationError` for other rows.
        """
        snapshots = _checked(self.model, snapshots)
        lengths = column_norms(snapshots)
        fresh = snapshots[:, lengths > 0.0] / lengths[lengths > 0.0]
        fresh = fresh - self.spanned(self.components(fresh))
        fresh = fresh[:, column_norms(fresh) > RANK_TOLERANCE]
        if not fresh.shape[1]:
            return self
        fresh = orthonormal_basis(fresh, overwrite=True)
        # a single pass leaves rounding errors of the subtracted part
        fresh = orthonormal_basis(fresh - self.spanned(self.components(fresh)), overwrite=True)
        model, old, blocks = self.model, self.reduced, []
        for matrix, block in zip(model.free_stiffness, old.stiffness, strict=True):
            image = times(matrix, fresh)
            side, corner = self.components(image), fresh.T @ image
            blocks.append(np.block([[block, side], [side.T, 0.5 * (corner + corner.T)]]))
        reduced = replace(
            old,
            stiffness=np.stack(blocks),
            coupling=np.concatenate([old.coupling, _coupling(model, self.by_material, fresh)], axis=1),
            load=np.concatenate([old.load, fresh.T @ model.free_load]),
            output_basis=(*old.output_basis, times(model.constraint.free, fresh)),
        )
        return replace(self, reduced=reduced)

    def with_model(self, model: LinearModel) -> Projection:
        """The projection of another state of the body, whose modes are the same, on the same vectors in memory.

        Not at the displacement of this state: material modes move nothing.
        """
        coupling = self.reduced.coupling.copy()
        coupling[:, :, self.reduced.n_boundary : -1] = 0.0
        for number, matrix in enumerate(model.coupling):
            coupling[number, :, -1] = self.components(matrix[:, -1:].toarray())[:, 0]
        load = self.components(model.free_load[:, None])[:, 0]
        reduced = replace(self.reduced, coupling=coupling, load=load, output_offset=model.constraint.offset)
        return Projection(model, reduced)

    def at_displacement(self, values: NDArray[np.float64]) -> Projection:
        """The projection with the forces of the material modes at a displacement (n_dof,) mm of homogeneous tissues."""
        by_material, first = self.model.material_by_region(values), self.reduced.n_boundary
        coupling, every = self.reduced.coupling.copy(), np.eye(self.reduced.n_modes - first)
        for of_region, forces in zip(coupling, by_material, strict=True):
            of_region[:, first:-1] = self._worked_on(forces.along(every))
        return replace(self, reduced=replace(self.reduced, coupling=coupling), by_material=by_material)


def free_combinations(
    model: LinearModel, displacements: NDArray[np.float32], combinations: NDArray[np.float32]
) -> NDArray[np.float64]:
    """F^T U C (n_free, k) mm of displacements U (n_dof, l) mm in single precision, and C (l, k), dimensionless."""
    free = sparse.csr_matrix(model.constraint.free.T).astype(np.float32)
    found = np.empty((free.shape[0], combinations.shape[1]))

    def fill(rows: slice) -> None:
        """Some rows: as a whole, in single precision and double, it would be there twice."""
        found[rows] = np.asarray(free[rows] @ displacements) @ combinations

    mapped(fill, [slice(start, start + ROWS) for start in range(0, len(found), ROWS)])
    return found


def projection(model: LinearModel, snapshots: NDArray[np.float64], *, overwrite: bool = False) -> Projection:
    """Project `model` on the span of `snapshots` (n_free, k), free coordinates F^T u of displacements u, mm.

    They are made orthonormal, in their place if it may be overwritten, and their rank cut; raises `ConfigurationError`
    when their rows are not n_free.
    """
    vectors = orthonormal_basis(_checked(model, snapshots), overwrite=overwrite)
    stiffness = np.stack([_projected(matrix, vectors) for matrix in model.free_stiffness])
    load, coupling = np.asarray(vectors.T @ model.free_load), _coupling(model, (), vectors)
    outputs, constraint = times(model.constraint.free, vectors), model.constraint
    reduced = ReducedModel(model.names, stiffness, coupling, load, (outputs,), constraint.modes, constraint.offset)
    return Projection(model, reduced)


def _projected(matrix: sparse.csr_matrix[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """V^T A V (m, m) for V (n, m) and a symmetric A (n, n) that is empty but for some rows and columns."""
    touched, within = touched_rows(matrix)

    def some(part: slice) -> NDArray[np.float64]:
        """What some of the rows add to it."""
        return np.asarray(vectors[touched[part]].T @ (within[part] @ vectors))

    parts = [slice(start, start + ROWS) for start in range(0, len(touched), ROWS)]
    projected = np.sum(mapped(some, parts), axis=0)
    return np.asarray(0.5 * (projected + projected.T))


def orthonormal_basis(snapshots: NDArray[np.float64], *, overwrite: bool = False) -> NDArray[np.float64]:
    """Orthonormal columns (n, m) that span the snapshots (n, k), each first scaled to length 1.

    overwrite: whether they may take the snapshots' place: a second copy would be among the largest arrays there are.
    Directions below 1e-10 of the largest singular value are dropped; raises `ConfigurationError` when none is left.
    Cholesky factors of the Gram matrix, taken twice, where it is well conditioned (Yamamoto et al., Electron. Trans.
    Numer. Anal. 44 (2015) 306-326), else Householder's QR.
    """
    lengths = column_norms(snapshots) if snapshots.ndim == 2 else np.zeros(1)
    if snapshots.ndim != 2 or not np.all(np.isfinite(lengths)) or not np.any(lengths > 0.0):
        raise ConfigurationError(f"a reduced basis needs finite, non-zero snapshots (n, k); got {snapshots.shape}")
    moving = np.flatnonzero(lengths)
    whole = len(moving) == len(lengths)
    vectors = snapshots if whole else np.take(snapshots, moving, axis=1)
    scale = 1.0 / lengths[moving]
    gram = scale[:, None] * _gram(vectors) * scale
    sizes = np.linalg.eigvalsh(gram)
    if sizes[0] > WELL_CONDITIONED * sizes[-1]:
        found = vectors if overwrite or not whole else np.empty(vectors.shape)
        for again in (False, True):  # V R^-1 in place of V, with V^T V = R^T R
            factor = linalg.cholesky(_gram(found) if again else gram, check_finite=False)
            inverse = linalg.solve_triangular(factor, np.eye(len(factor)), check_finite=False)
            given, by = (found, inverse) if again else (vectors, scale[:, None] * inverse)
            pairs = zip(_parts(given), _parts(found), strict=True)
            mapped(lambda item: np.copyto(item[1], item[0] @ item[2]), [(*pair, by) for pair in pairs])
        return found
    q, r = np.linalg.qr(scale * vectors)
    rotation, values, _ = np.linalg.svd(r)
    return np.asarray(q @ rotation[:, : int(np.sum(values > RANK_TOLERANCE * values[0]))])


def _parts(vectors: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Rows of vectors (n, m), some at once."""
    return [vectors[start : start + ROWS] for start in range(0, len(vectors), ROWS)]


def _gram(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """V^T V (m, m) of vectors V (n, m)."""
    return np.asarray(np.sum(mapped(lambda part: part.T @ part, _parts(vectors)), axis=0))


def _checked(model: LinearModel, snapshots: NDArray[np.float64]) -> NDArray[np.float64]:
    n_free = model.constraint.free.shape[1]
    if snapshots.ndim != 2 or len(snapshots) != n_free:
        raise ConfigurationError(f"the basis has the shape {snapshots.shape}; it must have {n_free} rows (n_free)")
    return snapshots


def _coupling(
    model: LinearModel, by_material: Sequence[MaterialForces], vectors: NDArray[np.float64]
) -> NDArray[np.float64]:
    """V^T [C_r, G_r, o_r] (n_regions, m, n_modes + 1), 0 of material modes whose forces are not known."""
    found = np.zeros((model.n_regions, vectors.shape[1], model.n_modes + 1))
    first = model.constraint.n_modes
    for of_region, matrix in zip(found, model.coupling, strict=True):
        given = np.asarray((matrix.T @ vectors).T)
        of_region[:, :first], of_region[:, -1] = given[:, :-1], given[:, -1]
    outputs = times(model.constraint.free, vectors) if by_material else vectors
    for of_region, forces in zip(found, by_material, strict=False):
        of_region[:, first:-1] = forces.work(outputs).T
    return found
