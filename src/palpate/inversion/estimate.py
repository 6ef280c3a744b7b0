"""From models and observations to the moduli that explain the later images: start, starts, continuation, comparison."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError
from palpate.inversion.candidates import Inversion, concluded
from palpate.inversion.continuation import continued
from palpate.inversion.later_state import InverseProblem
from palpate.inversion.objective import Objective
from palpate.inversion.optimise import Bounds, Minimum
from palpate.inversion.starts import from_starts, informed_start
from palpate.inversion.trust_region import NEAR, REPORTED, StopRule, minimised
from palpate.parallel import blas_on_one_thread
from palpate.progress import Line, Progress, during


@dataclass(frozen=True, slots=True)
class InversionSettings:
    """Starts theta (n_parameters,) each, and their bounds; the first minimum is sought from their `centre`."""

    starts: tuple[NDArray[np.float64], ...]
    bounds: Bounds
    further: tuple[NDArray[np.float64], ...] = ()

    @property
    def every_start(self) -> tuple[NDArray[np.float64], ...]:
        """All starts (n_parameters,), the further ones last."""
        return self.starts + self.further

    @property
    def centre(self) -> NDArray[np.float64]:
        """Theta (n_parameters,) at the middle of the bounds, or at the end of the starts' range nearest to it.

        Two sets of starts about it are judged from one minimum, of one problem.
        """
        starts = np.stack(self.starts)
        return np.clip(0.5 * (self.bounds.lower + self.bounds.upper), starts.min(axis=0), starts.max(axis=0))


@blas_on_one_thread()
def invert(
    problem: InverseProblem, settings: InversionSettings, *, progress: Progress, rule: StopRule = REPORTED
) -> Inversion:
    """Estimate log-moduli and drivers' motion together, from all starts, with the linear law first.

    States that bring an approximation are estimated on it; for the others a reduced basis is made at the middle of the
    bounds and extended where the estimate goes. rule: when the estimate ends; a linear one that another law follows
    ends near. At last blocks that were fixed are free, see `ended`.
    Raises `ConfigurationError` for an unknown Poisson's ratio with another law, `EstimationError`s of solving; an
    estimate that did not converge says so in its minimum's outcome.
    """
    if problem.finite_strain and problem.parameters.poisson:
        raise ConfigurationError(
            "a Poisson's ratio can be estimated under the linear law only, as finite-strain models keep those of the"
            " tissues; estimate none, or leave out the states' `finite_strain` models (`InverseProblem.linear`)"
        )
    bounds = settings.bounds
    minima, runs, rest = from_starts(problem, settings.centre, settings.every_start, bounds, progress=progress)
    if problem.finite_strain:
        best = minima[0].objective.parameters.in_words(minima[0].minimum.unknowns)
        progress(Line(f"{best} by the linear law; now at finite strain", "check the law"))
        progress = during("check the law", progress)
    ends = continued(minima, bounds, rule=rule, progress=progress)
    return concluded(ends, runs, rest, bounds)


@blas_on_one_thread()
def first_noise_of(
    problem: InverseProblem, settings: InversionSettings, *, progress: Progress
) -> tuple[Objective, Minimum]:
    """What an estimate begins with under the linear law: the objective under the noise that the images show, and where.

    Its minimum is the first one, and no estimate: no start was tried. Raises as `invert` does.
    """
    start = informed_start(problem.linear(), settings.centre, progress=progress)
    nearby = minimised(start, settings.bounds, NEAR, progress=progress, title="the first minimum")
    return nearby.objective, nearby.minimum
