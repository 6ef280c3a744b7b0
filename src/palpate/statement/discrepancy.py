"""What the estimate found of effects beside the moduli: motion of the frame, offset surfaces, inhomogeneity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.findings import Finding
from palpate.images.checks import later_names
from palpate.inversion import Inversion
from palpate.mechanics.finite_strain import NEARLY_INCOMPRESSIBLE
from palpate.mesh.surface import cut_faces
from palpate.uncertainty import NORMAL_95, FittedState
from palpate.unknowns import Acts, Choice, in_series

TOLD = 2.0  # standard deviations, above which an offset is reported in words
LEAST_TOLD_MM = 0.1


@dataclass(frozen=True, slots=True)
class FrameFound:
    """Motion of the frame, the body's faces on the image's cut, in one later state: root mean square and largest, mm.

    prior_mm: learned standard deviation of each component of its smooth part.
    """

    rms_mm: float
    largest_mm: float
    prior_mm: float


@dataclass(frozen=True, slots=True)
class OffsetFound:
    """How much further out (mm) a tissue's surface is drawn in a later image, with a 95 % interval."""

    tissue: str
    state: int
    mm: float
    interval95: tuple[float, float]

    @property
    def told(self) -> bool:
        """Whether it is so much larger than its own uncertainty that it is a warning."""
        sd = (self.interval95[1] - self.interval95[0]) / (2.0 * NORMAL_95)
        return abs(self.mm) > max(TOLD * sd, LEAST_TOLD_MM)


@dataclass(frozen=True, slots=True)
class HeterogeneityFound:
    """Standard deviation of ln E inside a tissue: learned, and what it is in a patchy one."""

    tissue: str
    sd: float
    prior: float


@dataclass(frozen=True, slots=True)
class LayerFound:
    """Ratio of the stiffness of a layer around an organ to that of the tissue it belongs to, with a 95 % interval."""

    tissue: str
    ratio: float
    interval95: tuple[float, float]

    @property
    def told(self) -> bool:
        """Whether it differs from its tissue by so much more than its own uncertainty."""
        low, high = np.log(self.interval95)
        return abs(float(np.log(self.ratio))) > TOLD * float(high - low) / (2.0 * NORMAL_95)


@dataclass(frozen=True, slots=True)
class PoissonRatioFound:
    """Poisson's ratio of a tissue, dimensionless: as stated, and as fitted beside the moduli, with its sd.

    pair: number of the image pair, from 1; each has its own fit.
    """

    tissue: str
    pair: int
    stated: float
    fitted: float
    sd: float


@dataclass(frozen=True, slots=True)
class FoundDiscrepancy:
    """All of it: the frame of each later state (None: it is held), offsets, tissues that are not homogeneous.

    layers: round organs, none where the estimate takes them for their tissue; poisson_ratios: of tissues whose ratio
    the case gives, none where that is held.
    """

    frame: tuple[FrameFound | None, ...] = ()
    offsets: tuple[OffsetFound, ...] = ()
    heterogeneity: tuple[HeterogeneityFound, ...] = ()
    layers: tuple[LayerFound, ...] = ()
    poisson_ratios: tuple[PoissonRatioFound, ...] = ()


@dataclass(frozen=True, slots=True)
class FittedMaterial:
    """How the elements of a body differ from homogeneous tissues in an estimate.

    log_ratio (n_tets,): ln E of each over that of its tissue; poisson_shifts: by tissue, of a given Poisson's ratio.
    """

    log_ratio: NDArray[np.float64]
    poisson_shifts: Mapping[str, float]


def fitted_materials(inversion: Inversion) -> tuple[FittedMaterial, ...]:
    """The material of the best minimum, one for each later state."""
    parameters, found = inversion.objective.parameters, list[FittedMaterial]()
    unknowns = inversion.minimum.unknowns
    coefficients, blocks = parameters.coefficients(unknowns), enumerate(parameters.blocks)
    layers = [(b, unknowns[parameters.columns(i)]) for i, b in blocks if b.choice is Choice.LAYERS]
    sought = {block.of for block in parameters.blocks if block.sought}
    for state, of_state in zip(inversion.objective.states, coefficients, strict=True):
        mesh, material = state.model.space.mesh, state.model.material
        own = of_state[state.model.constraint.n_modes :]
        logs = np.log(material.scale(own)) if material.fields.shape[1] else np.zeros(len(mesh.tets))
        for block, x in layers:
            inside = np.isin(mesh.region, [state.model.regions[region] for region in block.regions])
            logs[inside] += in_series(x, np.array([block.share]))
        shifts = {mesh.tissues[number].name: shift for number, shift in material.poisson_shifts(own).items()}
        found.append(FittedMaterial(logs, {name: shift for name, shift in shifts.items() if name not in sought}))
    return tuple(found)


