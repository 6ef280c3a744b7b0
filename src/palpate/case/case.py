"""One case: all that a case.toml says, with the defaults of its schema."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from palpate.case.data import CaseData, CaseLoad
from palpate.case.schema import rule, shown
from palpate.case.sources import (
    AUTO,
    LAW_NAMES,
    SEED,
    CaseSurface,
    ImagePair,
    Images,
    MeshBody,
    Motion,
    Pair,
    Phantom,
)
from palpate.case.tissue import KILOPASCALS, REMAINING, CaseTissue, refuse_name
from palpate.errors import ConfigurationError
from palpate.images.tissue import Role, Tissue
from palpate.mechanics.laws.contract import Law
from palpate.mechanics.laws.registry import law_from, law_parameters
from palpate.mechanics.solvers.registry import SOLVERS
from palpate.observation.contract import DataFile

HELD = ("fixed", "sliding")  # outer boundaries that leave a body no rigid motion
SOLVER_NAMES = ("auto", *SOLVERS)

POSITIVE_NUMBERS = "a list of positive numbers"
LOW_HIGH = "[low, high] with low < high"
RATIOS = (1e-6, 1e6)
SAMPLES = (100, 100_000)  # draws: fewer tell nothing of the tails, and more tell no more


def _ordered(bounds: tuple[float, float]) -> bool:
    return bounds[0] < bounds[1]


@dataclass(frozen=True, slots=True)
class Domain:
    """What is meshed, and how its outer border is held.

    `outer_boundary` "moving": the border's motion is an unknown, `outer_motion_mm` the prior standard deviation of each
    component of its smooth part, with a Gaussian kernel of `outer_kernel_mm`; the images say how much of it there is.
    """

    extent: str = field(default="image", metadata=rule(choices=("image", "margin")))
    margin_mm: float = field(default=40.0, metadata=rule(between=(0.1, 1e4)))
    outer_boundary: str = field(default="moving", metadata=rule(choices=("moving", "fixed", "sliding", "free")))
    outer_motion_mm: float = field(default=1.5, metadata=rule(between=(1e-3, 100.0)))
    outer_kernel_mm: float = field(default=60.0, metadata=rule(between=(1.0, 1e4)))


@dataclass(frozen=True, slots=True)
class Discrepancy:
    """What the model leaves out, as unknowns with these prior standard deviations; 0 leaves one out.

    heterogeneity_sd: of ln E inside a patchy tissue, with a Gaussian kernel of heterogeneity_length_mm; a third of it
    inside one that is nearly homogeneous, twice of it inside a very patchy one, of which the images choose; poisson_sd:
    of each Poisson's ratio that is given; surface_offset_mm: of how much larger each surface, and each driver's wall,
    is drawn in each later image; layer_sd: of ln E of a layer of layer_mm between each organ and what is known round
    it, over that tissue's own.
    """

    heterogeneity_sd: float = field(default=0.3, metadata=rule(between=(0.0, 3.0)))
    heterogeneity_length_mm: float = field(default=25.0, metadata=rule(between=(1.0, 1e3)))
    poisson_sd: float = field(default=0.02, metadata=rule(between=(0.0, 0.2)))
    surface_offset_mm: float = field(default=0.5, metadata=rule(between=(0.0, 100.0)))
    layer_sd: float = field(default=1.5, metadata=rule(between=(0.0, 5.0)))
    layer_mm: float = field(default=3.0, metadata=rule(between=(0.01, 1000.0)))


@dataclass(frozen=True, slots=True)
class Mechanics:
    """Material law, finite element and linear solver (`palpate.mechanics.laws`, `.dilatation`, `.solvers.registry`).

    law_parameters: what the case states under the names of the laws' parameters; each law takes its own.
    """

    law: str = field(default="neo-hookean", metadata=rule(choices=LAW_NAMES))
    element: str = field(default="auto", metadata=rule(choices=("P1", "P2", "P2-P0", "auto")))
    solver: str = field(default="auto", metadata=rule(choices=SOLVER_NAMES))
    law_parameters: Mapping[str, float] = field(
        default_factory=dict,
        metadata=rule(collects={name: (p.least, p.most) for name, p in law_parameters().items()}),
    )

    @property
    def material_law(self) -> Law:
        """The law with its parameters."""
        return law_from(self.law, self.law_parameters)


@dataclass(frozen=True, slots=True)
class MeshSettings:
    """Edge length (mm) of the tetrahedra at the organs; None: "auto", chosen by the organs (see `edge_length_of`).

    Of organs of which some are much larger it is that of the smallest.
    """

    edge_length_mm: float | None = field(default=None, metadata=rule(between=(0.01, 1e3), chosen=AUTO))


@dataclass(frozen=True, slots=True)
class DriverMotion:
    """Smooth modes of the driver's wall: how many, Gaussian kernel's length and prior amplitude, mm.

    `learn_prior`: the images say how far and how smoothly the wall moves; kernel and amplitude are the first guess.
    """

    modes: int = field(default=90, metadata=rule(between=(3, 10_000)))
    kernel_mm: float = field(default=20.0, metadata=rule(between=(0.1, 1e3)))
    prior_mm: float = field(default=5.0, metadata=rule(between=(1e-3, 1e3)))
    learn_prior: bool = True


@dataclass(frozen=True, slots=True)
class Noise:
    """Error of the segmented surfaces, mm; None: estimated from the residuals."""

    surface_sd_mm: float | None = field(default=None, metadata=rule(between=(1e-4, 100.0)))
    correlation_length_mm: float | None = field(default=None, metadata=rule(between=(0.01, 1e3)))

    def __post_init__(self) -> None:
        if self.correlation_length_mm is not None and self.surface_sd_mm is None:
            raise ConfigurationError(
                "[noise] has a correlation_length_mm without a surface_sd_mm, so it has no effect: give both, or give"
                " neither to have both estimated from the residuals"
            )


@dataclass(frozen=True, slots=True)
class Estimate:
    """How the unknowns are found; starts and bounds to the `known` tissue, or in kPa where these are given.

    `parameters`: what is sought of every `estimate` tissue; `samples`: draws of the moduli's posterior; 0:
    none.
    """

    method: str = field(default="gauss-newton", metadata=rule(choices=("gauss-newton", "lbfgs")))
    parameters: tuple[str, ...] = field(
        default=("youngs_modulus",), metadata=rule(choices=("youngs_modulus", "poisson_ratio"))
    )
    start_ratios: tuple[float, ...] = field(
        default=(0.5, 2.0, 8.0), metadata=rule(between=RATIOS, test=bool, wanted=POSITIVE_NUMBERS)
    )
    starts_kpa: tuple[float, ...] | None = field(
        default=None,
        metadata=rule(instead_of="start_ratios", between=KILOPASCALS, test=bool, wanted=POSITIVE_NUMBERS),
    )
    bounds_ratio: tuple[float, float] = field(
        default=(0.02, 200.0), metadata=rule(between=RATIOS, test=_ordered, wanted=LOW_HIGH)
    )
    bounds_kpa: tuple[float, float] | None = field(
        default=None, metadata=rule(instead_of="bounds_ratio", between=KILOPASCALS, test=_ordered, wanted=LOW_HIGH)
    )
    samples: int = field(default=0, metadata=rule(between=(0, SAMPLES[1])))

    @property
    def seeks_poisson_ratios(self) -> bool:
        """Whether Poisson's ratios are sought beside the moduli."""
        return "poisson_ratio" in self.parameters

    def __post_init__(self) -> None:
        if "youngs_modulus" not in self.parameters:
            raise ConfigurationError(
                f"[estimate] parameters is {shown(list(self.parameters))}; Young's moduli are always estimated and"
                ' Poisson\'s ratios on demand: ["youngs_modulus"] or ["youngs_modulus", "poisson_ratio"]'
            )
        if self.samples and not SAMPLES[0] <= self.samples <= SAMPLES[1]:
            raise ConfigurationError(
                f"[estimate] samples is {self.samples}; ask for {SAMPLES[0]} to {SAMPLES[1]} draws (4000 are"
                " usually enough), or 0 for none"
            )
        for starts, bounds, name in (
            (self.start_ratios, self.bounds_ratio, "start_ratios"),
            (self.starts_kpa, self.bounds_kpa, "starts_kpa"),
        ):
            outside = [start for start in starts or () if bounds and not bounds[0] < start < bounds[1]]
            if outside:
                raise ConfigurationError(
                    f"[estimate] {name}: {shown(outside)} do not lie between the bounds {list(bounds or ())}; change"
                    " the start, or widen the bounds"
                )


