"""Poisson's ratios as unknowns beside the moduli: what a case believes of them, and what is stated of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from palpate.case.case import Case
from palpate.images.tissue import Role, Tissue
from palpate.inversion import Inversion
from palpate.mesh.space import LagrangeSpace
from palpate.uncertainty import NORMAL_95, Covariance, Interval

NOT_IDENTIFIED = "not identified"  # the verdict of what has no interval
IDENTIFIED, WEAK = 0.05, 0.2  # largest width of an interval; soft tissue is usually given 0.40 to 0.49
BELIEVED = 0.8  # of the prior's standard deviation: a larger one shows that the data say nothing
WIDE = (0.05, 0.499)  # two standard deviations of a prior that is not stated
SETTLED, UNTOLD = 0.1, 0.5  # standard deviations to the model's ratio where its responses hold; if the data say nothing
STEP = 2.0  # of eta: longest way from the ratio of a model to that of the next
MODELS = (0.02, 0.4995)  # between which models are made


@dataclass(frozen=True, slots=True)
class PoissonRatioEstimate:
    """Poisson's ratio of one tissue, dimensionless, with its 95 % interval; None of what is not identified.

    value: None when nothing converged; variance_shares: of each cause in the variance of eta = ln(lambda / mu).
    """

    tissue: str
    value: float | None
    interval95: Interval | None
    verdict: str
    why: str
    variance_shares: Mapping[str, float] | None = None


def no_ratio(tissue: str, *, why: str) -> PoissonRatioEstimate:
    """The entry of a tissue when nothing converged: no value that could be taken for a result."""
    return PoissonRatioEstimate(tissue, None, None, NOT_IDENTIFIED, why)


def eta_of_ratio(ratio: float) -> float:
    """Eta = ln(lambda / mu) = ln(2 nu / (1 - 2 nu)) of a Poisson's ratio nu between 0 and 0.5."""
    return float(np.log(2.0 * ratio / (1.0 - 2.0 * ratio)))


def ratio_of_eta(eta: float) -> float:
    """Poisson's ratio nu = 1/2 e^eta / (1 + e^eta) of eta = ln(lambda / mu)."""
    return float(0.5 / (1.0 + np.exp(-eta)))


def eta_slope(ratio: float) -> float:
    """Derivative d eta / d nu = 1 / (nu (1 - 2 nu)) at a Poisson's ratio nu."""
    return 1.0 / (ratio * (1.0 - 2.0 * ratio))


def sought_priors(given: Sequence[Tissue], made: Sequence[Tissue], case: Case) -> tuple[tuple[str, float, float], ...]:
    """Of each tissue whose Poisson's ratio the case seeks its name, and mean and standard deviation of the unknown.

    The unknown x moves eta = ln(lambda / mu) by x d eta / d nu from the ratio with which the model is `made`, the ratio
    to first order by x. Eta is normal about that of the `given` ratio, with the width that is stated of this, or so
    wide that two standard deviations reach 0.05 and 0.499.
    """
    if not case.estimate.seeks_poisson_ratios:
        return ()
    stated, ratios = {t.name: t.poisson_ratio_sd for t in case.tissues}, {t.name: t.poisson_ratio for t in given}
    found = list[tuple[str, float, float]]()
    for tissue in (tissue for tissue in made if tissue.role is Role.ESTIMATE):
        ratio, sd, slope = ratios[tissue.name], stated.get(tissue.name), eta_slope(tissue.poisson_ratio)
        eta = eta_of_ratio(ratio)
        wide = 0.5 * max(abs(eta_of_ratio(end) - eta) for end in WIDE)
        width = wide if sd is None else sd * eta_slope(ratio)
        found.append((tissue.name, (eta - eta_of_ratio(tissue.poisson_ratio)) / slope, width / slope))
    return tuple(found)


