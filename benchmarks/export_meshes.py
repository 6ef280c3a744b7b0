"""gmsh, meshio, trimesh, dolfinx and FEBio's schema read our meshes: nodes, cells, groups, volumes, displacement."""

from __future__ import annotations

import importlib
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from export_rows import (
    VOLUME,
    Results,
    Row,
    any_of,
    installed,
    missing,
    percent,
    ran,
    tetrahedra,
    volumes_of,
    worst_volume,
)

import palpate
from palpate.export import face_groups, fitted_bodies

LONG = ("Nodes", "Elements", "Surface", "NodeData", "ElementData")  # lists of FEBio's
SYSTEM = "/usr/bin/python3"  # for which Debian has dolfinx


def gmsh(results: Results, folder: Path) -> Iterator[Row]:
    """Read, name, measure and write again by gmsh itself."""
    result = any_of(results)
    (path,) = palpate.export(result, folder / "gmsh", format="gmsh")
    program, module = shutil.which("gmsh", path="/usr/bin"), installed("gmsh")
    what = "problems that gmsh -check finds"
    if program is None:
        yield from missing("gmsh of Debian", what)
    else:
        said = ran([program, "-check", path, "-"], folder)
        yield Row(
            "gmsh of Debian", what, said.count("Warning") + said.count("Error") + said.count("uplicate nodes found"), 0
        )
    if module is None:
        yield from missing("gmsh", "volumes, groups, displacement")
        return
    module.initialize()
    try:
        module.option.setNumber("General.Terminal", 0)
        module.open(str(path))
        sizes = {}
        for dimension, tag in module.model.getPhysicalGroups(3):
            tags = elements_of(module, dimension, tag)
            name = module.model.getPhysicalName(dimension, tag)
            sizes[name] = float(np.sum(module.model.mesh.getElementQualities(tags, "volume")))
        counts = faces_of_groups(module)
        nodes, _, _ = module.model.mesh.getNodes()
        _, tags, values, _, _ = module.view.getModelData(module.view.getTags()[0], 1)
        motion = np.array(values)[np.argsort(tags)]
        module.write(str(folder / "again.msh"))
        module.clear()
        module.open(str(folder / "again.msh"))
        again = faces_of_groups(module)
    finally:
        module.finalize()
    expected = {group.name: len(group.triangles) for group in face_groups(result.space.mesh)}
    yield Row("gmsh", "volume of a tissue, relative difference", worst_volume(sizes, result.space.mesh), VOLUME)
    yield Row("gmsh", "nodes lost or gained", abs(len(nodes) - len(result.space.points)), 0)
    yield Row("gmsh", "groups of faces with lost or gained ones", different(counts, expected), 0)
    yield Row("gmsh", "the same when gmsh writes the file again", different(again, expected), 0)
    yield Row("gmsh", "displacement, RMS to ours", percent(motion, result.estimation.displacements[-1]), 1e-5, "%")


def elements_of(module: Any, dimension: int, tag: int) -> list[int]:
    """Tags of the elements of a physical group."""
    entities = module.model.getEntitiesForPhysicalGroup(dimension, tag)
    found = [module.model.mesh.getElements(dimension, entity)[1] for entity in entities]
    return [int(tag) for of_entity in found for tags in of_entity for tag in tags]


def faces_of_groups(module: Any) -> dict[str, int]:
    """How many faces each physical surface has."""
    groups = module.model.getPhysicalGroups(2)
    return {module.model.getPhysicalName(*group): len(elements_of(module, *group)) for group in groups}


def different(found: dict[str, int], expected: dict[str, int]) -> int:
    """How many names have another count."""
    return sum(found.get(name) != expected.get(name) for name in {*found, *expected})


def meshes(results: Results, folder: Path) -> Iterator[Row]:
    """Counts, volumes, sets and displacement by meshio, closed surfaces by trimesh."""
    result = any_of(results)
    mesh, meshio = result.space.mesh, importlib.import_module("meshio")
    for name, file in (("abaqus", "palpate.inp"), ("gmsh", "palpate.msh"), ("vtu", "mesh_1.vtu")):
        palpate.export(result, folder / f"meshio-{name}", format=name)
        read = meshio.read(folder / f"meshio-{name}" / file)
        blocks = [(number, block) for number, block in enumerate(read.cells) if block.type.startswith("tetra")]
        lost = abs(len(read.points) - len(result.space.points))
        lost += abs(sum(len(block.data) for _, block in blocks) - len(mesh.tets))
        yield Row("meshio", f"{name}: nodes and tetrahedra lost or gained", lost, 0)
        if name != "abaqus":
            ours = result.estimation.displacements[-1]
            yield Row(
                "meshio",
                f"{name}: displacement, RMS to ours",
                percent(read.point_data["displacement_mm"], ours),
                1e-5,
                "%",
            )
        if name == "vtu":
            continue
        if name == "gmsh":
            counts = {key: sum(len(ids) for ids in sets if ids is not None) for key, sets in read.cell_sets.items()}
            expected = {group.name: len(group.triangles) for group in face_groups(mesh)}
            wrong = sum(counts.get(key) != count for key, count in expected.items())
            yield Row("meshio", "gmsh: groups of faces with lost or gained ones", wrong, 0)
        plain = {tissue: tissue.upper() if name == "abaqus" else tissue for tissue in volumes_of(mesh)}
        own = {
            tissue: [(block, read.cell_sets[key][number]) for number, block in blocks] for tissue, key in plain.items()
        }
        sizes = {
            tissue: sum(
                tetrahedra(read.points, block.data[ids]) for block, ids in parts if ids is not None and len(ids)
            )
            for tissue, parts in own.items()
        }
        yield Row("meshio", f"{name}: volume of a tissue, relative difference", worst_volume(sizes, mesh), VOLUME)
    trimesh = installed("trimesh")
    for name in ("stl", "obj", "ply"):
        words = f"{name}: volume of a tissue, relative difference", f"{name}: surfaces that are not closed and outward"
        if trimesh is None:
            yield from missing("trimesh", words[0])
            continue
        sizes, open_ones = {}, 0
        for path in palpate.export(result, folder / name, format=name):
            surface = trimesh.load(path)
            open_ones += not (closed(surface) and surface.volume > 0.0)
            number, rest = path.stem.split("_", 1)
            if rest.endswith("_before"):
                sizes[result.tissues[int(number)].name] = float(surface.volume)
        yield Row("trimesh", words[0], worst_volume(sizes, mesh), VOLUME)
        yield Row("trimesh", words[1], open_ones, 0)


