"""gmsh: MSH 4.1, second order, a physical group a tissue, wall, observed surface and the cut of the image.

Format: gmsh's reference manual, section "MSH file format". Faces that belong to the same groups are one surface.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.groups import element_faces, face_groups, rows, tissue_groups
from palpate.study.outputs import write_text

TETRAHEDRON, TRIANGLE = {1: 4, 2: 11}, {1: 2, 2: 9}  # gmsh's element types by order
EDGES = np.array([0, 1, 2, 3, 4, 5, 6, 7, 9, 8])  # gmsh has the last two edges the other way round


def write(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write palpate.msh: the mesh at rest, moduli and Poisson's ratios of its elements, displacements of its nodes."""
    space = body.space
    surfaces, names = _surfaces(body)
    volumes = tissue_groups(body.mesh)
    parts = ["$MeshFormat\n4.1 0 8\n$EndMeshFormat\n", "$PhysicalNames\n", f"{len(names) + len(volumes)}\n"]
    parts += [f'2 {tag} "{_quoted(name)}"\n' for tag, name in enumerate(names, start=1)]
    parts += [f'3 {tag} "{_quoted(name)}"\n' for tag, name in enumerate(volumes, start=1)]
    parts.append(f"$EndPhysicalNames\n$Entities\n0 0 {len(surfaces)} {len(volumes)}\n")
    for tag, (groups, triangles) in enumerate(surfaces, start=1):
        tags = " ".join(map(str, groups))
        parts.append(f"{tag} {_box(space.points[triangles])} {len(groups)} {tags} 0\n")
    for tag, cells in enumerate(volumes.values(), start=1):
        parts.append(f"{tag} {_box(space.points[space.cells[cells]])} 1 {tag} 0\n")
    n = len(space.points)
    parts += [
        "$EndEntities\n",
        f"$Nodes\n1 {n} 1 {n}\n3 1 0 {n}\n",
        rows("%d", np.arange(1, n + 1)),
        rows("%.16g %.16g %.16g", space.points),
    ]
    # triangles, then tetrahedra, numbered as they come
    order = EDGES[: space.cells.shape[1]]
    blocks = [(2, tag, TRIANGLE, space.facets(faces)) for tag, (_, faces) in enumerate(surfaces, start=1)]
    blocks += [(3, tag, TETRAHEDRON, space.cells[c][:, order]) for tag, c in enumerate(volumes.values(), start=1)]
    total, first = sum(len(nodes) for *_, nodes in blocks), 1
    parts.append(f"$EndNodes\n$Elements\n{len(blocks)} {total} 1 {total}\n")
    for dimension, tag, kind, nodes in blocks:
        parts.append(f"{dimension} {tag} {kind[space.order]} {len(nodes)}\n")
        parts.append(rows(" ".join(["%d"] * (1 + nodes.shape[1])), np.arange(first, first + len(nodes)), nodes + 1))
        first += len(nodes)
    parts.append("$EndElements\n")
    for number, displacement in enumerate(body.displacements, start=1):
        heading = f'$NodeData\n1\n"displacement_mm"\n1\n{float(number):g}\n3\n{number}\n3\n{n}\n'
        parts += [heading, rows("%d %.9g %.9g %.9g", np.arange(1, n + 1), displacement), "$EndNodeData\n"]
    # a triangle has the values of the tetrahedron behind it, for programs that ask a value of every element
    behind = [element_faces(body.mesh, triangles)[0] for _, triangles in surfaces]
    cells = np.concatenate([*behind, *volumes.values()])
    poisson = np.array([tissue.poisson_ratio for tissue in body.tissues])
    for name, values in (
        (model.modulus_name, body.element_moduli(model.moduli)),
        ("poisson_ratio", poisson[body.mesh.region]),
    ):
        heading = f'$ElementData\n1\n"{name}"\n1\n0\n3\n0\n1\n{len(cells)}\n'
        parts += [heading, rows("%d %.9g", np.arange(1, len(cells) + 1), values[cells]), "$EndElementData\n"]
    write_text(folder / "palpate.msh", "".join(parts))


def _surfaces(body: FittedBody) -> tuple[list[tuple[tuple[int, ...], NDArray[np.int64]]], list[str]]:
    """Faces (n, 3) by the tags of all the groups that they belong to, and the groups' names, tag by tag from 1.

    The smallest group has the lowest tag: dolfinx keeps that one of a face.
    """
    groups = sorted(face_groups(body.mesh), key=lambda group: len(group.triangles))
    triangles = np.concatenate([group.triangles for group in groups])
    keys = np.sort(triangles, axis=1)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    member = np.zeros((len(first), len(groups)), dtype=bool)
    start = 0
    for number, group in enumerate(groups):
        member[inverse.ravel()[start : start + len(group.triangles)], number] = True
        start += len(group.triangles)
    kinds, kind = np.unique(member, axis=0, return_inverse=True)
    found = [
        (tuple(int(tag) + 1 for tag in np.flatnonzero(row)), triangles[first[kind.ravel() == number]])
        for number, row in enumerate(kinds)
    ]
    return found, [group.name for group in groups]


def _box(points: NDArray[np.float64]) -> str:
    flat = points.reshape(-1, 3)
    return " ".join(f"{x:.9g}" for x in (*flat.min(axis=0), *flat.max(axis=0)))


def _quoted(name: str) -> str:
    """A name without what ends it in the file."""
    return name.replace('"', "'").replace("\\", "/")
