"""The objective near an estimate with its closest points, weights and hyper-parameters fixed.

Every residual is then linear in the displacement: a smooth least-squares problem, of which profiles are taken. On a
reduced model it is a quadratic form in the model's amplitudes: an evaluation forgets mesh and surfaces.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError
from palpate.inversion.objective import Evaluation, Linearisation, Objective
from palpate.inversion.optimise import LeastSquares
from palpate.mechanics.curved import CurvedModel
from palpate.mechanics.first_order import FirstOrderModel
from palpate.mechanics.forward import ForwardModel
from palpate.mechanics.reduced import ReducedModel, common_vectors
from palpate.mechanics.solvers.cholesky import adjoint_product, forward, lower_factor
from palpate.observation.jacobian import Jacobian
from palpate.unknowns.parameters import ParameterMap

ROUNDING = 1e-13  # of the largest number on the diagonal of a form that has no inverse
ONE = np.ones(1)  # the coordinate of what no unknown moves


@dataclass(frozen=True, slots=True)
class FixedCorrespondence:
    """An objective whose closest points are those of one evaluation; the model bends as it does.

    Residuals are r_0 + S (u(E, q) - u_0) with the Jacobians S by the displacement, and count by the robust
    weights w_0 there, as in the Gauss-Newton matrix: J = 1/2 sum_j precision w_0j r_j^2 + prior. What re-chosen closest
    points add, some tenths of a unit, is noise beside its second derivative, and far away a robust loss would take
    every residual for an outlier. unknowns (n_unknowns,): those of the evaluation; models: of each state, at its
    observed unknowns; displacements: u_0 (n_dofs,) mm of each linearisation.
    """

    objective: Objective
    unknowns: NDArray[np.float64]
    models: tuple[ForwardModel, ...]
    linearisations: tuple[Linearisation, ...]
    displacements: tuple[NDArray[np.float64], ...]

    @property
    def n_parameters(self) -> int:
        """Number of log-moduli among the unknowns."""
        return self.objective.n_parameters

    @property
    def parameters(self) -> ParameterMap:
        """The unknowns with their prior."""
        return self.objective.parameters

    def __call__(self, unknowns: NDArray[np.float64]) -> Evaluation:
        """J at `unknowns` (n_unknowns,) with score and Gauss-Newton matrix; raises `SolverError`."""
        mapping, found = self.objective.parameters, list[Linearisation]()
        left = iter(zip(self.linearisations, self.displacements, strict=True))
        moduli, coefficients = mapping.moduli(unknowns), mapping.coefficients(unknowns)
        for s, (state, model, q) in enumerate(zip(self.objective.states, self.models, coefficients, strict=True)):
            there = model.solve(moduli, q)
            tangent = mapping.by_unknowns(there.tangent(), unknowns)
            offset = mapping.offsets(unknowns - self.unknowns, s)
            for rows, (term, before) in zip(state.slices, left, strict=False):
                n_dofs, drawn = len(before), term.jacobian.tangent[: len(before) + 1, tangent.shape[1] :] @ offset
                material = term.jacobian.tangent[n_dofs + 1 :] @ (unknowns - self.unknowns)[term.columns]
                drawn[:n_dofs] += there.values[rows] - before
                moved = np.concatenate([drawn, material])
                values = term.residuals.values + term.jacobian.by_displacement @ moved
                jacobian = term.jacobian.with_tangent(tangent[rows])
                residuals = replace(term.residuals, values=values)
                found.append(Linearisation.of(term.observation, s, residuals, term.columns, jacobian, term.weights))
        return self.assembled(unknowns, found)

    def with_prior(self, parameters: ParameterMap) -> FixedCorrespondence:
        """The same under another prior of its unknowns."""
        return replace(self, objective=self.objective.with_prior(parameters))

    def assembled(self, unknowns: NDArray[np.float64], linearisations: Sequence[Linearisation]) -> Evaluation:
        """J at `unknowns` (n_unknowns,) where its linearisations there are known."""
        found = self.objective.assembled(unknowns, linearisations)
        squares = sum(term.precision * float(term.weights @ term.residuals.values**2) for term in linearisations)
        return replace(found, value=found.prior_value + 0.5 * squares)


def fixed_correspondence(
    objective: Objective, unknowns: NDArray[np.float64], evaluation: Evaluation
) -> FixedCorrespondence:
    """The objective with the closest points and weights of an evaluation at `unknowns` (n_unknowns,).

    Expansions bend as the linear law does (`CurvedModel`).
    """
    models, displacements = list[ForwardModel](), list[NDArray[np.float64]]()
    mapping = objective.parameters
    moduli, coefficients = mapping.moduli(unknowns), mapping.coefficients(unknowns)
    for state, q in zip(objective.states, coefficients, strict=True):
        model, bending = state.observed, state.bending
        assert model is not None, "an objective is made of states with approximations"
        values = model.solve(moduli, q).values
        displacements += [values[rows] for rows in state.slices]
        if bending is not None and isinstance(model, FirstOrderModel):
            model = CurvedModel.of(model, bending.model.outputs(state.seen))
        models.append(model)
    return FixedCorrespondence(objective, unknowns, tuple(models), evaluation.linearisations, tuple(displacements))


@dataclass(frozen=True, slots=True)
class FrozenState:
    """One later state: z = [a, q, 1] with the amplitudes a (m,) of its `reduced` model, which answers nothing else.

    Offsets of the residuals, and modes of surfaces at rest, stand before the 1. expanded (n_regions,) kPa: E_0 where an
    expansion adds to the model, z = [a, q, ln E - ln E_0, 1]; form: Q (k, k), the residuals' part of the objective is
    1/2 z^T Q z; square: S (k, k), their mean square is z^T S z, mm^2; root, beside, left: lower R_a^T (m, m), R_l^T
    and Q_l of the others z_l, with which it is 1/2 |R_a a + R_l z_l|^2 + 1/2 z_l^T Q_l z_l but for what is linear in z;
    common: how many first basis vectors are those of the first state.
    """

    reduced: ReducedModel
    expanded: NDArray[np.float64] | None
    form: NDArray[np.float64]
    square: NDArray[np.float64]
    root: NDArray[np.float64]
    beside: NDArray[np.float64]
    left: NDArray[np.float64]
    common: int = 0

    @classmethod
    def of(
        cls,
        reduced: ReducedModel,
        expanded: NDArray[np.float64] | None,
        form: NDArray[np.float64],
        square: NDArray[np.float64],
        common: int,
    ) -> FrozenState:
        """That of a form, with its root: Q_aa = R_a^T R_a by Cholesky, up to rounding, and R_a^T R_l = Q_al."""
        m = reduced.n_basis
        own, across = form[:m, :m].copy(), form[:m, m:-1]
        own[np.diag_indices(m)] += ROUNDING * float(np.diag(own).max(initial=0.0)) + np.finfo(np.float64).tiny
        factor = lower_factor(own)
        beside = np.ascontiguousarray(forward(factor, across).T)
        left = form[m:-1, m:-1] - beside @ beside.T
        return cls(reduced, expanded, form, square, factor, beside, left, common)

    def pulled(self, pull: NDArray[np.float64]) -> FrozenState:
        """The same with a form that is z^T y larger, y = `pull` (k - 1,) by all coordinates but the last."""
        form = self.form.copy()
        form[:-1, -1] += pull
        form[-1, :-1] += pull
        return replace(self, form=form)

    def coordinates(
        self,
        amplitude: NDArray[np.float64],
        moduli: NDArray[np.float64],
        coefficients: NDArray[np.float64],
        offsets: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Z (k,) of the amplitude (m,) at moduli (n_regions,) kPa, coefficients (n_modes,) and offsets (n_offsets,)."""
        further = [] if self.expanded is None else [np.log(moduli / self.expanded)]
        return np.concatenate([amplitude, coefficients, *further, offsets, ONE])

    def gradient(
        self, force: NDArray[np.float64], amplitude_slopes: NDArray[np.float64], modulus_slopes: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """D^T y (n_own,) for y (k,), D the derivatives of z by the state's own unknowns.

        amplitude_slopes (m, n): of the amplitudes, by the first n of these, what acts on moduli and boundary modes;
        modulus_slopes (n_regions, n_moduli): of ln E by the former. The other coordinates are unknowns themselves.
        """
        m = len(amplitude_slopes)
        found = self._by_others(force[m:-1], modulus_slopes)
        found[: amplitude_slopes.shape[1]] += amplitude_slopes.T @ force[:m]
        return found

    def curvature(
        self, amplitude_slopes: NDArray[np.float64], modulus_slopes: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """D^T Q D (n_own, n_own), of the same derivatives D = [A; B], B of all coordinates but the amplitudes.

        It is Z^T Z + B^T Q_l B with Z = R_a A + R_l B, R_a triangular, and B is of zeros and ones but for ln E.
        """
        half = self._by_others(self.beside, modulus_slopes)
        half[: amplitude_slopes.shape[1]] += adjoint_product(self.root, amplitude_slopes).T
        found = self._of_others(self.left, modulus_slopes)
        found += half @ half.T
        return found

    def _of_others(self, values: NDArray[np.float64], modulus_slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        """B^T y B (n_own, n_own) of a symmetric y (k, k) of coordinates that are no amplitudes."""
        n_moduli, places = modulus_slopes.shape[1], self._places(len(values), modulus_slopes)
        size = places[-1][1].stop
        found = np.zeros((size, size))
        for row, to_row in places:
            for column, to_column in places:
                found[to_row, to_column] = values[row, column]
        if self.expanded is not None:
            expanded = slice(self.reduced.n_modes, self.reduced.n_modes + len(self.expanded))
            for column, to_column in places:
                found[:n_moduli, to_column] = modulus_slopes.T @ values[expanded, column]
                found[to_column, :n_moduli] = found[:n_moduli, to_column].T
            found[:n_moduli, :n_moduli] = modulus_slopes.T @ values[expanded, expanded] @ modulus_slopes
        return found

    def _by_others(self, values: NDArray[np.float64], modulus_slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        """B^T y (n_own,) or (n_own, r) of coordinates (k,) or (k, r) that are no amplitudes."""
        places = self._places(len(values), modulus_slopes)
        found = np.zeros((places[-1][1].stop, *values.shape[1:]))
        for row, to_row in places:
            found[to_row] = values[row]
        if self.expanded is not None:
            expanded = slice(self.reduced.n_modes, self.reduced.n_modes + len(self.expanded))
            found[: modulus_slopes.shape[1]] = modulus_slopes.T @ values[expanded]
        return found

    def _places(self, n_others: int, modulus_slopes: NDArray[np.float64]) -> tuple[tuple[slice, slice], ...]:
        """Where coefficients and offsets stand among the coordinates that are no amplitudes, and among the unknowns."""
        n_modes, n_moduli = self.reduced.n_modes, modulus_slopes.shape[1]
        before = 0 if self.expanded is None else len(self.expanded)
        offsets = n_others - before - n_modes
        end = n_moduli + n_modes
        return (
            (slice(0, n_modes), slice(n_moduli, end)),
            (slice(n_modes + before, n_others), slice(end, end + offsets)),
        )


@dataclass(frozen=True, slots=True)
class FrozenPosterior:
    """Minus log-posterior 1/2 sum_s z_s^T Q_s z_s + 1/2 (x - m)^T P (x - m) + v(theta) of unknowns x (n,).

    It is dimensionless. z_s: see `FrozenState`; m, P and the room v, if any: those of `parameters`.
    """

    parameters: ParameterMap
    states: tuple[FrozenState, ...]

    @property
    def n_parameters(self) -> int:
        """Number of log-moduli among the unknowns."""
        return self.parameters.n_parameters

    def with_prior(self, parameters: ParameterMap) -> FrozenPosterior:
        """The same under another prior of its unknowns."""
        return replace(self, parameters=parameters)

    def pulled(self, pulls: Sequence[NDArray[np.float64]], amount: float) -> FrozenPosterior:
        """The same with residuals that pull by `amount` times y (k - 1,) of each state more (see `pulls_of`)."""
        pairs = zip(self.states, pulls, strict=True)
        return replace(self, states=tuple(state.pulled(amount * pull) for state, pull in pairs))

    def alone(self, number: int) -> FrozenPosterior:
        """That of one state, of the unknowns of `ParameterMap.alone`."""
        return FrozenPosterior(self.parameters.alone(number)[0], (replace(self.states[number], common=0),))

    def __call__(self, unknowns: NDArray[np.float64]) -> Evaluation:
        """Its value, score and Gauss-Newton matrix at unknowns (n,), without residuals; raises `SolverError`.

        With D_s = d z_s / dx the score is sum_s D_s^T Q_s z_s + P (x - m) + dv/dx, the matrix sum_s D_s^T Q_s D_s + P.
        """
        parameters, prior = self.parameters, self.parameters.prior_matrix
        moduli, modulus_slopes = parameters.moduli(unknowns), parameters.derivatives(unknowns)
        believed, pull = parameters.prior(unknowns)
        value, score, misfit = believed, pull.copy(), 0.0
        blocks, first = list[tuple[NDArray[np.int64], NDArray[np.float64]]](), None
        for s, (state, coefficients) in enumerate(zip(self.states, parameters.coefficients(unknowns), strict=True)):
            system = state.reduced.system(moduli, first, state.common)
            first, there, own = first or system, system.solve(coefficients), parameters.unknowns_of(s)
            z = state.coordinates(there.amplitude, moduli, coefficients, parameters.offsets(unknowns, s))
            amplitude_slopes, force = there.amplitude_tangent(modulus_slopes), state.form @ z
            value += 0.5 * float(z @ force)
            misfit += float(z @ (state.square @ z))
            score[own] += state.gradient(force, amplitude_slopes, modulus_slopes)
            blocks.append((own, state.curvature(amplitude_slopes, modulus_slopes)))
        return Evaluation(value, misfit, score, prior.plus(blocks), (), prior, pull, believed)


@dataclass(frozen=True, slots=True)
class _SeenState:
    """A state to be frozen: `bare` of forms, its z (k,) there, and of each observation a term and its S dr/dz."""

    bare: FrozenState
    z: NDArray[np.float64]
    terms: tuple[tuple[Linearisation, Jacobian], ...]


def _seen_states(objective: Objective, unknowns: NDArray[np.float64], evaluation: Evaluation) -> Iterator[_SeenState]:
    """What is frozen of one state after the other at unknowns (n,); raises as `frozen_posterior`."""
    parameters = objective.parameters
    moduli, coefficients = parameters.moduli(unknowns), parameters.coefficients(unknowns)
    for s, model in enumerate(fixed_correspondence(objective, unknowns, evaluation).models):
        reduced = model.like if isinstance(model, CurvedModel) else model
        if not isinstance(reduced, ReducedModel):
            raise ConfigurationError(
                f"the posterior is frozen on reduced models; state {s} has a {type(model).__name__}"
            )
        answer = np.concatenate([*reduced.output_basis, reduced.output_modes], axis=1)
        answer = np.pad(answer, ((0, 0), (0, reduced.n_modes - reduced.n_boundary)))
        linearisations = [term for term in evaluation.linearisations if term.state == s]
        expanded = moduli if any(term.residuals.direct is not None for term in linearisations) else None
        if expanded is not None:
            answer = np.pad(answer, ((0, 0), (0, len(moduli))))
        if isinstance(model, CurvedModel):
            rest, expanded = model.expansion.derivatives - model.linear.derivatives, model.expansion.moduli
            modes = slice(reduced.n_basis, reduced.n_basis + model.n_modes)
            answer[:, modes] += rest[:, model.n_regions :]
            answer = np.concatenate([answer[:, : modes.stop], rest[:, : model.n_regions]], axis=1)
        offsets = parameters.offsets(unknowns, s)
        alone = reduced.outputs(lambda values: values[:0])
        alone = replace(alone, coupling=np.ascontiguousarray(alone.coupling))
        bare = FrozenState(alone, expanded, *(np.zeros((0, 0)),) * 5)
        z = bare.coordinates(bare.reduced.solve(moduli, coefficients[s]).amplitude, moduli, coefficients[s], offsets)
        terms = list[tuple[Linearisation, Jacobian]]()
        for rows, term in zip(objective.states[s].slices, linearisations, strict=True):
            of_offsets = term.jacobian.tangent[:, term.jacobian.shape[1] - len(offsets) :]
            below = np.zeros((len(of_offsets) - len(answer[rows]), answer.shape[1]))
            if term.residuals.direct is not None:  # z holds the material's coefficients, then ln E - ln E_0
                n_regions, first = len(moduli), reduced.n_basis + reduced.n_boundary
                below[1 : 1 + n_regions, -n_regions:] = np.eye(n_regions)
                below[1 + n_regions :, first : first + len(below) - 1 - n_regions] = np.eye(len(below) - 1 - n_regions)
            moved = np.concatenate([np.concatenate([answer[rows], below]), of_offsets], axis=1)
            terms.append((term, replace(term.jacobian, tangent=moved)))
        yield _SeenState(bare, z, tuple(terms))


def frozen_posterior(
    objective: Objective, unknowns: NDArray[np.float64], evaluation: Evaluation | None = None
) -> FrozenPosterior:
    """The posterior with the closest points and weights at `unknowns` (n,), under the objective's own prior of them.

    Residuals are point-to-plane, r + n.(u - u_0), as in the Gauss-Newton matrix. evaluation: that of the objective
    there, where it is known. Raises `ConfigurationError` for models that are neither reduced ones nor bent by one.
    """
    evaluation = evaluation or objective(unknowns)
    states = list[FrozenState]()
    for seen in _seen_states(objective, unknowns, evaluation):
        form, square = np.zeros((len(seen.z), len(seen.z))), np.zeros((len(seen.z), len(seen.z)))
        for term, by_z in seen.terms:
            rest = term.residuals.values - by_z.times(seen.z[:-1])
            side = by_z.transposed_times(term.weights * rest)[:, None]
            own = np.block([[by_z.gram(term.weights), side], [side.T, float(term.weights @ rest**2)]])
            form += term.precision * own
            square += own / len(evaluation.linearisations)
        common = common_vectors(states[0].reduced, seen.bare.reduced) if states else 0
        states.append(FrozenState.of(seen.bare.reduced, seen.bare.expanded, form, square, common))
    return FrozenPosterior(objective.parameters, tuple(states))


def pulls_of(
    objective: Objective,
    unknowns: NDArray[np.float64],
    evaluation: Evaluation,
    changes: Sequence[Sequence[NDArray[np.float64]]],
) -> list[tuple[NDArray[np.float64], ...]]:
    """How residuals pull that change: of each of several changes e (n,) mm of each observation, y (k - 1,) by state.

    y = sum W S^T e by the coordinates z, so that the objective changes by z^T y but for a constant. Of the posterior
    that is frozen there; raises as `frozen_posterior`.
    """
    found: list[list[NDArray[np.float64]]] = [[] for _ in changes]
    first = 0
    for seen in _seen_states(objective, unknowns, evaluation):
        own = slice(first, first + len(seen.terms))
        first = own.stop
        for of_change, change in zip(found, changes, strict=True):
            pulls = (
                by_z.transposed_times(term.precision * term.weights * e)
                for (term, by_z), e in zip(seen.terms, change[own], strict=True)
            )
            of_change.append(np.sum(list(pulls), axis=0))
    return [tuple(of_change) for of_change in found]


class Posterior(LeastSquares, Protocol):
    """Minus the log posterior of all unknowns, under a prior that can be replaced."""

    @property
    def parameters(self) -> ParameterMap:
        """The unknowns with their prior."""
        ...

    def with_prior(self, parameters: ParameterMap) -> Posterior:
        """The same under another prior of its unknowns."""
        ...


def cheapest_posterior(objective: Objective, unknowns: NDArray[np.float64], evaluation: Evaluation) -> Posterior:
    """The objective with the closest points and weights of an evaluation at unknowns (n_unknowns,).

    Frozen, where its models are reduced ones.
    """
    try:
        return frozen_posterior(objective, unknowns, evaluation)
    except ConfigurationError:
        return fixed_correspondence(objective, unknowns, evaluation)
