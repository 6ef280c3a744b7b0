"""A block with two materials and named surfaces that overlap, as files of the formats that hold such groups."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from pathlib import Path

import h5py
import meshio
import numpy as np
from numpy.typing import NDArray
from scipy.io import netcdf_file

from bodies import box_cells

NUMBERS = {"SOFT": 1, "STIFF": 2, "BOTTOM": 11, "TOP": 12, "GRIP": 13, "INNER": 14}
MIDDLES = {3: [(0, 1), (1, 2), (0, 2)], 4: [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]}
ABAQUS_FACES = [(0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3)]
EXODUS_SIDES = [(0, 1, 3), (1, 2, 3), (0, 2, 3), (0, 1, 2)]


@dataclasses.dataclass(frozen=True)
class Block:
    """Nodes (n, 3); tetrahedra and triangles (n, 4 or 10 and 3 or 6); which ones each group has."""

    nodes: NDArray[np.float64]
    tets: NDArray[np.int64]
    triangles: NDArray[np.int64]
    groups: dict[str, NDArray[np.int64]]
    surfaces: dict[str, NDArray[np.int64]]

    @property
    def ending(self) -> tuple[str, str]:
        return ("tetra10", "triangle6") if self.tets.shape[1] == 10 else ("tetra", "triangle")

    def parts(self, of: dict[str, NDArray[np.int64]], n: int) -> dict[tuple[str, ...], NDArray[np.int64]]:
        """What is in the same groups."""
        found = defaultdict(list)
        for number in range(n):
            found[tuple(name for name, own in of.items() if number in own)].append(number)
        return {names: np.array(own) for names, own in found.items()}


def block() -> Block:
    nodes, tets = box_cells((2, 2, 3), (20.0, 20.0, 30.0))
    low = nodes[tets].mean(axis=1)[:, 2] < 15.0
    faces = np.concatenate([tets[:, list(corners)] for corners in ABAQUS_FACES])
    bottom, top = (faces[np.abs(nodes[faces][:, :, 2] - z).max(axis=1) < 1e-9] for z in (0.0, 30.0))
    grip = len(bottom) + np.flatnonzero(nodes[top][:, :, 0].max(axis=1) < 10.1)
    return Block(
        nodes,
        tets,
        np.concatenate([bottom, top]),
        {"SOFT": np.flatnonzero(low), "STIFF": np.flatnonzero(~low)},
        {"BOTTOM": np.arange(len(bottom)), "TOP": len(bottom) + np.arange(len(top)), "GRIP": grip},
    )


def second_order(of: Block) -> Block:
    """With a node in the middle of each edge."""
    numbers, nodes = dict[tuple[int, int], int](), list(of.nodes)

    def grown(cells):
        rows = []
        for cell in cells.tolist():
            pairs = [(min(cell[a], cell[b]), max(cell[a], cell[b])) for a, b in MIDDLES[len(cell)]]
            for pair in pairs:
                if pair not in numbers:
                    numbers[pair] = len(nodes)
                    nodes.append(0.5 * (nodes[pair[0]] + nodes[pair[1]]))
            rows.append(cell + [numbers[pair] for pair in pairs])
        return np.array(rows)

    tets, triangles = grown(of.tets), grown(of.triangles)
    return dataclasses.replace(of, nodes=np.array(nodes), tets=tets, triangles=triangles)


def shuffled(of: Block, seed: int, *, unused: int = 0) -> Block:
    """Nodes and elements in another order, beside some nodes that no element has."""
    rng = np.random.default_rng(seed)
    nodes = np.concatenate([of.nodes, rng.uniform(-90.0, 90.0, (unused, 3))])
    node, tet, triangle = (rng.permutation(len(x)) for x in (nodes, of.tets, of.triangles))
    new, new_tet, new_triangle = np.argsort(node), np.argsort(tet), np.argsort(triangle)
    return Block(
        nodes[node],
        new[of.tets][tet],
        new[of.triangles][triangle],
        {name: new_tet[own] for name, own in of.groups.items()},
        {name: new_triangle[own] for name, own in of.surfaces.items()},
    )


def gmsh_2(path: Path, of: Block) -> None:
    """An element in two groups stands there twice, as gmsh writes it."""
    types, rows = {3: 2, 6: 9, 4: 4, 10: 11}, []
    for sets, cells in ((of.surfaces, of.triangles), (of.groups, of.tets)):
        for name, own in sets.items():
            tag = f"{types[cells.shape[1]]} 2 {NUMBERS[name]} 1"
            rows += [f"{tag} {' '.join(map(str, cells[i] + 1))}" for i in own]
    lines = [f"{i} {x!r} {y!r} {z!r}" for i, (x, y, z) in enumerate(of.nodes.tolist(), 1)]
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", *_names(), "$Nodes", str(len(lines)), *lines, "$EndNodes"]
    rows = [f"{i} {row}" for i, row in enumerate(rows, 1)]
    path.write_text("\n".join([*lines, "$Elements", str(len(rows)), *rows, "$EndElements", ""]))


def gmsh_4(path: Path, of: Block, *, binary: bool = False) -> None:
    """An entity lies in several groups; a point and a curve lie in none, as where all is saved."""
    out = [f"$MeshFormat\n4.1 {int(binary)} 8\n".encode()]

    def put(kind, *values):
        out.append(np.array(values, kind).tobytes() if binary else (" ".join(map(repr, values)) + "\n").encode())

    put("i4", 1) if binary else None
    out.append(b"\n$EndMeshFormat\n" + "\n".join(_names()).encode() + b"\n$Entities\n")
    surfaces = list(of.parts(of.surfaces, len(of.triangles)).items())
    volumes = list(of.parts(of.groups, len(of.tets)).items())
    put("u8", 1, 1, len(surfaces), len(volumes))
    put("i4", 9), put("f8", 1.0, 2.0, -40.0), put("u8", 0)
    put("i4", 4), put("f8", *6 * [0.0]), put("u8", 0), put("u8", 2), put("i4", 1, -1)
    for parts in (surfaces, volumes):
        for number, (names, _) in enumerate(parts, 1):
            tags = [-NUMBERS[name] if name == "BOTTOM" else NUMBERS[name] for name in names]  # a face turned round
            put("i4", number), put("f8", *6 * [0.0]), put("u8", len(tags)), put("i4", *tags), put("u8", 0)
    out.append(b"\n$EndEntities\n$Nodes\n")
    put("u8", 1, len(of.nodes), 1, len(of.nodes)), put("i4", 3, 1, 0), put("u8", len(of.nodes))
    put("u8", *range(1, len(of.nodes) + 1)), put("f8", *of.nodes.ravel().tolist())
    out.append(b"\n$EndNodes\n$Elements\n")
    put("u8", 1 + len(surfaces) + len(volumes), 1 + len(of.tets) + len(of.triangles), 1, 10**4)
    put("i4", 0, 9, 15), put("u8", 1), put("u8", 9999, 1)
    for dimension, parts, cells in ((2, surfaces, of.triangles), (3, volumes, of.tets)):
        for number, (_, own) in enumerate(parts, 1):
            put("i4", dimension, number, {3: 2, 6: 9, 4: 4, 10: 11}[cells.shape[1]]), put("u8", len(own))
            put("u8", *np.c_[own + 1, cells[own] + 1].ravel().tolist())
    out.append(b"\n$EndElements\n")
    path.write_bytes(b"".join(out))


def gmsh_4_binary(path: Path, of: Block) -> None:
    gmsh_4(path, of, binary=True)


def abaqus(path: Path, of: Block) -> None:
    """Elements of one block a material, surfaces of their faces."""
    lines = ["*Heading", "*NODE"] + [f"{i}, {x!r}, {y!r}, {z!r}" for i, (x, y, z) in enumerate(of.nodes.tolist(), 1)]
    for name, own in of.groups.items():
        lines.append(f"*ELEMENT, TYPE=C3D{of.tets.shape[1]}, ELSET={name}")
        lines += [f"{i + 1}, " + ", ".join(map(str, of.tets[i] + 1)) for i in own]
    for name, own in of.surfaces.items():
        lines.append(f"*SURFACE, NAME={name}, TYPE=ELEMENT")
        lines += [f"{tet + 1}, S{side + 1}" for tet, side in _sides(of, own, ABAQUS_FACES)]
    path.write_text("\n".join([*lines, ""]))


def exodus(path: Path, of: Block, *, classic: bool = False) -> None:
    """Element blocks and side sets, with names and numbers."""
    arrays, order = {}, np.concatenate(list(of.groups.values()))
    for axis, values in zip("xyz", of.nodes.T, strict=True):
        arrays[f"coord{axis}"] = values
    for number, own in enumerate(of.groups.values(), 1):
        arrays[f"connect{number}"] = (of.tets[own] + 1).astype("i4")
    for number, own in enumerate(of.surfaces.values(), 1):
        tets, sides = np.array(_sides(of, own, EXODUS_SIDES)).T
        arrays[f"elem_ss{number}"] = (np.argsort(order)[tets] + 1).astype("i4")
        arrays[f"side_ss{number}"] = (sides + 1).astype("i4")
    for key, names in (("eb", of.groups), ("ss", of.surfaces)):
        arrays[f"{key}_prop1"] = np.array([NUMBERS[name] for name in names], "i4")
        arrays[f"{key}_names"] = np.array([list(name.encode().ljust(33, b"\0")) for name in names], "u1").view("S1")
    with netcdf_file(path, "w") if classic else h5py.File(path, "w") as file:
        for name, array in arrays.items():
            if classic:
                for axis, size in enumerate(array.shape):
                    file.createDimension(f"{name}_{axis}", size)
                data = file.createVariable(
                    name, array.dtype.newbyteorder("="), [f"{name}_{a}" for a in range(array.ndim)]
                )
                data[:] = array
                if name.startswith("connect"):
                    data.elem_type = b"TETRA"
            else:
                file[name] = array
                if name.startswith("connect"):
                    file[name].attrs["elem_type"] = np.bytes_("TETRA4")


def exodus_classic(path: Path, of: Block) -> None:
    exodus(path, of, classic=True)


def med(path: Path, of: Block) -> None:
    """A family for what is in the same groups."""
    families, tags = {}, []
    for sets, cells in ((of.groups, of.tets), (of.surfaces, of.triangles)):
        values = np.zeros(len(cells), dtype=int)
        for names, own in of.parts(sets, len(cells)).items():
            values[own] = -1 - len(families)
            families[-1 - len(families)] = list(names)
        tags.append(values)
    cells = list(zip(of.ending, (of.tets, of.triangles), strict=True))
    mesh = meshio.Mesh(of.nodes, cells, cell_data={"cell_tags": tags})
    mesh.cell_tags = families
    meshio.write(path, mesh)


def numbered(path: Path, of: Block) -> None:
    """One number a cell: a triangle that is in two groups has the last one's."""
    data = [np.zeros(len(cells), dtype=int) for cells in (of.tets, of.triangles)]
    for values, sets in zip(data, (of.groups, of.surfaces), strict=True):
        for name, own in sets.items():
            values[own] = NUMBERS[name]
    cells = list(zip(of.ending, (of.tets, of.triangles), strict=True))
    key = "medit:ref" if path.suffix == ".mesh" else "tissue"
    meshio.write(path, meshio.Mesh(of.nodes, cells, cell_data={key: data}))


def _names() -> list[str]:
    rows = [f'{2 if number > 9 else 3} {number} "{name}"' for name, number in NUMBERS.items()]
    return ["$PhysicalNames", str(len(rows)), *rows, "$EndPhysicalNames"]


def _sides(of: Block, own: NDArray[np.int64], sides: list[tuple[int, ...]]) -> list[tuple[int, int]]:
    """Tetrahedron and side of triangles."""
    every = {
        tuple(sorted(tet[list(corners)])): (number, side)
        for number, tet in enumerate(of.tets[:, :4])
        for side, corners in enumerate(sides)
    }
    return [every[tuple(sorted(triangle))] for triangle in of.triangles[own, :3].tolist()]


NAMED = {"2.msh": gmsh_2, "4.msh": gmsh_4, "4b.msh": gmsh_4_binary, "a.inp": abaqus, "h.exo": exodus}
NAMED |= {"c.e": exodus_classic, "f.med": med}
COUNTED = {"n.vtu": numbered, "n.xdmf": numbered, "n.mesh": numbered, "n.vtk": numbered}
