"""The misfit of all surfaces and images, with the prior of the driver's motion, as a function of every unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.errors import EstimationError
from palpate.inversion.modulus_map import ModulusMap
from palpate.inversion.tukey import Tukey
from palpate.mechanics.forward import ForwardModel
from palpate.observation.misfit import Correspondence, SurfaceResiduals, correspondence, surface_residuals
from palpate.observation.target import SurfaceTarget
from palpate.parallel import mapped

__all__ = ["Evaluation", "Linearisation", "LocalModel", "Objective", "State", "Weighting"]


class LocalModel(ForwardModel, Protocol):
    """A forward model of all points that can answer at some of them only."""

    def at(self, dofs: NDArray[np.int64]) -> ForwardModel:
        """The same model with the outputs `dofs` (n,) only."""
        ...


@dataclass(frozen=True, slots=True)
class State:
    """One later state of the body: its model, which answers at the observed points only, and its surfaces.

    `model` gives displacements (n_dofs,) mm at the unknowns of all `targets`, one after the other.
    """

    model: ForwardModel
    targets: tuple[SurfaceTarget, ...]

    @property
    def dofs(self) -> NDArray[np.int64]:
        """The unknowns of all targets (n_dofs,), one target after the other."""
        return np.concatenate([target.surface.dofs for target in self.targets])

    def slices(self) -> list[slice]:
        """Rows of the model's answer that belong to each target."""
        ends = np.cumsum([len(target.surface.dofs) for target in self.targets])
        return [slice(end - len(t.surface.dofs), end) for end, t in zip(ends, self.targets, strict=True)]


