"""The misfit of all observations of all later states, with the prior, as a function of every unknown."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.contract import Approximation, LinearisationPoint, determined
from palpate.inversion.later_state import LaterState
from palpate.mechanics.forward import Equilibrium
from palpate.observation.contract import Observation, OfMaterial, Rematched, Residuals
from palpate.observation.jacobian import Jacobian, jacobian_of
from palpate.parallel import mapped
from palpate.unknowns.arrowhead import Arrowhead
from palpate.unknowns.parameters import ParameterMap


@dataclass(frozen=True, slots=True)
class Linearisation:
    """One observation of one `state` at some unknowns: its residuals, robust weights (n,) and derivatives.

    columns (n_columns,): the unknowns that move it, the log-moduli and those of its own state. jacobian J (n,
    n_columns); score (n_columns,) J^T W r and information (n_columns, n_columns) J^T W J, W = precision
    diag(weights): what it adds to those of the objective.
    """

    observation: Observation
    state: int
    residuals: Residuals
    columns: NDArray[np.int64]
    jacobian: Jacobian
    weights: NDArray[np.float64]
    score: NDArray[np.float64]
    information: NDArray[np.float64]

    @property
    def precision(self) -> float:
        """Weight of the mean square, mm^-2."""
        return self.observation.weighting.precision

    @classmethod
    def of(
        cls,
        observation: Observation,
        state: int,
        residuals: Residuals,
        columns: NDArray[np.int64],
        jacobian: Jacobian,
        weights: NDArray[np.float64],
        information: NDArray[np.float64] | None = None,
    ) -> Linearisation:
        """That of residuals with a Jacobian and weights; information (n_columns, n_columns): None, it is formed."""
        believed = observation.weighting.precision * weights
        score = jacobian.transposed_times(believed * residuals.values)
        information = jacobian.gram(believed) if information is None else information
        return cls(observation, state, residuals, columns, jacobian, weights, score, information)

    def with_errors(self, errors: NDArray[np.float64]) -> Linearisation:
        """The same with residuals that are larger by errors (n,), in their unit."""
        residuals = replace(self.residuals, values=self.residuals.values + errors)
        own = (self.columns, self.jacobian, self.weights, self.information)
        return Linearisation.of(self.observation, self.state, residuals, *own)

    def moved(self, observation: Observation, step: NDArray[np.float64]) -> Linearisation:
        """That of the residuals r + J d after a step d (n_unknowns,), as an observation otherwise weighted has them.

        Where the weights of most residuals stay, their part of the information is not formed again.
        """
        values = self.residuals.values + self.jacobian.times(step[self.columns])
        residuals = observation.weighed(replace(self.residuals, values=values))
        weights, precision = _robust_weights(observation, residuals), observation.weighting.precision
        change, information = precision * (weights - self.weights), None
        if np.count_nonzero(change) <= self.jacobian.by_displacement.shape[1]:  # else forming it anew is cheaper
            scaled = precision / self.precision * self.information
            information = self.jacobian.changed_gram(scaled, change)
        return Linearisation.of(observation, self.state, residuals, self.columns, self.jacobian, weights, information)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Value (dimensionless, minus log-posterior) and the Gauss-Newton system.

    matrix H = J^T W J + P and score (n,) = J^T W r + P (x - m) + dv/dx with the Jacobians J of smooth surfaces and the
    room v of `ParameterMap.volume`, which H is without. The estimate is where the score vanishes. prior: P, the
    precision of the unknowns before the images are seen; prior_score (n,), prior_value: its part, and that of v, of
    score and value.
    """

    value: float
    misfit_mm2: float
    score: NDArray[np.float64]
    matrix: Arrowhead
    linearisations: tuple[Linearisation, ...]
    prior: Arrowhead
    prior_score: NDArray[np.float64]
    prior_value: float = 0.0

    def covariance_columns(self, n_parameters: int) -> NDArray[np.float64]:
        """H^-1 [e_1, ..., e_k] (n, k) of the first k unknowns, the log-moduli, with the Gauss-Newton matrix H.

        The variance of a modulus that moves nothing is infinite, and that of no other. Raises `EstimationError` where
        neither images nor prior determine some other unknown.
        """
        unseen = ~(self.matrix.diagonal > 0.0)
        unseen[n_parameters:] = False
        with determined():
            alone = self.matrix.plus_diagonal(unseen.astype(np.float64)) if unseen.any() else self.matrix
            found = alone.solve(np.eye(self.matrix.size, n_parameters))
        numbers = np.flatnonzero(unseen)
        found[numbers, numbers] = np.inf
        return found

    def with_prior(self, parameters: ParameterMap, unknowns: NDArray[np.float64]) -> Evaluation:
        """The same at `unknowns` (n_unknowns,), where it is of, under another prior of these."""
        value, pull = parameters.prior(unknowns)
        prior = parameters.prior_matrix
        return replace(
            self,
            value=self.value - self.prior_value + value,
            score=self.score - self.prior_score + pull,
            matrix=self.matrix - self.prior + prior,
            prior=prior,
            prior_value=value,
            prior_score=pull,
        )


