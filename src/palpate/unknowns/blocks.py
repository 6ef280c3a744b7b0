"""Parameter blocks: groups of unknowns beside the moduli, each with its prior.

A block is one cause that a real pair of images brings: how a driver's wall moves, how the frame that the image cuts out
of the body moves, how a surface is drawn, how a tissue's stiffness varies. The layers above ask a block what it acts on
and what it believes, never what it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

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

AMPLITUDES = (0.005, 2.0)  # bounds, times the standard deviation of the coefficients
STILL, SLIGHT = 0.02, 0.1  # motion of a frame that stands still, and that hardly moves, over that of a moving one
MOVES = (1.0, 2.0)  # bounds of a frame's amplitude, times the stated one
STILL_RIGID, MOVED_RIGID = 0.005, 0.2
DRAWN_ALIKE, SELDOM = 0.1, 0.01  # sd of an offset of surfaces drawn alike, over that of others; odds of the others
KNOWN_MODULUS, FRAME = "known modulus", "frame"
FIELD, LAYER = "field", "layer"
LEFT_OUT, LEFT_OUT_OF_MAP = 1.0, 0.3  # see `Block.left_out`; less for a map, which would lack those modes
FIELD_AMPLITUDES = (1.0, 2.0)  # of a mapped tissue, times the stated standard deviation
CONSIDERED = 1e8  # factor on the precision of a considered unknown, which then does not move
# standard deviation of ln E in a tissue that is nearly homogeneous, patchy, very patchy, over the stated one; and the
# log prior odds of the three: 1, 0.15 and 0.15
PATCHINESS: tuple[float, ...] = (1.0 / 3.0, 1.0, 2.0)
PATCHY_ODDS = (0.0, -1.9, -1.9)
LAYER_ODDS = -1.9  # log prior odds that layers differ from their tissue: those of a patchy tissue


class Acts(Enum):
    """What the unknowns of a block enter."""

    BOUNDARY = "the displacement of prescribed points"
    MATERIAL = "the material of the elements"
    MODULI = "the logarithms of the moduli of regions"
    RESIDUALS = "the residuals of the observations, one unknown each"


@dataclass(frozen=True, slots=True)
class Block:
    """Unknowns x ~ N(0, P^-1) that act in the later `states` (their numbers).

    of: the tissue that it is of, or the frame; cause: by which shares of a variance are told; unit_mm: what a
    coefficient of 1 is worth where it is a motion; precision: P (n, n) before anything is learned. alternatives:
    families of covariances sum_t a_t^2 C_t (n, n), each the tuple of its terms C_t, of which the images choose one with
    its amplitudes a_t, by their evidence; none where P is held. amplitudes: bounds of a_t; odds: log prior odds of the
    alternatives, of which the likeliest is taken; none: of alternatives that are alike the widest. considered: the
    images cannot tell them, so that they are held at 0, and what they may be counts in the covariance (Schmidt 1966).
    last: its prior is learned where the estimate has converged under those of the others; before it would take what
    they explain, or leave it to them. rivals: causes that explain as much as it: its last alternative is none where a
    block of theirs has left its first one. slight: whether its second alternative is so near the first that blocks with
    its cause among their rivals explain as much. released: held at 0 as well while an estimate is sought, and free
    under P where its interval is, and in the estimate where that is likelier, by log prior odds of `released_odds`.
    left_out: variances of the first noise, a tenth of the found one, that what is left out of the unknowns may explain
    (see `informed_objective`); below 0 none is. regions: numbers of the model's regions whose moduli it multiplies, one
    unknown x for all of them, where it acts on moduli: a `share` s of each, in series with the rest of it, is e^x times
    as stiff, and the whole 1 / (1 + s (e^-x - 1)) times. Raises `ConfigurationError` for terms of another size.
    """

    of: str
    cause: str
    acts: Acts
    states: tuple[int, ...]
    precision: NDArray[np.float64]
    alternatives: tuple[tuple[NDArray[np.float64], ...], ...] = ()
    amplitudes: tuple[float, float] = AMPLITUDES
    odds: tuple[float, ...] = ()
    considered: bool = False
    last: bool = False
    rivals: tuple[str, ...] = ()
    slight: bool = False
    released: bool = False
    released_odds: float = 0.0
    unit_mm: float = 1.0
    regions: tuple[int, ...] = ()
    share: float = 1.0
    left_out: float = LEFT_OUT

    def __post_init__(self) -> None:
        shape = (len(self.precision),) * 2
        wrong = [term.shape for terms in self.alternatives for term in terms if term.shape != shape]
        if self.precision.shape != shape or wrong:
            raise ConfigurationError(
                f"the block '{self.cause}' of '{self.of}' has a precision {self.precision.shape} and covariance"
                f" terms {wrong or [shape]}; all must be square and of one size"
            )

    @property
    def size(self) -> int:
        """Number of its unknowns."""
        return len(self.precision)

    @property
    def widest(self) -> NDArray[np.float64]:
        """Covariance (n, n) with the largest amplitudes, the mean of its alternatives; P^-1 where there are none."""
        if not self.alternatives:
            return np.asarray(np.linalg.inv(self.precision))
        every = [sum(terms, np.zeros_like(self.precision)) for terms in self.alternatives]
        return np.asarray(self.amplitudes[1] ** 2 * np.mean(every, axis=0))

    def combined(self, inverse: NDArray[np.float64]) -> Block:
        """The block of the combinations z = inverse x, inverse (k, n), what they leave out held at 0."""
        covariance = inverse @ np.linalg.inv(self.precision) @ inverse.T
        alternatives = tuple(tuple(inverse @ term @ inverse.T for term in terms) for terms in self.alternatives)
        precision = np.asarray(np.linalg.inv(0.5 * (covariance + covariance.T)), dtype=np.float64)
        return replace(self, precision=precision, alternatives=alternatives)


def unit_blocks(*n_modes: int) -> tuple[Block, ...]:
    """One block of boundary modes a later state, with independent coefficients of variance 1 that are not learned."""
    return tuple(
        Block("what is prescribed", "driver", Acts.BOUNDARY, (state,), np.eye(n)) for state, n in enumerate(n_modes)
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
    block = Block(wall.name, "driver", Acts.BOUNDARY, (state,), np.eye(n + m), (tuple(terms),) if learned else ())
    return (block,) if n + m else ()


def frame_blocks(motion: PrescribedMotion, state: int) -> tuple[Block, ...]:
    """The motion in a later state of the frame that the image cuts out of the body: smooth, and rigid.

    Each a mixture, of which the evidence chooses: the frame stands still, or moves as far as is stated; or, smoothly,
    it hardly moves, for a cut that moves by a quarter of a millimetre passes else for one that stands still in very
    patchy tissue. With an amplitude that may be anything between the frame is believed to move less than it does, for
    patchy tissues explain as much, and the moduli pay for it.
    """
    smooth = [motion.smooth[0] * STILL**2, motion.smooth[-1] * SLIGHT**2, *motion.smooth] if motion.smooth else []
    rigid = [np.eye(motion.n_rigid) * amount**2 for amount in (STILL_RIGID, MOVED_RIGID)]
    return tuple(
        Block(
            "frame",
            FRAME,
            Acts.BOUNDARY,
            (state,),
            np.linalg.inv(terms[-1]) if terms is rigid else np.eye(len(terms[0])),
            tuple((term,) for term in terms),
            amplitudes=amplitudes,
            odds=(0.0, *(-float(np.log(len(terms) - 1)),) * (len(terms) - 1)),
            slight=terms is smooth,
            unit_mm=motion.smooth_mm,
        )
        for terms, amplitudes in ((smooth, MOVES), (rigid, (1.0, 1.0)))
        if terms and len(terms[0])
    )


def offset_block(observation: Observation, state: int, *, sd: float) -> Block:
    """By how much more an observation shows in a later state than is there; sd in the unit of its residuals.

    A mixture of two normal laws, of which the evidence chooses: drawn alike but for a tenth of sd, or otherwise by sd,
    which is so seldom that a bias of some hundredths of a millimetre is not taken for it. Until an estimate has
    converged it is the latter: what is held at first is taken for motion. A driver's wall moves as its drawing does:
    its offset is considered, not estimated.
    """
    own = (observation.name, "offset", Acts.RESIDUALS, (state,), np.full((1, 1), sd**-2.0))
    if observation.of_driver:
        return Block(*own, considered=True)
    alternatives = tuple((np.full((1, 1), (share * sd) ** 2),) for share in (DRAWN_ALIKE, 1.0))
    return Block(*own, alternatives, amplitudes=(1.0, 1.0), odds=(0.0, float(np.log(SELDOM))), last=True)


def instrument_block(name: str, state: int, *, sd: float) -> Block:
    """By how much the instrument of an observation is off in a later state; sd in the unit of its residuals."""
    return Block(name, "instrument", Acts.RESIDUALS, (state,), np.full((1, 1), sd**-2.0))


def material_blocks(
    modes: MaterialModes,
    mesh: TetMesh,
    states: tuple[int, ...],
    *,
    heterogeneity_sd: float,
    poisson_sd: float,
) -> tuple[Block, ...]:
    """How ln E varies in each tissue, and by how much Poisson's ratios are not those given.

    A tissue is nearly homogeneous, by a third of what is stated, patchy by all of it, or very patchy by twice of it, of
    which the evidence chooses; surfaces hardly tell these apart, so that the first stays until another one is clearly
    more likely. A very patchy tissue looks like a frame that moves: where the frame moves none is very patchy, or
    hardly an estimate with such a frame would state anything. The field of a tissue that is mapped has the amplitude
    that is stated until twice of it is clearly more likely. It has no less: a small part that differs in a tissue that
    is else homogeneous speaks for a small amplitude, which hides it.
    """
    blocks, tissues = [], mesh.tissues
    for tissue, n in modes.sizes:
        if not n:
            continue
        cause, sd, shares = "heterogeneity", heterogeneity_sd, PATCHINESS
        if mapped := tissues[tissue].field:
            cause, sd, shares = FIELD, mapped.sd, FIELD_AMPLITUDES
        first, *_ = levels = [(share * sd) ** 2 for share in shares]
        odds = (0.0,) * len(levels) if mapped else PATCHY_ODDS
        blocks.append(
            Block(
                tissues[tissue].name,
                cause,
                Acts.MATERIAL,
                states,
                np.eye(n) / first,
                tuple((level * np.eye(n),) for level in levels),
                amplitudes=(1.0, 1.0),
                odds=odds,
                last=mapped is None,
                rivals=() if mapped else (FRAME,),
                left_out=LEFT_OUT if mapped is None else LEFT_OUT_OF_MAP,
            )
        )
    if modes.poisson:
        precision = np.eye(len(modes.poisson)) / poisson_sd**2
        blocks.append(Block("all tissues", "poisson", Acts.MATERIAL, states, precision))
    return tuple(blocks)


def layer_blocks(
    layers: Sequence[tuple[str, tuple[int, ...], float]], states: tuple[int, ...], *, sd: float, thickness_mm: float
) -> tuple[Block, ...]:
    """By how much ln E of a layer round each organ differs from that of its tissue: one unknown each.

    layers: of each organ its name, the numbers of the model's regions, and how thick its elements are there, h mm. The
    layer is t = `thickness_mm` of them, or all where these are thinner: a share min(t / h, 1). A capsule, a film
    of fat or a plane on which an organ slides is hardly seen by its surface, but the organ's modulus depends on it: as
    an unknown of the estimate it costs accuracy where there is none, and an interval that leaves it out does not hold
    where there is one.
    """
    return tuple(
        Block(
            organ,
            LAYER,
            Acts.MODULI,
            states,
            np.full((1, 1), sd**-2.0),
            released=True,
            released_odds=LAYER_ODDS,
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
            np.full((1, 1), sd**-2.0),
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


def of_series(y: NDArray[np.float64], shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """The x (n,) of which y (n,) is `in_series`; infinite where no stiffness of the share makes a region so stiff."""
    left = np.expm1(-y) / shares
    return np.asarray(-np.log1p(np.maximum(left, -1.0), where=left > -1.0, out=np.full_like(left, -np.inf)))


def joined(blocks: Sequence[Block]) -> NDArray[np.float64]:
    """Precision (n, n) with which an estimate of the unknowns of several blocks begins, one after the other."""
    total = sum(block.size for block in blocks)
    matrix, start = np.zeros((total, total)), 0
    for block in blocks:
        end, held = start + block.size, block.considered or block.released
        matrix[start:end, start:end], start = CONSIDERED * block.precision if held else block.precision, end
    return matrix
