"""Parameter blocks: groups of unknowns beside the moduli, each with its prior.

A block is one cause that a real pair of images brings: how a driver's wall moves, how the frame that the image cuts out
of the body moves, how a surface is drawn, how a tissue's stiffness varies. The layers above ask a block what it acts on
and what it believes, never what it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate.errors import ConfigurationError
from palpate.images.tissue import Role, Tissue
from palpate.mechanics.material import MaterialModes
from palpate.mesh.tet_mesh import TetMesh
from palpate.observation.contract import Observation
from palpate.observation.prescribed_motion import PrescribedMotion
from palpate.observation.wall_modes import Wall

STILL, SLIGHT = 0.02, 0.1  # motion of a frame that stands still, and that hardly moves, over that of a moving one
STILL_RIGID, MOVED_RIGID = 0.005, 0.2
DRAWN_ALIKE = 0.1  # standard deviation of an offset of surfaces drawn alike, over that of others
SELDOM = 0.01  # odds of a surface that is drawn otherwise
AMPLITUDES = (0.005, 2.0)  # bounds of those that are learned, times the standard deviation of the coefficients
KNOWN_MODULUS, FRAME, REFERENCE = "known modulus", "frame", "reference"
FIELD, LAYER, POISSON = "field", "layer", "poisson"
BONDED = 1e-4  # standard deviation of a layer that is like its tissue, over that of one that is not
LEAST_VARIANCE = 1e-3  # of a motion's coefficient, in its unit, so that no mode is excluded
# standard deviation of ln E in a tissue that is nearly homogeneous, patchy, very patchy, over the stated one; and the
# log prior odds of the three: 1, 0.15 and 0.02
PATCHINESS = {"nearly homogeneous": 1.0 / 3.0, "patchy": 1.0, "very patchy": 2.0}
OF_A_MAP = (1.0, 1.0, 2.0)  # the same of a tissue that is mapped, which is never taken for homogeneous
PATCHY_ODDS = (0.0, -1.9, -3.8)
HELD = 1e-8  # factor on the variance of a block that is held, which then does not move
LAYER_ODDS = -1.9  # log prior odds that layers differ from their tissue: those of a patchy tissue


class Acts(Enum):
    """What the unknowns of a block enter."""

    BOUNDARY = "the displacement of prescribed points"
    MATERIAL = "the material of the elements"
    MODULI = "the logarithms of the moduli of regions"
    RESIDUALS = "the residuals of the observations, one unknown each"
    REFERENCE = "the surfaces of the reference image, which all later images are compared with"


class Choice(Enum):
    """How the alternative priors of several blocks go together."""

    NONE = "there is one"
    PATCHINESS = "the same of all tissues"
    LAYERS = "the same of all organs"
    FRAME = "the same in all later images"
    DRAWING = "of an image's surfaces none, one or all are drawn otherwise"
    HELD = "the block is held at its mean, and what it may be counts in the covariance (Schmidt 1966)"

    @property
    def of_tissues(self) -> bool:
        """Whether a scenario of the tissues decides, and no single image."""
        return self in (Choice.PATCHINESS, Choice.LAYERS)

    @property
    def of_explanations(self) -> bool:
        """Whether explanations of the later images may differ in it."""
        return self not in (Choice.NONE, Choice.HELD)


@dataclass(frozen=True)
class Alternative:
    """One prior N(0, covariance (n, n)) of a block, its log prior odds, and its name for a reader.

    variances: of the block's terms, where they were learned.
    """

    covariance: NDArray[np.float64]
    log_odds: float = 0.0
    name: str = ""
    variances: tuple[float, ...] = ()

    @cached_property
    def precision(self) -> NDArray[np.float64]:
        """The covariance's inverse (n, n), formed once."""
        return np.asarray(np.linalg.inv(self.covariance), dtype=np.float64)

    @cached_property
    def log_determinant(self) -> float:
        """Ln det of the precision, found once."""
        return -float(np.linalg.slogdet(self.covariance)[1])


