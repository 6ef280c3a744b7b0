"""What is found by one estimate, as values: moduli with interval and verdict, every start, the fit of what was seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from palpate.body.poisson_ratios import NOT_IDENTIFIED, PoissonRatioEstimate
from palpate.findings import Finding
from palpate.inversion import EarlierImages
from palpate.observation.contract import Fit, PointMotions
from palpate.statement.discrepancy import FittedMaterial, FoundDiscrepancy
from palpate.statement.image_pairs import ImagePairs
from palpate.statement.joint import ModulusRegion
from palpate.statement.samples import ModulusSamples
from palpate.statement.variations import Variation
from palpate.uncertainty import Combination, Covariance, Information, Interval, StiffnessMap


@dataclass(frozen=True, slots=True)
class Iteration:
    """One step of one start: misfit (mm^2), moduli (kPa, or ratios), and the decrement still promised."""

    objective_mm2: float
    moduli: Mapping[str, float]
    decrement: float


@dataclass(frozen=True, slots=True)
class Start:
    """What one start did alone: moduli (kPa, or ratios) it began and ended with, its steps and how they ended.

    minimum: number, from 0, of the distinct minimum that it leads to; None where that was not followed, others being
    lower.
    """

    start: Mapping[str, float]
    end: Mapping[str, float]
    objective_mm2: float
    status: str
    reason: str
    minimum: int | None
    history: tuple[Iteration, ...]

    @property
    def iterations(self) -> int:
        """Number of accepted points."""
        return len(self.history)


@dataclass(frozen=True, slots=True)
class ModulusEstimate:
    """Young's modulus of one tissue, in `unit` (kPa, or a ratio to `relative_to`), with its 95 % interval.

    interval95: with all discrepancies of the model as unknowns, layers too; the verdict follows from it;
    interval95_given_model: what would be left if the model held. None: no interval is stated, as of every modulus that
    is not identified; `value` is None in ratio mode and when nothing converged. variance_shares: of each cause in the
    variance of ln E; profile: values (kPa, or ratios) with their signed root deviances.
    """

    tissue: str
    unit: str
    value: float | None
    interval95: Interval | None
    interval_kind: str
    relative_to: str
    ratio: float | None
    ratio_interval95: Interval | None
    verdict: str
    why: str
    truth: float | None = None
    parameter: str = "youngs_modulus"
    variance_shares: Mapping[str, float] | None = None
    profile: tuple[tuple[float, float], ...] = ()
    interval95_given_model: Interval | None = None


@dataclass(frozen=True, slots=True)
class TissueFit:
    """Fit of one observation in one later image, before and after the estimation; `tissue`: its name."""

    tissue: str
    start: Fit
    end: Fit
    observed_share: float


@dataclass(frozen=True, slots=True)
class ForceFit:
    """A measured and the fitted force of a later state (its number, from 0), N, with its standard deviation."""

    name: str
    state: int
    measured_n: float
    fitted_n: float
    sd_n: float


@dataclass(frozen=True, slots=True)
class PointFit:
    """Points whose motion was measured in a later state (its number, from 0), beside the fitted model's.

    misfit: root mean square of the residuals that count, over the standard deviation stated, dimensionless.
    """

    name: str
    state: int
    motions: PointMotions
    misfit: float


@dataclass(frozen=True, slots=True)
class StatedExplanation:
    """One of the explanations of all later images: its probability, and the moduli (kPa, or ratios) under it.

    scenario: of all tissues and of the frame, in words; images: which surfaces each later one draws otherwise.
    """

    scenario: tuple[str, ...]
    images: tuple[tuple[str, ...], ...]
    probability: float
    moduli: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Estimation:
    """Result of one inversion.

    estimates: of the moduli; poisson_ratios: of those that were sought beside them; covariance: of the log-moduli;
    with_ratios: of these and then of the ratios under the likeliest explanation, None where none is sought; fits:
    the tissues of each later image; displacements: (n_points, 3) mm of each later image;
    outer_loop: the steps from the best start's minimum to the estimate, which all starts of that minimum share;
    counts: of all starts and minima together; observations: what was compared, in words, by its kind; information: the
    directions of the log-moduli by how well they are known; information_shares: by tissue, of each kind of data, and of
    what was believed before; discrepancy: what the images say of frame, drawing and material; combinations: what is
    known where single moduli are not; regions: joint ones of two moduli; forces, points: measured and fitted;
    image_pairs: what each of several later images says alone; samples: of the moduli's posterior,
    where the case asks for them and the estimate converged; variations: what would change the answer; maps: of tissues
    whose modulus is a field; materials: of the elements, one for each later state;
    images: what they tell, for others that are added;
    explanations: the likelier ones of those of which the posterior is a mixture.
    """

    status: str
    reason: str
    estimates: tuple[ModulusEstimate, ...]
    covariance: Covariance
    starts: tuple[Start, ...]
    fits: tuple[tuple[TissueFit, ...], ...]
    displacements: tuple[NDArray[np.float64], ...]
    counts: Mapping[str, int]
    outer_loop: tuple[Iteration, ...] = ()
    remarks: tuple[Finding, ...] = ()
    observations: Mapping[str, str] = field(default_factory=dict)
    information: Information | None = None
    information_shares: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    combinations: tuple[Combination, ...] = ()
    discrepancy: FoundDiscrepancy = field(default_factory=FoundDiscrepancy)
    regions: tuple[ModulusRegion, ...] = ()
    image_pairs: ImagePairs | None = None
    samples: ModulusSamples | None = None
    poisson_ratios: tuple[PoissonRatioEstimate, ...] = ()
    with_ratios: Covariance | None = None
    forces: tuple[ForceFit, ...] = ()
    points: tuple[PointFit, ...] = ()
    variations: tuple[Variation, ...] = ()
    maps: tuple[StiffnessMap, ...] = ()
    materials: tuple[FittedMaterial, ...] = ()
    images: EarlierImages | None = None
    explanations: tuple[StatedExplanation, ...] = ()

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Correlation (n, n) of the log-moduli, then of the Poisson's ratios that are sought, dimensionless."""
        own = self.covariance.correlation
        found = own if self.with_ratios is None else self.with_ratios.correlation
        found[: len(own), : len(own)] = own
        return found

    @property
    def found_ratios(self) -> dict[str, float]:
        """The Poisson's ratios that were sought, by their tissue, as far as there are any."""
        return {of.tissue: of.value for of in self.poisson_ratios if of.value is not None}


def no_estimate(
    tissue: str, *, absolute: bool, relative_to: str, why: str, truth: float | None = None
) -> ModulusEstimate:
    """The entry of a tissue when nothing converged: no value that could be taken for a result."""
    return ModulusEstimate(
        tissue=tissue,
        unit="kPa" if absolute else "ratio",
        value=None,
        interval95=None,
        interval_kind="linearised",
        relative_to=relative_to,
        ratio=None,
        ratio_interval95=None,
        verdict=NOT_IDENTIFIED,
        why=why,
        truth=truth,
    )