@dataclass(frozen=True, slots=True)
class Objective:
    """J, minus the log posterior of all unknowns x under one prior, over all observations k of all later states.

    J(x) = sum_k n_k sum_j w_j rho_k(r_j(x)) / (2 s_k^2) + 1/2 (x - m)^T P (x - m) + v(theta), but for a constant. The
    unknowns x, their prior mean m and precision P are those of `parameters`, and so is the room v, if any; scales s_k
    and numbers n_k of independent residuals are those of the observations' `weighting`. Each observation has an offset,
    where `parameters` have one.
    """

    states: tuple[LaterState, ...]
    parameters: ParameterMap

    @property
    def n_parameters(self) -> int:
        """Number of log-moduli among the unknowns."""
        return self.parameters.n_parameters

    @property
    def observations(self) -> list[Observation]:
        """Those of all states, one state after the other."""
        return [observation for state in self.states for observation in state.observations]

    @property
    def approximations(self) -> list[Approximation]:
        """What stands in for each state's model."""
        found = [state.approximation for state in self.states if state.approximation is not None]
        assert len(found) == len(self.states), "an objective is made of states with approximations"
        return found

    @property
    def bends_as(self) -> list[Approximation]:
        """What answers far from where each approximation is exact: what an expansion bends as, else that one."""
        return [state.bending or model for state, model in zip(self.states, self.approximations, strict=True)]

    def linearisation_points(
        self, unknowns: NDArray[np.float64], evaluations: Sequence[Evaluation] = (), *, all_material: bool = True
    ) -> list[LinearisationPoint]:
        """What unknowns (n_unknowns,) mean for each state; with the directions that decide, by `evaluations` there.

        These are of one or more priors; the first one's matrix is the metric. all_material: whether derivatives by all
        material modes are asked for, too.
        """
        mapping, n = self.parameters, self.n_parameters
        moduli, coefficients = mapping.moduli(unknowns), mapping.coefficients(unknowns)
        if not evaluations:
            return [LinearisationPoint(moduli, q) for q in coefficients]
        every = [deciding_directions(evaluation, n)[:, n * (i > 0) :] for i, evaluation in enumerate(evaluations)]
        directions, points = np.concatenate(every, axis=1), []
        for s, q in enumerate(coefficients):
            own, chain = mapping.unknowns_of(s), mapping.chain(s, unknowns)
            metric = chain @ evaluations[0].matrix.block(own, own) @ chain.T
            points.append(LinearisationPoint(moduli, q, chain @ directions[own], metric, all_material))
        return points

    def with_approximations(self, approximations: Sequence[Approximation]) -> Objective:
        """The same observations and weights with other approximations, one for each state."""
        pairs = zip(self.states, approximations, strict=True)
        return replace(self, states=tuple(state.with_approximation(model) for state, model in pairs))

    def bent_as(self, models: Sequence[Approximation]) -> Objective:
        """The same with others in place of what it `bends_as`, one for each state."""
        pairs = zip(self.states, models, strict=True)
        states = [replace(s, bending=model) if s.bending else s.with_approximation(model) for s, model in pairs]
        return replace(self, states=tuple(states))

    def with_prior(self, parameters: ParameterMap) -> Objective:
        """The same under another prior of its unknowns."""
        return replace(self, parameters=parameters)

    def with_observations(self, observations: Sequence[Observation]) -> Objective:
        """The same with each observation otherwise weighted or matched, in the order of `observations`."""
        left = iter(observations)
        states = [state.with_observations([next(left) for _ in state.observations]) for state in self.states]
        return replace(self, states=tuple(states))

    def __call__(self, unknowns: NDArray[np.float64]) -> Evaluation:
        """J with score, Gauss-Newton matrix and residuals at `unknowns` (n_unknowns,)."""
        found = mapped(lambda s: self._linearised(s, unknowns), range(len(self.states)))
        return self.assembled(unknowns, list(itertools.chain.from_iterable(found)))

    def assembled(self, unknowns: NDArray[np.float64], linearisations: Sequence[Linearisation]) -> Evaluation:
        """The evaluation at `unknowns` (n_unknowns,) from all observations' residuals there, with their derivatives."""
        believed, pull = self.parameters.prior(unknowns)
        prior = self.parameters.prior_matrix
        value, score, misfit = believed, pull.copy(), 0.0
        for term in linearisations:
            score[term.columns] += term.score
            loss = float(term.residuals.weights @ term.observation.weighting.loss.rho(term.residuals.values))
            misfit += loss / len(linearisations)
            value += 0.5 * term.precision * loss
        matrix = prior.plus((term.columns, term.information) for term in linearisations)
        return Evaluation(value, misfit, score, matrix, tuple(linearisations), prior, pull, believed)

    def weighed(
        self, unknowns: NDArray[np.float64], linearisations: Sequence[Linearisation], like: Sequence[Linearisation]
    ) -> Evaluation:
        """The evaluation at `unknowns` (n_unknowns,) from residuals there, with the robust weights of others."""
        every = zip(self.observations, linearisations, like, strict=True)
        found = [
            Linearisation.of(observation, of.state, of.residuals, of.columns, of.jacobian, other.weights)
            for observation, of, other in every
        ]
        return self.assembled(unknowns, found)

    def rematched(self, unknowns: NDArray[np.float64]) -> Objective:
        """The same with what belongs together in model and image chosen anew at unknowns (n_unknowns,).

        Raises `EstimationError` when an observation has nothing left to compare.
        """

        def fresh(of: tuple[tuple[Observation, NDArray[np.float64]], float]) -> Observation:
            """One observation with its closest points chosen anew."""
            (observation, motion), offset = of
            return observation.rematched(motion, offset) if isinstance(observation, Rematched) else observation

        seen = [self._seen(s, self._equilibrium(s, unknowns).values, unknowns) for s in range(len(self.states))]
        offsets = [self._offsets(s, unknowns) for s in range(len(self.states))]
        pairs = zip(itertools.chain.from_iterable(seen), itertools.chain.from_iterable(offsets), strict=True)
        return self.with_observations(mapped(fresh, pairs))

    def _equilibrium(self, s: int, unknowns: NDArray[np.float64]) -> Equilibrium:
        observed = self.states[s].observed
        assert observed is not None, "an objective is made of states with approximations"
        return observed.solve(self.parameters.moduli(unknowns), self.parameters.coefficients(unknowns)[s])

    def _seen(
        self, s: int, values: NDArray[np.float64], unknowns: NDArray[np.float64]
    ) -> list[tuple[Observation, NDArray[np.float64]]]:
        """Each observation of a state with its displacements (n_dofs,) mm from where the reference image draws it."""
        state, drawn, found = self.states[s], self.parameters.offsets(unknowns, s), []
        at_rest = self.parameters.at_rest(s)
        for observation, rows in zip(state.observations, state.slices, strict=True):
            motion = values[rows]
            if modes := state.modes_at_rest(observation, at_rest):
                motion = motion + modes[1] @ drawn[modes[0]]
            found.append((observation, motion))
        return found

    def _residuals(
        self, s: int, values: NDArray[np.float64], unknowns: NDArray[np.float64]
    ) -> list[tuple[Observation, Residuals]]:
        """Each observation of a state with its residuals at displacements (n_observed,) mm and its offset."""
        moduli, coefficients = self.parameters.moduli(unknowns), self.parameters.coefficients(unknowns)[s]
        material = moduli, coefficients[self.states[s].model.constraint.n_modes :]

        def seen(of: tuple[tuple[Observation, NDArray[np.float64]], float]) -> tuple[Observation, Residuals]:
            """One observation with its residuals."""
            (observation, motion), offset = of
            here = observation.with_material(*material) if isinstance(observation, OfMaterial) else observation
            return observation, here.residuals(motion, offset)

        return mapped(seen, zip(self._seen(s, values, unknowns), self._offsets(s, unknowns), strict=True))

    def _by_material(self, s: int, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives (n_regions + n_material, k) of ln E and the material of a state by theta and coefficients."""
        n, n_boundary = len(self.parameters.base), self.states[s].model.constraint.n_modes
        n_modes = len(self.parameters.coefficients(unknowns)[s])
        kept = np.r_[np.arange(n), np.arange(n + n_boundary, n + n_modes)]
        return self.parameters.by_unknowns(np.eye(n + n_modes)[kept], unknowns)

    def _offsets(self, s: int, unknowns: NDArray[np.float64]) -> list[float]:
        """The offset of each observation of a state, 0 where it has none."""
        known = dict(zip(self.parameters.offset_names(s), self.parameters.offsets(unknowns, s).tolist(), strict=False))
        return [known.get(o.name, 0.0) for o in self.states[s].observations]

    def _linearised(self, s: int, unknowns: NDArray[np.float64]) -> list[Linearisation]:
        state, solution = self.states[s], self._equilibrium(s, unknowns)
        tangent, columns = solution.tangent(), self.parameters.unknowns_of(s)
        n_offsets = len(self.parameters.offsets(unknowns, s))
        seen = self._residuals(s, solution.values, unknowns)
        numbers = {name: number for number, name in enumerate(self.parameters.offset_names(s))}
        at_rest = self.parameters.at_rest(s)

        def linearised(of: tuple[slice, tuple[Observation, Residuals]]) -> Linearisation:
            """One observation's residuals with their derivative."""
            rows, (observation, residuals) = of
            direct = None if residuals.direct is None else (residuals.direct, self._by_material(s, unknowns))
            number = numbers.get(observation.name)
            own = self.parameters.by_unknowns(tangent[rows], unknowns)
            drawn = state.modes_at_rest(observation, at_rest)
            jacobian = jacobian_of(
                residuals.jacobian, own, number=number, n_offsets=n_offsets, direct=direct, at_rest=drawn
            )
            weights = _robust_weights(observation, residuals)
            return Linearisation.of(observation, s, residuals, columns, jacobian, weights)

        return mapped(linearised, zip(state.slices, seen, strict=True))


@dataclass(frozen=True, slots=True)
class LinearisedObjective:
    """An objective with the residuals linear around unknowns (n_unknowns,) where it was evaluated.

    No displacement and no closest point is sought: a value costs a hundredth. `objective` says how much each residual
    counts, which may be other than in the evaluation.
    """

    objective: Objective
    unknowns: NDArray[np.float64]
    evaluation: Evaluation

    @property
    def n_parameters(self) -> int:
        """Number of log-moduli among the unknowns."""
        return self.objective.n_parameters

    def __call__(self, unknowns: NDArray[np.float64]) -> Evaluation:
        """J at `unknowns` (n_unknowns,) with the residuals r + J (x - x_0) by the Jacobians."""
        step = unknowns - self.unknowns
        pairs = zip(self.objective.observations, self.evaluation.linearisations, strict=True)
        return self.objective.assembled(unknowns, mapped(lambda pair: pair[1].moved(pair[0], step), pairs))


def deciding_directions(evaluation: Evaluation, n_parameters: int) -> NDArray[np.float64]:
    """Directions (n_unknowns, 2 n_parameters) of the unknowns that decide the parameters theta, dimensionless.

    First the unit vectors e_i of the parameters, then h_i = H^-1 e_i with the Gauss-Newton matrix H. Where the
    derivatives J h_i of the residuals are exact, so are to first order in an error of the other columns of J the
    parameters' part of the step, e_i^T H^-1 J^T W r = (J h_i)^T W r + ..., their gain (J h_i)^T W and their variance
    e_i^T H^-1 e_i, whose variation is -2 (dJ h_i)^T W J h_i. h_i is 0 of a modulus that moves nothing.
    """
    unit = np.eye(evaluation.matrix.size, n_parameters)
    columns = evaluation.covariance_columns(n_parameters)
    return np.concatenate([unit, np.where(np.isfinite(columns), columns, 0.0)], axis=1)


def _robust_weights(observation: Observation, residuals: Residuals) -> NDArray[np.float64]:
    """The weights (n,) of residuals, times the robust weights of the loss."""
    return np.asarray(residuals.weights * observation.weighting.loss.weight(residuals.values))
