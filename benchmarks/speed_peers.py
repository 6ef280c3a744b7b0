"""Other programs that speed.py compares with: torch-fem's gradient, and the direct solvers PARDISO and SuperLU.

torch-fem gets the misfit with closest points and weights frozen, a quadratic form in the surface's displacement, so
that what is timed is the mechanics. A program that is not installed is None. The direct solvers get the order that
METIS finds on the graph of the nodes.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from multifrontal import nested_dissection
from palpate.inversion import InverseProblem, Objective

Array = NDArray[np.float64]
Gradient = Callable[[], Array]
Matrix = sparse.csr_matrix
Solve = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class FrozenMisfit:
    """1/2 |A u + b|^2 of the displacement u (n_dof,) mm, dimensionless: A (n_residuals, n_dof), b (n_residuals,)."""

    design: sparse.csr_matrix[np.float64]
    rest: Array

    def pull(self, displacement: Array) -> Array:
        """Derivative (n_dof,) by the displacement."""
        return np.asarray(self.design.T @ (self.design @ displacement + self.rest))


def frozen_misfit(objective: Objective, unknowns: Array) -> FrozenMisfit:
    """The misfit of an objective with one state, frozen at `unknowns`."""
    parameters, state = objective.parameters, objective.states[0]
    moduli, coefficients = parameters.moduli(unknowns), parameters.coefficients(unknowns)[0]
    values = state.displacement(moduli, coefficients).ravel()
    n_dof = 1 + max(int(observation.dofs.max()) for observation in state.observations)
    designs, rests = [], []
    for line in objective(unknowns).linearisations:
        scale, dofs = np.sqrt(line.precision * line.weights), line.observation.dofs
        plane = sparse.csr_matrix(sparse.diags_array(scale) @ line.residuals.jacobian)
        spread = sparse.csr_matrix((np.ones(len(dofs)), (np.arange(len(dofs)), dofs)), shape=(len(dofs), n_dof))
        designs.append(sparse.csr_matrix(plane @ spread))
        rests.append(scale * line.residuals.values - plane @ values[dofs])
    return FrozenMisfit(sparse.csr_matrix(sparse.vstack(designs)), np.concatenate(rests))


def _widened(frozen: FrozenMisfit, n_dof: int) -> FrozenMisfit:
    design, shape = frozen.design, (len(frozen.rest), n_dof)
    return FrozenMisfit(sparse.csr_matrix((design.data, design.indices, design.indptr), shape=shape), frozen.rest)


def disagreement(gradient: Array, frozen: FrozenMisfit, problem: InverseProblem, unknowns: Array) -> float:
    """Relative difference of a peer's gradient to that of the full model's adjoint."""
    model, mapping = problem.states[0].model, problem.parameters
    equilibrium = model.solve(mapping.moduli(unknowns), mapping.coefficients(unknowns)[0])
    pull = _widened(frozen, len(equilibrium.values)).pull(equilibrium.values)
    exact = mapping.by_unknowns(equilibrium.adjoint(pull)[None], unknowns)[0] + mapping.prior_matrix @ unknowns
    return float(np.linalg.norm(gradient - exact) / np.linalg.norm(exact))


def reduced(objective: Objective, frozen: FrozenMisfit, unknowns: Array) -> Gradient:
    """Our own: the approximation at the observed unknowns and its adjoint."""
    mapping, (state,) = objective.parameters, objective.states
    model, dofs = state.observed, np.concatenate([observation.dofs for observation in state.observations])
    assert model is not None, "an objective is made of states with approximations"
    design = sparse.csr_matrix(frozen.design[:, dofs])
    transposed = sparse.csr_matrix(design.T)

    def gradient() -> Array:
        solution = model.solve(mapping.moduli(unknowns), mapping.coefficients(unknowns)[0])
        pull = np.asarray(transposed @ (design @ solution.values + frozen.rest))
        by_unknowns = mapping.by_unknowns(solution.adjoint(pull)[None], unknowns)[0]
        return np.asarray(by_unknowns + mapping.prior_matrix @ unknowns)

    return gradient


def torch_fem(problem: InverseProblem, frozen: FrozenMisfit, unknowns: Array) -> Gradient | None:
    """Backward through torch-fem's solve: P2 tetrahedra, the moduli by tissue, the wall's modes as displacements."""
    try:
        torch, solid = importlib.import_module("torch"), importlib.import_module("torchfem.solid")
        elastic = importlib.import_module("torchfem.materials.elasticity")
    except ImportError:
        return None
    torch.set_default_dtype(torch.float64)
    model, mapping = problem.states[0].model, problem.parameters
    space, constraint = model.space, model.constraint
    n_dof, n = 3 * len(space.points), mapping.n_parameters
    place = torch.tensor(np.searchsorted(model.regions, space.mesh.region))
    poisson = torch.tensor([t.poisson_ratio for t in space.mesh.tissues])[torch.tensor(space.mesh.region)]
    nodes, cells = torch.tensor(space.points), torch.tensor(space.cells)
    modes, offset = torch.tensor(constraint.modes), torch.tensor(constraint.offset)
    held = torch.ones(n_dof, dtype=torch.bool)
    held[torch.tensor(np.unique(constraint.free.tocoo().row))] = False
    wide = _widened(frozen, n_dof)
    torch.sparse.check_sparse_tensor_invariants.disable()
    design = torch.sparse_csr_tensor(wide.design.indptr, wide.design.indices, wide.design.data, wide.design.shape)
    rest, base, selection = (torch.tensor(array) for array in (wide.rest, mapping.base, mapping.selection))

    def gradient() -> Array:
        theta = torch.tensor(unknowns[:n], requires_grad=True)
        amounts = torch.tensor(unknowns[n:], requires_grad=True)
        moduli = base * torch.exp(selection @ theta)
        body = solid.Solid(nodes, cells, elastic.IsotropicElasticity3D(moduli[place], poisson))
        body.constraints = held.reshape(-1, 3)
        body.displacements = (modes @ amounts + offset).reshape(-1, 3)
        solution = body.solve(differentiable_parameters=(theta, amounts), method="direct")[0]
        residual = design @ solution.ravel() + rest
        value = 0.5 * residual @ residual + 0.5 * amounts @ amounts
        value.backward()
        return np.concatenate([theta.grad.numpy(), amounts.grad.numpy()])

    return gradient


def pardiso(matrix: Matrix) -> Solve:
    """Symmetric positive definite, our order, without its own refinement, which trebles the price of a solution."""
    files = importlib.metadata.files("mkl") or []
    found = [path for file in files if "mkl_rt" in file.name and (path := Path(str(file.locate())).resolve()).exists()]
    if found:  # else every factorisation searches the whole environment for MKL
        os.environ.setdefault("PYPARDISO_MKL_RT", str(found[0]))
    pypardiso = importlib.import_module("pypardiso")
    upper = sparse.csr_matrix(sparse.triu(matrix, format="csr"))
    upper.sort_indices()
    solver = pypardiso.PyPardisoSolver(mtype=2, size_limit_storage=np.inf)
    for number, value in {1: 1, 5: 1, 8: 0}.items():
        solver.set_iparm(number, value)
    solver.perm = (nested_dissection(matrix) + 1).astype(np.int32)
    solver.factorize(upper)
    solver.factorized_A = upper  # the wrapper would keep a copy to compare with
    return lambda rhs: np.asarray(solver.solve(upper, np.asfortranarray(rhs)))


def superlu(matrix: Matrix) -> Solve:
    """In its symmetric mode, without pivoting; 16 columns at once, for more of them fall out of the cache."""
    order = nested_dissection(matrix)
    ordered = sparse.csc_matrix(matrix[order][:, order])
    factors = splu(ordered, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def solve(rhs: np.ndarray) -> np.ndarray:
        solution = np.empty_like(rhs)
        for start in range(0, rhs.shape[1], 16):
            columns = slice(start, start + 16)
            solution[order, columns] = factors.solve(np.asfortranarray(rhs[order, columns]))
        return solution

    return solve