@dataclass(frozen=True, slots=True)
class Block:
    """Unknowns that act in the later `states` (their numbers), with one or more alternative priors.

    of: the tissue that it is of, or the frame; cause: by which shares of a variance are told; alternatives: from narrow
    to wide, among which `choice` says how one is chosen; terms: covariances C_t (n, n) of which a prior is the sum
    sum_t a_t^2 C_t with amplitudes a_t that are learned once, none where it is not; unit_mm: what a coefficient of 1 is
    worth where it is a motion; regions: numbers of the model's regions whose moduli it multiplies, one unknown x for
    all of them, where it acts on moduli: a `share` s of each, in series with the rest of it, is e^x times as stiff, and
    the whole 1 / (1 + s (e^-x - 1)) times; mean (n,): of its priors, 0 where it is empty; rows (n, m): of which m
    unknowns its own are combinations; None: of themselves. Raises `ConfigurationError` for covariances of different
    sizes.
    """

    of: str
    cause: str
    acts: Acts
    states: tuple[int, ...]
    alternatives: tuple[Alternative, ...]
    choice: Choice = Choice.NONE
    terms: tuple[NDArray[np.float64], ...] = ()
    unit_mm: float = 1.0
    regions: tuple[int, ...] = ()
    share: float = 1.0
    mean: tuple[float, ...] = ()
    rows: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        shape = (len(self.alternatives[0].covariance),) * 2
        shapes = [of.covariance.shape for of in self.alternatives] + [term.shape for term in self.terms]
        if any(found != shape for found in shapes):
            raise ConfigurationError(
                f"the block '{self.cause}' of '{self.of}' has covariances {shapes}; all must be square and of one size"
            )

    @property
    def size(self) -> int:
        """Number of its unknowns."""
        return len(self.alternatives[0].covariance)

    @property
    def sought(self) -> bool:
        """Whether it is a Poisson's ratio that is to be found."""
        return self.acts is Acts.MATERIAL and bool(self.mean)

    @property
    def moves_driver(self) -> bool:
        """Whether its unknowns move a driver's wall."""
        return self.acts is Acts.BOUNDARY and self.choice is not Choice.FRAME

    @property
    def mapped(self) -> bool:
        """Whether it is the field of ln E of a tissue that is mapped."""
        return self.cause == FIELD

    @property
    def widest(self) -> NDArray[np.float64]:
        """Covariance (n, n) of its last alternative, the mean of those with its name.

        The largest where amplitudes are learned.
        """
        if self.terms:
            return np.asarray(AMPLITUDES[1] ** 2 * np.sum(self.terms, axis=0))
        alike = [of.covariance for of in self.alternatives if of.name == self.alternatives[-1].name]
        return np.asarray(np.mean(alike, axis=0))

    @property
    def first(self) -> int:
        """Number of the alternative with which a search begins.

        The wide one of a motion or a drawing: what is held at first is taken for motion. Of a tissue the narrow one: it
        would else take what a motion explains.
        """
        return 0 if self.choice.of_tissues else len(self.alternatives) - 1

    @property
    def begins(self) -> Alternative:
        """The prior with which a search begins: that of its `first` alternative, next to none where it is held."""
        first = self.alternatives[self.first]
        return replace(first, covariance=HELD * first.covariance) if self.choice is Choice.HELD else first

    def combined(self, inverse: NDArray[np.float64]) -> Block:
        """The block of the combinations z = inverse x, inverse (k, n), what they leave out held at 0."""

        def of(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
            """Its covariance (k, k)."""
            found = inverse @ covariance @ inverse.T
            return np.asarray(0.5 * (found + found.T))

        alternatives = tuple(replace(each, covariance=of(each.covariance)) for each in self.alternatives)
        mean = tuple((inverse @ self.mean).tolist()) if self.mean else ()
        rows = inverse if self.rows is None else inverse @ self.rows
        return replace(self, alternatives=alternatives, terms=tuple(map(of, self.terms)), mean=mean, rows=rows)

    def with_variances(self, variances: Sequence[float]) -> Block:
        """The block whose terms have these variances, and are learned no more."""
        every = [term + LEAST_VARIANCE * np.eye(self.size) for term in self.terms]
        known = Alternative(np.tensordot(variances, np.stack(every), axes=1), variances=tuple(variances))
        return replace(self, alternatives=(known,), terms=())


def only(covariance: NDArray[np.float64]) -> tuple[Alternative, ...]:
    """The alternatives of a block that has one prior, of a covariance (n, n)."""
    return (Alternative(covariance),)


def unit_blocks(*n_modes: int) -> tuple[Block, ...]:
    """One block of boundary modes a later state, with independent coefficients of variance 1 that are not learned."""
    return tuple(
        Block("what is prescribed", "driver", Acts.BOUNDARY, (state,), only(np.eye(n)))
        for state, n in enumerate(n_modes)
    )


def wall_blocks(wall: Wall, state: int, *, learned: bool = True) -> tuple[Block, ...]:
    """The motion of a driver's wall in a later state: drifts, swellings (see `Wall`), and what is finer.

    The amplitudes of all are learned together: what one explains the others need not, and in turn whichever was learned
    first would keep it. All lengths are terms of one covariance: as alternatives two may be as good, and which one is
    taken would hang on the way.
    """
    n, m = len(wall.columns), wall.n_fine
    terms = [linalg.block_diag(of, np.zeros((m, m))) for of in (*wall.drifts, *wall.swellings)]
    terms += [np.diag(np.repeat([0.0, 1.0], [n, m]))] if m else []
    own = wall.name, "driver", Acts.BOUNDARY, (state,), only(np.eye(n + m))
    return (Block(*own, terms=tuple(terms) if learned else ()),) if n + m else ()


def frame_blocks(motion: PrescribedMotion, state: int) -> tuple[Block, ...]:
    """The motion in a later state of the frame that the image cuts out of the body: smooth, and rigid.

    The frame stands still, or moves as far as is stated; or, smoothly, it hardly moves, for a cut that moves by a
    quarter of a millimetre passes else for one that stands still in very patchy tissue. With an amplitude that may be
    anything between the frame is believed to move less than it does, for patchy tissues explain as much, and the moduli
    pay for it.
    """
    blocks = []
    if motion.smooth:
        size, odds = len(motion.smooth[0]), -float(np.log(len(motion.smooth) + 1))
        floor = LEAST_VARIANCE * np.eye(size)
        levels = [
            Alternative(motion.smooth[0] * STILL**2 + floor, 0.0, "still"),
            Alternative(motion.smooth[-1] * SLIGHT**2 + floor, odds, "hardly moves"),
            *(Alternative(covariance + floor, odds, "moves") for covariance in motion.smooth),
        ]
        if size:
            blocks.append(("smooth", tuple(levels)))
    if motion.n_rigid:
        unit = np.eye(motion.n_rigid)
        rigid = (
            Alternative(unit * STILL_RIGID**2, 0.0, "still as a whole"),
            Alternative(unit * MOVED_RIGID**2, 0.0, "moves as a whole"),
        )
        blocks.append(("rigid", rigid))
    return tuple(
        Block("frame", FRAME, Acts.BOUNDARY, (state,), levels, Choice.FRAME, unit_mm=motion.smooth_mm)
        for _, levels in blocks
    )


def offset_block(observation: Observation, state: int, *, sd: float) -> Block:
    """By how much more an observation shows in a later state than is there; sd in the unit of its residuals.

    Drawn alike but for a tenth of sd, or otherwise by sd, which is so seldom that a bias of some hundredths of a
    millimetre is not taken for it. A driver's wall moves as its drawing does: its offset is held.
    """
    own = (observation.name, "offset", Acts.RESIDUALS, (state,))
    variance = np.full((1, 1), sd**2)
    if observation.of_driver:
        return Block(*own, only(variance), Choice.HELD)
    alike = Alternative(DRAWN_ALIKE**2 * variance, 0.0, "alike")
    return Block(*own, (alike, Alternative(variance, float(np.log(SELDOM)), "otherwise")), Choice.DRAWING)


def reference_block(
    name: str, states: tuple[int, ...], covariances: Sequence[NDArray[np.float64]], *, unit_mm: float
) -> Block:
    """How much further out a surface lies than the reference image draws it, alike for all later `states`.

    covariances (n, n): of its modes, of several lengths; unit_mm: their standard deviation where an amplitude is 1.
    """
    own = name, REFERENCE, Acts.REFERENCE, states, only(np.asarray(sum(covariances)) / len(covariances))
    return Block(*own, terms=tuple(covariances), unit_mm=unit_mm)


def instrument_block(name: str, state: int, *, sd: float) -> Block:
    """By how much the instrument of an observation is off in a later state; sd in the unit of its residuals."""
    return Block(name, "instrument", Acts.RESIDUALS, (state,), only(np.full((1, 1), sd**2)))


def material_blocks(
    modes: MaterialModes,
    mesh: TetMesh,
    states: tuple[int, ...],
    *,
    heterogeneity_sd: float,
    poisson_sd: float,
    n_sought: int = 0,
) -> tuple[Block, ...]:
    """How ln E varies in each tissue, and by how much Poisson's ratios are not those given.

    n_sought: of how many tissues, the last of the modes, the ratios are sought, which have blocks of their own.
    Tissues are nearly homogeneous, by a third of what is stated, patchy by all of it, or very patchy by twice of it.
    The field of a tissue that is mapped has at least what is stated: a small part that differs in a tissue that is else
    homogeneous speaks for a small amplitude, which hides it.
    """
    blocks, tissues, end = list[Block](), mesh.tissues, 0
    for tissue, n in modes.sizes:
        end += n
        if not n:
            continue
        mapped = tissues[tissue].field
        cause, sd, shares = "heterogeneity", heterogeneity_sd, tuple(PATCHINESS.values())
        if mapped:
            cause, sd, shares = FIELD, mapped.sd, OF_A_MAP
        levels = tuple(
            Alternative((share * sd) ** 2 * np.eye(n), odds, name)
            for share, odds, name in zip(shares, PATCHY_ODDS, PATCHINESS, strict=True)
        )
        blocks.append(Block(tissues[tissue].name, cause, Acts.MATERIAL, states, levels, Choice.PATCHINESS))
    if n_given := len(modes.poisson) - n_sought:
        blocks.append(Block("all tissues", POISSON, Acts.MATERIAL, states, only(np.eye(n_given) * poisson_sd**2)))
    return tuple(blocks)


def sought_ratio_blocks(priors: Sequence[tuple[str, float, float]], states: tuple[int, ...]) -> tuple[Block, ...]:
    """By how much the Poisson's ratio of a tissue is not that of the model: one unknown each, alike in all states.

    priors: of each tissue whose ratio is sought its name, the mean and the standard deviation of the unknown.
    """
    return tuple(
        Block(name, POISSON, Acts.MATERIAL, states, only(np.full((1, 1), sd**2)), mean=(mean,))
        for name, mean, sd in priors
    )


def layer_blocks(
    layers: Sequence[tuple[str, tuple[int, ...], float]], states: tuple[int, ...], *, sd: float, thickness_mm: float
) -> tuple[Block, ...]:
    """By how much ln E of a layer round each organ differs from that of its tissue: one unknown each.

    layers: of each organ its name, the numbers of the model's regions, and how thick its elements are there, h mm. The
    layer is t = `thickness_mm` of them, or all where these are thinner: a share min(t / h, 1). A capsule, a film
    of fat or a plane on which an organ slides is hardly seen by its surface, but the organ's modulus depends on it. All
    organs have such layers, or none has.
    """
    variance = np.full((1, 1), sd**2)
    levels = Alternative(BONDED**2 * variance, 0.0, "bonded"), Alternative(variance, LAYER_ODDS, "layers")
    return tuple(
        Block(
            organ,
            LAYER,
            Acts.MODULI,
            states,
            levels,
            Choice.LAYERS,
            regions=regions,
            share=min(thickness_mm / h, 1.0),
        )
        for organ, regions, h in layers
    )


def known_modulus_blocks(
    tissues: Sequence[Tissue], regions: tuple[int, ...], states: tuple[int, ...]
) -> tuple[Block, ...]:
    """By how much ln E of each `known` tissue differs from what is given, where that is a range.

    tissues: the mesh's, whose number in `regions` is each of the model's; layers of a tissue are called as it is.
    """
    believed = {t.name: t.modulus_sd for t in tissues if t.role is Role.KNOWN and t.modulus_sd}
    return tuple(
        Block(
            name,
            KNOWN_MODULUS,
            Acts.MODULI,
            states,
            only(np.full((1, 1), sd**2)),
            regions=tuple(i for i, number in enumerate(regions) if tissues[number].name == name),
        )
        for name, sd in believed.items()
    )


def in_series(x: NDArray[np.float64], shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Change y of ln E (n,) of regions of which shares s (n,) are e^x times as stiff: y = -ln(1 + s (e^-x - 1))."""
    return np.asarray(-np.log1p(shares * np.expm1(-x)))


def in_series_slopes(x: NDArray[np.float64], shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivatives dy / dx = s e^-x / (1 - s + s e^-x), (n,), of `in_series`."""
    softer = shares * np.exp(-x)
    return np.asarray(softer / (1.0 - shares + softer))
