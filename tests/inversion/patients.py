"""Patients without a mesh: two moduli, known responses, and numbers read off one or more later images."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from types import SimpleNamespace

import numpy as np
from scipy import linalg, sparse

from palpate.inversion import (
    Bounds,
    InverseProblem,
    InversionSettings,
    LaterState,
    Objective,
    alternatives_of,
    scenarios_of,
)
from palpate.mechanics.first_order import FirstOrderModel, expanded
from palpate.mechanics.forward import DenseEquilibrium, SolveCounts
from palpate.observation.contract import Residuals, Weighting
from palpate.observation.noise_model import NoiseModel
from palpate.observation.robust_loss import PowerLaw
from palpate.unknowns import Acts, Alternative, Block, Choice, ParameterMap, reference_block

ORGANS = ("gland", "sac")
N_READ, N_FRAME, N_FIELD = 9, 2, 2  # of each organ in an image; unknowns of a frame, and of a tissue's field
SD = 0.1  # of a reading
WIDE = Bounds(np.full(2, -4.0), np.full(2, 4.0))


@dataclass(frozen=True)
class Response:
    """Outputs u = T [ln E, q] + 1/2 B (ln E)^2: T (n, n_regions + n_modes), B (n, n_regions), 0 of a linear body."""

    slopes: np.ndarray
    bends: np.ndarray
    n_boundary: int

    @property
    def n_regions(self):
        return self.bends.shape[1]

    @property
    def n_modes(self):
        return self.slopes.shape[1] - self.n_regions

    @property
    def constraint(self):
        return SimpleNamespace(n_modes=self.n_boundary)

    def outputs(self, seen):
        return replace(self, slopes=seen(self.slopes), bends=seen(self.bends))

    def solve(self, moduli, coefficients):
        changes = np.log(moduli)
        values = self.slopes @ np.concatenate([changes, coefficients]) + 0.5 * self.bends @ changes**2
        tangent = self.slopes.copy()
        tangent[:, : self.n_regions] += self.bends * changes
        return Answer(values, tangent)


@dataclass(frozen=True)
class Answer(DenseEquilibrium):
    """What a body answers at one place, an `Equilibrium`."""

    values: np.ndarray
    slopes: np.ndarray

    def tangent(self):
        return self.slopes.copy()


@dataclass(frozen=True)
class Expanded:
    """A body to first order around one place, an `Approximation`."""

    body: Response
    model: FirstOrderModel
    counts: SolveCounts = field(default_factory=SolveCounts)
    trust_radius: float = np.inf

    @classmethod
    def update_all(cls, each, points):
        return [one.update(at) for one, at in zip(each, points, strict=True)]

    def update(self, at):
        there = self.body.solve(at.moduli, at.coefficients)
        own = {"names": self.model.names, "moduli": at.moduli, "coefficients": at.coefficients}
        return replace(self, model=expanded(there, **own), counts=self.counts + SolveCounts(forward=1))


def approximated(body):
    """The expansion of a body around equal moduli of 1 kPa and no motion."""
    names = tuple("abcdefgh"[: body.n_regions])
    at = {"moduli": np.ones(body.n_regions), "coefficients": np.zeros(body.n_modes)}
    return Expanded(body, expanded(body.solve(**at), names=names, **at))


@dataclass(frozen=True)
class Whole:
    """A body itself in the place of an approximation."""

    model: Response
    counts: SolveCounts = field(default_factory=SolveCounts)
    trust_radius: float = np.inf

    @classmethod
    def update_all(cls, each, points):
        return [one.update(at) for one, at in zip(each, points, strict=True)]

    def update(self, _at):
        return self


@dataclass(frozen=True)
class Readings:
    """Numbers `seen` (n,) mm of an organ, outputs `dofs` (n,) with independent errors, an `Observation` of an image.

    bounds: of their scale, equal where it is stated.
    """

    name: str
    dofs: np.ndarray
    seen: np.ndarray
    bounds: tuple[float, float]
    weighting: Weighting
    kind: str = "reading"
    description: str = "what was read"
    unit: str = "mm"
    of_driver: bool = False
    observed_share: float = 1.0
    tissue: int = 0
    stated_noise: NoiseModel | None = None

    @property
    def noise_model(self):
        return NoiseModel(np.array([self.weighting.sd**2]), np.array([1.0]))

    @property
    def sd_bounds(self):
        return self.bounds

    def residuals(self, displacement, offset=0.0):
        n = len(self.seen)
        places, shares = np.zeros((n, 3)), np.full(n, 1.0 / n)
        return Residuals(
            displacement - self.seen + offset, shares, places, places, places, sparse.csr_matrix(np.eye(n))
        )

    def with_sd(self, sd):
        n = len(self.seen)
        return replace(self, weighting=Weighting(n / sd**2, self.weighting.loss, float(n)))

    def with_noise(self, noise):
        return self.with_sd(noise.sd)

    def with_correlation(self, _noise):
        return self

    def weighed(self, residuals):
        return residuals

    def first_noise(self, _peers):
        return self.noise_model

    def fitted_noise(self, _residuals, _response=None):
        return self.noise_model

    def imaging_error(self, residuals, _before, _after):
        return np.zeros(len(residuals.values))

    def growth_error(self, residuals, _tissue, _peers):
        return np.zeros(len(residuals.values))


def readings(name, dofs, seen, *, bounds=(SD, SD)):
    return Readings(name, dofs, seen, bounds, Weighting(1.0, PowerLaw())).with_sd(max(bounds[0], min(SD, bounds[1])))


def blocks_of(n_images, *, odds=0.0, seldom=-3.0, unit=1.0):
    """Fields and layers of both organs, and in each image a frame and how both organs are drawn.

    odds: log prior odds of the middle patchiness; seldom: of an organ that is drawn otherwise; unit: of what a frame's
    coefficient of 1 is worth.
    """
    every, eye = tuple(range(n_images)), np.eye(N_FRAME) / unit**2
    levels = tuple(
        Alternative(sd**2 * np.eye(N_FIELD), odd, name)
        for sd, odd, name in ((0.1, 0.0, "homogeneous"), (0.3, odds, "patchy"), (0.6, -1.0, "very patchy"))
    )
    layers = Alternative(np.full((1, 1), 1e-6), 0.0, "bonded"), Alternative(np.full((1, 1), 0.7), -1.5, "layers")
    frames = tuple(
        Alternative(sd**2 * eye, odd, name)
        for sd, odd, name in ((0.02, 0.0, "still"), (0.2, -0.7, "hardly moves"), (1.5, -0.7, "moves"))
    )
    drawn = (
        Alternative(np.full((1, 1), 0.01**2), 0.0, "alike"),
        Alternative(np.full((1, 1), 0.4**2), seldom, "otherwise"),
    )
    fields = [Block(of, "heterogeneity", Acts.MATERIAL, every, levels, Choice.PATCHINESS) for of in ORGANS]
    films = [
        Block(of, "layer", Acts.MODULI, every, layers, Choice.LAYERS, regions=(2 + i,)) for i, of in enumerate(ORGANS)
    ]
    of_images = [
        block
        for s in every
        for block in (
            Block("frame", "frame", Acts.BOUNDARY, (s,), frames, Choice.FRAME),
            *(Block(of, "offset", Acts.RESIDUALS, (s,), drawn, Choice.DRAWING) for of in ORGANS),
        )
    ]
    return (*fields, *films, *of_images)


@dataclass(frozen=True)
class Patient:
    """Bodies of one patient's later images, what is believed of their unknowns, and all unknowns as they are.

    at_rest: modes (N_READ, m) by which the reference image draws each organ otherwise, in every image.
    """

    bodies: tuple[Response, ...]
    parameters: ParameterMap
    truth: np.ndarray
    at_rest: dict[str, np.ndarray] = field(default_factory=dict)

    def problem(self, rng=None, *, bounds=(SD, SD), scale=1.0, whole=False) -> InverseProblem:
        """What readings tell of the truth, with errors of `scale` SD drawn by `rng` where it is given.

        whole: whether each body stands for itself, else what it is to first order.
        """
        states = []
        for s, body in enumerate(self.bodies):
            unknowns, n = self.truth, len(body.slopes)
            values = body.solve(self.parameters.moduli(unknowns), self.parameters.coefficients(unknowns)[s]).values
            drawn = self.parameters.offsets(unknowns, s)
            offsets = dict(zip(self.parameters.offset_names(s), drawn, strict=False))
            values = values + np.repeat([offsets.get(of, 0.0) for of in ORGANS], N_READ)
            for of, which in self.parameters.at_rest(s).items():
                values[np.repeat(ORGANS, N_READ) == of] += self.at_rest[of] @ drawn[which]
            values = values if rng is None else values + scale * SD * rng.standard_normal(n)
            parts = np.split(np.arange(n), len(ORGANS))
            own = [readings(of, dofs, values[dofs], bounds=bounds) for of, dofs in zip(ORGANS, parts, strict=True)]
            model = Whole(body) if whole else approximated(body)
            states.append(LaterState(body, tuple(own), at_rest=self.at_rest).with_approximation(model))
        return InverseProblem(tuple(states), self.parameters)

    def objective(self, *args, **named) -> Objective:
        problem = self.problem(*args, **named)
        return Objective(problem.states, problem.parameters)

    def design(self) -> np.ndarray:
        """Derivatives (n, n_unknowns) of all readings of all images, of a linear body."""
        rows = []
        for s, body in enumerate(self.bodies):
            names = self.parameters.offset_names(s)
            own, part = self.parameters.unknowns_of(s), np.zeros((len(body.slopes), self.parameters.n_unknowns))
            chain = self.parameters.chain(s, np.zeros(self.parameters.n_unknowns))
            part[:, own] = body.slopes @ chain
            for name, column in zip(names, self.parameters.acting(Acts.RESIDUALS, s), strict=True):
                part[np.repeat(ORGANS, N_READ) == name, column] = 1.0
            for name, which in self.parameters.at_rest(s).items():
                columns = self.parameters.acting(Acts.REFERENCE, s)[which.start - len(names) : which.stop - len(names)]
                part[np.ix_(np.repeat(ORGANS, N_READ) == name, columns)] = self.at_rest[name]
            rows.append(part)
        return np.concatenate(rows)


def patient(rng, n_images=1, *, bend=0.0, gain=(1.0, 1.0), **beliefs) -> Patient:
    """Two organs; gain: what ln E of each moves; bend: second derivative by ln E, over the first."""
    parameters = ParameterMap(
        np.ones(4),
        np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]]),
        ORGANS,
        "rest",
        True,
        blocks_of(n_images, **beliefs),
    )
    unit = beliefs.get("unit", 1.0)
    bodies = []
    for _ in range(n_images):
        slopes = rng.standard_normal((2 * N_READ, 4 + N_FRAME + 2 * N_FIELD))
        slopes[:, :4] *= np.array([1.0, 1.0, 0.4, 0.4]) * np.tile(gain, 2)
        slopes[:, 4 : 4 + N_FRAME] *= unit
        bodies.append(Response(slopes, bend * slopes[:, :4], N_FRAME))
    truth = np.zeros(parameters.n_unknowns)
    truth[:2] = 0.5, -0.3
    return Patient(tuple(bodies), parameters, truth)


def without(of: Patient, dropped) -> Patient:
    """The same without what the blocks that are `dropped`, by their numbers, stand for."""
    parameters, kept = of.parameters, [i for i in range(len(of.parameters.blocks)) if i not in dropped]
    fewer = replace(parameters, blocks=tuple(parameters.blocks[i] for i in kept), priors=())
    bodies = []
    for s, body in enumerate(of.bodies):
        groups = [parameters.acting(acts, s) for acts in (Acts.BOUNDARY, Acts.MATERIAL)]
        own = np.concatenate(groups)
        stay = np.isin(own, np.concatenate([np.zeros(0, dtype=int), *(parameters.columns(i) for i in kept)]))
        slopes = np.concatenate([body.slopes[:, :4], body.slopes[:, 4:][:, stay]], axis=1)
        bodies.append(Response(slopes, body.bends, int(stay[: len(groups[0])].sum())))
    truth = np.concatenate([of.truth[:2], *(of.truth[parameters.columns(i)] for i in kept)])
    return Patient(tuple(bodies), fewer, truth)


def with_unknowns(of: Patient, block, values) -> Patient:
    """The same, where the unknowns of a block, by its number, have other values."""
    truth = of.truth.copy()
    truth[of.parameters.columns(block)] = values
    return replace(of, truth=truth)


def drawn_at_rest(of: Patient, modes, covariances, *, learned=False) -> Patient:
    """The same with modes (N_READ, m) by which the reference image draws each organ otherwise, which all images share.

    covariances (m, m): of their coefficients, believed in sum, or by amplitudes that are `learned`.
    """
    own, every = of.parameters, tuple(range(len(of.bodies)))
    blocks = [reference_block(organ, every, covariances, unit_mm=1.0) for organ in ORGANS]
    if not learned:
        blocks = [replace(b, terms=(), alternatives=(Alternative(np.sum(covariances, axis=0)),)) for b in blocks]
    parameters = replace(own, blocks=(*own.blocks, *blocks), priors=())
    truth = np.concatenate([of.truth, np.zeros(sum(block.size for block in blocks))])
    return replace(of, parameters=parameters, truth=truth, at_rest=dict.fromkeys(ORGANS, modes))


def in_unit(of: Patient, unit) -> Patient:
    """The same, all that is read in another unit, by `unit` times larger numbers."""
    own = of.parameters
    blocks = [
        replace(block, alternatives=tuple(replace(a, covariance=unit**2 * a.covariance) for a in block.alternatives))
        if block.acts is Acts.RESIDUALS
        else block
        for block in own.blocks
    ]
    parameters = replace(own, blocks=tuple(blocks), priors=())
    bodies = tuple(Response(unit * b.slopes, unit * b.bends, b.n_boundary) for b in of.bodies)
    truth = of.truth.copy()
    for s in range(own.n_states):
        truth[own.acting(Acts.RESIDUALS, s)] *= unit
    return Patient(bodies, parameters, truth)


def reordered(problem: InverseProblem, order) -> InverseProblem:
    """The same later images in another order."""
    own = problem.parameters
    alone = {block.states: [b for b in own.blocks if b.states == block.states] for block in own.blocks}
    tissues = [block for block in own.blocks if len(block.states) > 1]
    images = [replace(block, states=(new,)) for new, old in enumerate(order) for block in alone[(old,)]]
    parameters = replace(own, blocks=(*tissues, *images), priors=())
    return InverseProblem(tuple(problem.states[old] for old in order), parameters)


def every_explanation(parameters):
    """All explanations: choices by block with their log prior odds, every combination of those of several images."""
    images = [alternatives_of(parameters.blocks, s) for s in range(parameters.n_states)]
    for parts in product(scenarios_of(parameters.blocks), *images):
        yield tuple(pair for of in parts for pair in of.chosen), sum(of.log_odds for of in parts)


def dense_evidence(of: Patient, seen, chosen, *, theta=(0.0, 0.0), theta_sd=1e3) -> float:
    """Ln N(seen; D m, s^2 1 + D C D^T) of all readings, ln E normal around theta by theta_sd; by whole matrices."""
    parameters, design = of.parameters, of.design()
    choices = dict(chosen)
    covariances = [b.alternatives[choices.get(i, b.first)].covariance for i, b in enumerate(parameters.blocks)]
    covariance = linalg.block_diag(theta_sd**2 * np.eye(2), *covariances)
    total = SD**2 * np.eye(len(design)) + design @ covariance @ design.T
    away = np.concatenate(seen) - design[:, :2] @ np.asarray(theta)
    return float(-0.5 * (away @ np.linalg.solve(total, away) + np.linalg.slogdet(total)[1]))


def exact_posterior(of: Patient, seen):
    """Mean (2,) and covariance (2, 2) of ln E of a linear body, over all explanations, by whole matrices."""
    every, design, read = list(every_explanation(of.parameters)), of.design(), np.concatenate(seen)
    levels = np.array([odds + dense_evidence(of, seen, chosen) for chosen, odds in every])
    weights = np.exp(levels - levels.max()) / np.sum(np.exp(levels - levels.max()))
    priors = (of.parameters.choosing(dict(chosen)).prior_matrix.dense for chosen, _ in every)
    whole = [np.linalg.inv(design.T @ design / SD**2 + prior) for prior in priors]
    means = np.stack([(inverse @ design.T @ read / SD**2)[:2] for inverse in whole])
    away = means - weights @ means
    within = np.tensordot(weights, np.stack([inverse[:2, :2] for inverse in whole]), axes=1)
    return weights @ means, within + (away.T * weights) @ away


def settings(*starts) -> InversionSettings:
    return InversionSettings(tuple(np.asarray(start, dtype=float) for start in starts or ([0.0, 0.0],)), WIDE)


def seen_in(objective):
    """What was read (n,) in each image."""
    return [np.concatenate([o.seen for o in state.observations]) for state in objective.states]
