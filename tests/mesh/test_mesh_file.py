"""Meshes of other programs: one body is one value, whatever its format, its numbers, its order and its unused nodes."""

from __future__ import annotations

import h5py
import meshio
import numpy as np
import pytest

from bodies import box_cells
from mesh_writers import COUNTED, NAMED, NUMBERS, abaqus, block, exodus, gmsh_4, second_order, shuffled
from palpate.errors import InputDataError
from palpate.mesh.mesh_file import read_mesh_file
from palpate.mesh.tet_mesh import FACES


def places(nodes, cells):
    """Cells as sets of places."""
    return {frozenset(map(tuple, np.round(nodes[cell], 6).tolist())) for cell in cells}


def value_of(file, names):
    """What a file says of the body: its tetrahedra, its groups and its surfaces, by where they lie."""
    groups = {name: places(file.nodes, file.tets[file.groups[name]]) for name in names if name in file.groups}
    return (
        places(file.nodes, file.tets),
        groups,
        {name: places(file.nodes, file.surfaces[name]) for name in names if name in file.surfaces},
    )


def value_of_block(of, names, number):
    """The same of what was written; a group is called as `number` says."""
    return (
        places(of.nodes, of.tets),
        {number(name): places(of.nodes, of.tets[own]) for name, own in of.groups.items() if name in names},
        {number(name): places(of.nodes, of.triangles[own]) for name, own in of.surfaces.items() if name in names},
    )


VARIANTS = {
    "as it is": lambda of: of,
    "in another order": lambda of: shuffled(of, 1),
    "with nodes of no element": lambda of: shuffled(of, 2, unused=7),
    "of second order": lambda of: shuffled(second_order(of), 3, unused=5),
}


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", NAMED)
def test_a_body_is_one_value_in_every_format_that_names_groups(tmp_path, name, variant):
    NAMED[name](tmp_path / name, VARIANTS[variant](block()))
    file = read_mesh_file(tmp_path / name)
    assert value_of(file, NUMBERS) == value_of_block(block(), NUMBERS, str)
    assert len(file.surfaces["GRIP"]) == 4
    assert len(file.surfaces["TOP"]) == 8  # those of the grip count in both
    corners = file.nodes[file.tets]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    assert volumes.min() > 0.0
    assert volumes.sum() == pytest.approx(20.0 * 20.0 * 30.0)


@pytest.mark.parametrize(
    ("name", "variant"),  # of second order meshio writes no .mesh, and reads no .xdmf of two kinds of cells
    [(n, v) for n in COUNTED for v in VARIANTS if v != "of second order" or n not in ("n.mesh", "n.xdmf")],
)
def test_a_body_is_one_value_in_every_format_that_numbers_groups(tmp_path, name, variant):
    COUNTED[name](tmp_path / name, VARIANTS[variant](block()))
    whole = ["SOFT", "STIFF", "BOTTOM", "GRIP"]
    found = value_of(read_mesh_file(tmp_path / name), [NUMBERS[name] for name in whole])
    assert found == value_of_block(block(), whole, NUMBERS.get)


@pytest.mark.parametrize("name", ["2.msh", "4.msh", "4b.msh", "h.exo", "c.e"])
def test_groups_with_a_name_are_found_by_number_too(tmp_path, name):
    NAMED[name](tmp_path / name, block())
    file = read_mesh_file(tmp_path / name)
    for called, number in NUMBERS.items():
        for of in (file.groups, file.surfaces):
            assert np.array_equal(of.get(called), of.get(number)) or called not in of


def test_an_empty_block_of_exodus_is_none(tmp_path):
    """Blocks that a program keeps without an element have a number and a name, and no array."""
    exodus(tmp_path / "m.exo", block())
    with h5py.File(tmp_path / "m.exo", "r+") as file:
        numbers, names = file["eb_prop1"][()], file["eb_names"][()]
        del file["eb_prop1"], file["eb_names"]
        file["eb_prop1"], file["eb_names"] = np.append(numbers, 9).astype("i4"), np.concatenate([names, names[:1]])
    file = read_mesh_file(tmp_path / "m.exo")
    assert {name: len(own) for name, own in file.groups.items()} == {"SOFT": 32, 1: 32, "STIFF": 40, 2: 40}


def test_elements_that_gmsh_saves_without_a_group_are_in_none(tmp_path):
    of = block()
    del of.groups["STIFF"]
    gmsh_4(tmp_path / "m.msh", of)
    file = read_mesh_file(tmp_path / "m.msh")
    assert len(file.tets) == len(of.tets)
    n = len(of.groups["SOFT"])
    assert {name: len(own) for name, own in file.groups.items()} == {"SOFT": n, 1: n}
    assert read_mesh_file(tmp_path / "m.msh", data="gmsh:geometrical").groups.keys() == {1, 2}


