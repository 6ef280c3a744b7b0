"""Table 2: prostate and bladder of a real pelvis, of one modulus, from half of it; the rectum fills and drives them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from palpate.experiments.reproduce.columns import (
    Progress,
    entries_from_surfaces,
    entries_from_voxels,
    from_half,
    imaged_states,
)
from palpate.experiments.reproduce.ledger import Ledger
from palpate.experiments.reproduce.paper import PAPER_TABLE2
from palpate.experiments.reproduce.paper_method import paper_estimate, paper_target
from palpate.experiments.reproduce.real_pelvis import ORGANS, RealPelvis, grid_over, real_pelvis
from palpate.experiments.reproduce.table import Entry, Table, TableRow
from palpate.images.tissue import Role
from palpate.inversion.invert import invert, invert_with
from palpate.inversion.modulus_map import modulus_map
from palpate.inversion.problem import InverseProblem, Inversion
from palpate.inversion.surrogate import Surrogate, with_offset
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.linear_model import LinearModel, linear_model, with_constraint
from palpate.mesh.anatomy import anatomy_of
from palpate.mesh.quality import check_mesh
from palpate.mesh.space import LagrangeSpace, lagrange_space
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.observation.observed_surface import observed_surface
from palpate.observation.prescribed_motion import prescribed_motion
from palpate.phantoms.exact_targets import target_of_truth
from palpate.study.body import Body, inverse_problem
from palpate.study.case import Case, DriverMotion, Mechanics, MeshSettings, Phantom
from palpate.images.distance import observation_width, smoothing_width

__all__ = ["SURROUNDINGS_KPA", "Table2Settings", "table2"]

Array = NDArray[np.float64]

SURROUNDINGS_KPA = 50.0  # the paper states none; stiffer organs than some ten times it would say nothing of themselves

NOTES = (
    f"The surroundings have {SURROUNDINGS_KPA:g} kPa and are known; they set the scale. The paper does not state theirs.",
    "The pelvis is a real CT with automatic labels of 3 mm voxels; the later state is simulated: the rectum is filled by"
    " 6.5 mm with the linear law on a finer mesh.",
    "same_mesh: the wall moves as the driver's modes can; all other columns: as the filling makes it.",
    "voxels: 1 mm, on one of several grids shifted at random; everything is made from the labels.",
    "paper_method: its Eq. 4 on linear tetrahedra with L-BFGS, the wall's true motion prescribed, on data made with its"
    " own mesh, as in the paper; paper_method_other_mesh: the same on the data of the column other_mesh.",
)


@dataclass(frozen=True, slots=True)
class Table2Settings:
    """Edges of the inverting and of the truth's mesh (mm), moduli (kPa), random grids, modes of the wall."""

    edge_mm: float = 7.0
    truth_edge_mm: float = 5.5
    voxel_mm: float = 1.0
    filling_mm: float = 6.5
    moduli_kpa: tuple[float, ...] = tuple(PAPER_TABLE2)
    positions: int = 4
    driver: DriverMotion = DriverMotion()
    seed: int = 2


def table2(settings: Table2Settings, ledger: Ledger, *, progress: Progress) -> Table:
    """All rows; raises `PalpateError`s of meshing and solving."""
    bench = _Bench(settings)
    columns: dict[str, Callable[[float, Progress], dict[str, Entry]]] = {
        "same_mesh": bench.same_mesh,
        "other_mesh": bench.other_mesh,
        "paper_method": lambda kpa, _: bench.by_the_paper(kpa, bench.linear_tetrahedra),
        "paper_method_other_mesh": lambda kpa, _: bench.by_the_paper(kpa, bench.fine),
    }
    found: dict[float, dict[str, dict[str, Entry]]] = {kpa: {} for kpa in settings.moduli_kpa}
    for name, make in columns.items():
        for kpa in settings.moduli_kpa:
            progress(f"table 2, {kpa:g} kPa: {name}")
            found[kpa][name] = ledger.entries(f"{kpa:g} {name}", lambda make=make, kpa=kpa: make(kpa, progress))  # type: ignore[misc]
    for position in range(settings.positions):
        imaged = _Imaged(bench, position)
        for kpa in settings.moduli_kpa[position :: settings.positions]:
            progress(f"table 2, {kpa:g} kPa: voxels, grid {position + 1} of {settings.positions}")
            found[kpa]["voxels"] = ledger.entries(f"{kpa:g} voxels", lambda kpa=kpa: imaged.voxels(kpa, progress))
    rows = (
        TableRow(
            f"{kpa:g}",
            organ,
            kpa,
            PAPER_TABLE2.get(kpa, {}).get(organ),
            {name: entries[organ] for name, entries in columns.items()},
        )
        for kpa, columns in found.items()
        for organ in ORGANS
    )
    return Table("table2", tuple(rows), NOTES)
