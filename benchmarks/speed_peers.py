"""What others would pay for the same gradient on the same mesh: torch-fem, scikit-fem, finite differences.

All of them get the misfit with closest points and weights frozen, a quadratic form in the surface's displacement, so
that what is timed is the mechanics. Each returns the gradient (n_unknowns,) of it, or is None when it is not installed.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.optimize import least_squares
from scipy.sparse.linalg import splu

from palpate.inversion.objective import Objective
from palpate.inversion.problem import InverseProblem, InversionSettings
from palpate.inversion.surrogate import Surrogate
from palpate.inversion.weighting import SEGMENTATION_LAW, objective_of
from palpate.mechanics.first_order import FirstOrderModel
from palpate.observation.misfit import surface_residuals

Gradient = Callable[[], np.ndarray]


@dataclass(frozen=True)
class FrozenMisfit:
    """1/2 |A u + b|^2 of the displacement u (n_dof,) mm, dimensionless: A (n_residuals, n_dof), b (n_residuals,)."""

    design: sparse.csr_matrix
    rest: np.ndarray

    def pull(self, displacement: np.ndarray) -> np.ndarray:
        """Derivative (n_dof,) by the displacement."""
        return self.design.T @ (self.design @ displacement + self.rest)


def frozen_misfit(objective: Objective, unknowns: np.ndarray) -> FrozenMisfit:
    """The misfit of an objective with one state, frozen at `unknowns`."""
    state = objective.states[0]
    moduli = objective.modulus_map.moduli(unknowns[: objective.n_parameters])
    values = state.model.solve(moduli, objective.coefficients(unknowns)[0]).values
    n_dof = 1 + max(int(t.surface.dofs.max()) for t in state.targets)
    designs, rests = [], []
    for rows, line in zip(state.slices(), objective(unknowns).surfaces, strict=True):
        scale = np.sqrt(line.precision * line.weights)
        plane = sparse.diags_array(scale) @ line.residuals.normal_jacobian
        dofs = line.target.surface.dofs
        spread = sparse.csr_matrix((np.ones(len(dofs)), (np.arange(len(dofs)), dofs)), shape=(len(dofs), n_dof))
        designs.append(sparse.csr_matrix(plane @ spread))
        rests.append(scale * line.residuals.values - plane @ values[rows])
    return FrozenMisfit(sparse.csr_matrix(sparse.vstack(designs)), np.concatenate(rests))


def _widened(frozen: FrozenMisfit, n_dof: int) -> FrozenMisfit:
    design = frozen.design.copy()
    design.resize(design.shape[0], n_dof)
    return FrozenMisfit(design, frozen.rest)


def disagreement(gradient: np.ndarray, frozen: FrozenMisfit, surrogate: Surrogate, unknowns: np.ndarray) -> float:
    """Relative difference of a peer's gradient to that of the full model's adjoint."""
    model, n = surrogate.model, len(gradient) - surrogate.model.n_modes
    known = [i for i, t in enumerate(model.space.mesh.tissues) if t.meshed and t.role.value == "known"]
    columns = [i for i, region in enumerate(model.regions) if region not in known]
    moduli = np.array([model.space.mesh.tissues[region].youngs_modulus_kpa or 10.0 for region in model.regions])
    moduli[columns] = 10.0 * np.exp(unknowns[:n])
    equilibrium = model.solve(moduli, unknowns[n:])
    exact = equilibrium.adjoint(_widened(frozen, len(equilibrium.values)).pull(equilibrium.values))
    exact = np.concatenate([exact[columns], exact[model.n_regions :] + unknowns[n:]])
    return float(np.linalg.norm(gradient - exact) / np.linalg.norm(exact))


def torch_fem(problem: InverseProblem, frozen: FrozenMisfit, unknowns: np.ndarray) -> Gradient | None:
    """Backward through torch-fem's solve: P2 tetrahedra, the moduli by tissue, the wall's modes as displacements."""
    try:
        torch, solid = importlib.import_module("torch"), importlib.import_module("torchfem.solid")
        elastic = importlib.import_module("torchfem.materials.elasticity")
    except ImportError:
        return None
    torch.set_default_dtype(torch.float64)
    model, mapping = problem.models[0], problem.modulus_map
    space, constraint = model.space, model.constraint
    n_dof, n = 3 * len(space.points), len(mapping.tissues)
    place = torch.tensor(np.searchsorted(model.regions, space.mesh.region))
    poisson = torch.tensor([t.poisson_ratio for t in space.mesh.tissues])[torch.tensor(space.mesh.region)]
    nodes, cells = torch.tensor(space.points), torch.tensor(space.cells)
    modes, offset = torch.tensor(constraint.modes), torch.tensor(constraint.offset)
    held = torch.ones(n_dof, dtype=torch.bool)
    held[torch.tensor(np.unique(constraint.free.tocoo().row))] = False
    wide = _widened(frozen, n_dof)
    torch.sparse.check_sparse_tensor_invariants.disable()
    design = torch.sparse_csr_tensor(wide.design.indptr, wide.design.indices, wide.design.data, wide.design.shape)
    rest, columns = torch.tensor(wide.rest), torch.tensor(mapping.columns)

    def gradient() -> np.ndarray:
        theta = torch.tensor(unknowns[:n], requires_grad=True)
        amounts = torch.tensor(unknowns[n:], requires_grad=True)
        moduli = torch.tensor(mapping.base).index_put((columns,), mapping.scale_kpa * torch.exp(theta))
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


def scikit_fem(problem: InverseProblem, frozen: FrozenMisfit, unknowns: np.ndarray) -> Gradient | None:
    """Assembly by scikit-fem, SuperLU, and the adjoint by hand; the stiffness of each tissue is assembled once."""
    try:
        fem = importlib.import_module("skfem")
        elasticity = importlib.import_module("skfem.models.elasticity")
    except ImportError:
        return None
    model, mapping = problem.models[0], problem.modulus_map
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
    wide, n = _widened(frozen, 3 * len(space.points)), len(mapping.tissues)

    def gradient() -> np.ndarray:
        moduli = mapping.moduli(unknowns[:n])
        stiffness = sparse.csr_matrix(sum(e * part for e, part in zip(moduli, parts, strict=True)))
        u = constraint.modes @ unknowns[n:] + constraint.offset
        factors = splu(sparse.csc_matrix(stiffness[free][:, free]))
        u[free] = -factors.solve((stiffness @ u)[free])
        pull = wide.pull(u)
        adjoint = np.zeros_like(u)
        adjoint[free] = factors.solve(pull[free])
        by_modulus = [-moduli[r] * float(adjoint @ (parts[r] @ u)) for r in mapping.columns]
        by_mode = constraint.modes.T @ (pull - stiffness @ adjoint) + unknowns[n:]
        return np.concatenate([by_modulus, by_mode])

    return gradient


def _same_place(doflocs: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Number in scikit-fem of the unknown 3 p + a: it keeps the axes of one place next to each other, in order."""
    theirs = np.round(doflocs.T, 6)
    first = np.lexsort((np.arange(len(theirs)), *theirs.T[::-1]))
    ours = np.lexsort(np.round(points, 6).T[::-1])
    order = np.empty(3 * len(points), dtype=np.int64)
    order[(3 * ours[:, None] + np.arange(3)).ravel()] = first
    return order


