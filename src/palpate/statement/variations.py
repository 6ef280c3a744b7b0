"""What an estimate rests on, changed on the fast path: constants, surfaces, the drivers' modes and their prior."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from palpate.errors import EstimationError, SolverError
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.inversion import Inversion, InversionSettings
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.laws.contract import Law
from palpate.observation.contract import Imaged, OfMaterial
from palpate.parallel import mapped
from palpate.statement.stated_posterior import StatedPosterior
from palpate.uncertainty import (
    Equilibria,
    Errors,
    Shift,
    exact_equilibria,
    fast_path,
    law_errors,
    modulus_errors,
    poisson_errors,
    surface_errors,
)
from palpate.unknowns import Choice

POISSON_STEP = 0.02
KNOWN_FACTOR = 1.2
DOWN, UP = f"/ {KNOWN_FACTOR:g}", f"x {KNOWN_FACTOR:g}"  # settings of a known modulus
NAMES = {  # of a bar, by its cause; {} is the tissue
    "known_modulus": "modulus of {}",
    "poisson_ratio": "Poisson's ratio of {}",
    "segmentation": "surface of {}",
    "driver_prior": "prior of the drivers' motion",
    "driver_modes": "modes of the drivers' motion",
    "frame": "motion of the frame",
    "law": "material law",
    "outer_boundary": "outer boundary",
    "edge_length": "edge length of the mesh",
    "alignment": "alignment",
}
VOXELS = (-0.5, -0.25, 0.25, 0.5)
PRIOR_WIDTHS = (0.5, 2.0)
ALL = "all tissues"
DRAWN = "not varied: how it is drawn is an unknown of the estimate, so the interval includes it"


@dataclass(frozen=True, slots=True)
class Variation:
    """One changed assumption: its cause, what it is about (`subject`, a tissue or nothing), its setting in words.

    method: "exact", "linearised" or "re-estimated"; changes: ln E' / E of each tissue, None where there is no estimate,
    for a `reason`; at_bound: tissues whose modulus runs to the bounds of the search; seconds: what it took.
    """

    cause: str
    subject: str
    setting: str
    method: str
    changes: Mapping[str, float] | None
    at_bound: tuple[str, ...] = ()
    reason: str = ""
    seconds: float = 0.0


def ratio_change(change: float, cause: str, subject: str, setting: str, *, relative_to: str) -> float:
    """Change of ln (E / E_known), dimensionless, by a variation that changes ln E by `change`.

    Where the known modulus itself is varied, E_known changes by a factor of 1.2 as well.
    """
    if cause != "known_modulus" or subject != relative_to:
        return change
    return change + float(np.log(KNOWN_FACTOR)) * {DOWN: 1.0, UP: -1.0}[setting]


@dataclass(frozen=True, slots=True)
class _Input:
    """One input that can be changed by an amount, with the residuals' changes for a unit of it."""

    cause: str
    subject: str
    errors: Errors
    amounts: tuple[tuple[float, str], ...]


def voxel_mm(later: Sequence[Segmentation]) -> float:
    """Mean edge, mm, of the voxels of later images; 1 where there are none."""
    return float(np.mean([image.grid.voxel_volume ** (1.0 / 3.0) for image in later])) if later else 1.0


