"""How uncertain the estimate is: correlated residuals, the drivers' prior, the voxels' place, the mesh."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.images.distance import NearMaps, cropped, window_of
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.inversion.hyper_parameters import of_one_noise
from palpate.inversion.objective import Evaluation, Linearisation, Objective
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.voxelise import DeformedFaces
from palpate.observation.contract import Imaged
from palpate.observation.jacobian import Jacobian
from palpate.observation.noise_model import FitResponse, NoiseModel, mean_noise
from palpate.parallel import mapped
from palpate.uncertainty.intervals import discretisation_sd
from palpate.unknowns import Choice

GridErrors = Sequence[Sequence[NDArray[np.float64]]]
"""Errors (n,) mm of the residuals of each observation, of each draw of a grid."""

GRID_DRAWS = 8
EARLIER = "earlier"  # the cause of errors that earlier images have left
ROUNDING = 1e-6  # share of a variance that is only rounding, as of blocks that are held
TOLD = 1e-3  # share of the images in what is known of a combination, below which the fit takes no errors for it
MARGIN_MM, MARGIN_VOXELS = 12.0, 8.0  # of the grid around the residuals' places, wider than the maps' smoothing


@dataclass(frozen=True, slots=True)
class FittedState:
    """A fitted later state: displacement (n_points, 3) mm of its `space`, and the grids of both images."""

    space: LagrangeSpace
    displacement: NDArray[np.float64]
    before: VoxelGrid
    after: VoxelGrid


def gain(evaluation: Evaluation, n_parameters: int) -> tuple[NDArray[np.float64], ...]:
    """Derivative (n_parameters, n_residuals) of the estimated log-moduli by the residuals of each surface, 1/mm.

    G = H^-1 J^T W: a change e of the data moves the estimate by -G e; H is the Gauss-Newton matrix with the prior.
    """
    return _gain(evaluation, evaluation.covariance_columns(n_parameters).T)


def _gain(evaluation: Evaluation, rows: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """The gain of combinations of the unknowns, by their rows (k, n_unknowns) of H^-1."""
    return tuple(
        s.jacobian.times(rows[:, s.columns].T).T * (s.precision * s.weights) for s in evaluation.linearisations
    )


@dataclass(frozen=True, slots=True)
class Covariance:
    """Of the parameters, (n_parameters, n_parameters) each, dimensionless, by its independent causes.

    Parameters are the log-moduli, then the further unknowns that are asked for. noise: of the residuals; prior: that of
    all unknowns, of which `causes` are the parts by the cause of their block;
    grid: the place of the voxels, as far as it is not in noise that the residuals tell, which voxels round; mesh: what
    another mesh would make of it (of Young's moduli); held: the part of causes by blocks that are held. given_model:
    all that would be left if frame, drawing and material were as the model has them, and only the drivers' motion
    unknown. plain: H^-1, what noise and prior would be if residuals were as independent as they are counted.
    """

    noise: NDArray[np.float64]
    prior: NDArray[np.float64]
    grid: NDArray[np.float64]
    mesh: NDArray[np.float64]
    plain: NDArray[np.float64]
    causes: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    held: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    given_model: NDArray[np.float64] | None = None

    @property
    def total(self) -> NDArray[np.float64]:
        """The sum of all causes."""
        return self.noise + self.prior + self.grid + self.mesh

    @property
    def of_held(self) -> NDArray[np.float64]:
        """That by all blocks that are held."""
        return sum(self.held.values(), np.zeros_like(self.prior))

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Correlation (n, n), dimensionless, by all causes."""
        sd = np.sqrt(np.diag(self.total))
        return np.asarray(self.total / np.outer(sd, sd))

    def of_first(self, n: int) -> Covariance:
        """That of the first n."""
        every = (self.noise, self.prior, self.grid, self.mesh, self.plain)
        noise, prior, grid, mesh, plain = (part[:n, :n] for part in every)
        causes, held = ({k: part[:n, :n] for k, part in of.items()} for of in (self.causes, self.held))
        return Covariance(noise, prior, grid, mesh, plain, causes, held, self.given_model)

    def shares(self, number: int) -> dict[str, float]:
        """Share of each cause, 0 to 1, in the variance of the log-modulus with a `number`."""
        rest = self.prior - sum(self.causes.values(), np.zeros_like(self.prior))
        parts = {"noise": self.noise, **self.causes, "prior": rest, "grid": self.grid, "mesh": self.mesh}
        shares = {name: float(part[number, number] / self.total[number, number]) for name, part in parts.items()}
        return {name: share for name, share in shares.items() if name != "prior" or share > ROUNDING}


def covariance_of(
    objective: Objective,
    evaluation: Evaluation,
    errors: GridErrors,
    *,
    noise_of: Mapping[tuple[int, str], NoiseModel] | None = None,
    further: Sequence[NDArray[np.int64]] = (),
) -> Covariance:
    """All that is known of the log-moduli's errors under one explanation of the images.

    The sandwich, blocks that are held, the mesh, and what the scatter over grid positions, by the `errors` there, adds
    (see `grid_covariance`); nothing of no errors. A block has the part H^-1 P_b H^-1 of the prior's.
    noise_of: the residuals' noise where it is not that of the evaluation (see `error_noise`), whose residuals hold what
    wrong moduli leave. further: numbers (n,) of other unknowns that stand after the log-moduli, not in `given_model`.
    """
    noise_of = error_noise(evaluation) if noise_of is None else noise_of
    n, mesh, given = objective.n_parameters, mesh_covariance(objective), _given_model(objective, evaluation)
    numbers = np.concatenate([np.arange(n), *further])
    rows = evaluation.covariance_columns(int(numbers.max()) + 1)[:, numbers].T
    sets = [(evaluation, rows)] + ([] if given is evaluation else [(given, given.covariance_columns(n).T)])
    gains = [np.concatenate(of_sets) for of_sets in zip(*(_gain(*of) for of in sets), strict=True)]
    by_noise = noise_covariance(objective, list(zip(evaluation.linearisations, gains, strict=True)), noise_of)

    def parts(i: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Covariances by noise, prior and grid of one set of unknowns."""
        (of, inverse), first = sets[i], sum(len(rows) for _, rows in sets[:i])
        own = slice(first, first + len(inverse))
        noise, prior = by_noise[own, own], np.asarray(inverse @ (of.prior @ inverse.T))
        if not errors:
            return noise, prior, np.zeros_like(noise)
        shifts = shifts_by([rows[own] for rows in gains], errors)
        return noise, prior, grid_covariance(evaluation, scatter(shifts), noise)

    noise, prior, grid = parts(0)
    held = _held(objective, evaluation, rows)
    causes, prior = dict(held), prior + sum(held.values(), np.zeros_like(prior))
    left = (noise, prior, grid) if given is evaluation else parts(1)
    inverse, parameters = rows.T, objective.parameters
    for i, block in enumerate(parameters.blocks):
        own = parameters.columns(i)
        part = inverse[own].T @ parameters.prior_of_blocks.block(own, own) @ inverse[own]
        causes[block.cause] = causes.get(block.cause, np.zeros_like(part)) + part
    if parameters.earlier:
        causes[EARLIER] = np.asarray(rows @ ((evaluation.prior - parameters.prior_of_blocks) @ inverse))
    padded = np.pad(mesh, (0, len(numbers) - n))
    return Covariance(noise, prior, grid, padded, rows[:, numbers], causes, held, sum(left, mesh))


def _held(objective: Objective, evaluation: Evaluation, rows: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """By cause, S C_b S^T (k, k) of blocks that are held, not estimated (Schmidt 1966).

    S = -H^-1 J^T W J_b: how the unknowns with these rows (k, n_unknowns) of H^-1 answer to them.
    """
    found = dict[str, NDArray[np.float64]]()
    for i, block in enumerate(objective.parameters.blocks):
        if block.choice is Choice.HELD:
            own = objective.parameters.columns(i)
            answer = ((evaluation.matrix - evaluation.prior) @ rows.T)[own].T
            part = answer @ block.widest @ answer.T
            found[block.cause] = found.get(block.cause, np.zeros_like(part)) + part
    return found


def _given_model(objective: Objective, evaluation: Evaluation) -> Evaluation:
    """The evaluation with the unknowns of parameters and drivers alone, all others held where they are."""
    parameters = objective.parameters
    drivers = [parameters.columns(i) for i, block in enumerate(parameters.blocks) if block.moves_driver]
    own = np.concatenate([np.arange(parameters.n_parameters), *drivers])
    if len(own) == parameters.n_unknowns:
        return evaluation
    linearisations = []
    for term in evaluation.linearisations:
        inside = np.isin(term.columns, own)
        columns, jacobian = np.searchsorted(own, term.columns[inside]), term.jacobian.of_columns(inside)
        score, information = term.score[inside], term.information[np.ix_(inside, inside)]
        linearisations.append(replace(term, columns=columns, jacobian=jacobian, score=score, information=information))
    kept = np.isin(np.arange(parameters.n_unknowns), own)
    return replace(
        evaluation,
        score=evaluation.score[own],
        matrix=evaluation.matrix.among(kept),
        linearisations=tuple(linearisations),
        prior=evaluation.prior.among(kept),
        prior_score=evaluation.prior_score[own],
    )


def mesh_covariance(objective: Objective) -> NDArray[np.float64]:
    """Covariance (n_parameters, n_parameters) of the log-moduli by their meshes: diagonal, s^2 of each tissue.

    s is `discretisation_sd` in the mesh of a reference state; the meshes of R reference states err independently, which
    leaves the mean of their s^2 over R.
    """
    references = {state.reference: state.model for state in objective.states}
    variances = np.zeros(objective.n_parameters)
    for model in references.values():
        for i, scaled in enumerate(objective.parameters.selection.T > 0.0):
            tissues = sorted({model.regions[r] for r in np.flatnonzero(scaled)})
            variances[i] += discretisation_sd(model.space, tissues) ** 2 / len(references) ** 2
    return np.diag(variances)


def sandwich_covariance(
    objective: Objective,
    evaluation: Evaluation,
    noise_of: Mapping[tuple[int, str], NoiseModel] | None = None,
) -> NDArray[np.float64]:
    """Covariance (n_parameters, n_parameters) of the log-moduli: H^-1 (J^T W C W J + P) H^-1.

    C is the covariance of the residuals' errors under the noise model of their image (see `error_noise`), across all
    observations of a kind; P the prior, whose uncertainty is thereby included (White 1980; Aitken's theorem read for
    correlated errors). A residual is the error of a later image less that of its rest state's image, each with half of
    the noise: the later ones are independent, that of the rest state is the same for all states that have it, at the
    material place, by the mean of their noise models; none where its drawing is an unknown. Later states that move
    alike do not average it away, opposite ones do. noise_of: the residuals' noise where it is not that of the
    evaluation.
    """
    rows = evaluation.covariance_columns(objective.n_parameters).T
    noise, prior = _sandwich(objective, evaluation, rows, error_noise(evaluation) if noise_of is None else noise_of)
    return noise + prior


def covariance_among(objective: Objective, evaluation: Evaluation, numbers: NDArray[np.int64]) -> NDArray[np.float64]:
    """Covariance (k, k) of the unknowns with these `numbers` (k,): the sandwich, and what is held."""
    rows = evaluation.covariance_columns(evaluation.matrix.size)[numbers]
    noise, prior = _sandwich(objective, evaluation, rows, error_noise(evaluation))
    return sum(_held(objective, evaluation, rows).values(), noise + prior)


def _sandwich(
    objective: Objective,
    evaluation: Evaluation,
    rows: NDArray[np.float64],
    noise_of: Mapping[tuple[int, str], NoiseModel],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The sandwich's parts (k, k) by residuals and by prior, of unknowns with rows (k, n_unknowns) of H^-1."""
    data = noise_covariance(
        objective, list(zip(evaluation.linearisations, _gain(evaluation, rows), strict=True)), noise_of
    )
    return data, np.asarray(rows @ (evaluation.prior @ rows.T))


def noise_covariance(
    objective: Objective,
    pairs: Sequence[tuple[Linearisation, NDArray[np.float64]]],
    noise_of: Mapping[tuple[int, str], NoiseModel],
) -> NDArray[np.float64]:
    """G C G^T (n, n) by the residuals' errors, of observations with their gains G (n, n_residuals), 1/mm.

    See `sandwich_covariance`. Half of the errors are the rest image's, or none where its drawing is an unknown.
    """
    n = len(pairs[0][1])
    data, at_rest_of = np.zeros((n, n)), [objective.parameters.at_rest(s) for s in range(len(objective.states))]
    for kind in dict.fromkeys(term.observation.kind for term, _ in pairs):
        of_kind = [(term, row) for term, row in pairs if term.observation.kind == kind]
        later = [term.state for term, _ in of_kind]
        for groups, at_rest in ((later, False), ([objective.states[s].reference for s in later], True)):
            for key in dict.fromkeys(groups):
                group = [pair for pair, own in zip(of_kind, groups, strict=True) if own == key]
                noise = mean_noise([noise_of[term.state, kind] for term, _ in group])
                told = [bool(of := at_rest_of[term.state]) and term.observation.name in of for term, _ in group]
                parts = [0.5 if not known else 0.0 if at_rest else 1.0 for known in told]
                carried = np.concatenate(
                    [np.sqrt(part) * row for part, (_, row) in zip(parts, group, strict=True)], axis=1
                )
                residuals = [term.residuals for term, _ in group]
                places = np.concatenate([r.material if at_rest else r.places for r in residuals])
                moved = np.flatnonzero(carried.any(axis=1))  # the others are estimates from other images
                normals = np.concatenate([r.normals for r in residuals])
                data[np.ix_(moved, moved)] += noise.covariance(carried[moved], places, normals)
    return data


def error_noise(evaluation: Evaluation) -> dict[tuple[int, str], NoiseModel]:
    """Noise model of the residuals' errors, by later state and kind of observation.

    The residuals at a minimum are what the fit left of them: see `FitResponse`. What errors of one later image do to
    the residuals of another, by the moduli alone, is neglected.
    """
    linearisations, found = evaluation.linearisations, {}
    inverse = evaluation.covariance_columns(evaluation.matrix.size)
    for key, (own, telling) in of_one_noise(evaluation).items():
        columns = linearisations[own[0]].columns
        of_data = evaluation.matrix.block(columns, columns) - evaluation.prior.block(columns, columns)
        told = _told(inverse[np.ix_(columns, columns)], of_data)
        gains = list[Jacobian]()
        for term in (linearisations[i] for i in own):  # W J T, its part of the gain's transpose
            weights = sparse.diags_array(term.precision * term.weights)
            seen = sparse.csr_matrix(weights @ term.jacobian.by_displacement)
            gains.append(Jacobian(seen, term.jacobian.tangent @ told))
        response = FitResponse(
            [replace(of := linearisations[i].jacobian, tangent=of.tangent @ told) for i in telling],
            gains,
            places=[linearisations[i].residuals.material for i in own],
            normals=[linearisations[i].residuals.normals for i in own],
        )
        found[key] = linearisations[own[0]].observation.fitted_noise(
            [linearisations[i].residuals for i in telling], response
        )
    return found


def _told(covariance: NDArray[np.float64], information: NDArray[np.float64]) -> NDArray[np.float64]:
    """T (n, k) of combinations of unknowns with T T^T = C (n, n) but for what images do not tell.

    The combinations are independent of each other under the covariance C and under the images' information (n, n), of
    which each has a share h = T^T M T in what is known of it, and those with hardly any are left out.
    """
    known = np.isfinite(np.diag(covariance))
    sizes, axes = np.linalg.eigh(covariance[np.ix_(known, known)])
    root = axes * np.sqrt(np.maximum(sizes, 0.0))
    shares, turn = np.linalg.eigh(root.T @ information[np.ix_(known, known)] @ root)
    found = np.zeros((len(known), np.count_nonzero(shares > TOLD)))
    found[known] = root @ turn[:, shares > TOLD]
    return found


def grid_position_shifts(
    objective: Objective,
    evaluation: Evaluation,
    states: tuple[FittedState, ...],
    *,
    draws: int = GRID_DRAWS,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Shifts (draws, n_parameters) of the estimated log-moduli when an exact model is imaged on random grids.

    The errors e of the residuals (see `grid_errors`) go through the gain of one Gauss-Newton step, -G e.
    """
    errors = grid_errors(objective, evaluation, states, draws=draws, rng=rng)
    return shifts_by(gain(evaluation, objective.n_parameters), errors)


def grid_errors(
    objective: Objective,
    evaluation: Evaluation,
    states: tuple[FittedState, ...],
    *,
    draws: int = GRID_DRAWS,
    rng: np.random.Generator,
) -> GridErrors:
    """Errors e (n,) mm of the residuals of each observation, on so many random grids (see `imaging_errors`).

    Every draw has a generator of its own, so that they can be made side by side.
    """
    faces = _faces(objective, states)
    return mapped(lambda own: _imaging_errors(objective, evaluation, states, faces, own, MARGIN_MM), rng.spawn(draws))


def scatter(shifts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance (n, n) by the grid's place of shifts (draws, n) that are errors themselves: about 0, not their mean.

    A mean of few squares is a variance that is itself uncertain: an error under it has Student's law, with as many
    degrees of freedom as draws, whose variance is draws / (draws - 2) times that mean.
    """
    return np.asarray(shifts.T @ shifts / (len(shifts) - 2))


def grid_covariance(
    evaluation: Evaluation, grid: NDArray[np.float64], noise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """What the place of the `grid` (n, n) adds to the `noise` (n, n), the covariances of the log-moduli by each.

    All of it to noise that is stated. Noise that the residuals tell has it already, as they are rounded by voxels, and
    is the less only where it is no kernel's: then the positive part of the difference, with which the noise is at least
    as large as each of the two in every direction.
    """
    seen = [term.observation for term in evaluation.linearisations]
    if any(isinstance(o, Imaged) and o.stated_noise is not None for o in seen):
        return grid
    return _positive_part(grid - noise)


def _positive_part(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The symmetric matrix (n, n) without its negative eigenvalues."""
    sizes, axes = np.linalg.eigh(matrix)
    return np.asarray((axes * np.maximum(sizes, 0.0)) @ axes.T)


def shifts_by(gains: Sequence[NDArray[np.float64]], errors: GridErrors) -> NDArray[np.float64]:
    """Shifts -G e (draws, n) of n unknowns by errors e (n_residuals,) mm of each surface, of each draw.

    gains: G (n, n_residuals) of each surface, 1/mm.
    """
    moved = [-sum((row @ e for row, e in zip(gains, of, strict=True)), np.zeros(len(gains[0]))) for of in errors]
    return np.asarray(moved).reshape(len(moved), len(gains[0]))


def imaging_errors(
    objective: Objective,
    evaluation: Evaluation,
    states: tuple[FittedState, ...],
    *,
    rng: np.random.Generator,
    margin_mm: float = MARGIN_MM,
) -> list[NDArray[np.float64]]:
    """Errors (n,) mm of the residuals of each observation when the fitted model itself is imaged.

    The model, at rest and deformed, is turned into voxels on grids shifted at random by up to half a voxel, at least
    within a margin of the residuals' places; later states of one reference state have the same image of it.
    """
    return _imaging_errors(objective, evaluation, states, _faces(objective, states), rng, margin_mm)


def _faces(objective: Objective, states: tuple[FittedState, ...]) -> list[tuple[DeformedFaces, DeformedFaces]]:
    """The faces of every later state at rest, one for all of a reference state, and deformed."""
    rest = dict[int, DeformedFaces]()
    for state, fitted in zip(objective.states, states, strict=True):
        if state.reference not in rest:
            rest[state.reference] = DeformedFaces.of(fitted.space, np.zeros_like(fitted.displacement))
    pairs = zip(objective.states, states, strict=True)
    return [(rest[state.reference], DeformedFaces.of(fitted.space, fitted.displacement)) for state, fitted in pairs]


def _imaging_errors(
    objective: Objective,
    evaluation: Evaluation,
    states: tuple[FittedState, ...],
    faces: Sequence[tuple[DeformedFaces, DeformedFaces]],
    rng: np.random.Generator,
    margin_mm: float,
) -> list[NDArray[np.float64]]:
    """Those of `imaging_errors`, by the faces of each state at rest and deformed."""
    errors, rest = list[NDArray[np.float64]](), dict[int, NearMaps]()
    references = [state.reference for state in objective.states]
    for s, (reference, fitted) in enumerate(zip(references, states, strict=True)):
        linearisations: list[Linearisation] = [term for term in evaluation.linearisations if term.state == s]
        if not any(isinstance(term.observation, Imaged) for term in linearisations):
            errors += [np.zeros(len(term.weights)) for term in linearisations]
            continue
        at_rest, deformed = faces[s]
        if reference not in rest:
            material = [
                term.residuals.material for term in evaluation.linearisations if references[term.state] == reference
            ]
            rest[reference] = NearMaps(_imaged(at_rest, fitted.before, material, margin_mm, rng))
        places = [term.residuals.places for term in linearisations]
        after = NearMaps(_imaged(deformed, fitted.after, places, margin_mm, rng))
        for term in linearisations:
            seen, error = term.observation, np.zeros(len(term.weights))  # none of what no segmented image shows
            if isinstance(seen, Imaged):
                error = seen.imaging_error(term.residuals, rest[reference], after)
            errors.append(error)
    return errors


def _imaged(
    faces: DeformedFaces,
    grid: VoxelGrid,
    places: Sequence[NDArray[np.float64]],
    margin_mm: float,
    rng: np.random.Generator,
) -> Segmentation:
    """The model's image around places (n, 3) mm, where alone it is used."""
    margin = max(margin_mm, MARGIN_VOXELS * float(grid.spacing.max())) / float(grid.spacing.min())
    near = cropped(grid, window_of(grid.index(np.concatenate(places)), grid, margin=math.ceil(margin)))
    affine = np.array(near.affine)
    affine[:3, 3] += affine[:3, :3] @ rng.uniform(-0.5, 0.5, 3)
    shifted = replace(near, affine=affine)
    return Segmentation(faces.on(shifted, crossing=True), shifted, faces.mesh.tissues)