def discrepancy_of(inversion: Inversion, states: Sequence[FittedState]) -> FoundDiscrepancy:
    """What the blocks of unknowns of a converged inversion say, with the fitted later states."""
    parameters, unknowns = inversion.objective.parameters, inversion.minimum.unknowns
    offsets, heterogeneity, layers = list[OffsetFound](), list[HeterogeneityFound](), list[LayerFound]()
    smooth, ratios, pair = dict[int, float](), list[PoissonRatioFound](), 0
    eliminated = inversion.minimum.evaluation.matrix.eliminated()

    def variances(own: NDArray[np.int64]) -> NDArray[np.float64]:
        """Posterior variances (n,) of unknowns with these numbers (n,)."""
        return np.diag(eliminated.inverse_among(own))

    for number, block in enumerate(parameters.blocks):
        own = parameters.columns(number)
        learned = float(np.sqrt(np.mean(np.diag(parameters.priors[number].covariance)))) if block.size else 0.0
        if block.acts is Acts.RESIDUALS and block.choice is not Choice.NONE:
            variance = block.widest[0, 0] if block.choice is Choice.HELD else variances(own)[0]
            value, half = float(unknowns[own[0]]), NORMAL_95 * float(np.sqrt(variance))
            offsets.append(OffsetFound(block.of, block.states[0], value, (value - half, value + half)))
        elif block.choice is Choice.PATCHINESS and not block.mapped:
            patchy = block.alternatives[1].covariance  # the first is nearly homogeneous, the last very patchy
            heterogeneity.append(HeterogeneityFound(block.of, learned, float(np.sqrt(np.mean(np.diag(patchy))))))
        elif block.choice is Choice.LAYERS and inversion.mixture.explanations[0].chosen.get(number):
            x, half = float(unknowns[own[0]]), NORMAL_95 * float(np.sqrt(variances(own)[0]))
            low, ratio, high = np.exp([x - half, x, x + half]).tolist()
            layers.append(LayerFound(block.of, ratio, (low, high)))
        elif block.acts is Acts.MATERIAL and block.choice is Choice.NONE and not block.sought:
            pair += 1
            model = inversion.objective.states[block.states[0]].model
            found = zip(model.material.poisson, unknowns[own].tolist(), variances(own).tolist(), strict=False)
            for group, shift, variance in found:  # the layers of a tissue have its ratio
                tissue = model.space.mesh.tissues[group[0]]
                fitted = min(tissue.poisson_ratio + shift, NEARLY_INCOMPRESSIBLE)
                sd = float(np.sqrt(variance))
                ratios.append(PoissonRatioFound(tissue.name, pair, tissue.poisson_ratio, fitted, sd))
        elif block.choice is Choice.FRAME:
            smooth.setdefault(block.states[0], learned * block.unit_mm)
    frames = list[FrameFound | None]([None] * len(states))
    for s, prior_mm in smooth.items():
        points = np.unique(states[s].space.facets(cut_faces(states[s].space.mesh)))
        motion = np.linalg.norm(states[s].displacement[points], axis=1) if len(points) else np.zeros(1)
        frames[s] = FrameFound(float(np.sqrt(np.mean(motion**2))), float(motion.max()), prior_mm)
    return FoundDiscrepancy(tuple(frames), tuple(offsets), tuple(heterogeneity), tuple(layers), tuple(ratios))


def discrepancy_findings(found: FoundDiscrepancy) -> tuple[Finding, ...]:
    """A finding for each surface that is drawn differently in a later image, and for each layer around an organ."""
    findings = []
    names = later_names(1 + max((offset.state for offset in found.offsets), default=0))
    for offset in found.offsets:
        if offset.told:
            image = f"in '{names[offset.state]}'"
            text = (
                f"The surface of '{offset.tissue}' {image} lies {abs(offset.mm):.2g} mm further"
                f" {'out' if offset.mm > 0.0 else 'in'} than its motion explains (95 % interval:"
                f" {offset.interval95[0]:.2g} to {offset.interval95[1]:.2g} mm). The estimate allows for it; to be"
                " sure, draw it in the same way in both images."
            )
            findings.append(Finding("drawn-otherwise", text, offset.tissue, f"{image} ({offset.mm:+.2g} mm)"))
    for layer in found.layers:
        if layer.told:
            low, high = layer.interval95
            text = (
                f"The data fit better with a layer around '{layer.tissue}' that is {layer.ratio:.2g} times as stiff as"
                f" the tissue it belongs to ({low:.2g} to {high:.2g}), such as fat, a capsule or a sliding plane. The"
                " estimate includes it: do not compare the modulus with one from a model without it."
            )
            findings.append(Finding("layer", text))
    return tuple(findings)
