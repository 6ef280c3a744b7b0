"""The map from the unknowns to the parameters of a model, and the prior of the unknowns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from palpate.errors import ConfigurationError
from palpate.images.tissue import Role, Tissue
from palpate.unknowns.blocks import KNOWN_MODULUS, Acts, Block, in_series, in_series_slopes, joined

LOADS = "the known loads"


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where the unknowns of blocks stand among all: of each block (n,), and by how they act in which state (n,).

    on_moduli (n,): those that act on moduli, in every later state; shares (n,): theirs; of_regions (n_regions, n): 1
    where such an unknown is one of a region; images: of each later state those that act in it alone, () where fewer
    than two states have any.
    """

    blocks: tuple[NDArray[np.int64], ...]
    acting: dict[tuple[Acts, int], NDArray[np.int64]]
    on_moduli: NDArray[np.int64]
    shares: NDArray[np.float64]
    of_regions: NDArray[np.float64]
    images: tuple[NDArray[np.int64], ...]

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
        images = tuple(numbers for numbers in of_one if len(numbers))
        of_regions = [np.isin(np.arange(n_regions), block.regions) for block in own]
        return cls(
            places,
            acting,
            joint([place for block, place in pairs if block.acts is Acts.MODULI]),
            np.array([block.share for block in own]),
            np.array(of_regions, dtype=np.float64).reshape(len(own), n_regions).T,
            images if len(images) > 1 else (),
        )