DECK = """*Heading
** written by hand
*Part, name=Block
*node, NSET=every
{nodes}
*Element, type=C3D10,
 elset="soft part"
{first}
*ELEMENT, TYPE=C3D10H, ELSET=Stiff
{second}
*ELEMENT, TYPE=C3D10, ELSET=stiff
{third}
*ELEMENT, TYPE=T3D2, ELSET=wires
900, {a}, {b}
*ELSET, ELSET=even, GENERATE
2, 72, 2
200, 300, 50
*ELSET, ELSET=Both
EVEN, Soft Part
3, Stiff
*ELSET, ELSET=nothing
*NSET, NSET=Lid, unsorted
{lid}
*SURFACE, TYPE=NODE, NAME=by nodes
LID, 1.0
*SURFACE, NAME="by faces"
Soft Part, S2
*End Part
*Instance, name=Block-1, part=Block
*End Instance
*NODE PRINT, NSET=Lid
U
"""


def test_a_deck_is_read_as_abaqus_reads_it(tmp_path):
    """Names whatever their letters, sets that go on, of sets and of steps; rows that are broken where they like."""
    of, rows = shuffled(second_order(block()), 5), []
    for i, cell in enumerate(of.tets + 1, 1):
        rows.append(f"{i}, " + ", ".join(map(str, cell[:7])) + ",\n " + ", ".join(map(str, cell[7:])))
    nodes = "\n".join(f"{i}, {x!r}, {y!r}, {z!r}" for i, (x, y, z) in enumerate(of.nodes.tolist(), 1))
    lid = np.flatnonzero(of.nodes[:, 2] > 30.0 - 1e-9) + 1
    parts = {"first": rows[:30], "second": rows[30:50], "third": rows[50:]}
    text = DECK.format(
        nodes=nodes,
        lid=",\n".join(", ".join(map(str, lid[i : i + 16])) for i in range(0, len(lid), 16)),
        a=lid[0],
        b=lid[1],
        **{name: "\n".join(part) for name, part in parts.items()},
    )
    (tmp_path / "m.inp").write_bytes(text.replace("\n", "\r\n").encode())
    file = read_mesh_file(tmp_path / "m.inp")
    sizes = {name: len(own) for name, own in file.groups.items()}
    assert sizes == {"SOFT PART": 30, "STIFF": 42, "EVEN": 36, "BOTH": 72}
    top = places(of.nodes, of.triangles[of.surfaces["TOP"], :3])
    assert places(file.nodes, file.surfaces["LID"]) == places(file.nodes, file.surfaces["BY NODES"]) == top
    corners = of.tets[:30, :4]
    assert places(file.nodes, file.surfaces["BY FACES"]) == places(of.nodes, corners[:, [0, 1, 3]])


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("*INCLUDE, INPUT=/etc/passwd", "places nodes or elements by \\*INCLUDE"),
        ("*PART, NAME=A\n*PART, NAME=B", "by \\*PART"),
        ("*INSTANCE, NAME=A-1, PART=A\n1.0, 0.0, 0.0", "by \\*INSTANCE"),
        ("*NODE, SYSTEM=C\n900, 1.0, 0.0, 0.0", "by \\*NODE"),
        ("*NODE\n1, 1.0, 0.0, 0.0", "have the same number"),
        ("*ELEMENT, TYPE=S3\n900, 1, 2, 999", "name nodes that do not exist"),
        ("*ELEMENT, TYPE=C3D99X\n900, 1, 2", "'C3D99X' do not have 99 nodes each"),
        ("*ELEMENT, TYPE=C3D5\n900, 1, 2, 3, 4, 5", "it has 1 volume of 5 nodes"),
        ("*ELEMENT, TYPE=XYZ\n900, 1, 2", "'XYZ' are not supported"),
        ("*ELEMENT, TYPE=C3D8\n900, 1, 2, 3, 4, 5, 6, 7, 8", "beside 72 tetrahedra it has 1 hexahedron"),
        ("*ELSET, ELSET=A, GENERATE\n1, 1000000000000", "over 1e.07 members"),
        ("*ELSET, ELSET=A\nB", "names a set 'B'"),
    ],
)
def test_a_deck_that_places_its_mesh_otherwise_is_refused(tmp_path, line, words):
    abaqus(tmp_path / "m.inp", block())
    (tmp_path / "m.inp").write_text((tmp_path / "m.inp").read_text() + line + "\n")
    with pytest.raises(InputDataError, match=words):
        read_mesh_file(tmp_path / "m.inp")


def cracked():
    """Two boxes that meet in a plane, where each has nodes of its own, one thousandth of a micrometre apart."""
    nodes, tets = box_cells((2, 2, 2), (10.0, 10.0, 10.0))
    return np.concatenate([nodes, nodes + np.array([10.0 + 1e-6, 0.0, 0.0])]), np.concatenate([tets, tets + len(nodes)])