@dataclass(frozen=True, slots=True)
class Case:
    """Everything that one run depends on; one value, checked when it is made.

    `overrides`: those that `read_case` applied, as they were given; two cases that say the same are equal without them.
    Raises `ConfigurationError` when the tissues contradict each other, or images and phantom are both or neither there.
    """

    id: str
    patient: str = field(default="", metadata=rule(test=bool, wanted="a name; without it the case's id is used"))
    stage: int | None = field(default=None, metadata=rule(between=(0, 1000)))
    seed: int = field(default=0, metadata=SEED)
    images: Images | None = None
    pairs: tuple[Pair, ...] = ()
    body: MeshBody | None = None
    surfaces: tuple[CaseSurface, ...] = ()
    phantom: Phantom | None = None
    motion: Motion | None = None
    tissues: tuple[CaseTissue, ...] = ()
    domain: Domain = Domain()
    mechanics: Mechanics = Mechanics()
    loads: tuple[CaseLoad, ...] = ()
    data: tuple[CaseData, ...] = ()
    mesh: MeshSettings = MeshSettings()
    driver: DriverMotion = DriverMotion()
    noise: Noise = Noise()
    discrepancy: Discrepancy = Discrepancy()
    estimate: Estimate = Estimate()
    overrides: tuple[str, ...] = field(default=(), compare=False, metadata=rule(unwritten=True))

    def __repr__(self) -> str:
        """One line: id, images, the tissues of each role, and the law."""
        given = [self.images.before.name, *(path.name for path in self.images.after)] if self.images else []
        given += ["a mesh"] if self.body else ["a phantom"] if self.phantom else []
        roles = dict.fromkeys(tissue.role for tissue in self.tissues)
        who = [f"{role} {', '.join(t.name for t in self.tissues if t.role is role)}" for role in roles]
        return f"<case '{self.id}': {'; '.join([', '.join(given), *who, self.mechanics.law])}>"

    def __post_init__(self) -> None:
        object.__setattr__(self, "patient", self.patient or self.id)
        refuse_name(self.id, "the case's id")
        refuse_name(self.patient, "the case's patient")
        if sum(part is not None for part in (self.images, self.body, self.phantom)) != 1:
            raise ConfigurationError(
                f"case '{self.id}' needs either [images] (with before and after) or [phantom], but not both; a [body]"
                " with its mesh may replace the images"
            )
        bare = set(range(1, self.n_states + 1)) - {data.state for data in self.data}
        if self.body is not None and bare:
            of = f" of state {min(bare)}, of {self.n_states}" if self.data else ""
            raise ConfigurationError(
                f"case '{self.id}' has a [body] and no [[data]]{of}: without images, measurements must say how it moved"
            )
        if self.surfaces and self.body is None:
            raise ConfigurationError(
                f"case '{self.id}' has [[surfaces]] without a [body]; remove them, as images have the surfaces of their"
                " organs"
            )
        names = [tissue.name for tissue in self.tissues] + [surface.name for surface in self.surfaces]
        if len(set(names)) < len(names):
            raise ConfigurationError(f"case '{self.id}' gives two tissues or surfaces the same name: {shown(names)}")
        if self.images is not None and not self.images.after and self.motion is None and not self.loads:
            raise ConfigurationError(
                "the key 'after' is missing in [images]; name one or more later states of the body (only a simulation"
                " with [motion] or [[loads]] needs none)"
            )
        if self.pairs and self.images is None:
            raise ConfigurationError(
                f"case '{self.id}' has [[pairs]] without [images]: name the first pair there, with the label table"
            )
        if self.phantom is not None and self.loads:
            raise ConfigurationError(
                f"case '{self.id}' has [[loads]] on a [phantom], which only its walls move; remove the loads"
            )
        stated = [("loads", load.state or 1) for load in self.loads] + [("data", data.state) for data in self.data]
        beyond = [(table, state) for table, state in stated if state > self.n_states]
        if beyond:
            table, state = beyond[0]
            raise ConfigurationError(
                f"[[{table}]] state = {state}: case '{self.id}' has {self.n_states} later state(s); they are numbered"
                " from 1 in the order of `after`, and those of [[pairs]] come last"
            )
        self._check_tissues()
        self._check_ratios()

    @property
    def known_force(self) -> bool:
        """Whether a force is known, as a load or by a measurement: moduli then come out in kPa by themselves."""
        return bool(self.loads) or any(data.tells_scale for data in self.data)

    @property
    def data_files(self) -> tuple[DataFile, ...]:
        """The measurements beside the images, each with a name of its own in its state."""
        kinds = [(data.kind, data.state) for data in self.data]
        numbers = [kinds[: i + 1].count(kind) for i, kind in enumerate(kinds)]
        names = [kind if n == 1 else f"{kind} {n}" for (kind, _), n in zip(kinds, numbers, strict=True)]
        return tuple(data.named(name) for data, name in zip(self.data, names, strict=True))

    @property
    def image_pairs(self) -> tuple[ImagePair, ...]:
        """The pair of [images], then those of [[pairs]]; none where no image is named."""
        found, first = list[ImagePair](), 1
        named = [] if self.images is None else [(self.images.before, self.images.after, "")]
        named += [(pair.before, pair.after, f"pairs[{number}].") for number, pair in enumerate(self.pairs)]
        for before, after, key in named:
            found.append(ImagePair(before, after, key, range(first, first + len(after))))
            first += len(after)
        return tuple(found)

    @property
    def n_states(self) -> int:
        """Number of later states: of the later images of all pairs, or the one that is simulated."""
        if self.body is not None:
            return max([1, *(data.state for data in self.data), *(load.state or 1 for load in self.loads)])
        return max(1, sum(len(pair.after) for pair in self.image_pairs))

    def loads_in(self, state: int) -> tuple[CaseLoad, ...]:
        """The known loads of the reference state, 0, or what changes from them to the later state with a number."""
        borne = tuple(load for load in self.loads if load.state == 0)
        if state == 0:
            return borne
        return tuple(load for load in self.loads if load.state in (None, state)) + tuple(load.taken for load in borne)

    @property
    def strained_reference(self) -> bool:
        """Whether the reference state bears loads that the law cannot simply take off: its rest state is found."""
        return self.mechanics.material_law.finite and bool(self.loads_in(0))

    @property
    def align(self) -> str:
        """How the later images are brought to the first: "rigid-tissues", "surfaces" or "none".

        As the case says; else on the rigid tissues, if any, or on all surfaces, but where the outer boundary is held:
        that states that the images lie on each other.
        """
        if self.body is not None:
            return "none"
        if self.images is not None and self.images.align != AUTO:
            return self.images.align
        if any(tissue.role is Role.RIGID for tissue in self.tissues):
            return "rigid-tissues"
        return "none" if self.domain.outer_boundary in HELD else "surfaces"

    def resolve_tissues(self, names: Mapping[int, str]) -> tuple[Tissue, ...]:
        """The tissues with their labels; `names` (label -> name) is the label table, empty when there is none.

        Raises `ConfigurationError` when a name is not in the table or a label is claimed twice.
        """
        tissues = tuple(tissue.resolve(names) for tissue in self.tissues)
        _check_claims([(tissue.name, tissue.labels) for tissue in tissues])
        return tissues

    def _check_tissues(self) -> None:
        estimated = any(tissue.role is Role.ESTIMATE for tissue in self.tissues)
        if not estimated and (self.tissues or self.phantom is None):  # a phantom brings its own tissues
            raise ConfigurationError(
                f"case '{self.id}' has no tissue with role = \"estimate\", so nothing can be estimated; give that role"
                " to the organs whose stiffness you want"
            )
        remaining = [tissue.name for tissue in self.tissues if tissue.label == REMAINING]
        if len(remaining) > 1:
            raise ConfigurationError(
                f"tissues {shown(remaining)} all have label = '{REMAINING}'; only one tissue can be the rest"
            )
        if self.images is not None and self.images.body_from_ct and not remaining:
            raise ConfigurationError(
                "[images] body_from_ct gives label 0 inside the body to the remaining tissue, but there is none: give"
                " one tissue label = 'remaining'"
            )
        _check_claims([(t.name, (t.label,) if isinstance(t.label, str) else t.label) for t in self.tissues])

    def _check_ratios(self) -> None:
        sought = [t for t in self.tissues if t.role is Role.ESTIMATE and self.estimate.seeks_poisson_ratios]
        for tissue in self.tissues:
            if tissue.poisson_ratio_sd is not None and tissue not in sought:
                raise ConfigurationError(
                    f"tissue '{tissue.name}' has a poisson_ratio_sd without effect, because its Poisson's ratio is not"
                    " estimated. Remove it, or estimate those of the `estimate` tissues with [estimate] parameters ="
                    ' ["youngs_modulus", "poisson_ratio"]'
                )
        for tissue in sought:
            if tissue.poisson_ratio is not None and tissue.poisson_ratio <= 0.0:
                raise ConfigurationError(
                    f"the Poisson's ratio of '{tissue.name}' is estimated between 0 and 0.5, but its poisson_ratio of"
                    f" {tissue.poisson_ratio}, from which the search starts, lies outside: change it, or leave"
                    ' [estimate] parameters at ["youngs_modulus"]'
                )


def _check_claims(claims: list[tuple[str, tuple[int, ...] | tuple[str, ...]]]) -> None:
    owner: dict[int | str, str] = {}
    for name, labels in claims:
        for label in labels:
            if label in owner:
                raise ConfigurationError(
                    f"label {label!r} is claimed by tissue '{owner[label]}' and by tissue '{name}';"
                    " a voxel can belong to one tissue only"
                )
            owner[label] = name