@dataclass(frozen=True, slots=True)
class SoughtRatio:
    """The Poisson's ratio of a tissue in an inversion: that of the `model`, and the eta = ln(lambda / mu) found there.

    sd, prior_sd: standard deviations of eta, posterior and prior.
    """

    tissue: str
    model: float
    eta: float
    sd: float
    prior_sd: float

    @property
    def settled(self) -> bool:
        """Whether the model has nearly the ratio that is found; if the data say little of it, not far from it."""
        near = SETTLED if self.sd < BELIEVED * self.prior_sd else UNTOLD
        return abs(self.eta - eta_of_ratio(self.model)) < near * self.sd

    @property
    def next_model(self) -> float:
        """The ratio with which the model is made again."""
        here = eta_of_ratio(self.model)
        return float(np.clip(ratio_of_eta(here + np.clip(self.eta - here, -STEP, STEP)), *MODELS))


def sought_ratios(inversion: Inversion) -> tuple[SoughtRatio, ...]:
    """Those that a converged inversion seeks."""
    parameters, unknowns, found = inversion.objective.parameters, inversion.minimum.unknowns, list[SoughtRatio]()
    made = {t.name: t.poisson_ratio for t in inversion.objective.states[0].model.space.mesh.tissues}
    for i, block in ((i, block) for i, block in enumerate(parameters.blocks) if block.sought):
        number, model = int(parameters.columns(i)[0]), made[block.of]
        slope, prior_sd = eta_slope(model), float(np.sqrt(block.widest[0, 0]))
        variance = float(inversion.minimum.evaluation.covariance_columns(number + 1)[number, number])
        eta = eta_of_ratio(model) + slope * float(unknowns[number])
        sd = slope * float(np.sqrt(variance))
        found.append(SoughtRatio(block.of, model, eta, sd, slope * prior_sd))
    return tuple(found)


def ratio_verdict(interval: tuple[float, float], *, settled: bool, of_prior: float) -> tuple[str, str]:
    """Verdict and its reason from the interval of a Poisson's ratio.

    `identified`: no wider than 0.05; `weak`: no wider than 0.2; `not identified`: wider, not `settled`, or `of_prior`,
    the standard deviation over that of the prior, at least 0.8.
    """
    low, high = interval
    if of_prior >= BELIEVED:
        return NOT_IDENTIFIED, "the interval is that of the stated prior; the data add little to it"
    if not settled:
        return NOT_IDENTIFIED, "models made again at the found ratio lead to another one; state a narrower prior"
    width = f"the 95 % interval is {high - low:.2g} wide"
    if high - low > WEAK:
        return NOT_IDENTIFIED, width
    if high - low > IDENTIFIED:
        return "weak", f"{width}; a larger motion, or a known poisson_ratio_sd, narrows it"
    return "identified", width


def ratios_of(inversion: Inversion, covariance: Covariance) -> tuple[PoissonRatioEstimate, ...]:
    """What is stated of the Poisson's ratios that are sought, eta = ln(lambda / mu) being normal.

    covariance: of the parameters, then of the unknowns of these ratios (see `covariance_of`).
    """
    parameters, found = inversion.objective.parameters, list[PoissonRatioEstimate]()
    if not inversion.minimum.converged:
        return tuple(no_ratio(block.of, why=not_converged(inversion)) for block in parameters.blocks if block.sought)
    for i, of in enumerate(sought_ratios(inversion), start=parameters.n_parameters):
        sd = max(of.sd, eta_slope(of.model) * float(np.sqrt(covariance.total[i, i])))
        low, high = (ratio_of_eta(of.eta + half * sd) for half in (-NORMAL_95, NORMAL_95))
        word, why = ratio_verdict((low, high), settled=of.settled, of_prior=sd / of.prior_sd)
        stated, shares = None if word == NOT_IDENTIFIED else (low, high), covariance.shares(i)
        found.append(PoissonRatioEstimate(of.tissue, ratio_of_eta(of.eta), stated, word, why, shares))
    return tuple(found)


def not_converged(inversion: Inversion) -> str:
    """Why nothing is stated of an inversion that did not converge."""
    return f"the estimation did not converge: {inversion.minimum.outcome.value}"


def with_ratios(space: LagrangeSpace, ratios: Mapping[str, float]) -> LagrangeSpace:
    """The same space on a mesh whose tissues have these Poisson's ratios, by their names."""
    tissues = tuple(replace(t, poisson_ratio=ratios.get(t.name, t.poisson_ratio)) for t in space.mesh.tissues)
    return replace(space, mesh=replace(space.mesh, tissues=tissues))
