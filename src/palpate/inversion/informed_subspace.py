"""Of all unknowns beside the moduli those combinations that the images tell: a likelihood-informed subspace.

Most modes of a frame, or of a tissue's ln E, move no observed surface by as much as its noise: the images leave them
what they were believed to be, and so no modulus is paid for them. To carry them through every step costs most of an
estimate's time and memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate.inversion.blocks import Acts, Block
from palpate.inversion.later_state import InverseProblem, LaterState
from palpate.inversion.objective import Objective
from palpate.inversion.optimise import Bounds, ShareOfValue, fit_coefficients
from palpate.inversion.reweighting import with_first_noise
from palpate.mechanics.first_order import FirstOrderModel
from palpate.mechanics.linear_model import LinearSystem
from palpate.progress import Progress

__all__ = ["InformedProblem", "informed_problem"]

LEFT_OUT = 1.0  # variances of the first noise, a tenth of the found one, that what a block leaves out may explain
SMALL = 12  # unknowns of a block, which are kept
SEEN = 1e-4  # relative residual of responses that only say what is seen


@dataclass(frozen=True, slots=True)
class InformedProblem:
    """An inverse problem on the combinations that are seen, with each state's system at the middle start.

    unknowns (n_unknowns,): there, with the boundary's motion fitted; evaluations: what that cost.
    """

    problem: InverseProblem
    systems: tuple[LinearSystem, ...]
    unknowns: NDArray[np.float64]
    evaluations: int


def informed_problem(
    problem: InverseProblem, begin: NDArray[np.float64], *, bounds: Bounds, progress: Progress
) -> InformedProblem:
    """The problem on what the images tell of its blocks, by the responses of the full models at `begin` (n_unknowns,).

    x of a block with the widest covariance C = L L^T is seen along the eigenvectors of L^T A L, A = J^T W J its
    information: an eigenvalue l is the variance that x may explain along one over that of the noise, and what is left
    out widens the posterior by a share of less than its sum (Spantini et al. 2015, SIAM J. Sci. Comput. 37, A2451,
    Theorem 2.3; Cui et al. 2014, Inverse Problems 30, 114015). Noise is that before residuals are seen, which is small.
    """
    parameters, states, systems = problem.parameters, list[LaterState](), list[LinearSystem]()
    moduli = parameters.moduli(begin)
    for number, state in enumerate(problem.states, start=1):
        progress(f"responses of the full model at the middle start, state {number} of {len(problem.states)}")
        system = state.model.system(moduli)
        seen = system.seen_responses(state.dofs, tolerance=SEEN)
        fixed, material = np.zeros((len(seen), len(moduli))), np.zeros((len(seen), state.model.material.n_modes))
        still = np.zeros(state.model.n_modes)
        tangent = np.concatenate([fixed, seen[:, :-1], material], axis=1)
        model = FirstOrderModel(state.model.names, moduli, still, seen[:, -1], tangent)
        states.append(replace(state, observed=model))
        systems.append(system)
    progress("the motion of walls and frame at the middle start")
    objective = with_first_noise(Objective(tuple(states), parameters)).rematched(begin)
    fitted = fit_coefficients(objective, begin, bounds=bounds, tolerance=ShareOfValue(0.1))
    progress("what the images tell of all unknowns there")
    evaluation = _with_material(objective, systems, fitted.unknowns)(fitted.unknowns)
    data = evaluation.matrix - evaluation.prior
    bases = [_informed(block, data[np.ix_(own, own)]) for own, block in _with_columns(problem)]
    blocks = [block.combined(inverse) for block, (_, inverse) in zip(parameters.blocks, bases, strict=True)]
    found = replace(parameters, blocks=tuple(blocks), nuisance_precision=np.zeros((0, 0)))
    reduced = []
    for s, state in enumerate(problem.states):
        own = [(block, basis) for block, (basis, _) in zip(parameters.blocks, bases, strict=True) if s in block.states]
        boundary = [basis for block, basis in own if block.acts is Acts.BOUNDARY]
        n_fields = state.model.material.fields.shape[1]
        material = linalg.block_diag(*(basis for block, basis in own if block.acts is Acts.MATERIAL))
        n_kept = material.shape[1] - len(state.model.material.poisson)
        reduced.append(state.combined(linalg.block_diag(*boundary), material[:n_fields, :n_kept]))
    fit = [inverse @ fitted.unknowns[own] for (own, _), (_, inverse) in zip(_with_columns(problem), bases, strict=True)]
    unknowns = np.concatenate([fitted.unknowns[: parameters.n_parameters], *fit])
    again = [replace(system, model=state.model) for system, state in zip(systems, reduced, strict=True)]
    return InformedProblem(InverseProblem(tuple(reduced), found), tuple(again), unknowns, fitted.evaluations + 1)


def _with_columns(problem: InverseProblem) -> list[tuple[NDArray[np.int64], Block]]:
    """Each block with the numbers (n,) of its unknowns."""
    return [(problem.parameters.columns(i), block) for i, block in enumerate(problem.parameters.blocks)]


def _with_material(objective: Objective, systems: Sequence[LinearSystem], unknowns: NDArray[np.float64]) -> Objective:
    """The objective whose observed models answer to the material, too, to first order around unknowns (n_unknowns,)."""
    states = []
    coefficients = objective.parameters.coefficients(unknowns)
    for state, system, q in zip(objective.states, systems, coefficients, strict=True):
        model = state.observed
        assert isinstance(model, FirstOrderModel)
        n_material = state.model.material.n_modes
        boundary = np.where(np.arange(len(q)) < len(q) - n_material, q, 0.0)
        values = system.solve(boundary).values
        by_material = system.seen_material_responses(values, state.dofs, tolerance=SEEN)
        tangent = np.concatenate([model.derivatives[:, : model.derivatives.shape[1] - n_material], by_material], axis=1)
        states.append(replace(state, observed=replace(model, derivatives=tangent)))
    return replace(objective, states=tuple(states))


def _informed(block: Block, information: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Combinations (n, k) of a block's unknowns that data of an information (n, n) see, and their inverse (k, n)."""
    if block.size <= SMALL or block.acts is Acts.RESIDUALS:
        return np.eye(block.size), np.eye(block.size)
    root = linalg.cholesky(block.widest, lower=True)
    sizes, vectors = linalg.eigh(root.T @ information @ root)
    left = np.cumsum(np.maximum(sizes, 0.0)) < LEFT_OUT
    kept = vectors[:, ~left][:, ::-1]
    unit = float(np.sqrt(np.mean(np.diag(block.widest))))  # coefficients keep their size
    basis = root @ kept / unit
    return basis, unit * (kept.T @ linalg.solve_triangular(root, np.eye(len(root)), lower=True))
