"""Table 2: prostate and bladder of a real pelvis with one modulus; the rectum's filling moves them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from palpate.approximation import ReducedBasis, reduced_basis
from palpate.body import Body, inverse_problem
from palpate.case import Case, Domain, DriverMotion, Mechanics, MeshSettings, Phantom
from palpate.images import VoxelGrid, observation_width, smoothing_width
from palpate.inversion import InverseProblem, LaterState, invert
from palpate.mechanics import (
    LinearModel,
    choose_element,
    linear_model,
    outer_constraint,
)
from palpate.mesh import LagrangeSpace, anatomy_of, check_mesh, lagrange_space, tetrahedralise
from palpate.observation import observations, prescribed_motion
from palpate.unknowns import parameter_map, unit_blocks
from palpate_validation.paper.columns import (
    entries_by_the_paper,
    entries_from_surfaces,
    entries_from_voxels,
    exact_surfaces,
    from_half,
    imaged_states,
    with_motions,
)
from palpate_validation.paper.real_pelvis import ORGANS, SMOOTHING_MM, RealPelvis, grid_within, real_pelvis
from palpate_validation.paper.table import COLUMNS, PAPER_TABLE2, Entries, Table, TableRow, draw_table
from palpate_validation.scenes import Job, Part, Progress, Scenes

__all__ = ["SURROUNDINGS_KPA", "Table2Settings", "table2"]

Array = NDArray[np.float64]

SURROUNDINGS_KPA = 100.0  # the paper states none; organs ten times as stiff would move as rigid bodies
ELEMENT = "auto"  # of the truth, too
OUTER = "sliding"  # the scan ends in the prostate: with a fixed border it would hardly move

NOTES = (
    f"The surroundings are known ({SURROUNDINGS_KPA:g} kPa) and set the scale; the paper does not state theirs.",
    "The pelvis is a real CT with automatic labels of 3 mm voxels; its later state is simulated with the linear law.",
    f"Its organs are smoothed by {SMOOTHING_MM:g} mm, which removes the steps of the scan's voxels.",
    "As in the paper the scene is prostate, bladder, a hollow rectum and a box; bones are part of the surroundings.",
    "The wall's motion is prescribed in all columns but `voxels`, as in the paper.",
    "voxels: 1 mm, on one of several grids shifted at random; also the wall's motion comes from the labels.",
    "voxels: three later images; compared with the first image the rectum is emptier in one, and fuller in two.",
    "paper_method: its Eq. 4 on linear tetrahedra, L-BFGS, data of its own mesh.",
    "paper_method_other_mesh: the same on the data of the column other_mesh.",
)


@dataclass(frozen=True, slots=True)
class Table2Settings:
    """Edges of the inverting meshes and of the truth's (mm), moduli (kPa), random grids, modes of the wall.

    voxel_edge_mm: of the meshes that are made from voxels, whose noise is larger than what a finer mesh would better.
    filling_mm: of the rectum, 12 to 14 mm in radius at rest; below zero it empties. shares: of it in the later images
    of the voxel column; the other columns have the whole.
    """

    edge_mm: float = 6.0
    voxel_edge_mm: float = 7.0
    truth_edge_mm: float = 5.0
    voxel_mm: float = 1.0
    filling_mm: float = -7.5
    shares: tuple[float, ...] = (1.0, -0.5, -0.6)
    moduli_kpa: tuple[float, ...] = tuple(PAPER_TABLE2)
    positions: int = 4
    driver: DriverMotion = field(default_factory=DriverMotion)
    seed: int = 2


def table2(settings: Table2Settings) -> Scenes[Table]:
    """All rows; columns without voxels share their meshes, and so do the rows of one voxel grid."""
    names = [f"{kpa:g}" for kpa in settings.moduli_kpa]
    make = partial(_part, settings)
    surfaces = Job(tuple(f"{name} {column}" for column in COLUMNS if column != "voxels" for name in names), make)
    positions = [names[position :: settings.positions] for position in range(settings.positions)]
    jobs = [surfaces, *(Job(tuple(f"{name} voxels" for name in used), make) for used in positions if used)]
    return Scenes("table2", settings, jobs, partial(_rows, settings), draw_table)


def _rows(settings: Table2Settings, parts: Mapping[str, Part]) -> Table:
    rows: list[TableRow] = []
    for kpa in settings.moduli_kpa:
        papers = PAPER_TABLE2.get(kpa, {})
        for organ in ORGANS:
            entries = {column: parts[f"{kpa:g} {column}"][organ] for column in COLUMNS}
            rows.append(TableRow(f"{kpa:g}", organ, kpa, papers.get(organ), entries))
    return Table("table2", tuple(rows), NOTES)


def _part(settings: Table2Settings, key: str, progress: Progress) -> Entries:
    """The part of a key "modulus column"."""
    name, column = key.rsplit(" ", 1)
    progress(f"table 2, {name} kPa: {column}")
    number = [f"{kpa:g}" for kpa in settings.moduli_kpa].index(name)
    kpa, bench = settings.moduli_kpa[number], _bench(settings)
    if column == "voxels":
        _surfaces.cache_clear()  # a process that goes on with another job does not hold the factors of both
        return _imaged(settings, number % settings.positions).voxels(kpa, progress)
    seen = _surfaces(settings)
    if column.startswith("paper_method"):
        return seen.by_the_paper(kpa, other_mesh=column != "paper_method")
    if column == "other_mesh":
        return seen.from_surfaces(kpa, bench.fine, _truth(settings, kpa), progress)
    own = seen.coarse.solve(moduli_of(seen.coarse, kpa), np.zeros(0)).displacement
    return seen.from_surfaces(kpa, seen.coarse, own, progress)


@lru_cache(maxsize=1)
def _bench(settings: Table2Settings) -> _Bench:
    return _Bench(settings)


@lru_cache(maxsize=8)
def _truth(settings: Table2Settings, kpa: float) -> Array:
    """Displacement (n_points, 3) mm of the finer mesh."""
    fine = _bench(settings).fine
    return fine.solve(moduli_of(fine, kpa), np.zeros(0)).displacement


@lru_cache(maxsize=1)
def _surfaces(settings: Table2Settings) -> _Surfaces:
    return _Surfaces(_bench(settings))


@lru_cache(maxsize=1)
def _imaged(settings: Table2Settings, position: int) -> _Imaged:
    return _Imaged(_bench(settings), position)


@dataclass(frozen=True)
class _Bench:
    """Models that all rows share, made when they are first needed."""

    settings: Table2Settings

    @cached_property
    def pelvis(self) -> RealPelvis:
        """The scan and its surfaces."""
        return real_pelvis(SURROUNDINGS_KPA)

    @cached_property
    def fine(self) -> LinearModel:
        """The truth: a finer mesh, the wall filled; for one solution a modulus multigrid takes less memory."""
        return self.filled(self.pelvis.space(self.settings.truth_edge_mm), solver="multigrid")

    def filled(self, space: LagrangeSpace, *, solver: str = "auto") -> LinearModel:
        """A model whose wall is filled, without modes; `solver`: see `linear_model`."""
        motion = prescribed_motion(space, {}, n_modes=3, kernel_mm=1.0, prior_mm=1.0)
        offset = self.pelvis.filling(space, self.settings.filling_mm).ravel()
        none = np.zeros((offset.size, 0))
        constraint = outer_constraint(space, outer=OUTER, modes=none, offset=offset, prescribed=motion.prescribed)
        dilatation = choose_element(ELEMENT if space.order > 1 else "P1").dilatation
        return linear_model(space, constraint, solver=solver, dilatation=dilatation)

    def basis_of(self, model: LinearModel) -> ReducedBasis:
        """A reduced model for all rows: all responses at the middle of the table's moduli, and to high order in them.

        What it is made of cannot bias an estimate: its error is bounded at every estimate, and it is sharpened there.
        """
        organs = np.array([[float(name == organ) for organ in ORGANS] for name in model.names])
        basis = reduced_basis(model, moduli_of(model, self.middle_kpa))
        return basis.with_modulus_series(self.filling_modes(model), organs)

    @property
    def middle_kpa(self) -> float:
        """Geometric mean of the smallest and the largest modulus."""
        return float(np.sqrt(min(self.settings.moduli_kpa) * max(self.settings.moduli_kpa)))

    def filling_modes(self, model: LinearModel) -> Array:
        """Coefficients (n_modes,) of a model's modes that come nearest to the filling of the wall."""
        found, modes = np.zeros(model.n_modes), model.constraint.modes  # material modes stay at zero
        offset, rows = self.pelvis.filling(model.space, self.settings.filling_mm).ravel(), modes.any(axis=1)
        if modes.shape[1]:
            found[: modes.shape[1]] = np.linalg.lstsq(modes[rows], offset[rows], rcond=None)[0]
        return found


