"""Table 1: three concentric spheres with one modulus, and with three; each start is half of the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.body import make_body
from palpate.case import Case, Mechanics, MeshSettings, Phantom
from palpate.inversion import InverseProblem, Inversion, InversionSettings, LaterState, invert
from palpate.mechanics import Conditions, LinearModel, linear_model
from palpate.mesh import LagrangeSpace
from palpate.observation import Observation, observed_surface, surface_distances
from palpate.unknowns import parameter_map, unit_blocks
from palpate_validation.paper.balls import (
    BODIES,
    Balls,
    balls_space,
    balls_tissues,
    floating,
    mean_deformations,
    pulled,
    random_grid,
)
from palpate_validation.paper.columns import (
    entries_by_the_paper,
    entries_from_surfaces,
    entries_from_voxels,
    exact_surfaces,
    from_half,
    imaged_states,
)
from palpate_validation.paper.table import (
    COLUMNS,
    PAPER_TABLE1,
    Entry,
    Table,
    TableRow,
    as_part,
    draw_table,
    entries_of,
)
from palpate_validation.scenes import Job, Part, Progress, Scenes

__all__ = ["Table1Settings", "table1"]

Array = NDArray[np.float64]
Moduli = tuple[float, float, float]

DEFORMATION = 0.095  # of the region that is deformed most: "slightly less than 10 %"
SURFACE_COLUMNS = tuple(name for name in COLUMNS if name != "voxels")
NEAREST = 40  # points of the truth that give its displacement at a place

NOTES = (
    "The scale comes from a known load: the traction S n of a uniaxial stress S on the outside.",
    "Displacements alone give ratios of moduli. Where all bodies have one modulus, as in the paper, they give nothing.",
    "The load deforms the most deformed body by 9.5 %, so it is proportional to the modulus.",
    "So the six rows with one modulus are the same problem in different units, solved once; each has its own voxels.",
    "voxels: 1 mm, on a grid turned and shifted at random for every row; the body is meshed from its labels.",
    "paper_method: its Eq. 4 on linear tetrahedra with L-BFGS, on data made with its own mesh, as in the paper.",
    "paper_method_other_mesh: the same on the data of the column other_mesh.",
)


@dataclass(frozen=True, slots=True)
class Table1Settings:
    """Meshes and cases: moduli of the rows in which all three bodies have the same, and of those with three, kPa."""

    balls: Balls = field(default_factory=Balls)
    equal_kpa: tuple[float, ...] = tuple(PAPER_TABLE1)
    different_kpa: tuple[Moduli, ...] = ((50.0, 100.0, 150.0), (150.0, 100.0, 50.0))
    seed: int = 1

    @property
    def cases(self) -> tuple[Moduli, ...]:
        """Moduli (kPa) of the three bodies, case after case."""
        return tuple((modulus,) * 3 for modulus in self.equal_kpa) + self.different_kpa


def table1(settings: Table1Settings) -> Scenes[Table]:
    """All rows; rows that are the same problem in other units share all columns but `voxels`."""
    units = list(dict.fromkeys(_first_like(moduli, settings.cases) for moduli in settings.cases))
    make = partial(_part, settings)
    jobs = [Job((f"{_name(moduli)} voxels",), make) for moduli in settings.cases]
    jobs += [Job(tuple(f"{_name(unit)} {column}" for column in SURFACE_COLUMNS), make) for unit in units]
    return Scenes("table1", settings, jobs, partial(_rows, settings), draw_table)


def _rows(settings: Table1Settings, parts: Mapping[str, Part]) -> Table:
    rows: list[TableRow] = []
    for moduli in settings.cases:
        unit = _first_like(moduli, settings.cases)
        columns = {"voxels": entries_of(parts[f"{_name(moduli)} voxels"])}
        for column in SURFACE_COLUMNS:
            found = entries_of(parts[f"{_name(unit)} {column}"])
            columns[column] = {body: entry.scaled(moduli[0] / unit[0]) for body, entry in found.items()}
        for body, truth in zip(BODIES, moduli, strict=True):
            paper = PAPER_TABLE1.get(truth, {}).get(body) if len(set(moduli)) == 1 else None
            entries = {column: columns[column][body] for column in COLUMNS}
            rows.append(TableRow(_name(moduli), body, truth, paper, entries))
    return Table("table1", tuple(rows), NOTES)


def _part(settings: Table1Settings, key: str, progress: Progress) -> dict[str, Any]:
    """The part of a key "case column"."""
    name, column = key.rsplit(" ", 1)
    number = [_name(moduli) for moduli in settings.cases].index(name)
    case = _Case(settings.cases[number], _bench(settings.balls), settings.seed + number)
    progress(f"table 1, {name} kPa: {column}")
    return as_part(case.column(column, progress))


def _first_like(moduli: Moduli, cases: tuple[Moduli, ...]) -> Moduli:
    """The first case with the same ratios: the load is proportional to the moduli, so only the units differ."""
    return next(case for case in cases if np.allclose(np.array(case) * moduli[0], np.array(moduli) * case[0]))


def _name(moduli: Moduli) -> str:
    return f"{moduli[0]:g}" if len(set(moduli)) == 1 else "/".join(f"{modulus:g}" for modulus in moduli)


@dataclass(frozen=True)
class _Bench:
    """Models that all cases share, made when they are first needed; their load is a pull of 1 kPa."""

    balls: Balls

    @cached_property
    def coarse(self) -> LinearModel:
        """The model that inverts."""
        return _model(balls_space(self.balls, self.balls.edge_mm))

    @cached_property
    def fine(self) -> LinearModel:
        """The truth of the columns `other_mesh` and `voxels`."""
        return _model(balls_space(self.balls, self.balls.truth_edge_mm))

    @cached_property
    def linear_tetrahedra(self) -> LinearModel:
        """The paper's model: the inverting mesh with linear tetrahedra."""
        return _model(balls_space(self.balls, self.balls.edge_mm, element="P1"))


