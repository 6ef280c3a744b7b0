"""The map from the unknowns to the parameters of a model, and the prior of the unknowns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate.errors import ConfigurationError
from palpate.images.tissue import Role, Tissue
from palpate.unknowns.arrowhead import Arrowhead, Places
from palpate.unknowns.blocks import Acts, Alternative, Block, Choice, in_series, in_series_slopes
from palpate.unknowns.likelihood import Likelihood

LOADS = "the known loads"
HELD_SD = 0.01  # of ln E: what acts on moduli and is known better stays where it is
LEVELS_OFF = 1.5  # of ln E: distance from a place at which the room that theta leaves all others levels off


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where the unknowns of blocks stand among all: of each block (n,), and by how they act in which state (n,).

    on_moduli (n,): those that act on moduli, in every later state; shares (n,): theirs; of_regions (n_regions, n): 1
    where such an unknown is one of a region; places: those of one later state alone, and all others.
    """

    blocks: tuple[NDArray[np.int64], ...]
    acting: dict[tuple[Acts, int], NDArray[np.int64]]
    on_moduli: NDArray[np.int64]
    shares: NDArray[np.float64]
    of_regions: NDArray[np.float64]
    places: Places

    @classmethod
    def of(cls, blocks: Sequence[Block], first: int, n_regions: int) -> _Layout:
        """The layout of blocks whose unknowns follow each other, from the number of the first one."""
        ends = np.cumsum([first, *(block.size for block in blocks)])
        places = tuple(np.arange(*pair) for pair in pairwise(ends.tolist()))

        def joint(kept: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
            """Numbers (n,) of all of them, one after the other."""
            return np.concatenate([np.zeros(0, dtype=np.int64), *kept])

        pairs, states = list(zip(blocks, places, strict=True)), {state for block in blocks for state in block.states}
        acting = {(a, k): joint([p for b, p in pairs if b.acts is a and k in b.states]) for a in Acts for k in states}
        own = [block for block in blocks if block.acts is Acts.MODULI]
        of_one = [joint([place for block, place in pairs if block.states == (k,)]) for k in sorted(states)]
        of_regions = [np.isin(np.arange(n_regions), block.regions) for block in own]
        return cls(
            places,
            acting,
            joint([place for block, place in pairs if block.acts is Acts.MODULI]),
            np.array([block.share for block in own]),
            np.array(of_regions, dtype=np.float64).reshape(len(own), n_regions).T,
            Places.of(int(ends[-1]), of_one),
        )


@dataclass(frozen=True, slots=True)
class Volume:
    """How much room moduli leave all other unknowns, v = 1/2 ln det H_yy of their Gauss-Newton matrix, near a place.

    v(x) = sum_i g_i l tanh((x_i - c_i) / l) with the slope g (m,) at c (m,), l = `LEVELS_OFF`: where an organ is so
    stiff, or so soft, that its modulus hardly matters, the room stays as it is. x: theta, then unknowns with these
    `numbers` (m - n_parameters,) that act on moduli, too.
    """

    slope: NDArray[np.float64]
    centre: NDArray[np.float64]
    numbers: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def of(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """X (m,) of all unknowns (n_unknowns,)."""
        return np.concatenate([unknowns[: len(self.slope) - len(self.numbers)], unknowns[self.numbers]])

    def at(self, x: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """V at x (m,), and its derivatives (m,)."""
        away = np.tanh((x - self.centre) / LEVELS_OFF)
        return float(LEVELS_OFF * self.slope @ away), np.asarray(self.slope * (1.0 - away**2))


@dataclass(frozen=True)
class ParameterMap:
    """Unknowns x = [theta, x_1, ..., x_B] (n_unknowns,): the parameters theta, then those of the `blocks`.

    theta: ln(E / E_reference) of the `tissues`.
    base (n_regions,) kPa: Young's moduli of the model's regions at theta = 0; selection (n_regions, n_parameters): 1
    where a log-modulus scales a region, several regions where tissues are tied. `relative_to`: the tissue that holds
    the scale; `absolute` is False when nothing sets one: then the first `estimate` tissue is held at 1 and every value
    is a ratio to it. Where known loads alone set it, `relative_to` says so, and the base is 1 kPa. A model of a later
    state takes its `coefficients`: of its boundary modes, then of its material modes, in the order of the blocks.

    The prior is normal: theta with `prior_mean` (n_parameters,) and `prior_precision` (n_parameters, n_parameters),
    flat by default, the blocks' unknowns with their means and one of the `priors` for each block, by default what the
    blocks believe. `volume`: what integrating over the blocks' unknowns adds to J as a function of theta; None:
    nothing, the blocks' unknowns are sought. `earlier`: what images that are not among the later states say of the
    `shared` unknowns, under every scenario, by its `levels`: of each block that a scenario decides the number of its
    alternative, in order; that of the map's own levels counts as a prior. Raises `ConfigurationError` for a prior of
    another shape.
    """

    base: NDArray[np.float64]
    selection: NDArray[np.float64]
    tissues: tuple[str, ...]
    relative_to: str
    absolute: bool
    blocks: tuple[Block, ...]
    prior_mean: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    prior_precision: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    priors: tuple[Alternative, ...] = ()
    volume: Volume | None = None
    earlier: Mapping[tuple[int, ...], Likelihood] = field(default_factory=dict, repr=False)
    levels: tuple[int, ...] = ()
    _layout: _Layout = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        n = self.n_parameters
        object.__setattr__(self, "_layout", _Layout.of(self.blocks, n, len(self.base)))
        for name, shape in {"prior_mean": (n,), "prior_precision": (n, n)}.items():
            given = getattr(self, name)
            if not given.size:
                object.__setattr__(self, name, np.zeros(shape))
            elif given.shape != shape:
                raise ConfigurationError(f"{name} has the shape {given.shape}; {n} parameters need {shape}")
        if not self.priors:
            object.__setattr__(self, "priors", tuple(block.begins for block in self.blocks))
            object.__setattr__(self, "levels", tuple(self.blocks[i].first for i in self._of_tissues))
        sizes = [[len(of.covariance) for of in self.priors], [block.size for block in self.blocks]]
        if sizes[0] != sizes[1]:
            raise ConfigurationError(f"the priors are of {sizes[0]} unknowns, the blocks have {sizes[1]}")

    @property
    def by_load(self) -> bool:
        """Whether known loads, and no known modulus, set the scale."""
        return self.relative_to == LOADS

    @property
    def scale_kpa(self) -> float:
        """Modulus (kPa) of the tissue that holds the scale; 1 when none is known."""
        return float(self.base[self.selection[:, 0] > 0.0][0])

    def reference_shift(self, unknowns: NDArray[np.float64]) -> float:
        """By how much ln E of the tissue that holds the scale differs from what is given at unknowns (n_unknowns,)."""
        own = [
            i
            for i, b in enumerate(self.blocks)
            if b.choice is Choice.NONE and b.acts is Acts.MODULI and b.of == self.relative_to
        ]
        return sum(float(unknowns[self.columns(i)].sum()) for i in own)

    def in_words(self, unknowns: NDArray[np.float64]) -> str:
        """The parameters' values at unknowns (n_unknowns,), for the progress."""
        ratios = zip(self.tissues, np.exp(unknowns[: self.n_parameters]), strict=True)
        return ", ".join(f"{name} {ratio:.2f} x {self.relative_to}" for name, ratio in ratios)

    @property
    def n_parameters(self) -> int:
        """Number of parameters theta among the unknowns."""
        return len(self.tissues)

    @property
    def n_unknowns(self) -> int:
        """Number of all unknowns."""
        return self.n_parameters + self.n_coefficients

    @property
    def n_coefficients(self) -> int:
        """Number of the blocks' unknowns."""
        return sum(block.size for block in self.blocks)

    @property
    def n_states(self) -> int:
        """Number of later states."""
        return 1 + max((state for block in self.blocks for state in block.states), default=-1)

    def columns(self, block: int) -> NDArray[np.int64]:
        """Numbers (n,) among all unknowns of those of a block."""
        return self._layout.blocks[block]

    @property
    def places(self) -> Places:
        """Which unknowns belong to each later state alone, and which several share, as the log-moduli are."""
        return self._layout.places

    def acting(self, acts: Acts, state: int) -> NDArray[np.int64]:
        """Numbers (n,) of the unknowns that act so in a later state, in the order of the blocks."""
        return self._layout.acting.get((acts, state), np.zeros(0, dtype=np.int64))

    @property
    def shared(self) -> NDArray[np.int64]:
        """Numbers (n,) of theta and of the blocks of the body, which another later image would have, too."""
        body = [self.columns(i) for i in self.body_blocks]
        return np.concatenate([np.arange(self.n_parameters), *body])

    @property
    def body_blocks(self) -> list[int]:
        """Numbers of the blocks of the body, which no single image has for itself."""
        own = {i for state in range(self.n_states) for i in self.blocks_of_image(state)}
        return [i for i in range(len(self.blocks)) if i not in own]

    @property
    def _of_tissues(self) -> list[int]:
        return [i for i, block in enumerate(self.blocks) if block.choice.of_tissues]

    @cached_property
    def prior_of_blocks(self) -> Arrowhead:
        """Precision of all unknowns before any image is seen."""
        of_blocks = [(place, of.precision) for place, of in zip(self._layout.blocks, self.priors, strict=True)]
        return Arrowhead.zeros(self.places).plus([(np.arange(self.n_parameters), self.prior_precision), *of_blocks])

    @cached_property
    def prior_matrix(self) -> Arrowhead:
        """Precision P of all unknowns before the images are seen, but the earlier ones."""
        earlier = self.earlier.get(self.levels)
        return self.prior_of_blocks.plus([(self.shared, earlier.matrix)]) if earlier else self.prior_of_blocks

    @property
    def prior_pull(self) -> NDArray[np.float64]:
        """P m (n_unknowns,), m where the prior is largest."""
        pull, earlier = self.prior_of_blocks @ self.prior_centre, self.earlier.get(self.levels)
        if earlier:
            pull[self.shared] += earlier.pull
        return pull

    @property
    def earlier_constant(self) -> float:
        """The constant of what the earlier images say; 0 without any."""
        earlier = self.earlier.get(self.levels)
        return earlier.constant if earlier else 0.0

    @property
    def prior_centre(self) -> NDArray[np.float64]:
        """Mean (n_unknowns,) of all unknowns before any image is seen."""
        return np.concatenate([self.prior_mean, *(block.mean or np.zeros(block.size) for block in self.blocks)])

    def prior(self, unknowns: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """1/2 (x - m)^T P (x - m) + v(theta), v the `volume`, at unknowns x (n_unknowns,); gradient (n_unknowns,)."""
        away, n = unknowns - self.prior_centre, self.n_parameters
        pull = self.prior_of_blocks @ away
        value = 0.5 * float(away @ pull)
        if earlier := self.earlier.get(self.levels):
            told, by = earlier.at(unknowns[self.shared])
            value, pull[self.shared] = value + told, pull[self.shared] + by
        if self.volume is not None:
            added, slope = self.volume.at(self.volume.of(unknowns))
            value, pull[:n] = value + added, pull[:n] + slope[:n]
            pull[self.volume.numbers] += slope[n:]
        return value, pull

    def moduli(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """The regions' moduli (n_regions,) kPa at unknowns (n_unknowns,), or at theta (n_parameters,) alone."""
        logarithms = self.selection @ unknowns[: self.n_parameters]
        if len(unknowns) > self.n_parameters:
            changes = in_series(self._on_moduli(unknowns), self.shares_on_moduli)
            logarithms = logarithms + self._layout.of_regions @ changes
        return np.asarray(self.base * np.exp(logarithms))

    def derivatives(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives (n_regions, n) of the moduli's logarithms at unknowns (n_unknowns,).

        By theta, then by the blocks' unknowns that act on moduli.
        """
        slopes = in_series_slopes(self._on_moduli(unknowns), self.shares_on_moduli)
        return np.concatenate([self.selection, self._layout.of_regions * slopes], axis=1)

    @property
    def acting_on_moduli(self) -> NDArray[np.int64]:
        """Numbers (n,) of the blocks' unknowns by which moduli of regions differ, in every later state."""
        return self._layout.on_moduli

    @property
    def free_on_moduli(self) -> NDArray[np.int64]:
        """Those of them (n,) that the prior leaves free: layers unlike their tissues, known moduli that are a range."""
        own = self.acting_on_moduli
        return np.asarray(own[self.prior_matrix.diagonal[own] < HELD_SD**-2.0])

    @property
    def shares_on_moduli(self) -> NDArray[np.float64]:
        """Of the regions of each unknown that acts on moduli, the share (n,) that it is of."""
        return self._layout.shares

    def _on_moduli(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Those (n,) of unknowns (n_unknowns,) that act on moduli; 0 where there is theta alone."""
        own = self.acting_on_moduli
        return unknowns[own] if len(unknowns) > self.n_parameters else np.zeros(len(own))

    def coefficients(self, unknowns: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """What the model of each state takes beside the moduli (n_modes,): boundary modes, then material modes."""
        return [unknowns[self._model_columns(state)] for state in range(self.n_states)]

    def offsets(self, unknowns: NDArray[np.float64], state: int) -> NDArray[np.float64]:
        """How surfaces are drawn otherwise (n_offsets,): offsets in a later image, then modes in the one at rest."""
        return np.asarray(unknowns[self._drawing(state)])

    def offset_names(self, state: int) -> list[str]:
        """Names of the observations of a state that have an offset, in the order of these."""
        return [b.of for b in self.blocks if b.acts is Acts.RESIDUALS and state in b.states]

    def at_rest(self, state: int) -> dict[str, slice]:
        """Which of the `offsets` of a state are modes of a surface as the reference image draws it, by its name."""
        first, found = len(self.acting(Acts.RESIDUALS, state)), dict[str, slice]()
        for block in self.blocks:
            if block.acts is Acts.REFERENCE and state in block.states:
                found[block.of] = slice(first, first + block.size)
                first += block.size
        return found

    def _drawing(self, state: int) -> NDArray[np.int64]:
        return np.concatenate([self.acting(Acts.RESIDUALS, state), self.acting(Acts.REFERENCE, state)])

    def unknowns_of(self, state: int) -> NDArray[np.int64]:
        """Numbers (n_own,) of the unknowns that a state depends on.

        Theta, what else acts on moduli, its model's coefficients, how its surfaces are drawn otherwise.
        """
        theta = np.arange(self.n_parameters)
        return np.concatenate([theta, self.acting_on_moduli, self._model_columns(state), self._drawing(state)])

    def by_unknowns(self, tangent: NDArray[np.float64], unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives (n, k + n_modes) by what acts on moduli and the coefficients, from those by (ln E, q)."""
        n_regions = len(self.base)
        return np.concatenate([tangent[:, :n_regions] @ self.derivatives(unknowns), tangent[:, n_regions:]], axis=1)

    def chain(self, state: int, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives (n_regions + n_modes, n_own) of a state's (ln E, q) by its own unknowns.

        Its columns are those of `unknowns_of`, at unknowns (n_unknowns,).
        """
        n_modes, n_offsets = len(self._model_columns(state)), len(self._drawing(state))
        moved = linalg.block_diag(self.derivatives(unknowns), np.eye(n_modes))
        return np.pad(moved, ((0, 0), (0, n_offsets)))

    def alone(self, state: int) -> tuple[ParameterMap, NDArray[np.int64]]:
        """The map of one later state, without earlier images and room, and the numbers (n_own,) of its unknowns."""
        kept = [i for i, block in enumerate(self.blocks) if state in block.states]
        blocks = tuple(replace(self.blocks[i], states=(0,)) for i in kept)
        own = np.concatenate([np.arange(self.n_parameters), *(self.columns(i) for i in kept)])
        priors = tuple(self.priors[i] for i in kept)
        levels = tuple(level for i, level in zip(self._of_tissues, self.levels, strict=True) if i in kept)
        return replace(self, blocks=blocks, priors=priors, volume=None, earlier={}, levels=levels), own

    def _model_columns(self, state: int) -> NDArray[np.int64]:
        return np.concatenate([self.acting(Acts.BOUNDARY, state), self.acting(Acts.MATERIAL, state)])

    def with_priors(self, priors: Mapping[int, Alternative]) -> ParameterMap:
        """The same with other priors of some blocks, by their numbers."""
        return replace(self, priors=tuple(priors.get(i, own) for i, own in enumerate(self.priors)))

    def choosing(self, chosen: Mapping[int, int]) -> ParameterMap:
        """The same with the alternative priors of blocks, by the numbers of both."""
        levels = tuple(chosen.get(i, own) for i, own in zip(self._of_tissues, self.levels, strict=True))
        return replace(self.with_priors({i: self.blocks[i].alternatives[k] for i, k in chosen.items()}), levels=levels)

    def combined(self, inverses: Sequence[NDArray[np.float64]]) -> ParameterMap:
        """The map of combinations z = inverse x of each block's unknowns, inverse (k, n), as believed at first.

        What earlier images say of that which is left out is integrated out under each scenario.
        """
        blocks = tuple(block.combined(inverse) for block, inverse in zip(self.blocks, inverses, strict=True))
        shared, found = self.body_blocks, dict[tuple[int, ...], Likelihood]()
        rows = linalg.block_diag(np.eye(self.n_parameters), *(inverses[i] for i in shared))
        for levels, earlier in self.earlier.items():
            chosen = dict(zip(self._of_tissues, levels, strict=True))
            priors = [self.blocks[i].alternatives[chosen[i]] if i in chosen else self.priors[i] for i in shared]
            covariance = linalg.block_diag(np.eye(self.n_parameters), *(of.covariance for of in priors))
            found[levels] = earlier.of_combinations(rows, covariance)
        return replace(self, blocks=blocks, priors=(), earlier=found)

    def blocks_of_image(self, state: int) -> list[int]:
        """Numbers of the blocks of how a later image moves and is drawn, which no other image has."""
        own = (Acts.BOUNDARY, Acts.RESIDUALS)
        return [i for i, b in enumerate(self.blocks) if b.acts in own and b.states == (state,)]

    def of_image(self, state: int) -> NDArray[np.int64]:
        """Numbers (n,) of the unknowns of these blocks."""
        places = [self.columns(i) for i in self.blocks_of_image(state)]
        return np.concatenate([np.zeros(0, dtype=np.int64), *places])

    def with_prior(self, mean: NDArray[np.float64], sd: NDArray[np.float64]) -> ParameterMap:
        """The same with a normal prior of theta: mean and standard deviation (n_parameters,), inf where it is flat.

        Raises `ConfigurationError` unless every sd is positive and every mean that counts is a number.
        """
        wrong = ~(sd > 0.0) | (np.isfinite(sd) & ~np.isfinite(mean))
        if wrong.any():
            first = int(np.flatnonzero(wrong)[0])
            raise ConfigurationError(
                f"the prior of ln E of '{self.tissues[first]}' has the mean {mean[first]} and the standard deviation"
                f" {sd[first]}; give a finite mean and a positive standard deviation (inf: no prior), or make the"
                " modulus `known`"
            )
        return replace(self, prior_mean=np.where(np.isfinite(sd), mean, 0.0), prior_precision=np.diag(sd**-2.0))


def parameter_map(
    tissues: tuple[Tissue, ...],
    regions: tuple[int, ...],
    blocks: Sequence[Block],
    *,
    loaded: bool = False,
    tied: Sequence[Sequence[str]] = (),
) -> ParameterMap:
    """Make the map for a mesh whose regions are `tissues[i] for i in regions`, with these blocks of further unknowns.

    The scale is the modulus of the first `known` tissue in the file, or without one what the loads say (`loaded`: known
    loads act). tied: groups of `estimate` tissues, by name, that share one modulus. Raises `ConfigurationError` when
    there is nothing to estimate, or a single tissue and nothing to compare it with.
    """
    meshed = [tissues[i] for i in regions]
    known = [tissue for tissue in meshed if tissue.role is Role.KNOWN]
    estimated = [tissue.name for tissue in meshed if tissue.role is Role.ESTIMATE]
    strange = sorted({name for group in tied for name in group} - set(estimated))
    if strange:
        raise ConfigurationError(f"tied tissues must have the role `estimate`: of {estimated}, not {strange}")
    of = {name: tuple(group) for group in tied for name in group}
    groups = list(dict.fromkeys(of.get(name, (name,)) for name in estimated))
    absolute = bool(known)
    sought = groups if absolute or loaded else groups[1:]
    if not sought:
        raise ConfigurationError(
            "nothing can be estimated: displacements fix ratios of moduli only, so a case needs an `estimate` tissue"
            " and a `known` tissue, a known load, or a second `estimate` tissue"
        )
    selection = np.array([[float(tissue.name in group) for group in sought] for tissue in meshed])
    names = tuple(" and ".join(group) for group in sought)
    if loaded and not known:
        return ParameterMap(np.ones(len(meshed)), selection, names, LOADS, True, tuple(blocks))
    unit = (known[0].youngs_modulus_kpa or 1.0) if absolute else 1.0
    base = np.array([(t.youngs_modulus_kpa or unit) if t.role is Role.KNOWN else unit for t in meshed])
    scale = known[0].name if absolute else " and ".join(groups[0])
    return ParameterMap(base, selection, names, scale, absolute, tuple(blocks))