def finite_difference_lm(problem: InverseProblem, settings: InversionSettings) -> list[np.ndarray]:
    """Levenberg-Marquardt with forward differences and the fastest direct solver, from each start.

    Closest points are found anew at every evaluation; a factorisation is kept while the moduli stay as they are, which
    spares the 90 columns of the wall's modes a factorisation each.
    """
    model, mapping = problem.models[0], problem.modulus_map
    n, n_modes = len(mapping.tissues), model.n_modes
    n_dof = 3 * len(model.space.points)
    flat = np.zeros((n_dof, model.n_regions + n_modes))
    rest = FirstOrderModel(model.names, mapping.base, np.zeros(n_modes), np.zeros(n_dof), flat)
    objective = objective_of(problem, (rest,), SEGMENTATION_LAW)
    objective = objective.with_fresh_correspondence(np.zeros(n + n_modes))
    kept: dict[bytes, object] = {}

    def residuals(unknowns: np.ndarray) -> np.ndarray:
        moduli = mapping.moduli(unknowns[:n])
        if moduli.tobytes() not in kept:
            kept.clear()
            kept[moduli.tobytes()] = model.system(moduli)
        values = kept[moduli.tobytes()].solve(unknowns[n:]).values
        parts = [unknowns[n:]]
        for target, weighting in zip(problem.targets[0], objective.weighting[0], strict=True):
            motion = values[target.surface.dofs].reshape(-1, 3)
            found = surface_residuals(target, motion, weighting.held)
            parts.append(np.sqrt(weighting.precision * found.weights) * found.values)
        return np.concatenate(parts)

    ends = []
    for theta in settings.starts:
        start = np.concatenate([theta, np.zeros(n_modes)])
        found = least_squares(residuals, start, method="trf", diff_step=1e-4, xtol=1e-3, ftol=1e-4, max_nfev=12)
        ends.append(found.x[:n])
    return ends