def closed(surface: Any) -> bool:
    """Whether every edge is passed as often one way as the other: where a body touches itself, twice each."""
    ways = np.asarray(surface.edges)
    keys = ways @ [len(surface.vertices), 1]
    return bool(np.array_equal(np.sort(keys), np.sort(ways[:, ::-1] @ [len(surface.vertices), 1])))


def dolfinx(results: Results, folder: Path) -> Iterator[Row]:
    """Debian's dolfinx reads the gmsh file by gmshio, and meshio's conversion of it by XDMF."""
    result = any_of(results)
    (path,) = palpate.export(result, folder / "dolfinx", format="gmsh")
    probe = [SYSTEM, "-c", "import dolfinx, gmsh"]
    if not Path(SYSTEM).exists() or subprocess.run(probe, capture_output=True, check=False).returncode:
        yield from missing("dolfinx", "nodes, cells, groups, volumes")
        return
    meshio, mesh = importlib.import_module("meshio"), result.space.mesh
    read = meshio.read(path)
    tags = [
        data for block, data in zip(read.cells, read.cell_data["gmsh:physical"], strict=True) if block.type == "tetra10"
    ]
    tets = meshio.Mesh(
        read.points, [("tetra10", read.cells_dict["tetra10"])], cell_data={"tissue": [np.concatenate(tags)]}
    )
    meshio.write(folder / "dolfinx" / "palpate.xdmf", tets)
    script = Path(__file__).with_name("export_dolfinx.py")
    printed = ran([SYSTEM, script, path, folder / "dolfinx" / "palpate.xdmf"], folder)
    found = json.loads(printed.splitlines()[-1])
    part = f"dolfinx {found['version']}"
    for way in ("gmshio", "xdmf"):
        lost = abs(found[way]["nodes"] - len(result.space.points)) + abs(found[way]["cells"] - len(mesh.tets))
        yield Row(part, f"{way}: nodes and cells lost or gained", lost, 0)
        yield Row(
            part, f"{way}: volume of a tissue, relative difference", worst_volume(found[way]["volumes"], mesh), VOLUME
        )
    yield Row(
        part,
        "faces whose group is not the smallest one that they are in",
        different(found["faces"], first_groups(result)),
        0,
    )


def first_groups(result: palpate.CaseResult) -> dict[str, int]:
    """How many faces are in a group and in none that the gmsh file has before it."""
    seen, counts = set[tuple[int, ...]](), dict[str, int]()
    for group in sorted(face_groups(fitted_bodies(result)[0].mesh), key=lambda group: len(group.triangles)):
        own = {tuple(face) for face in np.sort(group.triangles, axis=1).tolist()}
        counts[group.name] = len(own - seen)
        seen |= own
    return {name: count for name, count in counts.items() if count}


def febio(results: Results, folder: Path) -> Iterator[Row]:
    """The schema of elements as pyfebio has it, on a file whose long lists are cut; it knows no maps as values."""
    result, what = any_of(results), "errors of the schema"
    module = installed("pyfebio.model")
    if module is None:
        yield from missing("pyfebio", what)
        return
    (path,) = palpate.export(result, folder / "febio", format="febio")
    root = ET.parse(path).getroot()
    points = np.array(
        [[float(x) for x in node.text.split(",")] for node in root.iter("node") if node.text and "id" in node.attrib]
    )
    sizes = {
        str(part.get("name")): tetrahedra(points, np.array([integers(e) for e in part]) - 1)
        for part in root.iter("Elements")
    }
    yield Row("XML", "FEBio: volume of a tissue, relative difference", worst_volume(sizes, result.space.mesh), VOLUME)
    for parent in root.iter():
        for child in list(parent)[20:] if parent.tag in LONG else []:
            parent.remove(child)
        if parent.attrib.get("type") == "map":
            del parent.attrib["type"]
            parent.text = "1.0"
        if parent.tag in ("NodeSet", "ElementSet"):
            parent.text = ",".join(map(str, integers(parent)[:20]))
    try:
        model = module.Model.from_xml(ET.tostring(root))
        errors = int(len(model.material_.all_materials) != len(sizes))
    except ValueError as error:
        print(str(error)[:3000], file=sys.stderr)
        errors = str(error).count("\n  [line ")
    yield Row("pyfebio", what, errors, 0)


def integers(element: ET.Element) -> list[int]:
    """The numbers in the text of an element."""
    return [int(x) for x in (element.text or "").split(",")]
