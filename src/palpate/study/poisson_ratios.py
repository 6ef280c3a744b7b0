"""Poisson's ratios as unknowns beside the moduli: what a case believes of them, and what is stated of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from palpate.mesh.space import LagrangeSpace
from palpate.study.case import Case
from palpate.study.case_tissue import RATIO_SD
from palpate.uncertainty import Interval
from palpate.unknowns import ParameterMap, eta_of_ratio

NOT_IDENTIFIED = "not identified"  # the verdict of what has no interval
IDENTIFIED, WEAK = 0.05, 0.2  # largest width of an interval; soft tissue is usually given 0.40 to 0.49
BELIEVED = 0.8  # of the prior's standard deviation: a larger one shows that the data say nothing


@dataclass(frozen=True, slots=True)
class PoissonRatioEstimate:
    """Poisson's ratio of one tissue, dimensionless, with its 95 % interval; None of what is not identified.

    value: None when nothing converged; variance_shares: of each cause in the variance of eta = ln(lambda / mu);
    profile: ratios with their signed root deviances.
    """

    tissue: str
    value: float | None
    interval95: Interval | None
    interval_kind: str
    verdict: str
    why: str
    variance_shares: Mapping[str, float] | None = None
    profile: tuple[tuple[float, float], ...] = ()


def no_ratio(tissue: str, *, why: str) -> PoissonRatioEstimate:
    """The entry of a tissue when nothing converged: no value that could be taken for a result."""
    return PoissonRatioEstimate(tissue, None, None, "linearised", NOT_IDENTIFIED, why)


def with_stated_priors(parameters: ParameterMap, case: Case) -> ParameterMap:
    """The map with what the case believes of Poisson's ratios: eta normal about that of the tissue's poisson_ratio.

    Its standard deviation is poisson_ratio_sd |d eta / d nu| = poisson_ratio_sd / (nu (1 - 2 nu)) there.
    """
    believed = {tissue.name: tissue.poisson_ratio_sd or RATIO_SD for tissue in case.tissues}
    mean, sd = np.zeros(parameters.n_parameters), np.full(parameters.n_parameters, np.inf)
    for open_ in parameters.poisson:
        mean[open_.column] = eta_of_ratio(open_.given)
        sd[open_.column] = believed.get(open_.tissue, RATIO_SD) / (open_.given * (1.0 - 2.0 * open_.given))
    return parameters.with_prior(mean, sd)


def ratio_verdict(interval: Interval, *, at_bound: bool, of_prior: float) -> tuple[str, str]:
    """Verdict and its reason from the interval of a Poisson's ratio.

    `identified`: closed and no wider than 0.05; `weak`: closed and no wider than 0.2; `not identified`: an open end, a
    bound, wider, or `of_prior`, the standard deviation over that of a stated prior, at least 0.8.
    """
    low, high = interval
    if at_bound:
        return NOT_IDENTIFIED, "the estimate lies at the end of the search; the images do not hold it back"
    if of_prior >= BELIEVED:
        return NOT_IDENTIFIED, "the interval is that of the stated prior: the images add little to it"
    if low is None or high is None:
        return NOT_IDENTIFIED, "the 95 % interval is open: it reaches beyond the ends of the search"
    width = f"the 95 % interval is {high - low:.2g} wide"
    if high - low > WEAK:
        return NOT_IDENTIFIED, width
    if high - low > IDENTIFIED:
        return "weak", f"{width}; a larger motion, or poisson_ratio_sd where something is known, narrows it"
    return "identified", width


def with_found_ratios(space: LagrangeSpace, estimates: Sequence[PoissonRatioEstimate]) -> LagrangeSpace:
    """The same space on a mesh whose tissues have the Poisson's ratios that were found."""
    found = {item.tissue: item.value for item in estimates if item.value is not None}
    tissues = (replace(t, poisson_ratio=found.get(t.name, t.poisson_ratio)) for t in space.mesh.tissues)
    return replace(space, mesh=replace(space.mesh, tissues=tuple(tissues))) if found else space
