"""FEBio 4: a model whose steps move walls and bones as they were fitted.

Format: FEBio User's Manual, "free format input", version 4.0. Its `neo-Hookean` is our law, and its `coupled
Mooney-Rivlin`, W = c1 (I1 - 3) + c2 (I2 - 3) - 2 (c1 + 2 c2) ln J + k/2 (ln J)^2, ours with k = lambda - 4 c2; for
small strains it has no law: `isotropic elastic` is Saint Venant-Kirchhoff, linear in the Green-Lagrange strain.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from palpate.body.loads import loads_on
from palpate.errors import ConfigurationError
from palpate.export.conditions import Prescribed, prescribed
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.groups import face_groups, tissue_groups
from palpate.mechanics.laws.linear import Linear
from palpate.mechanics.laws.mooney_rivlin import MooneyRivlin
from palpate.mechanics.laws.neo_hookean import NeoHookean
from palpate.mechanics.loads import FollowingPressure, Load
from palpate.mesh.space import LagrangeSpace
from palpate.study.outputs import write_bytes

Element = ET.Element
AXES = "xyz"
LAWS = (Linear, NeoHookean, MooneyRivlin)  # that it has
STEPS = 10  # of the time a later image takes, at first


def write(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write palpate.feb; raises `ConfigurationError` for faces that slide on an image askew to the world's axes."""
    space = body.space
    held = prescribed(body, space, outer=model.outer_boundary)
    if not held.along_world:
        raise ConfigurationError(
            'with outer_boundary = "sliding" the cut of the image slides along the image\'s axes, which are oblique to'
            " the world's; FEBio holds nodes only along the world's: export to abaqus, or estimate with another"
            " boundary"
        )
    acting = list(dict.fromkeys(load for of_image in body.loads for load in of_image))
    loads = loads_on(space, acting, densities=model.densities)
    root = Element("febio_spec", version="4.0")
    root.append(ET.Comment(f" fitted by Palpate; {model.units} "))
    _add(root, "Module", type="solid")
    material = _add(root, "Material")
    groups = enumerate(tissue_groups(body.mesh).items(), start=1)
    maps = {name: (cells, _material(material, model, body, name, number)) for number, (name, cells) in groups}
    mesh = _add(root, "Mesh")
    _mesh(mesh, body, space, loads)
    domains = _add(root, "MeshDomains")
    for name in tissue_groups(body.mesh):
        _add(domains, "SolidDomain", name=name, mat=name)
    data = _add(root, "MeshData")
    _element_data(mesh, data, maps)
    _node_sets(mesh, body, space, held, loads)
    curves = _add(root, "LoadData")
    if loads:
        _loads(data, _add(root, "Loads"), loads, len(space.points), first_curve=len(body.displacements) + 1)
    steps = _add(root, "Step")
    for number in range(1, len(body.displacements) + 1):
        step = _add(steps, "step", id=number, name=f"later image {number}")
        control = _add(step, "Control")  # a later image takes one unit of time
        for key, value in {"analysis": "STATIC", "time_steps": STEPS, "step_size": 1.0 / STEPS}.items():
            _add(control, key, value)
        stepper = _add(control, "time_stepper", type="default")
        for name, limit in {"max_retries": 10, "dtmin": 0.001, "dtmax": 1.0 / STEPS}.items():
            _add(stepper, name, limit)
        _add(control, "solver", type="solid")
        _boundary(step, data, body, held, number)
        _curve(curves, number, ((number - 1, 0), (number, 1)))
    for number, load in enumerate(acting, start=len(body.displacements) + 1):
        shares = [int(load in of_image) for of_image in body.loads]
        _curve(curves, number, tuple(enumerate([0, *shares])))
    output = _add(_add(root, "Output"), "plotfile", type="febio")
    for name in ("displacement", "stress"):
        _add(output, "var", type=name)
    ET.indent(root, " ")
    write_bytes(folder / "palpate.feb", ET.tostring(root, encoding="utf-8", xml_declaration=True))