@dataclass(frozen=True, slots=True)
class ParameterMap:
    """Unknowns x = [theta, x_1, ..., x_B] (n_unknowns,): the parameters theta, then those of the `blocks`.

    theta: ln(E / E_reference) of the `tissues`.
    base (n_regions,) kPa: Young's moduli of the model's regions at theta = 0; selection (n_regions, n_parameters): 1
    where a log-modulus scales a region, several regions where tissues are tied. `relative_to`: the tissue that holds
    the scale; `absolute` is False when nothing sets one: then the first `estimate` tissue is held at 1 and every value
    is a ratio to it. Where known loads alone set it, `relative_to` says so, and the base is 1 kPa. A model of a later
    state takes its `coefficients`: of its boundary modes, then of its material modes, in the order of the blocks.

    The prior is normal: theta with `prior_mean` (n_parameters,) and `prior_precision` (n_parameters, n_parameters),
    flat by default, the blocks' unknowns with their means and `nuisance_precision` (n_coefficients, n_coefficients), by
    default what the blocks believe. Raises `ConfigurationError` for a prior of another shape.
    """

    base: NDArray[np.float64]
    selection: NDArray[np.float64]
    tissues: tuple[str, ...]
    relative_to: str
    absolute: bool
    blocks: tuple[Block, ...]
    prior_mean: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    prior_precision: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    nuisance_precision: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    _layout: _Layout = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        n = self.n_parameters
        object.__setattr__(self, "_layout", _Layout.of(self.blocks, n, len(self.base)))
        k = self.n_coefficients
        for name, shape in {"prior_mean": (n,), "prior_precision": (n, n), "nuisance_precision": (k, k)}.items():
            given = getattr(self, name)
            if not given.size:  # inverses of all blocks' covariances are formed only where they are asked for
                blank = joined(self.blocks) if name == "nuisance_precision" else np.zeros(shape)
                object.__setattr__(self, name, blank)
            elif given.shape != shape:
                raise ConfigurationError(
                    f"{name} has the shape {given.shape}; {n} parameters and {k} unknowns in blocks need {shape}"
                )

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
        own = [i for i, b in enumerate(self.blocks) if b.cause == KNOWN_MODULUS and b.of == self.relative_to]
        return sum(float(unknowns[self.columns(i)].sum()) for i in own)

    def in_words(self, unknowns: NDArray[np.float64]) -> str:
        """The parameters' values at unknowns (n_unknowns,), for the progress."""
        ratios = zip(self.tissues, np.exp(unknowns), strict=False)
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
    def images(self) -> tuple[NDArray[np.int64], ...]:
        """Numbers (n,) of the unknowns that belong to each later state alone; () where fewer than two have any."""
        return self._layout.images

    def acting(self, acts: Acts, state: int) -> NDArray[np.int64]:
        """Numbers (n,) of the unknowns that act so in a later state, in the order of the blocks."""
        return self._layout.acting.get((acts, state), np.zeros(0, dtype=np.int64))

    @property
    def prior_matrix(self) -> NDArray[np.float64]:
        """Precision P (n_unknowns, n_unknowns) of all unknowns before the images are seen."""
        n, matrix = self.n_parameters, np.zeros((self.n_unknowns, self.n_unknowns))
        matrix[:n, :n] = self.prior_precision
        matrix[n:, n:] = self.nuisance_precision
        return matrix

    @property
    def prior_centre(self) -> NDArray[np.float64]:
        """Mean (n_unknowns,) of all unknowns before the images are seen."""
        return np.concatenate([self.prior_mean, *(block.mean or np.zeros(block.size) for block in self.blocks)])

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
        """What is added to the residuals of those observations of a state that have an offset (n_offsets,)."""
        return np.asarray(unknowns[self.acting(Acts.RESIDUALS, state)])

    def offset_names(self, state: int) -> list[str]:
        """Names of the observations of a state that have an offset, in the order of these."""
        return [b.of for b in self.blocks if b.acts is Acts.RESIDUALS and state in b.states]

    def unknowns_of(self, state: int) -> NDArray[np.int64]:
        """Numbers (n_own,) of the unknowns that a state depends on.

        Theta, what else acts on moduli, its model's coefficients, its offsets.
        """
        residuals, theta = self.acting(Acts.RESIDUALS, state), np.arange(self.n_parameters)
        return np.concatenate([theta, self.acting_on_moduli, self._model_columns(state), residuals])

    def by_unknowns(self, tangent: NDArray[np.float64], unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives (n, k + n_modes) by what acts on moduli and the coefficients, from those by (ln E, q)."""
        n_regions = len(self.base)
        return np.concatenate([tangent[:, :n_regions] @ self.derivatives(unknowns), tangent[:, n_regions:]], axis=1)

    def chain(self, state: int, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives (n_regions + n_modes, n_own) of a state's (ln E, q) by its own unknowns.

        Its columns are those of `unknowns_of`, at unknowns (n_unknowns,).
        """
        n_modes, n_offsets = len(self._model_columns(state)), len(self.acting(Acts.RESIDUALS, state))
        moved = linalg.block_diag(self.derivatives(unknowns), np.eye(n_modes))
        return np.pad(moved, ((0, 0), (0, n_offsets)))

    def alone(self, state: int) -> tuple[ParameterMap, NDArray[np.int64]]:
        """The map of one later state alone, and the numbers (n_own,) of its unknowns among all."""
        kept = [i for i, block in enumerate(self.blocks) if state in block.states]
        blocks = tuple(replace(self.blocks[i], states=(0,)) for i in kept)
        own = np.concatenate([np.arange(self.n_parameters), *(self.columns(i) for i in kept)])
        nuisance = own[self.n_parameters :] - self.n_parameters
        precision = self.nuisance_precision[np.ix_(nuisance, nuisance)]
        return replace(self, blocks=blocks, nuisance_precision=precision), own

    def _model_columns(self, state: int) -> NDArray[np.int64]:
        return np.concatenate([self.acting(Acts.BOUNDARY, state), self.acting(Acts.MATERIAL, state)])

    def believing(self, priors: Mapping[int, NDArray[np.float64]]) -> ParameterMap:
        """The same with the precisions (n, n) of some blocks, by their numbers."""
        precision, n = self.nuisance_precision.copy(), self.n_parameters
        for number, own in priors.items():
            columns = self.columns(number) - n
            precision[np.ix_(columns, columns)] = own
        return replace(self, nuisance_precision=precision)

    def choosing(self, chosen: Mapping[int, int]) -> ParameterMap:
        """The same with the alternative priors of blocks, by the numbers of both."""
        every = {i: self.blocks[i].alternatives[k].covariance for i, k in chosen.items()}
        return self.believing({i: np.asarray(np.linalg.inv(covariance)) for i, covariance in every.items()})

    def of_image(self, state: int) -> NDArray[np.int64]:
        """Numbers (n,) of the unknowns of how a later image moves and is drawn, which no other image has."""
        own = (Acts.BOUNDARY, Acts.RESIDUALS)
        places = [self.columns(i) for i, b in enumerate(self.blocks) if b.acts in own and b.states == (state,)]
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