@dataclass(frozen=True)
class _Surfaces:
    """What all columns that see no voxels share."""

    bench: _Bench

    @cached_property
    def coarse(self) -> LinearModel:
        """The model that inverts surfaces, the wall filled."""
        return self.bench.filled(self.bench.pelvis.space(self.bench.settings.edge_mm))

    @cached_property
    def linear_tetrahedra(self) -> LinearModel:
        """The paper's model: the inverting mesh with linear tetrahedra, the wall filled."""
        return self.bench.filled(lagrange_space(self.coarse.space.mesh, "P1"))

    @cached_property
    def basis(self) -> ReducedBasis:
        """The reduced model of `coarse`."""
        return self.bench.basis_of(self.coarse)

    def from_surfaces(self, kpa: float, truth: LinearModel, u: Array, progress: Progress) -> Entries:
        """What the exact surfaces of `truth` under u (n_points, 3) mm say of both organs."""
        seen = exact_surfaces(self.coarse.space, truth.space, u)
        mapping = parameter_map(truth.space.mesh.tissues, self.coarse.regions, unit_blocks(self.coarse.n_modes))
        state = LaterState(self.coarse, seen).with_approximation(self.basis)
        settings = from_half(mapping, dict.fromkeys(ORGANS, kpa))
        inversion = invert(InverseProblem((state,), mapping), settings, progress=progress)
        return entries_from_surfaces(inversion, settings, dict.fromkeys(ORGANS, kpa))

    def by_the_paper(self, kpa: float, *, other_mesh: bool) -> Entries:
        """The paper's method on data of its own mesh, or on those of `other_mesh`."""
        own = self.linear_tetrahedra
        space = self.bench.fine.space if other_mesh else own.space
        u = _truth(self.bench.settings, kpa) if other_mesh else own.solve(moduli_of(own, kpa), np.zeros(0)).displacement
        start = moduli_of(own, 0.5 * kpa)
        return entries_by_the_paper(own, space, u, dict.fromkeys(ORGANS, kpa), moduli=start)


