"""Where an estimate begins: in what the images tell of all unknowns, and what all starts lead to.

Of all unknowns beside the moduli those combinations stay that the images tell: a likelihood-informed subspace. Most
modes of a frame, or of a tissue's ln E, move no observed surface by as much as its noise: the images leave them what
they were believed to be, and so no modulus is paid for them. To carry them through every step costs most of an
estimate's time and memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate.approximation.reduced_basis import SNAPSHOT, ReducedBasis
from palpate.inversion.frozen_posterior import Posterior
from palpate.inversion.hyper_parameters import with_correlations, with_first_noise, with_scales
from palpate.inversion.later_state import InverseProblem, LaterState
from palpate.inversion.objective import LinearisedObjective, Objective
from palpate.inversion.optimise import Bounds, Minimum, Outcome, gauss_newton, grouped
from palpate.inversion.search import Searched, begun
from palpate.mechanics.first_order import FirstOrderModel
from palpate.mechanics.forward import SolveCounts
from palpate.mechanics.linear_model import LinearModel, LinearSystem, of_same_body
from palpate.mechanics.reduced import Projection, free_combinations, projection
from palpate.parallel import mapped
from palpate.progress import Progress
from palpate.unknowns.blocks import Acts, Block, Choice
from palpate.unknowns.parameters import ParameterMap

SCREENED = 0.01  # decrement at which the minimum of a start ends
LEFT_OUT, LEFT_OUT_OF_MAP = 0.5, 0.2  # variances of the noise that what is left out may explain; of a map
APART = 1.0  # of ln E: from the middle of the bounds to where responses to all modes are made once more
FITS, FIT = 4, 0.02  # of the coefficients; share of one posterior variance that a coefficient may still move


@dataclass(frozen=True, slots=True)
class StartRun:
    """What one start did on the cheapest model: log-moduli (n_parameters,) where it began, and the minimum it found.

    candidate: number of the distinct minimum that it leads to, None where it did not converge.
    """

    theta: NDArray[np.float64]
    minimum: Minimum
    candidate: int | None


def started(
    posterior: Posterior, near: NDArray[np.float64], starts: Sequence[NDArray[np.float64]], bounds: Bounds
) -> tuple[StartRun, ...]:
    """What each start does: theta (n_parameters,) each, all other unknowns as in `near` (n_unknowns,)."""
    n = posterior.n_parameters
    begins = [np.concatenate([theta, near[n:]]) for theta in starts]
    minima = mapped(lambda begin: gauss_newton(posterior, begin, bounds=bounds, tolerance=SCREENED), begins)
    groups = grouped(minima, n)
    return tuple(
        StartRun(theta, minimum, group if minimum.converged else None)
        for theta, minimum, group in zip(starts, minima, groups, strict=True)
    )


def informed_start(problem: InverseProblem, theta: NDArray[np.float64], *, progress: Progress) -> Searched:
    """Where the first minimum is sought, at theta (n_parameters,), in what the images tell of the problem's blocks.

    States that bring an approximation keep it and all unknowns, at which nothing moves. For the others the full models'
    responses tell, at the boundary's motion that fits there; reduced bases are made of these. Raises as `invert` does.
    x of a block with the widest covariance C = L L^T is seen along the eigenvectors of L^T A L, A = J^T W J its
    information: an eigenvalue l is the variance that x may explain along one over that of the noise, and what is left
    out widens the posterior by a share of less than its sum (Spantini et al. 2015, SIAM J. Sci. Comput. 37, A2451,
    Theorem 2.3; Cui et al. 2014, Inverse Problems 30, 114015). Noise is what the residuals show at these moduli.
    """
    parameters, states, found = problem.parameters, list[LaterState](), list[_Responses]()
    begin = np.concatenate([theta, np.zeros(parameters.n_coefficients)])
    start = with_first_noise(Objective(problem.states, parameters))
    if all(state.approximation for state in start.states):
        return begun(start, begin)
    for number, state in enumerate(start.states, start=1):
        progress(f"responses of the full model in the middle of the bounds, state {number} of {len(start.states)}")
        found.append(_responses(state.model, parameters.moduli(begin), found))
        states.append(replace(state, observed=found[-1].seen(state, np.zeros(state.model.n_modes))))
    progress("the motion of the walls and of the frame at these moduli")
    # at any moduli a Poisson's ratio that is sought would take what these miss, far from where its responses hold
    held = tuple(replace(b, mean=(), choice=Choice.HELD) if b.sought else b for b in parameters.blocks)
    still = replace(parameters, blocks=held, priors=())
    objective = replace(start, states=tuple(states), parameters=still).rematched(begin)
    fitted = fit_coefficients(objective, begin)
    progress("what the images tell about each unknown")
    motions = parameters.coefficients(fitted.unknowns)
    found = mapped(lambda pair: pair[0].with_material(pair[1]), zip(found, motions, strict=True))
    every = zip(objective.states, found, motions, strict=True)
    states = mapped(lambda of: replace(of[0], observed=of[1].seen(of[0], of[2])), every)
    shown = with_scales(with_correlations(objective, fitted.evaluation), fitted.evaluation)
    states = [replace(of, observed=own.observed) for of, own in zip(shown.states, states, strict=True)]
    evaluation = replace(objective, states=tuple(states))(fitted.unknowns)
    columns = [parameters.columns(i) for i in range(len(parameters.blocks))]
    data = evaluation.matrix - still.prior_of_blocks  # what earlier images tell, too
    middle, evaluations = fitted.unknowns, fitted.evaluations + 1
    # free the large derivatives of everything observed by all unknowns
    del objective, shown, states, fitted, evaluation
    informations = [data.block(own, own) for own in columns]
    bases = _combinations(parameters.blocks, informations, [state.model for state in start.states])
    fit = [inverse @ middle[own] for own, (_, inverse) in zip(columns, bases, strict=True)]
    unknowns = np.concatenate([theta, *fit])
    seen = parameters.combined([inverse for _, inverse in bases])
    progress(f"how the responses to the {seen.n_coefficients} unknowns that the images show change with the moduli")
    informed = _on_bases(start.states, found, bases, seen, unknowns)
    return begun(Objective(informed, seen), unknowns, evaluations=evaluations)


def _on_bases(
    states: Sequence[LaterState],
    found: Sequence[_Responses],
    bases: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
    seen: ParameterMap,
    unknowns: NDArray[np.float64],
) -> tuple[LaterState, ...]:
    """The states on reduced bases of their responses, at unknowns (n_unknowns,) of the map that is `seen`.

    found: the responses; bases: the combinations of each block, and their inverse.
    """
    made, asked = list[_Made](), list[tuple[LaterState, _Responses, Projection, NDArray[np.float64]]]()
    stiffer = unknowns.copy()
    stiffer[: seen.n_parameters] += APART
    for s, state in enumerate(states):
        of_state = [(b, basis) for b, (basis, _) in zip(seen.blocks, bases, strict=True) if s in b.states]
        boundary, material = (
            linalg.block_diag(np.zeros((0, 0)), *(basis for b, basis in of_state if b.acts is wanted))
            for wanted in (Acts.BOUNDARY, Acts.MATERIAL)
        )
        n = len(state.model.material.poisson)
        fields = material[: material.shape[0] - n, : material.shape[1] - n]
        modes = state.model.constraint.modes
        like = next((of for of in made if of.modes is modes and np.array_equal(of.boundary, boundary)), None)
        at_rest = {b.of: basis for b, basis in of_state if b.acts is Acts.REFERENCE}
        reduced = state.combined(boundary, fields, at_rest, like.projection.model if like else None)
        if like is None:
            projected = found[s].projected(reduced.model, boundary)
            projected = projected.extended(_free_responses(reduced.model, seen.moduli(stiffer)))
            like = _Made(modes, boundary, projected)
            made.append(like)
        asked.append((reduced, found[s], like.projection, material))

    def on_basis(
        of: tuple[tuple[LaterState, _Responses, Projection, NDArray[np.float64]], NDArray[np.float64]],
    ) -> LaterState:
        """A state on its basis."""
        (state, responses, projected, material), q = of
        own = projected if projected.model is state.model else projected.with_model(state.model)
        basis = responses.basis(own, material).with_modulus_series(q, seen.derivatives(unknowns))
        return state.with_approximation(basis)

    return tuple(mapped(on_basis, zip(asked, seen.coefficients(unknowns), strict=True)))


def _responses(model: LinearModel, moduli: NDArray[np.float64], others: Sequence[_Responses]) -> _Responses:
    """Those of a state's model at moduli (n_regions,) kPa; `others`: of the states before.

    States of one body with the same modes differ in offset and loads alone: one right-hand side.
    """
    alike = (other for other in others if other.system.model.constraint.modes is model.constraint.modes)
    for other in alike:
        if shared := of_same_body(model, moduli, [other.system]):
            alone = shared.solve(np.zeros(model.n_modes)).values.astype(np.float32)
            return _Responses(shared, other.boundary, alone, SolveCounts(forward=1))
    system = model.system(moduli)
    responses = system.single_responses(tolerance=SNAPSHOT)
    return _Responses(system, responses[:, :-1], responses[:, -1], system.response_counts)


def _free_responses(model: LinearModel, moduli: NDArray[np.float64]) -> NDArray[np.float64]:
    """Responses (n_free, n_boundary) mm of a model to all modes at moduli (n_regions,) kPa.

    With those at other moduli they tell how the response to every mode changes with the moduli, and so how much room
    the moduli leave the modes.
    """
    responses = model.system(moduli).single_responses(tolerance=SNAPSHOT)[:, :-1]
    return np.asarray(model.constraint.free.T @ responses, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class _Responses:
    """A system with the responses (n_dof, n_boundary) and (n_dof, n_material) mm of its model to all modes.

    alone (n_dof,) mm: to offset and loads; cost: of the former; values (n_dof,) mm: the displacement of homogeneous
    tissues that the material modes change.
    """

    system: LinearSystem
    boundary: NDArray[np.float32]
    alone: NDArray[np.float32]
    cost: SolveCounts
    material: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), dtype=np.float32))
    values: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def with_material(self, coefficients: NDArray[np.float64]) -> _Responses:
        """The same with responses to the material modes, at coefficients (n_modes,) of homogeneous tissues."""
        q = coefficients[: self.boundary.shape[1]].astype(np.float32)
        values = np.asarray(self.boundary @ q + self.alone, dtype=np.float64)
        material = self.system.material_responses(values, tolerance=SNAPSHOT, dtype=np.float32)
        return replace(self, material=material, values=values)

    def seen(self, state: LaterState, coefficients: NDArray[np.float64]) -> FirstOrderModel:
        """The observed part of the responses, to first order around coefficients (n_modes,), at fixed moduli."""
        model, moduli = self.system.model, self.system.moduli
        by_boundary = state.seen(self.boundary).astype(np.float64)
        alone = state.seen(self.alone).astype(np.float64)
        by_material = np.zeros((len(by_boundary), model.material.n_modes))
        by_material[:, : self.material.shape[1]] = state.seen(self.material) if self.material.size else 0.0
        tangent = np.concatenate([np.zeros((len(by_boundary), len(moduli))), by_boundary, by_material], axis=1)
        values = alone + tangent[:, len(moduli) :] @ coefficients
        return FirstOrderModel(model.names, moduli, coefficients, values, tangent)

    def projected(self, model: LinearModel, boundary: NDArray[np.float64]) -> Projection:
        """A model on its responses to combinations (n_boundary, k) of the modes, of which it is made."""
        if not boundary.shape[1]:  # what stands alone is all there is
            return projection(model, np.asarray(model.constraint.free.T @ self.alone, dtype=np.float64)[:, None])
        return projection(model, free_combinations(model, self.boundary, boundary.astype(np.float32)), overwrite=True)

    def basis(self, projected: Projection, material: NDArray[np.float64]) -> ReducedBasis:
        """The reduced basis of these, of what stands alone, and of combinations (n_material, l) of material modes."""
        cost, model = self.cost + SolveCounts(tangent=self.material.shape[1]), projected.model
        if np.any(self.alone):
            own = np.asarray(model.constraint.free.T @ self.alone, dtype=np.float64)
            projected = projected.extended(own[:, None])
        basis = ReducedBasis(projected, self.system.of(model), cost)
        responses = self.material @ material.astype(np.float32)
        return basis.with_material(responses, self.system.moduli, self.values)


@dataclass(frozen=True, slots=True)
class _Made:
    """The projection on combinations (n_boundary, k) of boundary modes (n_dof, n_boundary) of the states of a body."""

    modes: NDArray[np.float64]
    boundary: NDArray[np.float64]
    projection: Projection


def _combinations(
    blocks: Sequence[Block], informations: Sequence[NDArray[np.float64]], models: Sequence[LinearModel]
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """The informed combinations of each block; motions of one thing in several images of a body have the same ones.

    Each image then sees all that it sees of them, and models on them are made once. models: of each state.
    """
    groups = dict[object, list[int]]()
    for number, (block, state) in enumerate((block, block.states[0]) for block in blocks):
        before = sum(b.states == block.states and b.acts is block.acts for b in blocks[:number])
        alone = block.acts is not Acts.BOUNDARY or len(block.states) > 1
        modes = id(models[state].constraint.modes)
        groups.setdefault(number if alone else (before, block.of, block.cause, block.size, modes), []).append(number)
    found = dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]]()
    for own in groups.values():
        shared = informed_combinations(blocks[own[0]], *(informations[number] for number in own))
        found |= dict.fromkeys(own, shared)
    return [found[number] for number in range(len(blocks))]


def fit_coefficients(
    objective: Objective, begin: NDArray[np.float64], *, fits: int = FITS, tolerance: float = FIT
) -> Minimum:
    """The best coefficients of the blocks at the log-moduli of `begin` (n_unknowns,), sought from there.

    Closest points and coefficients in turn, `fits` times at most, until the decrement of a coefficient is below the
    tolerance: the minimum has converged then.
    """
    theta, at = begin[: objective.n_parameters], objective(begin)
    still, unknowns, evaluations = Bounds(theta, theta), begin, 1
    for _ in range(fits):
        found = gauss_newton(LinearisedObjective(objective, unknowns, at), unknowns, bounds=still)
        step, unknowns = found.unknowns - unknowns, found.unknowns
        objective = objective.rematched(unknowns)
        moved, at, evaluations = 0.5 * float(step @ (at.matrix @ step)), objective(unknowns), evaluations + 1
        if moved < tolerance * len(unknowns):
            return Minimum(unknowns, at, Outcome.CONVERGED, (), evaluations)
    return Minimum(unknowns, at, Outcome.STEPS, (), evaluations)


def informed_combinations(
    block: Block, *informations: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Combinations (n, k) of a block's unknowns that data of informations (n, n) see, and their inverse (k, n).

    Of a motion or a field whose prior is learned, at least the one that is seen most. Other unknowns stay as they are:
    Poisson's ratios have a tissue each. Several informations are those of a motion in several images: combinations are
    then the eigenvectors for the mean, and so many that for none of them more is left out.
    """
    motion = block.terms or block.acts is Acts.REFERENCE
    if not motion and block.choice not in (Choice.FRAME, Choice.PATCHINESS):
        return np.eye(block.size), np.eye(block.size)
    root = linalg.cholesky(block.widest, lower=True)
    of_images = [root.T @ information @ root for information in informations]
    _, vectors = linalg.eigh(np.mean(of_images, axis=0))
    sizes = [np.einsum("ij,ij->j", vectors, seen @ vectors) for seen in of_images]
    left = np.max(np.cumsum(np.maximum(sizes, 0.0), axis=1), axis=0) < (LEFT_OUT_OF_MAP if block.mapped else LEFT_OUT)
    left[-1:] = False
    kept = vectors[:, ~left][:, ::-1]
    unit = float(np.sqrt(np.mean(np.diag(block.widest))))  # coefficients keep their size
    basis = root @ kept / unit
    return basis, unit * (kept.T @ linalg.solve_triangular(root, np.eye(len(root)), lower=True))
