"""A body that comes as a mesh instead of images: its tissues, its named surfaces, and voxels to show it by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.body.imaged import ImagedStates, LaterImage
from palpate.case.case import Case
from palpate.case.schema import nearest, shown
from palpate.case.sources import MeshBody
from palpate.case.tissue import REMAINING, CaseTissue
from palpate.errors import ConfigurationError, InputDataError
from palpate.findings import Finding
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.mechanics.loads import boundary_named
from palpate.mesh.files.elements import Name
from palpate.mesh.mesh_file import MeshFile, read_mesh_file
from palpate.mesh.named_faces import PLANES, WHOLE, listed_faces, plane_faces, tissues_behind
from palpate.mesh.space import lagrange_space
from palpate.mesh.tet_mesh import TetMesh
from palpate.mesh.tetrahedralise import boundary_of
from palpate.mesh.voxelise import voxelise
from palpate.observation.measured_motion import MeasuredMotion
from palpate.observation.measured_points import MeasuredPoints
from palpate.progress import Progress

OUTSIDE = "outside"
USUAL_MM = (2.0, 3e3)  # the length of a body: one in metres, or in micrometres, lies outside
VOXELS_AN_EDGE, MOST_VOXELS, BORDER = 2.5, 4e6, 3  # of the label image that shows the mesh


def mesh_states(body: MeshBody, case: Case, *, progress: Progress) -> ImagedStates:
    """The reference state of a [body], with as many later states as the case speaks of, none of which is imaged.

    Raises `InputDataError` for a mesh that cannot be used, `ConfigurationError` for tissues, surfaces that it has not.
    """
    file = read_mesh_file(body.mesh, data=body.tissue_data)
    progress(f"'{body.mesh.name}': {len(file.tets)} tetrahedra, {len(file.nodes)} nodes")
    findings = _findings(file, case)
    mesh = _mesh(file, case)
    grid = _grid_around(mesh)
    index = voxelise(lagrange_space(mesh, "P1"), np.zeros_like(mesh.nodes), grid, crossing=True)
    before, later = Segmentation(index, grid, mesh.tissues), map(LaterImage, range(1, case.n_states + 1))
    return ImagedStates(before, tuple(later), findings, inputs={"mesh": file.digest}, mesh=mesh)


def _grid_around(mesh: TetMesh) -> VoxelGrid:
    """Voxels that show the mesh: some along an edge, and a border around."""
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    size = max(mesh.usual_edge_mm / VOXELS_AN_EDGE, float(np.cbrt(np.prod(high - low) / MOST_VOXELS)))
    n_x, n_y, n_z = (np.ceil((high - low) / size).astype(int) + 2 * BORDER).tolist()
    affine = np.diag([size, size, size, 1.0])
    affine[:3, 3] = 0.5 * (low + high) - 0.5 * size * (np.array([n_x, n_y, n_z]) - 1)
    return VoxelGrid((n_x, n_y, n_z), affine)


def with_prescribed(states: ImagedStates, case: Case) -> ImagedStates:
    """The states of a mesh with the motions that measured points prescribe to its surfaces.

    Raises `ConfigurationError` for a state without measured points, `InputDataError` where they lie elsewhere.
    """
    surfaces = [surface.name for surface in case.surfaces if surface.boundary == "prescribed"]
    if states.mesh is None or not surfaces:
        return states
    mesh, found = states.mesh, list[LaterImage]()
    names = [tissue.name for tissue in mesh.tissues]
    for later in states.later:
        points = [of for of in states.data if isinstance(of, MeasuredPoints) and of.file.state == later.number]
        if not points:
            raise ConfigurationError(
                f"'{surfaces[0]}' is prescribed, and no [[data]] of state {later.number} says where its points moved;"
                " add such data"
            )
        motion = MeasuredMotion(points, case.driver.kernel_mm, case.driver.prior_mm)
        for name in surfaces:
            motion.require(mesh.nodes[np.unique(boundary_named(mesh, name))], name)
        found.append(replace(later, bones={names.index(name): motion for name in surfaces}))
    return replace(states, later=tuple(found))


def _findings(file: MeshFile, case: Case) -> tuple[Finding, ...]:
    """Findings on a mesh's size and pieces; `InputDataError` where named surfaces would take all of it."""
    found, length = list[Finding](), float(np.ptp(file.nodes, axis=0).max())
    if not USUAL_MM[0] <= length <= USUAL_MM[1]:
        unit, factor = ("metres", 1e3) if length < USUAL_MM[0] else ("micrometres", 1e-3)
        text = f"The mesh is {length:.3g} mm long. If it was written in {unit}, multiply its coordinates by {factor:g}"
        wide = [s.name for s in case.surfaces if s.where in PLANES and s.within_mm > 0.5 * length]
        if wide:
            raise InputDataError(
                f"{text}; else make within_mm of '{wide[0]}' smaller, which now includes the whole mesh"
            )
        found.append(Finding("units", f"{text}."))
    if len(count := np.bincount(file.piece)) > 1:
        place = np.round(file.nodes[file.tets[file.piece == count.argmin()]].mean(axis=(0, 1)), 1).tolist()
        text = (
            f"The mesh has {len(count)} pieces that share no face, so no stress passes between them; the smallest has"
            f" {count.min()} tetrahedra near {place} mm. Join the pieces that belong together."
        )
        found.append(Finding("islands", text))
    return tuple(found)