@dataclass(frozen=True)
class _Imaged:
    """The pelvis on one random voxel grid: one rest state, and so one mesh, for all rows that use this grid."""

    bench: _Bench
    position: int

    @cached_property
    def grid(self) -> VoxelGrid:
        """Voxels within the box, shifted at random."""
        rng = np.random.default_rng([self.bench.settings.seed, self.position])
        return grid_within(self.bench.pelvis.box, self.bench.settings.voxel_mm, rng)

    @cached_property
    def body(self) -> Body:
        """Meshed from the labels at rest, in the truth's own domain; its later state is of the middle modulus."""
        states = imaged_states(self.bench.fine.space, self.later(self.bench.middle_kpa), self.grid)
        width = smoothing_width(self.grid)
        anatomy = anatomy_of(states.before, box=self.bench.pelvis.box, smoothing_mm=width)
        mesh = tetrahedralise(anatomy, edge_length_mm=self.bench.settings.voxel_edge_mm)
        quality = check_mesh(mesh, anatomy)
        return Body(states, lagrange_space(mesh, "P2"), quality, observation_width(self.grid))

    @cached_property
    def case(self) -> Case:
        """The settings of the estimate."""
        settings = self.bench.settings
        return Case(
            "table2",
            phantom=Phantom("pelvis"),
            mesh=MeshSettings(settings.voxel_edge_mm),
            driver=settings.driver,
            domain=Domain(outer_boundary=OUTER),
            mechanics=Mechanics(law="linear", element=ELEMENT),
        )

    @cached_property
    def problem(self) -> InverseProblem:
        """The inverse problem of the middle modulus: its model and surfaces serve all rows."""
        return inverse_problem(self.body, self.case, progress=lambda _: None)

    @cached_property
    def basis(self) -> ReducedBasis:
        """That of all later states, which have the same model."""
        return self.bench.basis_of(self.problem.states[0].model)

    def later(self, kpa: float) -> list[Array]:
        """Displacements (n_points, 3) mm of the later states: the linear law's grow with the filling."""
        return [share * _truth(self.bench.settings, kpa) for share in self.bench.settings.shares]

    def voxels(self, kpa: float, progress: Progress) -> Entries:
        """What the label images alone say of both organs."""
        imaged_later = with_motions(self.body.states, self.bench.fine.space, self.later(kpa))
        body = replace(self.body, states=imaged_later)
        pairs = zip(self.problem.states, observations(body.imaged()), strict=True)
        states = tuple(state.with_observations(seen).with_approximation(self.basis) for state, seen in pairs)
        truth, problem = dict.fromkeys(ORGANS, kpa), replace(self.problem, states=states)
        settings = from_half(problem.parameters, truth)
        inversion = invert(problem, settings, progress=progress)
        return entries_from_voxels(inversion, settings, body, truth, seed=self.bench.settings.seed)


def moduli_of(model: LinearModel, kpa: float) -> Array:
    """Moduli (n_regions,) kPa with both organs at `kpa` in the surroundings."""
    return np.array([kpa if name in ORGANS else SURROUNDINGS_KPA for name in model.names])
