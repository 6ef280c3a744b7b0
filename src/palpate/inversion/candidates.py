"""Of the minima that all starts lead to the distinct ones, and the best one of them under one objective."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from palpate.inversion.continuation import Candidate
from palpate.inversion.objective import Evaluation, Objective
from palpate.inversion.optimise import Bounds, Minimum, grouped
from palpate.inversion.starts import COMPARED, StartRun
from palpate.inversion.trust_region import Convergence, OuterIterate, begun, minimised, with_fewest
from palpate.mechanics.forward import SolveCounts
from palpate.progress import silent


@dataclass(frozen=True, slots=True)
class Inversion:
    """The distinct minima, the number of the best one, every start, and the evaluation at no motion (`rest`).

    evaluations, counts: of everything that was followed to find and compare them, not of the best one alone.
    """

    candidates: tuple[Candidate, ...]
    best: int
    starts: tuple[StartRun, ...]
    rest: Evaluation
    evaluations: int
    counts: SolveCounts

    @property
    def objective(self) -> Objective:
        """The objective of the best minimum, with its approximations and noise models."""
        return self.candidates[self.best].iterate.objective

    @property
    def minimum(self) -> Minimum:
        """The best minimum; its history is that of the outer loop that all of its starts share."""
        return self.candidates[self.best].minimum

    @property
    def released(self) -> OuterIterate | None:
        """The best minimum followed on with those blocks free that were fixed (see `Candidate`)."""
        return self.candidates[self.best].released

    @property
    def unsettled(self) -> str:
        """Why that did not end (see `Candidate`)."""
        return self.candidates[self.best].unsettled

    @property
    def convergence(self) -> Convergence:
        """What the best minimum's last outer iteration left unmet."""
        return self.candidates[self.best].iterate.convergence


def concluded(ends: Sequence[Candidate], starts: Sequence[StartRun], rest: Evaluation, bounds: Bounds) -> Inversion:
    """The distinct ones of minima as they ended, the one followed first foremost, with J at each.

    Where there are several all have the same numbers of independent residuals (see `with_fewest`), and hyper-parameters
    at their best.
    """
    n = ends[0].iterate.objective.n_parameters
    groups = grouped([end.minimum for end in ends], n)

    def rank(i: int) -> tuple[bool, bool, int]:
        """Which minimum represents its group: the one that was followed first, else one that converged."""
        return i != 0, not ends[i].minimum.converged, i

    of_group = [[i for i, of in enumerate(groups) if of == group] for group in range(max(groups) + 1)]
    distinct = [ends[min(own, key=rank)] for own in of_group]
    candidates, evaluations = list[Candidate](), 1 + sum(end.last.minimum.evaluations for end in ends)
    fewest = with_fewest([candidate.iterate for candidate in distinct]).objective
    for candidate in distinct if len(distinct) > 1 else []:
        begin = begun(candidate.iterate.objective.counted_as(fewest), candidate.minimum.unknowns)
        end = minimised(begin, bounds, COMPARED, progress=silent, title="compared")
        candidates.append(replace(candidate, value=end.objective.total(end.minimum.evaluation)))
        evaluations += end.minimum.evaluations
    candidates = candidates or distinct
    usable = [c.value if c.minimum.converged else np.inf for c in candidates]
    best = int(np.argmin(usable)) if np.isfinite(usable).any() else 0
    runs = tuple(s if s.candidate is None else replace(s, candidate=groups[s.candidate]) for s in starts)
    counts = sum((end.last.counts for end in ends), SolveCounts())
    return Inversion(tuple(candidates), best, runs, rest, evaluations, counts)