def _add(parent: Element, tag: str, text: object = None, **attributes: object) -> Element:
    child = ET.SubElement(parent, tag, {key: str(value) for key, value in attributes.items()})
    child.text = None if text is None else str(text)
    return child


def _material(
    parent: Element, model: FittedModel, body: FittedBody, name: str, number: int
) -> dict[str, NDArray[np.float64]]:
    """A tissue's law with its constants in kPa; those that differ between its elements, (n,) each."""
    cells = tissue_groups(body.mesh)[name]
    index = int(body.mesh.region[cells[0]])
    modulus, ratio, law = float(model.moduli[index]), body.tissues[index].poisson_ratio, model.law_among(*LAWS)
    log_ratio = np.zeros(1) if body.log_ratio is None else body.log_ratio[cells]
    scale = np.exp(log_ratio) if np.ptp(log_ratio) > 0.0 else np.ones(1)
    constants = {"E": modulus, "v": ratio}
    kind = "neo-Hookean" if law.finite else "isotropic elastic"
    if isinstance(law, MooneyRivlin):
        shear = modulus / (2.0 * (1.0 + ratio))
        first, second = (shear * coefficient for coefficient in law.coefficients)
        lame = modulus * ratio / ((1.0 + ratio) * (1.0 - 2.0 * ratio))
        constants, kind = {"c1": first, "c2": second, "k": lame - 4.0 * second}, "coupled Mooney-Rivlin"
    material = _add(parent, "material", id=number, name=name, type=kind)
    density = float(model.densities[index]) * 1e-9  # kg/mm^3, which goes with mm, kPa and mN
    maps = {key: value * scale for key, value in constants.items() if key != "v" and len(scale) > 1}
    for key, value in {"density": density, **constants}.items():
        if key in maps:
            _add(material, key, f"{name} {key}", type="map")
        else:
            _add(material, key, f"{value:.12g}")
    return maps


def _element_data(
    mesh: Element, data: Element, maps: dict[str, tuple[NDArray[np.int64], dict[str, NDArray[np.float64]]]]
) -> None:
    """The constants of each tissue's elements, by their number."""
    for name, (cells, constants) in maps.items():
        if constants:
            _add(mesh, "ElementSet", ",".join(map(str, (cells + 1).tolist())), name=f"{name} elements")
        for key, numbers in constants.items():
            values = _add(data, "ElementData", name=f"{name} {key}", elem_set=f"{name} elements", data_type="scalar")
            for place, value in enumerate(numbers.tolist(), start=1):
                _add(values, "elem", f"{value:.12g}", lid=place)


def _mesh(mesh: Element, body: FittedBody, space: LagrangeSpace, loads: tuple[Load, ...]) -> None:
    """Nodes, elements by tissue, and the surface of every group."""
    nodes = _add(mesh, "Nodes", name="all")
    for number, point in enumerate(space.points.tolist(), start=1):
        _add(nodes, "node", ",".join(f"{x:.12g}" for x in point), id=number)
    kind = "tet10" if space.order == 2 else "tet4"
    for name, cells in tissue_groups(body.mesh).items():
        elements = _add(mesh, "Elements", type=kind, name=name)
        for cell in cells.tolist():
            _add(elements, "elem", ",".join(str(p + 1) for p in space.cells[cell].tolist()), id=cell + 1)
    facets = {group.name: space.facets(group.triangles) for group in face_groups(body.mesh)}
    pressed = {f"load {n}": load.faces for n, load in enumerate(loads, start=1) if isinstance(load, FollowingPressure)}
    for name, faces in (facets | pressed).items():
        surface = _add(mesh, "Surface", name=name)
        for number, facet in enumerate(faces.tolist(), start=1):
            _add(surface, f"tri{len(facet)}", ",".join(str(p + 1) for p in facet), id=number)