_bench = lru_cache(maxsize=1)(_Bench)


@dataclass(frozen=True)
class _Case:
    """Three moduli (kPa) and the columns that they give."""

    moduli: Moduli
    bench: _Bench
    seed: int

    def column(self, name: str, progress: Progress) -> dict[str, Entry]:
        """What a column says of each body."""
        makers: dict[str, Callable[[], dict[str, Entry]]] = {
            "same_mesh": lambda: self.from_surfaces(self.bench.coarse, progress),
            "other_mesh": lambda: self.from_surfaces(self.bench.fine, progress),
            "voxels": lambda: self.from_voxels(progress),
            "paper_method": lambda: self.by_the_paper(self.bench.linear_tetrahedra),
            "paper_method_other_mesh": lambda: self.by_the_paper(self.bench.fine),
        }
        return makers[name]()

    @property
    def truth(self) -> dict[str, float]:
        """True modulus (kPa) of every sphere, by name."""
        return dict(zip(BODIES, self.moduli, strict=True))

    @cached_property
    def stress_kpa(self) -> float:
        """The pull under which the region that is deformed most is deformed by 9.5 %."""
        model = self.bench.coarse
        unit = model.solve(np.array(self.moduli), np.zeros(model.n_modes)).displacement
        return float(DEFORMATION / mean_deformations(model.space, unit).max())

    def displacement(self, model: LinearModel) -> Array:
        """Displacement (n_points, 3) mm of the truth on a model's mesh."""
        loaded = _pulled_by(model, self.stress_kpa)
        return loaded.solve(np.array(self.moduli), np.zeros(model.n_modes)).displacement

    def from_surfaces(self, truth: LinearModel, progress: Progress) -> dict[str, Entry]:
        """What exact surfaces of `truth` say of every sphere."""
        model = _pulled_by(self.bench.coarse, self.stress_kpa)
        seen = exact_surfaces(model.space, truth.space, self.displacement(truth))
        inversion, settings = self.invert_case(model, seen, progress)
        return entries_from_surfaces(inversion, settings, self.truth)

    def from_voxels(self, progress: Progress) -> dict[str, Entry]:
        """What two label images on a random grid say of every sphere."""
        balls, fine = self.bench.balls, self.bench.fine
        grid = random_grid(balls, np.random.default_rng(self.seed))
        space = replace(fine.space, mesh=replace(fine.space.mesh, tissues=balls_tissues(self.moduli)))
        states = imaged_states(space, (self.displacement(fine),), grid)
        mechanics = Mechanics(law="linear", element="P2")
        case = Case("table1", phantom=Phantom("spheres"), mesh=MeshSettings(balls.edge_mm), mechanics=mechanics)
        body = make_body(states, case, progress=progress)
        model = _pulled_by(_model(body.space), self.stress_kpa)
        surfaces = tuple(observed_surface(body.space, number) for number in range(len(BODIES)))
        inversion, settings = self.invert_case(model, surface_distances(body.imaged(), surfaces)[0], progress)
        return entries_from_voxels(inversion, settings, body, self.truth, seed=self.seed)

    def invert_case(
        self, model: LinearModel, observations: tuple[Observation, ...], progress: Progress
    ) -> tuple[Inversion, InversionSettings]:
        """The inversion of all spheres' surfaces from half of their moduli, and its settings."""
        mapping = parameter_map(balls_tissues(self.moduli), model.regions, unit_blocks(model.n_modes), loaded=True)
        settings = from_half(mapping, self.truth)
        problem = InverseProblem((LaterState(model, observations),), mapping)
        return invert(problem, settings, progress=progress), settings

    def by_the_paper(self, truth: LinearModel) -> dict[str, Entry]:
        """The paper's method; a few nodes hold the rigid motion, with the displacement that the truth has there."""
        own, u = self.bench.linear_tetrahedra, self.displacement(truth)
        offset = np.zeros(len(own.constraint.offset))
        for dof in np.flatnonzero(own.constraint.modes.any(axis=1)):
            away = truth.space.points - own.space.points[dof // 3]
            near = np.argsort(np.linalg.norm(away, axis=1))[:NEAREST]
            terms = np.column_stack([np.ones(NEAREST), away[near]])
            offset[dof] = np.linalg.lstsq(terms, u[near, dof % 3], rcond=None)[0][0]
        held = replace(own.constraint, modes=np.zeros((len(offset), 0)), offset=offset)
        model = own.with_conditions(Conditions(held, (pulled(own.space, self.stress_kpa),)))
        return entries_by_the_paper(model, truth.space, u, self.truth, moduli=0.5 * np.array(self.moduli))


def _model(space: LagrangeSpace) -> LinearModel:
    return linear_model(space, floating(space), loads=(pulled(space, 1.0),))


def _pulled_by(model: LinearModel, stress_kpa: float) -> LinearModel:
    """The model with a pull of `stress_kpa` instead of 1 kPa."""
    return model.with_conditions(Conditions(model.constraint, (pulled(model.space, stress_kpa),)))