@dataclass(frozen=True, slots=True)
class Weighting:
    """How the residuals of one surface count: `precision` (mm^-2) of its mean square under the robust `loss`.

    `held`: the image points in use and more; `noise` (mm^4, inf: all count by area) is the residuals' variance times
    their correlation area, against which the voxels' terraces are held.
    """

    precision: float
    loss: Tukey
    held: Correspondence
    noise: float = np.inf


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Residuals of one surface of one `state` with robust weights (n,) and their derivative (n, n_columns).

    `columns` (n_columns,): the unknowns that move it, the log-moduli and its own state's modes. `jacobian` is that of a
    smooth surface (see `SurfaceResiduals.normal_jacobian`); `gradient` (n_columns,) is the exact one of
    precision / 2 sum w rho(r).
    """

    residuals: SurfaceResiduals
    columns: NDArray[np.int64]
    jacobian: NDArray[np.float64]
    weights: NDArray[np.float64]
    precision: float
    target: SurfaceTarget
    gradient: NDArray[np.float64]
    state: int


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Value (dimensionless, minus log-posterior) with its exact gradient (n,), and the Gauss-Newton system.

    matrix (n, n) = J^T W J + P and score (n,) = J^T W r + P q with the smooth surface's J: the estimate is where the
    score vanishes. prior (n, n): P, the precision of the driver's coefficients before the images are seen.
    """

    value: float
    misfit_mm2: float
    gradient: NDArray[np.float64]
    score: NDArray[np.float64]
    matrix: NDArray[np.float64]
    surfaces: tuple[Linearisation, ...]
    prior: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Objective:
    """J(theta, q) = 1/2 sum_s precision_s sum_j w_j rho(r_j) + 1/2 q^T P q over all surfaces s of all states.

    The unknowns are theta (n_parameters,), then the mode coefficients q of each state; P is `prior`
    (n_coefficients, n_coefficients), the identity where None. rho: see `Tukey`.
    """

    states: tuple[State, ...]
    modulus_map: ModulusMap
    weighting: tuple[tuple[Weighting, ...], ...]
    prior: NDArray[np.float64] | None = None

    @property
    def n_parameters(self) -> int:
        """Number of moduli among the unknowns."""
        return len(self.modulus_map.tissues)

    @property
    def n_unknowns(self) -> int:
        """Number of all unknowns."""
        return self.n_parameters + sum(state.model.n_modes for state in self.states)

    def coefficients(self, unknowns: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Mode coefficients (n_modes,) of each state."""
        return np.split(unknowns[self.n_parameters :], np.cumsum([s.model.n_modes for s in self.states])[:-1])

    def under(self, models: Sequence[LocalModel]) -> Objective:
        """The same surfaces and weights with other models, one a state, that give all points."""
        pairs = zip(self.states, models, strict=True)
        return replace(self, states=tuple(replace(s, model=m.at(s.dofs)) for s, m in pairs))

    def value(self, unknowns: NDArray[np.float64]) -> float:
        """J alone, for trial steps."""
        total = 0.5 * float(unknowns @ self.prior_precision() @ unknowns)
        for s, displacement in enumerate(self._displacements(unknowns)):
            total += sum(mapped(_misfit, self._surfaces(s, displacement)))
        return total

    def __call__(self, unknowns: NDArray[np.float64]) -> Evaluation:
        """J with gradient, Gauss-Newton matrix and residuals at `unknowns` (n_unknowns,)."""
        prior = self.prior_precision()
        pull = prior @ unknowns
        value, gradient, score, matrix = 0.5 * float(unknowns @ pull), pull.copy(), pull.copy(), prior.copy()
        surfaces = [line for s in range(len(self.states)) for line in self._linearise(s, unknowns)]
        misfit = 0.0
        for line, weighting in zip(surfaces, self._flat_weighting(), strict=True):
            root = np.sqrt(line.precision * line.weights)
            scaled = root[:, None] * line.jacobian
            gradient[line.columns] += line.gradient
            score[line.columns] += scaled.T @ (root * line.residuals.values)
            matrix[np.ix_(line.columns, line.columns)] += scaled.T @ scaled  # of one array: half of a general product
            mean = _mean(line.residuals, weighting.loss)
            misfit += mean / len(surfaces)
            value += 0.5 * line.precision * mean
        return Evaluation(value, misfit, gradient, score, matrix, tuple(surfaces), prior)

    def value_and_gradient(self, unknowns: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """J and its exact gradient (n_unknowns,) by one adjoint solve a state, without the Gauss-Newton system."""
        pull = self.prior_precision() @ unknowns
        value, gradient = 0.5 * float(unknowns @ pull), pull.copy()
        moduli, n = self.modulus_map.moduli(unknowns[: self.n_parameters]), self.n_parameters
        for s, (state, amounts) in enumerate(zip(self.states, self.coefficients(unknowns), strict=True)):
            solution = state.model.solve(moduli, amounts)
            found = mapped(_misfit_and_pull, self._surfaces(s, solution.displacement.ravel()))
            value += sum(misfit for misfit, _ in found)
            by_parameter = solution.adjoint(np.concatenate([force for _, force in found]))
            gradient[:n] += by_parameter[self.modulus_map.columns]
            gradient[self._mode_places(s)] += by_parameter[len(by_parameter) - state.model.n_modes :]
        return value, gradient

    def prior_precision(self) -> NDArray[np.float64]:
        """Precision (n_unknowns, n_unknowns) of all unknowns before the images are seen; none of the log-moduli."""
        n = self.n_unknowns - self.n_parameters
        prior = np.eye(n) if self.prior is None else self.prior
        return np.pad(prior, ((self.n_parameters, 0), (self.n_parameters, 0)))

    def with_fresh_correspondence(self, unknowns: NDArray[np.float64]) -> Objective:
        """Choose anew which image points face the observed part of each surface.

        Raises `EstimationError` when a surface has none left.
        """
        fresh = [
            tuple(
                replace(weighting, held=correspondence(target, motion))
                for target, motion, weighting in self._surfaces(s, displacement)
            )
            for s, displacement in enumerate(self._displacements(unknowns))
        ]
        for state, weightings in zip(self.states, fresh, strict=True):
            for target, weighting in zip(state.targets, weightings, strict=True):
                _refuse_unseen(target, weighting)
        return replace(self, weighting=tuple(fresh))

    def _displacements(self, unknowns: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        moduli = self.modulus_map.moduli(unknowns[: self.n_parameters])
        q = self.coefficients(unknowns)
        return [state.model.solve(moduli, c).displacement.ravel() for state, c in zip(self.states, q, strict=True)]

    def _surfaces(self, state: int, displacement: NDArray[np.float64]) -> list[_Seen]:
        parts = [displacement[rows].reshape(-1, 3) for rows in self.states[state].slices()]
        return list(zip(self.states[state].targets, parts, self.weighting[state], strict=True))

    def _linearise(self, s: int, unknowns: NDArray[np.float64]) -> list[Linearisation]:
        state = self.states[s]
        theta = unknowns[: self.n_parameters]
        solution = state.model.solve(self.modulus_map.moduli(theta), self.coefficients(unknowns)[s])
        tangent = solution.tangent()
        n_regions = tangent.shape[1] - state.model.n_modes
        moved = np.concatenate([self.modulus_map.columns, np.arange(n_regions, tangent.shape[1])])
        columns = np.concatenate([np.arange(self.n_parameters), self._mode_places(s)])

        def line(of: tuple[slice, _Seen]) -> Linearisation:
            """One surface's residuals with their derivative."""
            rows, (target, motion, weighting) = of
            residuals = _weighted(target, motion, weighting)
            by_surface = tangent[rows][:, moved]
            jacobian = np.asarray(residuals.normal_jacobian @ by_surface)
            weights = residuals.weights * weighting.loss.weight(residuals.values)
            gradient = np.asarray(by_surface.T @ _pull(residuals, weighting))
            return Linearisation(residuals, columns, jacobian, weights, weighting.precision, target, gradient, s)

        return mapped(line, zip(state.slices(), self._surfaces(s, solution.displacement.ravel()), strict=True))

    def _mode_places(self, state: int) -> NDArray[np.int64]:
        start = self.n_parameters + sum(s.model.n_modes for s in self.states[:state])
        return np.arange(start, start + self.states[state].model.n_modes)

    def _flat_weighting(self) -> list[Weighting]:
        return [weighting for weightings in self.weighting for weighting in weightings]


_Seen = tuple[SurfaceTarget, NDArray[np.float64], Weighting]  # a surface, its motion (n_vertices, 3) mm, its weights


def _misfit(seen: _Seen) -> float:
    """What a surface adds to the objective, dimensionless."""
    return _share(_weighted(*seen), seen[2])


def _misfit_and_pull(seen: _Seen) -> tuple[float, NDArray[np.float64]]:
    """What a surface adds to the objective, and its derivative (n_dofs,) by the surface's displacement, 1/mm."""
    residuals = _weighted(*seen)
    return _share(residuals, seen[2]), _pull(residuals, seen[2])


def _share(residuals: SurfaceResiduals, weighting: Weighting) -> float:
    return 0.5 * weighting.precision * _mean(residuals, weighting.loss)


def _pull(residuals: SurfaceResiduals, weighting: Weighting) -> NDArray[np.float64]:
    weights = residuals.weights * weighting.loss.weight(residuals.values)
    return np.asarray(residuals.jacobian.T @ (weighting.precision * weights * residuals.values))


def _weighted(target: SurfaceTarget, motion: NDArray[np.float64], weighting: Weighting) -> SurfaceResiduals:
    """Residuals at a motion (n_vertices, 3) mm, weights falling as noise / (noise + terraces) with the same sum."""
    residuals = surface_residuals(target, motion, weighting.held)
    if not np.isfinite(weighting.noise):
        return residuals
    terraces = np.concatenate([target.terraces, weighting.held.terraces[weighting.held.kept]])
    weights = residuals.weights * weighting.noise / (weighting.noise + terraces)
    return replace(residuals, weights=weights * (residuals.weights.sum() / weights.sum()))


def _refuse_unseen(target: SurfaceTarget, weighting: Weighting) -> None:
    if not weighting.held.kept.any():
        raise EstimationError(
            f"'{target.surface.name}': none of the {len(weighting.held.kept)} points of its surface in the later image"
            " faces the observed part of the model; is it the same organ, and do the images lie on each other?"
        )


def _mean(residuals: SurfaceResiduals, loss: Tukey) -> float:
    """Weighted sum of rho(r), mm^2."""
    return float(residuals.weights @ loss.rho(residuals.values))
