"""Abaqus and CalculiX: an input file whose steps move walls and bones as they were fitted.

Keywords: Abaqus Analysis User's Guide; CalculiX CrunchiX User's Manual 2.20, chapter 7 (which takes the same file). The
hyperelastic laws of both are decoupled, W = C10 (J^(-2/3) I1 - 3) + C01 (J^(-4/3) I2 - 3) + (J - 1)^2 / D1, ours are
not: C10, C01 and D1 = 2 / K give the same moduli at small strain, mu and K, and docs/export.md the difference. Both
take what holds and loads a node with a *TRANSFORM along its axes; GLOBAL=YES prints along those of the world.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.body.loads import loads_on
from palpate.export.conditions import prescribed
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.groups import (
    OFF,
    element_faces,
    face_groups,
    material_parts,
    plain_names,
    rows,
    tissue_groups,
    wrapped,
)
from palpate.mechanics.laws.linear import Linear
from palpate.mechanics.laws.mooney_rivlin import MooneyRivlin
from palpate.mechanics.laws.neo_hookean import NeoHookean
from palpate.mechanics.loads import FollowingPressure, Load
from palpate.mesh.space import LagrangeSpace
from palpate.study.outputs import write_text

FACE = np.array([3, 4, 2, 1])  # Abaqus' number of each row of FACES
LAWS = (Linear, NeoHookean, MooneyRivlin)  # that it has
INCREMENT, LEAST = 0.2, 1e-6  # of a step at finite strain, at first and at the least


def write(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write palpate.inp; where Palpate averages the volume change, too, palpate_hybrid.inp, C3D10H for Abaqus alone."""
    space = body.space
    write_text(folder / "palpate.inp", _text(model, body, space, "C3D10" if space.order == 2 else "C3D4"))
    if model.element in ("auto", "P2-P0") and space.order == 2:
        write_text(folder / "palpate_hybrid.inp", _text(model, body, space, "C3D10H"))


def _text(model: FittedModel, body: FittedBody, space: LagrangeSpace, element: str) -> str:
    mesh, tissues = body.mesh, tissue_groups(body.mesh)
    groups, materials = face_groups(mesh), material_parts(mesh, body.log_ratio)
    names = plain_names(
        dict.fromkeys([*tissues, *(group.name for group in groups), *(part.name for part in materials)])
    )
    parts = [
        f"*HEADING\nFitted by Palpate.\n** units: {model.units}\n",
        f"** law: {model.law}; Palpate's element: {model.element}\n",
        *(f"** {plain}: {name}\n" for name, plain in names.items() if name.isprintable()),
        "*NODE, NSET=ALL_NODES\n",
        rows("%d, %.12g, %.12g, %.12g", np.arange(1, len(space.points) + 1), space.points),
    ]
    pattern = ", ".join(["%d"] * (1 + space.cells.shape[1]))
    for name, cells in tissues.items():
        parts += [f"*ELEMENT, TYPE={element}, ELSET={names[name]}\n", rows(pattern, cells + 1, space.cells[cells] + 1)]
    for group in groups:
        points = np.unique(space.facets(group.triangles))
        cells, faces = element_faces(mesh, group.triangles)
        parts += [f"*NSET, NSET={names[group.name]}\n", wrapped(points + 1)]
        parts += [f"*SURFACE, NAME={names[group.name]}_F, TYPE=ELEMENT\n", rows("%d, S%d", cells + 1, FACE[faces])]
    if any(part.name not in tissues for part in materials):
        parts.append(f"** an element's modulus is within {OFF:.1%} of the fitted one\n")
    for part in materials:
        name = names[part.name]
        if part.name not in tissues:
            parts += [f"*ELSET, ELSET={name}\n", wrapped(part.cells + 1)]
        # the law with its constants in the model's unit of stress, D1 in its inverse
        modulus = float(model.moduli[part.tissue] * np.exp(part.log_ratio))
        ratio, law = body.tissues[part.tissue].poisson_ratio, model.law_among(*LAWS)
        shear, compliance = modulus / (2.0 * (1.0 + ratio)), 6.0 * (1.0 - 2.0 * ratio) / modulus
        stated = f"*HYPERELASTIC, NEO HOOKE\n{0.5 * shear:.12g}, {compliance:.12g}\n"
        if isinstance(law, Linear):
            stated = f"*ELASTIC\n{modulus:.12g}, {ratio:.12g}\n"
        elif isinstance(law, MooneyRivlin):
            constants = ", ".join(f"{c:.12g}" for c in (*(c * shear for c in law.coefficients), compliance))
            stated = f"*HYPERELASTIC, MOONEY-RIVLIN\n{constants}\n"
        parts += [f"*MATERIAL, NAME={name}\n", stated]
        parts += [f"*SOLID SECTION, ELSET={name}, MATERIAL={name}\n"]
    return "".join([*parts, *_steps(model, body, space)])


