"""Pictures of what solvers and viewers of meshes get: CalculiX, FEBio, gmsh, SOFA, ParaView, surfaces."""

from __future__ import annotations

import json
import os
import runpy
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyvista

from . import meshes
from .sheet import COLOURS, Bar, Panel, Part, drawn, trimmed, write_sheet

ORGANS = ("prostate", "bladder")
EDGES = {"show_edges": True, "edge_color": "#404040"}
MOTION = "YlGnBu"  # pale where nothing moves
Grid = pyvista.UnstructuredGrid


def paraview(folder: Path, picture: Path) -> None:
    """The body before and after, cut open, by Young's modulus; some of its groups."""
    scene = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    low, high = scene["range"]
    bar = Bar("Young's modulus (kPa)", low, high, logarithmic=True, ticks=(10, 20, 30))
    bodies = [pyvista.read(folder / f"mesh_{state}.vtu") for state in (0, 1)]
    images = []
    for body in bodies:
        cut = body.warp_by_vector("displacement_mm").clip(normal="x", origin=scene["middle"])
        images.append(drawn([(cut, {"scalars": scene["modulus"], **bar.shown, **EDGES})], bodies[0].bounds))
    groups: list[Part] = []
    for name in ("prostate_observed", "bladder_observed", "rectum_wall", "bones_wall"):
        (path,) = (folder / "groups").glob(f"*{name}.vtp")
        moved = pyvista.read(path).warp_by_vector("displacement_mm")
        if name == "bones_wall":  # those of one side hide all
            moved = moved.clip(normal="x", origin=scene["middle"])
        groups.append((moved, {"color": COLOURS[name.split("_")[0]], "smooth_shading": True}))
    walls = drawn(groups, bodies[0].bounds)
    before, after = trimmed(*images)
    names = {name: COLOURS[name] for name in ("prostate", "bladder", "rectum", "bones")}
    panels = [Panel("before", before, bar), Panel("after, as fitted", after, bar)]
    write_sheet(picture, [*panels, Panel("groups of faces, after", trimmed(walls)[0], names=names)])


