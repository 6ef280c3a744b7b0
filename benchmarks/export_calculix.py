"""CalculiX solves our exports: its displacements and nodal forces are compared with ours. https://www.calculix.de.

The demo's pelvis lies along the axes. The turned body slides along oblique planes, under gravity, a pressure that
follows its surface, and a traction. Displacements are read from .dat (7 digits) and .frd (6 digits).
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from export_laws import Decoupled
from export_rows import Results, Row, percent, ran
from numpy.typing import NDArray
from scipy import sparse

import palpate
from palpate.body import loads_on
from palpate.export import fitted_bodies, material_parts, prescribed
from palpate.mechanics import Dilatation, equilibrium
from palpate.mesh import OUTER, Constraint

Array = NDArray[np.float64]

EQUAL = (
    0.01  # per cent, between two solutions of the same problem: CalculiX stops its iterations at 0.5 % of the forces
)
LIMITS = {"linear": 0.1, "neo-hookean": 0.5}  # per cent; at finite strain its law is another one


@dataclass(frozen=True)
class Solved:
    """What CalculiX found: displacements of .dat and .frd, and forces that hold or load the nodes, (n_points, 3) each.

    mm and mN, in the axes of the world; warnings: how many it printed.
    """

    displacement: Array
    shown: Array
    forces: Array
    warnings: int


def calculix(results: Results, folder: Path) -> Iterator[Row]:
    """Solve each case with CalculiX and compare the displacement of every node with ours, and the loads."""
    for (law, kind), result in results.items():
        name = f"{law}, {kind}"
        if shutil.which("ccx") is None:
            yield Row("CalculiX", f"{name}: RMS of the nodes' displacements to ours", None, LIMITS[law], "%")
            continue
        place = folder / f"{law}-{kind}"
        palpate.export(result, place, format="abaqus")
        found, ours = solved(place, len(result.space.points)), result.estimation.displacements[-1]
        words = f"{name}: RMS of the nodes' displacements to ours, of the largest motion"
        yield Row("CalculiX", words, percent(found.displacement, ours), LIMITS[law], "%")
        yield Row("CalculiX", f"{name}: .frd to .dat", percent(found.shown, found.displacement), 0.001, "%")
        yield Row("CalculiX", f"{name}: warnings", found.warnings, 0)
        if result.case.loads:
            yield from loads_compared(name, result, found)
        if law != "linear" and kind != "auto":
            same = under_decoupled_law(result)
            words = f"{name}: RMS to ours under its own volumetric term"
            yield Row("CalculiX", words, percent(found.displacement, same), EQUAL, "%")
            yield Row(
                "Palpate", f"{name}: our law to that of CalculiX, both solved by us", percent(same, ours), 0.5, "%"
            )


def loads_compared(name: str, result: palpate.CaseResult, found: Solved) -> Iterator[Row]:
    """The nodes' loads along the directions in which they may move, where CalculiX's internal forces bear them."""
    free = held_in(result).free
    case = result.case
    density = {tissue.name: tissue.density_kg_m3 for tissue in case.tissues}
    heavy = np.array([density[tissue.name] for tissue in result.tissues])
    acting = loads_on(result.space, case.loads_in(1), densities=heavy)
    place = found.displacement if case.mechanics.material_law.finite else np.zeros_like(found.displacement)
    ours = np.asarray(free @ (free.T @ sum((load.forces(place) for load in acting), np.zeros(place.size)))).reshape(
        -1, 3
    )
    theirs = np.asarray(free @ (free.T @ found.forces.ravel())).reshape(-1, 3)
    total, expected = theirs.sum(axis=0), ours.sum(axis=0)
    both = " and ".join("(" + ", ".join(f"{x:.1f}" for x in vector) + ")" for vector in (total, expected))
    words = f"{name}: resultant of the loads where the body may move, {both} mN, difference"
    off = 100.0 * float(np.linalg.norm(total - expected) / np.linalg.norm(expected))
    yield Row("CalculiX", words, off, 0.01, "%")
    yield Row("CalculiX", f"{name}: RMS of the nodes' loads to ours, of the largest", percent(theirs, ours), EQUAL, "%")


def solved(folder: Path, n_points: int) -> Solved:
    """What CalculiX finds at the end of the last step of palpate.inp."""
    printed = ran(["ccx", "palpate"], folder)
    if "Job finished" not in printed:
        raise RuntimeError(f"CalculiX ended without a result: {printed[-2000:]}")
    data = [line.split() for line in (folder / "palpate.dat").read_text().splitlines()]
    last = [[float(x) for x in words] for words in data if words and words[0].isdigit()][-2 * n_points :]
    table = np.array(last)  # a row that is not in the axes of the world has a fifth word
    if not np.array_equal(table[:, 0], np.tile(np.arange(1.0, n_points + 1), 2)):
        raise RuntimeError("palpate.dat does not have every node twice: its displacements, then its forces")
    lines = (folder / "palpate.frd").read_text().splitlines()
    start = max(number for number, line in enumerate(lines) if line.startswith(" -4  DISP"))
    shown = np.full((n_points, 3), np.nan)
    for line in lines[start:]:
        if line.startswith(" -3"):
            break
        if line.startswith(" -1"):
            shown[int(line[3:13]) - 1] = [float(line[13 + 12 * k : 25 + 12 * k]) for k in range(3)]
    return Solved(table[:n_points, 1:], shown, table[n_points:, 1:], printed.count("*WARNING"))


def held_in(result: palpate.CaseResult) -> Constraint:
    """The conditions of the input file: what moves as it was fitted, and what slides along the image's axes."""
    (body,), n = fitted_bodies(result)[:1], len(result.space.points)
    held = prescribed(body, result.space, outer=result.case.domain.outer_boundary)
    along, is_free = np.tile(np.eye(3), (n, 1, 1)), np.ones((n, 3), dtype=bool)
    along[held.sliding], is_free[held.sliding], is_free[held.whole] = held.axes, ~held.held, False
    point, row = np.nonzero(is_free)
    places = (3 * point[:, None] + np.arange(3)).ravel(), np.repeat(np.arange(len(point)), 3)
    free = sparse.csr_matrix((along[point, row].ravel(), places), shape=(3 * n, len(point)))
    offset = np.zeros((n, 3))
    offset[held.whole] = result.estimation.displacements[-1][held.whole]
    return Constraint(free, np.zeros((3 * n, 0)), offset.ravel())


def under_decoupled_law(result: palpate.CaseResult) -> Array:
    """Our displacement (n_points, 3) mm under CalculiX's law and the conditions and loads of its input file."""
    body = fitted_bodies(result)[0]
    parts, region = material_parts(body.mesh, body.log_ratio), np.empty_like(body.mesh.region)
    for number, part in enumerate(parts):
        region[part.cells] = number
    tissues = tuple(replace(body.tissues[part.tissue], name=part.name) for part in parts)
    mesh = replace(body.mesh, region=region, tissues=tissues, beyond=np.full_like(body.mesh.beyond, OUTER))
    moduli = np.array([result.stiffness[part.tissue] * np.exp(part.log_ratio) for part in parts])
    space = replace(result.space, mesh=mesh)
    heavy = np.array([t.density_kg_m3 for t in result.case.tissues for name in result.tissues if t.name == name.name])
    acting = loads_on(result.space, result.case.loads_in(1), densities=heavy)
    held = held_in(result)
    found = equilibrium(space, held, moduli, law=Decoupled(), dilatation=Dilatation.POINTWISE, loads=acting)
    return found.displacement