def _mesh(file: MeshFile, case: Case) -> TetMesh:
    """The mesh with the case's tissues, and a hollow one behind each named surface."""
    solid, region = _regions(file, case)
    tissues = (*solid, *(surface.behind for surface in case.surfaces), Tissue(OUTSIDE, Role.VOID))
    faces, surfaces, shared = boundary_of(file.tets), dict[str, NDArray[np.bool_]](), dict[str, NDArray[np.bool_]]()
    for surface in case.surfaces:
        group = _group(surface.where, file.surfaces)
        if group is not None:
            found = listed_faces(faces, group, surface.where)
        elif surface.where in (WHOLE, *PLANES):
            found = plane_faces(file.nodes, faces, surface.where, surface.within_mm)
        else:
            known = nearest(surface.where, [WHOLE, *PLANES, *map(str, file.surfaces)])
            raise ConfigurationError(f"the mesh has no surface '{surface.where}' for '{surface.name}': {known}")
        surfaces[surface.name] = found
        if group is not None or surface.where != WHOLE:  # which is what others leave of it
            shared[surface.name] = found
    behind = tissues_behind(surfaces, tuple(shared), tissues, len(faces))
    return TetMesh(file.nodes, file.tets, region, faces, behind, tissues, shared)


def _regions(file: MeshFile, case: Case) -> tuple[list[Tissue], NDArray[np.int64]]:
    """The case's tissues and which one (n_tets,) each tetrahedron is of; `ConfigurationError` unless it is one."""
    tissues = [stated.with_labels(stated.label if isinstance(stated.label, tuple) else ()) for stated in case.tissues]
    region, last = np.full(len(file.tets), -1), [stated.label == REMAINING for stated in case.tissues]
    for number in np.argsort(last, kind="stable").tolist():
        tissue = tissues[number]
        if not tissue.meshed:
            raise ConfigurationError(
                f"tissue '{tissue.name}' is {tissue.role}, but a mesh holds only solid tissues: name it in [[surfaces]]"
            )
        own = np.flatnonzero(region < 0) if last[number] else _tets(file, case.tissues[number])
        if not len(own):
            raise ConfigurationError(
                f"tissue '{tissue.name}' has no tetrahedron, because the other tissues have all; remove it"
            )
        if len(twice := region[own[region[own] >= 0]]):
            both = f"'{tissues[twice[0]].name}' and '{tissue.name}'"
            raise ConfigurationError(f"{len(twice)} tetrahedra are in groups of {both}; give each to one tissue")
        region[own] = number
    if len(left := np.flatnonzero(region < 0)):
        groups = sorted(str(name) for name, own in file.groups.items() if np.isin(own, left).any())
        raise ConfigurationError(
            f"{len(left)} tetrahedra belong to no tissue; they are in the group(s) {groups}. Give these groups to a"
            ' tissue, or give one tissue the label "remaining"'
        )
    return tissues, region


def _tets(file: MeshFile, stated: CaseTissue) -> NDArray[np.int64]:
    """The tetrahedra of the groups that a tissue names."""
    found = list[NDArray[np.int64]]()
    for label in stated.label if isinstance(stated.label, tuple) else (stated.label,):
        if (group := _group(label, file.groups)) is None:
            known = f"its groups: {nearest(str(label), map(str, file.groups))}" if file.groups else "it has no groups"
            raise ConfigurationError(
                f"tissue '{stated.name}' has no tetrahedron: the mesh has no group {shown(label)}; {known}"
                + (f"; {file.about}" if file.about else "")
            )
        found.append(group)
    return np.unique(np.concatenate(found))


def _group(key: Name, groups: Mapping[Name, NDArray[np.int64]]) -> NDArray[np.int64] | None:
    """The group of a name or a number, else the only one whose name differs in small and large letters alone."""
    alike = [name for name in groups if str(name).casefold() == str(key).casefold()]
    return groups.get(key, groups[alike[0]] if len(alike) == 1 else None)
