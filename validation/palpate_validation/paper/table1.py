"""Table 1: three concentric spheres with one modulus, and with three; each start is half of the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

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
from palpate_validation.paper.table import COLUMNS, PAPER_TABLE1, Entries, Entry, Table, TableRow, draw_table
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
        columns = {column: _scaled(parts[f"{_name(unit)} {column}"], moduli[0] / unit[0]) for column in SURFACE_COLUMNS}
        columns["voxels"] = parts[f"{_name(moduli)} voxels"]
        for body, truth in zip(BODIES, moduli, strict=True):
            paper = PAPER_TABLE1.get(truth, {}).get(body) if len(set(moduli)) == 1 else None
            entries = {column: columns[column][body] for column in COLUMNS}
            rows.append(TableRow(_name(moduli), body, truth, paper, entries))
    return Table("table1", tuple(rows), NOTES)


def _scaled(entries: Entries, factor: float) -> Entries:
    """The same problem in other units: moduli times `factor`, errors as they are."""

    def times(value: float | None) -> float | None:
        """In the other units."""
        return value and factor * value

    def scaled(entry: Entry) -> Entry:
        """With its interval."""
        ends = entry["interval95"] and [times(end) for end in entry["interval95"]]
        return entry | {"kpa": times(entry["kpa"]), "interval95": ends}

    return {body: scaled(entry) for body, entry in entries.items()}


def _first_like(moduli: Moduli, cases: tuple[Moduli, ...]) -> Moduli:
    """The first case with the same ratios: the load is proportional to the moduli, so only the units differ."""
    return next(case for case in cases if np.allclose(np.array(case) * moduli[0], np.array(moduli) * case[0]))


def _name(moduli: Moduli) -> str:
    return f"{moduli[0]:g}" if len(set(moduli)) == 1 else "/".join(f"{modulus:g}" for modulus in moduli)


def _part(settings: Table1Settings, key: str, progress: Progress) -> Entries:
    """The part of a key "case column"."""
    name, column = key.rsplit(" ", 1)
    number = [_name(moduli) for moduli in settings.cases].index(name)
    case = _Case(settings.cases[number], settings.balls, settings.seed + number)
    progress(f"table 1, {name} kPa: {column}")
    balls = settings.balls
    if column == "voxels":
        return case.from_voxels(progress)
    if column == "paper_method":
        return case.by_the_paper(_model(balls, balls.edge_mm, "P1"))
    fine = _model(balls, balls.truth_edge_mm)
    if column == "paper_method_other_mesh":
        return case.by_the_paper(fine)
    return case.from_surfaces(fine if column == "other_mesh" else _model(balls, balls.edge_mm), progress)


@lru_cache(maxsize=3)
def _model(balls: Balls, edge_mm: float, element: str = "P2") -> LinearModel:
    """A model under a pull of 1 kPa."""
    return _floating(balls_space(balls, edge_mm, element=element))


def _floating(space: LagrangeSpace) -> LinearModel:
    return linear_model(space, floating(space), loads=(pulled(space, 1.0),))


@dataclass(frozen=True)
class _Case:
    """Three moduli (kPa), and what is said of them; `seed`: of the voxels."""

    moduli: Moduli
    balls: Balls
    seed: int

    @property
    def truth(self) -> dict[str, float]:
        """True modulus (kPa) of every sphere, by name."""
        return dict(zip(BODIES, self.moduli, strict=True))

    @property
    def stress_kpa(self) -> float:
        """The pull under which the region that is deformed most is deformed by 9.5 %."""
        model = _model(self.balls, self.balls.edge_mm)
        unit = model.solve(np.array(self.moduli), np.zeros(model.n_modes)).displacement
        return float(DEFORMATION / mean_deformations(model.space, unit).max())

    def under_pull(self, model: LinearModel) -> LinearModel:
        """The model under that pull."""
        return model.with_conditions(Conditions(model.constraint, (pulled(model.space, self.stress_kpa),)))

    def displacement(self, model: LinearModel) -> Array:
        """Displacement (n_points, 3) mm of the truth on a model's mesh."""
        return self.under_pull(model).solve(np.array(self.moduli), np.zeros(model.n_modes)).displacement

    def from_surfaces(self, truth: LinearModel, progress: Progress) -> Entries:
        """What exact surfaces of `truth` say of every sphere."""
        model = self.under_pull(_model(self.balls, self.balls.edge_mm))
        seen = exact_surfaces(model.space, truth.space, self.displacement(truth))
        return entries_from_surfaces(*self.inverted(model, seen, progress), self.truth)

    def from_voxels(self, progress: Progress) -> Entries:
        """What two label images on a random grid say of every sphere."""
        fine = _model(self.balls, self.balls.truth_edge_mm)
        grid = random_grid(self.balls, np.random.default_rng(self.seed))
        space = replace(fine.space, mesh=replace(fine.space.mesh, tissues=balls_tissues(self.moduli)))
        states = imaged_states(space, (self.displacement(fine),), grid)
        mechanics, mesh = Mechanics(law="linear", element="P2"), MeshSettings(self.balls.edge_mm)
        body = make_body(
            states, Case("table1", phantom=Phantom("spheres"), mesh=mesh, mechanics=mechanics), progress=progress
        )
        surfaces = tuple(observed_surface(body.space, number) for number in range(len(BODIES)))
        seen = surface_distances(body.imaged(), surfaces)[0]
        inversion, settings = self.inverted(self.under_pull(_floating(body.space)), seen, progress)
        return entries_from_voxels(inversion, settings, body, self.truth, seed=self.seed)

    def inverted(
        self, model: LinearModel, observations: tuple[Observation, ...], progress: Progress
    ) -> tuple[Inversion, InversionSettings]:
        """The inversion of all spheres' surfaces from half of their moduli, and its settings."""
        mapping = parameter_map(balls_tissues(self.moduli), model.regions, unit_blocks(model.n_modes), loaded=True)
        settings = from_half(mapping, self.truth)
        problem = InverseProblem((LaterState(model, observations),), mapping)
        return invert(problem, settings, progress=progress), settings

    def by_the_paper(self, truth: LinearModel) -> Entries:
        """The paper's method; a few nodes hold the rigid motion, with the displacement that the truth has there."""
        own, u = _model(self.balls, self.balls.edge_mm, "P1"), self.displacement(truth)
        offset = np.zeros(len(own.constraint.offset))
        for dof in np.flatnonzero(own.constraint.modes.any(axis=1)):
            away = truth.space.points - own.space.points[dof // 3]
            near = np.argsort(np.linalg.norm(away, axis=1))[:NEAREST]
            terms = np.column_stack([np.ones(NEAREST), away[near]])
            offset[dof] = np.linalg.lstsq(terms, u[near, dof % 3], rcond=None)[0][0]
        held = replace(own.constraint, modes=np.zeros((len(offset), 0)), offset=offset)
        model = own.with_conditions(Conditions(held, (pulled(own.space, self.stress_kpa),)))
        return entries_by_the_paper(model, truth.space, u, self.truth, moduli=0.5 * np.array(self.moduli))