def _steps(model: FittedModel, body: FittedBody, space: LagrangeSpace) -> list[str]:
    """A step a later image: walls, bones and the cut of the image where the fit has them, and the known loads.

    Each node and face is loaded once in a step.
    """
    held = prescribed(body, space, outer=model.outer_boundary)
    parts = []
    if not held.along_world:
        parts += ["*NSET, NSET=SLIDING\n", wrapped(held.sliding + 1), "*TRANSFORM, NSET=SLIDING, TYPE=R\n"]
        parts += [", ".join(f"{x:.12g}" for x in held.axes[:2].ravel()) + "\n"]
    finite = model.material_law.finite
    for number, displacement in enumerate(body.displacements, start=1):
        increments = f"{INCREMENT:g}, 1., {LEAST:g}\n" if finite else ""
        parts += [f"** later image {number}\n*STEP{', NLGEOM, INC=1000' if finite else ''}\n*STATIC\n{increments}"]
        parts += ["*BOUNDARY\n"]
        for axis in range(3):
            along = np.full(len(held.whole), axis + 1)
            parts += [rows("%d, %d, %d, %.12g", held.whole + 1, along, along, displacement[held.whole, axis])]
            still = held.sliding[held.held[:, axis]] + 1
            parts += [rows("%d, %d, %d", still, np.full(len(still), axis + 1), np.full(len(still), axis + 1))]
        forces, pressure = _summed(space, loads_on(space, body.loads[number - 1], densities=model.densities))
        forces[held.sliding] = forces[held.sliding] @ held.axes.T
        points, axes = np.nonzero(forces)
        cells, faces = np.nonzero(pressure)
        new = ", OP=NEW" if any(body.loads[: number - 1]) else ""  # what acted before does not stay
        if new or len(points):
            parts += [f"*CLOAD{new}\n", rows("%d, %d, %.12g", points + 1, axes + 1, forces[points, axes])]
        if new or len(cells):
            parts += [f"*DLOAD{new}\n", rows("%d, P%d, %.12g", cells + 1, FACE[faces], pressure[cells, faces])]
        outputs = "*NODE PRINT, NSET=ALL_NODES, GLOBAL=YES\nU, RF\n*NODE FILE, GLOBAL=YES\nU, RF\n*END STEP\n"
        parts.append(outputs)
    return parts


def _summed(space: LagrangeSpace, loads: tuple[Load, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Forces on the nodes (n_points, 3) mN of loads that stay, pressures on faces (n_tets, 4) kPa of the others."""
    forces, pressure = np.zeros_like(space.points), np.zeros((len(space.mesh.tets), 4))
    for load in loads:
        if isinstance(load, FollowingPressure):
            np.add.at(pressure, element_faces(space.mesh, load.faces[:, :3]), load.kilopascal)
        else:
            forces += load.forces(np.zeros_like(forces)).reshape(-1, 3)
    return forces, pressure