def abaqus(folder: Path, picture: Path) -> None:
    """CalculiX solves palpate.inp; its own mesh and displacements, cut open."""
    with tempfile.TemporaryDirectory() as place:
        shutil.copy(folder / "palpate.inp", place)
        environment = {**os.environ, "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
        subprocess.run(["ccx", "palpate"], cwd=place, env=environment, check=True, capture_output=True)  # noqa: S607
        body = meshes.calculix(Path(place) / "palpate.frd")
    bar = _motion(body)
    materials = drawn(_by_tissue(_cut(body, body), **EDGES), body.bounds)
    motion = drawn(_moved(body, bar), body.bounds)
    images = trimmed(materials, motion)
    panels = [
        Panel("materials in the input file", images[0], names=_names(body)),
        Panel("CalculiX, after the step", images[1], bar),
    ]
    write_sheet(picture, panels)


def febio(folder: Path, picture: Path) -> None:
    """Element domains with their materials; the nodes that the step moves, by how far."""
    body, materials, prescribed = meshes.febio(folder / "palpate.feb")
    half = prescribed.extract_points(prescribed.points[:, 0] < _middle(body)[0], include_cells=False)
    half["mm"] = np.linalg.norm(half["displacement_mm"], axis=1)
    largest = np.linalg.norm(prescribed["displacement_mm"], axis=1).max()
    bar = Bar("prescribed displacement (mm)", 0.0, float(largest), "viridis_r")
    domains = drawn(_by_tissue(_cut(body, body), **EDGES), body.bounds)
    spheres = {"scalars": "mm", "render_points_as_spheres": True, "point_size": 14, **bar.shown}
    nodes = drawn([(half, spheres), *_organs(body)], body.bounds)
    names = {f"{name}: {words}": COLOURS[name] for name, words in materials.items()}
    images = trimmed(domains, nodes)
    panels = [Panel("element domains", images[0], names=names), Panel("node set “prescribed”, half", images[1], bar)]
    write_sheet(picture, panels)


def gmsh(folder: Path, picture: Path) -> None:
    """Physical volumes and surfaces, the view of displacements."""
    body, surfaces = meshes.gmsh(folder / "palpate.msh")
    bar = _motion(body)
    volumes = drawn(_by_tissue(_cut(body, body), **EDGES), body.bounds)
    view = drawn(_moved(body, bar), body.bounds)
    shown = ("prostate observed", "bladder observed", "rectum wall", "bones wall")
    surfaces["bones wall"] = surfaces["bones wall"].clip(normal="x", origin=_middle(body))
    faces = [(surfaces[name], {"color": COLOURS[name.split()[0]], **EDGES}) for name in shown]
    groups = drawn(faces, body.bounds)
    first, last = trimmed(volumes, view)
    panels = [
        Panel("physical volumes", first, names=_names(body)),
        Panel("physical surfaces", trimmed(groups)[0], names={name: COLOURS[name.split()[0]] for name in shown}),
        Panel("view displacement_mm", last, bar),
    ]
    write_sheet(picture, panels)


def sofa(folder: Path, picture: Path) -> None:
    """The linear tetrahedra; the walls at rest and where the scene has them after a second."""
    scene = runpy.run_path(str(folder / "scene.py"))  # it reads the arrays, and does without SOFA until it is played
    arrays, model = scene["ARRAYS"], scene["MODEL"]
    names = {tissue["region"]: tissue["name"] for tissue in model["tissues"]}
    body = meshes.tetrahedra(arrays["nodes"], arrays["tets"], np.array([names[i] for i in arrays["region"]]))
    body.point_data["id"] = np.arange(body.n_points)
    positions = arrays["nodes"].copy()
    positions[arrays["prescribed"]] = scene["positions"](1.0)
    body.point_data["motion"] = positions - arrays["nodes"]
    groups = {name: arrays[key] for key, name in model["groups"].items()}
    skin = body.extract_surface(algorithm="dataset_surface")
    still, moved = [], []
    bar = Bar("motion (mm)", 0.0, float(np.linalg.norm(body["motion"], axis=1).max()), MOTION)
    for name in ("rectum wall", "bones wall"):
        inside = np.isin(skin["id"], groups[name])
        faces = skin.faces.reshape(-1, 4)[:, 1:]
        wall = skin.extract_cells(inside[faces].all(axis=1)).extract_surface(algorithm="dataset_surface")
        if name == "bones wall":  # those of one side hide all
            wall = wall.clip(normal="x", origin=_middle(body))
        wall["mm"] = np.linalg.norm(wall["motion"], axis=1)
        still.append((wall, {"color": COLOURS[name.split()[0]], **EDGES}))
        moved.append((wall.warp_by_vector("motion"), {"scalars": "mm", **bar.shown, **EDGES}))
    first, last = trimmed(drawn(still, body.bounds), drawn(moved, body.bounds))
    tets = trimmed(drawn(_by_tissue(_cut(body, body), **EDGES), body.bounds))[0]
    panels = [
        Panel("tetrahedra", tets, names=_names(body)),
        Panel("walls, 0 s", first, names={f"{name} wall": COLOURS[name] for name in ("rectum", "bones")}),
        Panel("walls, 1 s", last, bar),
    ]
    write_sheet(picture, panels)


def surfaces(folder: Path, picture: Path) -> None:
    """The organs' surfaces before and after, and both on a plane through the prostate."""
    names = (*ORGANS, "rectum")
    before, after = (
        {name: pyvista.read(next(folder.glob(f"*_{name}_{state}.stl"))) for name in names}
        for state in ("before", "after")
    )
    bounds = pyvista.merge([*before.values(), *after.values()]).bounds
    bodies = [
        drawn([(mesh, {"color": COLOURS[name], **EDGES}) for name, mesh in state.items()], bounds)
        for state in (before, after)
    ]
    middle = before["prostate"].center
    lines = [(mesh.slice(normal="x", origin=middle), {"color": "#909090", "line_width": 8}) for mesh in before.values()]
    lines += [
        (mesh.slice(normal="x", origin=middle), {"color": COLOURS[name], "line_width": 12})
        for name, mesh in after.items()
    ]
    plane_image = drawn(lines, bounds, (1.0, 0.0, 0.0))
    first, second = trimmed(*bodies)
    panels = [
        Panel("before", first, names={name: COLOURS[name] for name in names}),
        Panel("after", second),
        Panel("cut through both", trimmed(plane_image)[0], names={"before": "#909090"}),
    ]
    write_sheet(picture, panels)


def _cut(mesh: Grid, body: Grid) -> Grid:
    """Half of a mesh, cut through the prostate of the body at rest."""
    return mesh.clip(normal="x", origin=_middle(body))


def _middle(body: Grid) -> tuple[float, float, float]:
    return tuple(body.extract_cells(body["tissue"] == "prostate").center)


def _by_tissue(mesh: Grid, **how: Any) -> Iterable[Part]:
    """A mesh in the colours of its tissues."""
    for name in np.unique(mesh["tissue"]):
        yield mesh.extract_cells(mesh["tissue"] == name), {"color": COLOURS[name], **how}


def _organs(body: Grid, **how: Any) -> Iterable[Part]:
    """The surfaces of the organs."""
    for name in ORGANS:
        organ = body.extract_cells(body["tissue"] == name).extract_surface(algorithm="dataset_surface")
        yield organ, {"color": COLOURS[name], "smooth_shading": True, **how}


def _outlines(mesh: Grid, body: Grid, **how: Any) -> Iterable[Part]:
    """The organs' outlines on the cut."""
    for name in ORGANS:
        organ = mesh.extract_cells(mesh["tissue"] == name).extract_surface(algorithm="dataset_surface")
        yield organ.slice(normal="x", origin=_middle(body)), {"line_width": 5, **how}


def _moved(body: Grid, bar: Bar) -> Iterable[Part]:
    """The deformed body, cut open, by displacement, the organs' outlines in it and, grey, at rest."""
    moved = body.warp_by_vector("displacement_mm")
    cut = _cut(moved, body)
    cut["mm"] = np.linalg.norm(cut["displacement_mm"], axis=1)
    yield cut, {"scalars": "mm", **bar.shown}
    yield from _outlines(body, body, color="#808080")
    yield from _outlines(moved, body, color="black")


def _motion(body: Grid) -> Bar:
    return Bar("displacement (mm)", 0.0, float(np.linalg.norm(body["displacement_mm"], axis=1).max()), MOTION)


def _names(body: Grid) -> dict[str, str]:
    return {name: COLOURS[name] for name in COLOURS if name in body["tissue"]}