def _node_sets(
    mesh: Element, body: FittedBody, space: LagrangeSpace, held: Prescribed, loads: tuple[Load, ...]
) -> None:
    """The nodes of every group and load, and those that are held; after sets of elements, as pyfebio has it."""
    for group in face_groups(body.mesh):
        _node_set(mesh, f"{group.name} nodes", np.unique(space.facets(group.triangles)))
    for number, load in enumerate(loads, start=1):
        if not isinstance(load, FollowingPressure):
            _node_set(mesh, f"load {number}", np.arange(len(space.points)))
    _node_set(mesh, "prescribed", held.whole)
    for axis, points in _sliding(held):
        _node_set(mesh, f"sliding {AXES[axis]}", points)


def _node_set(mesh: Element, name: str, points: NDArray[np.int64]) -> None:
    _add(mesh, "NodeSet", ",".join(map(str, (points + 1).tolist())), name=name)


def _sliding(held: Prescribed) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Each axis with the points (n,) that are held along it alone, or along some others."""
    for axis in range(3):
        points = held.sliding[held.held[:, axis]]
        if len(points):
            yield axis, points


def _boundary(step: Element, data: Element, body: FittedBody, held: Prescribed, number: int) -> None:
    """What one later image moves on from the one before, as a map on the prescribed nodes; what slides stays."""
    before = body.displacements[number - 2] if number > 1 else np.zeros_like(body.displacements[0])
    way = (body.displacements[number - 1] - before)[held.whole]
    boundary = _add(step, "Boundary")
    for axis in range(3):
        name = f"image {number} {AXES[axis]}"
        values = _add(data, "NodeData", name=name, node_set="prescribed", data_type="scalar")
        for place, value in enumerate(way[:, axis].tolist(), start=1):
            _add(values, "node", f"{value:.12g}", lid=place)
        condition = _add(boundary, "bc", type="prescribed displacement", node_set="prescribed")
        _add(condition, "dof", AXES[axis])
        _add(condition, "value", name, lc=number, type="map")
        if number > 1:
            _add(condition, "relative", 1)
    for axis, _ in _sliding(held):
        name = f"sliding {AXES[axis]}"
        condition = _add(boundary, "bc", type="zero displacement", node_set=name)
        for other in range(3):
            _add(condition, f"{AXES[other]}_dof", int(other == axis))


def _loads(data: Element, parent: Element, loads: tuple[Load, ...], n_points: int, *, first_curve: int) -> None:
    """Pressures on surfaces as they move; other loads as their forces on the nodes, mN; each by a curve of its own."""
    for number, load in enumerate(loads, start=1):
        name, curve = f"load {number}", first_curve + number - 1
        if isinstance(load, FollowingPressure):
            pressure = _add(parent, "surface_load", name=name, type="pressure", surface=name)
            _add(pressure, "pressure", f"{load.kilopascal:.12g}", lc=curve)
            _add(pressure, "linear", 0)
            continue
        values = _add(data, "NodeData", name=name, node_set=name, data_type="vec3")
        for place, force in enumerate(load.forces(np.zeros((n_points, 3))).reshape(-1, 3).tolist(), start=1):
            _add(values, "node", ",".join(f"{x:.12g}" for x in force), lid=place)
        nodal = _add(parent, "nodal_load", name=name, type="nodal_force", node_set=name)
        _add(nodal, "value", name, lc=curve, type="map")


def _curve(parent: Element, number: int, course: tuple[tuple[int, int], ...]) -> None:
    """A curve through pairs of time (a later image takes one unit) and share, straight between them."""
    controller = _add(parent, "load_controller", id=number, type="loadcurve")
    _add(controller, "interpolate", "LINEAR")
    _add(controller, "extend", "CONSTANT")
    points = _add(controller, "points")
    for time, value in course:
        _add(points, "pt", f"{time},{value}")
