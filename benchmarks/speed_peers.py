"""The time of the same gradient on the same mesh by torch-fem, scikit-fem, finite differences, and Palpate.

All get the misfit with closest points and weights frozen, a quadratic form in the surface's displacement, so that what
is timed is the mechanics. Each returns the gradient (n_unknowns,) of it, or is None when it is not installed.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import least_squares
from scipy.sparse.linalg import splu

from palpate.inversion import InverseProblem, InversionSettings, Objective
from palpate.mechanics import LinearSystem
from palpate.observation import SEGMENTATION_NOISE, SurfaceDistance

Array = NDArray[np.float64]
Gradient = Callable[[], Array]


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


def torch_fem_modules() -> tuple[Any, Any, Any] | None:
    """Torch in double precision, torch-fem's solid and its elasticity; None where they are not installed."""
    try:
        torch, solid = importlib.import_module("torch"), importlib.import_module("torchfem.solid")
        elastic = importlib.import_module("torchfem.materials.elasticity")
    except ImportError:
        return None
    torch.set_default_dtype(torch.float64)
    return torch, solid, elastic


def torch_fem(problem: InverseProblem, frozen: FrozenMisfit, unknowns: Array) -> Gradient | None:
    """Backward through torch-fem's solve: P2 tetrahedra, the moduli by tissue, the wall's modes as displacements."""
    if (modules := torch_fem_modules()) is None:
        return None
    torch, solid, elastic = modules
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
        solution = body.solve(differentiable_parameters=(theta, amounts), method=METHOD)[0]
        residual = design @ solution.ravel() + rest
        value = 0.5 * residual @ residual + 0.5 * amounts @ amounts
        value.backward()
        return np.concatenate([theta.grad.numpy(), amounts.grad.numpy()])

    return gradient


METHOD = "direct"  # PARDISO where it is installed: at these sizes several times faster than its multigrid


def scikit_fem(problem: InverseProblem, frozen: FrozenMisfit, unknowns: Array) -> Gradient | None:
    """Assembly by scikit-fem, SuperLU, and the adjoint by hand; the stiffness of each tissue is assembled once."""
    try:
        fem = importlib.import_module("skfem")
        elasticity = importlib.import_module("skfem.models.elasticity")
    except ImportError:
        return None
    model, mapping = problem.states[0].model, problem.parameters
    space, constraint = model.space, model.constraint
    mesh = fem.MeshTet(np.ascontiguousarray(space.mesh.nodes.T), np.ascontiguousarray(space.mesh.tets.T))
    basis = fem.Basis(mesh, fem.ElementVector(fem.ElementTetP2()), intorder=2)
    parts = []
    for region in model.regions:
        inside = fem.Basis(mesh, basis.elem, intorder=2, elements=np.flatnonzero(space.mesh.region == region))
        lame = elasticity.lame_parameters(1.0, space.mesh.tissues[region].poisson_ratio)
        parts.append(elasticity.linear_elasticity(*lame).assemble(inside))
    order = _same_place(basis.doflocs, space.points)
    parts = [sparse.csr_matrix(part[order][:, order]) for part in parts]
    free = np.unique(constraint.free.tocoo().row)
    wide, n = _widened(frozen, 3 * len(space.points)), mapping.n_parameters

    def gradient() -> Array:
        moduli = mapping.moduli(unknowns)
        stiffness = sparse.csr_matrix(sum(e * part for e, part in zip(moduli, parts, strict=True)))
        u = constraint.modes @ unknowns[n:] + constraint.offset
        factors = splu(sparse.csc_matrix(stiffness[free][:, free]))
        u[free] = -factors.solve((stiffness @ u)[free])
        pull = wide.pull(u)
        adjoint = np.zeros_like(u)
        adjoint[free] = factors.solve(pull[free])
        by_region = [-modulus * float(adjoint @ (part @ u)) for modulus, part in zip(moduli, parts, strict=True)]
        by_mode = constraint.modes.T @ (pull - stiffness @ adjoint) + unknowns[n:]
        return np.concatenate([mapping.selection.T @ by_region, by_mode])

    return gradient


def _same_place(doflocs: Array, points: Array) -> NDArray[np.int64]:
    """Number in scikit-fem of the unknown 3 p + a: it keeps the axes of one place next to each other, in order."""
    theirs = np.round(doflocs.T, 6)
    first = np.lexsort((np.arange(len(theirs)), *theirs.T[::-1]))
    ours = np.lexsort(np.round(points, 6).T[::-1])
    order = np.empty(3 * len(points), dtype=np.int64)
    order[(3 * ours[:, None] + np.arange(3)).ravel()] = first
    return order


def finite_difference_lm(problem: InverseProblem, settings: InversionSettings) -> list[Array]:
    """Levenberg-Marquardt with forward differences and the fastest direct solver, from each start.

    Closest points are found anew at every evaluation; a factorisation is kept while the moduli stay as they are, which
    spares the 90 columns of the wall's modes a factorisation each.
    """
    state, mapping = problem.states[0], problem.parameters
    weighted = [observation.with_noise(SEGMENTATION_NOISE) for observation in state.observations]
    seen = [o.rematched(np.zeros(len(o.dofs))) for o in weighted if isinstance(o, SurfaceDistance)]
    kept: dict[bytes, LinearSystem] = {}

    def residuals(unknowns: Array) -> Array:
        moduli, coefficients = mapping.moduli(unknowns), mapping.coefficients(unknowns)[0]
        if moduli.tobytes() not in kept:
            kept.clear()
            kept[moduli.tobytes()] = state.model.system(moduli)
        values = kept[moduli.tobytes()].solve(coefficients).values
        parts = [coefficients]
        for observation in seen:
            found = observation.residuals(values[observation.dofs])
            parts.append(np.sqrt(observation.weighting.precision * found.weights) * found.values)
        return np.concatenate(parts)

    ends = []
    for theta in settings.starts:
        start = np.concatenate([theta, np.zeros(state.model.n_modes)])
        found = least_squares(residuals, start, method="trf", diff_step=[1e-4], xtol=1e-3, ftol=1e-4, max_nfev=12)
        ends.append(np.asarray(found.x[: len(theta)]))
    return ends