def overlapping():
    """A block with one more tetrahedron on an inner face."""
    nodes, tets = box_cells((2, 2, 2), (10.0, 10.0, 10.0))
    faces, count = np.unique(np.sort(tets[:, FACES].reshape(-1, 3), axis=1), axis=0, return_counts=True)
    inner = faces[count == 2][0]
    return np.concatenate([nodes, [[15.2, 5.3, 5.4]]]), np.concatenate([tets, [[*inner, len(nodes)]]])


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (cracked, "18 of its nodes lie on another node without being joined to it.*at \\[10.0, .*merge such nodes"),
        (overlapping, "faces belong to more than two tetrahedra"),
    ],
)
def test_a_crack_and_an_overlap_are_refused_with_their_place(tmp_path, made, words):
    nodes, tets = made()
    meshio.write(tmp_path / "m.vtu", meshio.Mesh(nodes, [("tetra", tets)]))
    with pytest.raises(InputDataError, match=words):
        read_mesh_file(tmp_path / "m.vtu")


@pytest.mark.parametrize(("kind", "n"), [("hexahedron", 8), ("wedge", 6), ("pyramid", 5), ("tetra20", 20)])
def test_volume_cells_beside_tetrahedra_are_refused_by_number_and_kind(tmp_path, kind, n):
    of = block()
    cells = [("tetra", of.tets), (kind, np.arange(3 * n).reshape(3, n) % len(of.nodes)), ("line", [[0, 1]])]
    meshio.write(tmp_path / "m.vtk", meshio.Mesh(of.nodes, cells)) if kind != "tetra20" else None
    path = tmp_path / ("m.vtk" if kind != "tetra20" else "m.msh")
    if kind == "tetra20":
        meshio.write(path, meshio.Mesh(of.nodes, cells), file_format="gmsh22", binary=False)
    with pytest.raises(InputDataError, match=f"beside 72 tetrahedra it has 3 {kind}: split these"):
        read_mesh_file(path)


def test_arrays_outside_of_an_xdmf_files_folder_are_not_read(tmp_path):
    """Nor where the name is broken by a comment, as a parser joins its parts."""
    of, path = block(), tmp_path / "in" / "m.xdmf"
    path.parent.mkdir()
    meshio.write(path, meshio.Mesh(of.nodes, [("tetra", of.tets)]))
    (path.parent / "m.h5").rename(tmp_path / "m.h5")
    text = path.read_text()
    for name in ("../m.h5:", ".<!-- -->./m.h5:", f"{tmp_path}/m.h5:"):
        path.write_text(text.replace("m.h5:", name))
        with pytest.raises(InputDataError, match="outside its own folder"):
            read_mesh_file(path)


@pytest.mark.parametrize(("space", "signs"), [("RAS", [1, 1, 1]), ("LPS", [-1, -1, 1])])
def test_a_vtk_of_3d_slicer_says_its_axes(tmp_path, space, signs):
    of, path = block(), tmp_path / "m.vtk"
    meshio.write(path, meshio.Mesh(of.nodes * signs, [("tetra", of.tets)]), file_format="vtk42")
    version, _, rest = path.read_bytes().split(b"\n", 2)
    path.write_bytes(b"\n".join([version, f"3D Slicer output. SPACE={space}".encode(), rest]))
    read = read_mesh_file(path)
    assert places(read.nodes, read.tets) == places(of.nodes, of.tets)


@pytest.mark.parametrize("name", ["label", "Labels", "RegionId", "MaterialIDs", "CellEntityIds"])
def test_cell_data_that_number_groups_are_found_by_their_usual_names(tmp_path, name):
    of = block()
    numbers = np.isin(np.arange(len(of.tets)), of.groups["STIFF"]) + 1
    meshio.write(tmp_path / "m.vtu", meshio.Mesh(of.nodes, [("tetra", of.tets)], cell_data={name: [numbers]}))
    groups = read_mesh_file(tmp_path / "m.vtu").groups
    assert {number: len(own) for number, own in groups.items()} == {n: (numbers == n).sum() for n in (1, 2)}
    both = {name: [np.stack([numbers, numbers], axis=1)]}
    meshio.write(tmp_path / "m.vtu", meshio.Mesh(of.nodes, [("tetra", of.tets)], cell_data=both))
    with pytest.raises(InputDataError, match="not one whole number for each cell"):
        read_mesh_file(tmp_path / "m.vtu")


def test_a_file_says_which_cell_data_it_has(tmp_path):
    of = block()
    meshio.write(
        tmp_path / "m.vtu", meshio.Mesh(of.nodes, [("tetra", of.tets)], cell_data={"Part": [of.tets[:, 0] % 2]})
    )
    file = read_mesh_file(tmp_path / "m.vtu")
    assert list(file.groups) == [1]
    assert "'Part'" in file.about
    assert read_mesh_file(tmp_path / "m.vtu", data="Part").groups.keys() == {0, 1}
    with pytest.raises(InputDataError, match=r"no cell data 'part'.*Part"):
        read_mesh_file(tmp_path / "m.vtu", data="part")
