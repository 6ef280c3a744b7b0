"""A later image of a body, and the inverse problem that several of them pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from palpate.approximation.contract import Approximation
from palpate.errors import ConfigurationError
from palpate.mechanics.finite_strain import FiniteStrainModel
from palpate.mechanics.forward import ForwardModel
from palpate.mechanics.linear_model import LinearModel
from palpate.observation.contract import Float, Imaged, Observation, OfMaterial, Rematched, n_seen, seen_by
from palpate.observation.noise_model import NoiseModel
from palpate.unknowns.parameters import ParameterMap


@dataclass(frozen=True, slots=True)
class LaterState:
    """One later state of a body: its model, what its image shows, and what stands in for the model.

    model: the body under the linear law; finite_strain: under the law that the estimate is continued to, None where
    that is the linear one; reference: number of the rest state that it belongs to; observed: the approximation's model
    of what is observed alone, one observation after the other; bending: the linear law's approximation, whose
    curvature an expansion under another law lacks; at_rest: modes (n_dofs, m) mm by which the reference image may draw
    the surface of an observation otherwise, by its name.
    """

    model: LinearModel
    observations: tuple[Observation, ...]
    finite_strain: FiniteStrainModel | None = None
    reference: int = 0
    approximation: Approximation | None = field(default=None, repr=False)
    observed: ForwardModel | None = field(default=None, repr=False)
    bending: Approximation | None = field(default=None, repr=False)
    at_rest: Mapping[str, NDArray[np.float64]] = field(default_factory=dict, repr=False)

    @property
    def noise(self) -> dict[str, NoiseModel]:
        """The noise model of each kind of observation."""
        return {observation.kind: observation.noise_model for observation in self.observations}

    @property
    def slices(self) -> list[slice]:
        """Rows of the `observed` answer that belong to each observation."""
        ends = np.cumsum([0, *map(n_seen, self.observations)]).tolist()
        return [slice(start, end) for start, end in pairwise(ends)]

    def seen(self, displacement: NDArray[Float]) -> NDArray[Float]:
        """What is observed (n_observed,) or (n_observed, k) of displacements (n_dof,) or (n_dof, k) mm, in order."""
        return np.concatenate([seen_by(observation, displacement) for observation in self.observations])

    @property
    def motion_mm2(self) -> float:
        """Mean square (mm^2) of how far what is observed lies from where the reference image shows it."""
        found = list[float]()
        for observation in self.observations:
            still = np.zeros(n_seen(observation))
            if isinstance(observation, Rematched):
                residuals = observation.rematched(still, 0.0).residuals(still, 0.0)
                found.append(float(residuals.weights @ residuals.values**2))
        return float(np.mean(found)) if found else 0.0

    def modes_at_rest(
        self, observation: Observation, which: Mapping[str, slice]
    ) -> tuple[slice, NDArray[np.float64]] | None:
        """The modes (n_dofs, m) mm of a surface at rest, and `which` unknowns they are; None where it has none."""
        if observation.name not in which or not isinstance(observation, Imaged):
            return None
        return which[observation.name], self.at_rest[observation.name]

    def combined(
        self,
        boundary: NDArray[np.float64],
        fields: NDArray[np.float64],
        at_rest: Mapping[str, NDArray[np.float64]],
        like: LinearModel | None = None,
    ) -> LaterState:
        """The same state with models on combinations of boundary modes (n_boundary, k) and of fields (n_fields, l).

        at_rest: combinations (m, j) of the modes of surfaces at rest, by their names; like: the model of another state
        of the body on the same combinations, whose modes and material serve again.
        """
        if like is None:
            modes, moved = self.model.constraint.modes, np.flatnonzero(self.model.constraint.modes.any(axis=1))
            combined = np.zeros((len(modes), boundary.shape[1]))
            combined[moved] = modes[moved] @ boundary
            material = self.model.material.combined(fields)
        else:
            combined, material = like.constraint.modes, like.material
        constraint = replace(self.model.constraint, modes=combined)
        conditions = replace(self.model.conditions, constraint=constraint)
        finite = self.finite_strain and replace(self.finite_strain.with_conditions(conditions), material=material)
        model = replace((like or self.model).with_conditions(conditions), material=material)
        seen = tuple(o.combined(fields) if isinstance(o, OfMaterial) else o for o in self.observations)
        drawn = {name: modes @ at_rest[name] for name, modes in self.at_rest.items()}
        return replace(self, model=model, observations=seen, finite_strain=finite, at_rest=drawn)

    def with_approximation(self, approximation: Approximation) -> LaterState:
        """The same state with another approximation of its model."""
        return replace(self, approximation=approximation, observed=approximation.model.outputs(self.seen))

    def with_observations(self, observations: Sequence[Observation]) -> LaterState:
        """The same state with the same observations otherwise weighted or matched."""
        return replace(self, observations=tuple(observations))

    def displacement(self, moduli: NDArray[np.float64], coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (n_points, 3) mm of the whole mesh at moduli (n_regions,) kPa and coefficients (n_modes,).

        Raises `ConfigurationError` while nothing stands in for the model.
        """
        if self.approximation is None:
            raise ConfigurationError("this state has no approximation of its model yet: call `with_approximation`")
        return self.approximation.model.solve(moduli, coefficients).displacement


@dataclass(frozen=True, slots=True)
class InverseProblem:
    """The later states of one patient and the moduli that they share, by `parameters`."""

    states: tuple[LaterState, ...]
    parameters: ParameterMap

    @property
    def finite_strain(self) -> bool:
        """Whether the estimate is continued to a finite-strain law."""
        return all(state.finite_strain is not None for state in self.states)

    def linear(self) -> InverseProblem:
        """The same problem under the linear law."""
        return replace(self, states=tuple(replace(state, finite_strain=None) for state in self.states))