def fast_variations(
    inversion: Inversion,
    settings: InversionSettings,
    tissues: tuple[Tissue, ...],
    *,
    dilatation: Dilatation,
    voxel_mm: float,
) -> tuple[Variation, ...]:
    """All that is found without solving the model for another estimate.

    tissues: the mesh's; dilatation: the element's; voxel_mm: edge of a voxel of the later images. Raises
    `EstimationError`, `SolverError` where the estimate itself cannot be changed at all.
    """
    path = fast_path(inversion.objective, inversion.minimum, settings.bounds)
    names, equilibria = inversion.objective.parameters.tissues, _equilibria(inversion)
    inputs = _inputs(inversion, equilibria, tissues, dilatation, voxel_mm)

    def vary(job: tuple[_Input, float, str]) -> Variation:
        """One input changed by one of its amounts."""
        each, amount, words = job
        errors = tuple(amount * error for error in each.errors)
        return _stated(names, (each.cause, each.subject, words), partial(path.shifted_by, errors))

    found = [
        *_exact(inversion, tissues),
        *mapped(vary, [(each, *amount) for each in inputs for amount in each.amounts]),
        *(Variation("segmentation", name, "any", "linearised", None, reason=DRAWN) for name in _offset(inversion)),
    ]
    if inversion.objective.parameters.n_coefficients:
        for width in PRIOR_WIDTHS:
            change = partial(path.shift, width=width)
            found.append(_stated(names, ("driver_prior", "", f"{width:g} times as wide"), change))
        # the finer half of each wall's modes, which are sorted by their size
        blocks = inversion.objective.parameters.blocks
        finer = [(np.arange(b.size) >= 3 * (b.size // 6)) & b.moves_driver for b in blocks]
        fewer = partial(path.shift, dropped=np.concatenate(finer))
        found.append(_stated(names, ("driver_modes", "", "the smoother half alone"), fewer))
    return tuple(found)


def what_would_change(
    inversion: Inversion,
    settings: InversionSettings,
    tissues: tuple[Tissue, ...],
    laws: Sequence[Law],
    *,
    dilatation: Dilatation,
    voxel_mm: float,
    posterior: StatedPosterior | None = None,
) -> tuple[Variation, ...]:
    """What an estimate rests on, in few lines: known modulus, surfaces by half a voxel, Poisson's ratios, frame, law.

    laws: others than that of the estimate, which none has that measures what depends on the material directly, as a
    force does; posterior: what is stated of the estimate, where it is there; otherwise as `fast_variations`.
    """
    minimum, known = inversion.minimum, None
    if posterior is not None and posterior.objective is inversion.objective:  # no model was made more exact since
        known = posterior.frozen, posterior.minimum
    path = fast_path(inversion.objective, minimum, settings.bounds, known)
    names, equilibria = inversion.objective.parameters.tissues, _equilibria(inversion)
    blocks = inversion.objective.parameters.blocks
    inputs = [
        replace(each, amounts=(each.amounts[0], each.amounts[-1]))
        for each in _inputs(inversion, equilibria, tissues, dilatation, voxel_mm)
        if each.cause != "poisson_ratio" or each.subject == ALL
    ]

    changes: list[tuple[tuple[str, str, str], Callable[[], Shift]]] = [
        ((each.cause, each.subject, words), partial(path.shift, pulled(amount)))
        for each, pulled in zip(inputs, path.pulled([each.errors for each in inputs]), strict=True)
        for amount, words in each.amounts
    ]
    frame = np.concatenate([np.zeros(0, dtype=bool), *(np.full(b.size, b.choice is Choice.FRAME) for b in blocks)])
    if frame.any():
        changes.append((("frame", "", "held still"), partial(path.shift, dropped=frame)))

    def under(law: Law) -> Callable[[], Shift]:
        """What a step to another law's equilibrium does."""
        return lambda: path.shift(path.pulled([law_errors(minimum.evaluation, equilibria, law, dilatation)])[0](1.0))

    bound = any(isinstance(o, OfMaterial) for o in inversion.objective.observations)
    changes += [(("law", "", law.name), under(law)) for law in laws if not bound]
    return (*_exact(inversion, tissues), *mapped(lambda change: _stated(names, *change), changes))


def _equilibria(inversion: Inversion) -> Equilibria:
    return exact_equilibria(inversion.objective, inversion.minimum.unknowns)


def _inputs(
    inversion: Inversion, equilibria: Equilibria, tissues: tuple[Tissue, ...], dilatation: Dilatation, voxel_mm: float
) -> tuple[_Input, ...]:
    """Poisson's ratio of each tissue and of all, each observed surface, known moduli where several set the scale.

    Surfaces whose offset is an unknown of the estimate are left out, because a step cannot change their offset.
    """
    objective, minimum = inversion.objective, inversion.minimum
    model = objective.states[0].model
    regions = [model.space.mesh.tissues[region] for region in model.regions]
    by_poisson = poisson_errors(minimum.evaluation, equilibria, dilatation)
    found = []
    numbers = {name: [i for i, t in enumerate(regions) if t.name == name] for name in (t.name for t in regions)}
    for name, own in numbers.items():  # layers round organs are regions of their tissue
        given = regions[own[0]].poisson_ratio
        words = tuple((step, f"{given + step:.3g}") for step in _poisson_steps(given))
        found.append(_Input("poisson_ratio", name, tuple(e[:, own].sum(axis=1) for e in by_poisson), words))
    if len(numbers) > 1:
        steps = _poisson_steps(max(tissue.poisson_ratio for tissue in regions))
        words = tuple((step, f"{step:+.3g}") for step in steps)
        found.append(_Input("poisson_ratio", ALL, tuple(e.sum(axis=1) for e in by_poisson), words))
    surfaces = dict.fromkeys(o.name for o in objective.observations if isinstance(o, Imaged))
    for name in (name for name in surfaces if name not in _offset(inversion)):
        amounts = tuple((voxel_mm * share, f"{share:+g} voxel") for share in VOXELS)
        found.append(_Input("segmentation", name, surface_errors(minimum.evaluation, name), amounts))
    if not _exact(inversion, tissues):
        by_modulus = modulus_errors(objective, minimum.unknowns, minimum.evaluation)
        step = float(np.log(KNOWN_FACTOR))
        amounts = ((-step, DOWN), (step, UP))
        found += [
            _Input("known_modulus", name, tuple(e[:, own].sum(axis=1) for e in by_modulus), amounts)
            for name, own in numbers.items()
            if regions[own[0]].role is Role.KNOWN
        ]
    return tuple(found)


def _offset(inversion: Inversion) -> list[str]:
    """The surfaces whose offset is an unknown of the estimate."""
    blocks = inversion.objective.parameters.blocks
    return list(dict.fromkeys(block.of for block in blocks if block.choice is Choice.DRAWING))


def _poisson_steps(ratio: float) -> tuple[float, float]:
    """Down and up, the latter at most half of the way to 0.5."""
    return -POISSON_STEP, min(POISSON_STEP, 0.5 * (0.5 - ratio))


def _exact(inversion: Inversion, tissues: tuple[Tissue, ...]) -> list[Variation]:
    """The exact effect of the known modulus where it alone sets the scale: all others are proportional to it."""
    mapping = inversion.objective.parameters
    known = list(dict.fromkeys(tissue.name for tissue in tissues if tissue.role is Role.KNOWN))  # layers are of theirs
    loaded = any(state.model.load.any() for state in inversion.objective.states)
    if len(known) != 1 or loaded or not mapping.absolute:
        return []
    step = float(np.log(KNOWN_FACTOR))
    return [
        Variation("known_modulus", known[0], words, "exact", dict.fromkeys(mapping.tissues, sign * step))
        for sign, words in ((-1.0, DOWN), (1.0, UP))
    ]


def _stated(names: tuple[str, ...], what: tuple[str, str, str], change: Callable[[], Shift]) -> Variation:
    """A variation of cause, subject and setting by its shift on the fast path; one without an estimate says why."""
    try:
        shift = change()
    except (SolverError, EstimationError) as error:
        return Variation(*what, "linearised", None, reason=str(error))
    if not shift.converged:
        return Variation(*what, "linearised", None, reason="the estimate did not converge")
    changes = dict(zip(names, shift.theta.tolist(), strict=False))
    at_bound = tuple(name for name, ended in zip(names, shift.at_bound, strict=False) if ended)
    return Variation(*what, "linearised", changes, at_bound)
