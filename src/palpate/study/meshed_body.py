"""A body that comes as a mesh instead of images: its tissues, its named surfaces, and voxels to show it by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError
from palpate.images.alignment import Motion
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.mechanics.loads import boundary_named
from palpate.mesh.mesh_file import PLANES, WHOLE, MeshFile, body_mesh, plane_faces, read_mesh_file
from palpate.mesh.space import lagrange_space
from palpate.mesh.tet_mesh import TetMesh
from palpate.mesh.tetrahedralise import boundary_of
from palpate.mesh.voxelise import voxelise
from palpate.observation.measured_motion import measured_motion
from palpate.observation.measured_points import MeasuredPoints
from palpate.progress import Progress
from palpate.study.case import Case
from palpate.study.case_body import MeshBody
from palpate.study.imaged import ImagedStates
from palpate.study.schema import nearest

OUTSIDE = "outside"
VOXELS_AN_EDGE, MOST_VOXELS, BORDER = 2.5, 4e6, 3  # of the label image that shows the mesh


def mesh_states(body: MeshBody, case: Case, *, progress: Progress) -> ImagedStates:
    """The reference state of a [body], with as many later states as the case speaks of, none of which is imaged.

    Raises `InputDataError` for a mesh that cannot be used, `ConfigurationError` for tissues, surfaces that it has not.
    """
    file = read_mesh_file(body.mesh, data=body.tissue_data)
    progress(f"'{body.mesh.name}': {len(file.tets)} tetrahedra, {len(file.nodes)} nodes")
    mesh = _mesh(file, case)
    # voxels that show the mesh: some along an edge, and a border around
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    size = max(mesh.usual_edge_mm / VOXELS_AN_EDGE, float(np.cbrt(np.prod(high - low) / MOST_VOXELS)))
    shape = np.ceil((high - low) / size).astype(int) + 2 * BORDER
    affine = np.diag([size, size, size, 1.0])
    affine[:3, 3] = 0.5 * (low + high) - 0.5 * size * (shape - 1)
    grid = VoxelGrid((int(shape[0]), int(shape[1]), int(shape[2])), affine)
    index = voxelise(lagrange_space(mesh, "P1"), np.zeros_like(mesh.nodes), grid, crossing=True)
    before = Segmentation(index, grid, mesh.tissues)
    bones = tuple(dict[int, Motion]() for _ in range(case.n_states))
    return ImagedStates(before, (), bones, (), inputs={"mesh": file.digest}, mesh=mesh)


def with_prescribed(states: ImagedStates, case: Case) -> ImagedStates:
    """The states of a mesh with the motions that measured points prescribe to its surfaces.

    Raises `ConfigurationError` for a state without measured points, `InputDataError` where they lie elsewhere.
    """
    surfaces = [surface.name for surface in case.surfaces if surface.boundary == "prescribed"]
    if states.mesh is None or not surfaces:
        return states
    mesh, found = states.mesh, list[Mapping[int, Motion]]()
    names = [tissue.name for tissue in mesh.tissues]
    for state in range(1, states.n_later + 1):
        points = [of for of in states.data if isinstance(of, MeasuredPoints) and of.file.state == state]
        if not points:
            raise ConfigurationError(
                f"the motion of '{surfaces[0]}' is prescribed, and no [[data]] of state {state} says where points went:"
                ' give landmarks or a displacement field, or the surface another boundary ("moving", "fixed")'
            )
        motion = measured_motion(points, kernel_mm=case.driver.kernel_mm, amplitude_mm=case.driver.prior_mm)
        for name in surfaces:
            motion.require(mesh.nodes[np.unique(boundary_named(mesh, name))], name)
        found.append({names.index(name): motion for name in surfaces})
    return replace(states, bones=tuple(found))


def _mesh(file: MeshFile, case: Case) -> TetMesh:
    """The mesh with the case's tissues, and a hollow one behind each named surface."""
    groups = {number: file.names.get(number, str(number)) for number in np.unique(file.group).tolist()}
    tissues, region = list[Tissue](), np.full(len(file.tets), -1)
    for stated in case.tissues:
        tissue = stated.resolve(groups)
        if not tissue.meshed:
            raise ConfigurationError(
                f"tissue '{tissue.name}' has the role {tissue.role}, but a mesh holds solid ones alone: name hollow"
                " spaces and what moves as [[surfaces]]"
            )
        own = np.isin(file.group, tissue.labels) if tissue.labels else region < 0
        region[own & (region < 0)] = len(tissues)
        tissues.append(tissue)
    left = sorted(set(file.group[region < 0].tolist()))
    if left:
        raise ConfigurationError(
            f"no tissue of the case has the group(s) {[groups[n] for n in left]} of the mesh; give each a tissue,"
            ' or one label = "remaining"'
        )
    faces, surfaces = boundary_of(file.tets), dict[str, NDArray[np.bool_]]()  # which (n_boundary,) belong to each
    for surface in case.surfaces:
        if surface.where in (WHOLE, *PLANES):
            surfaces[surface.name] = plane_faces(file.nodes, faces, surface.where, surface.within_mm)
            continue
        if surface.where not in file.surfaces:
            known = nearest(surface.where, [WHOLE, *PLANES, *file.surfaces])
            raise ConfigurationError(
                f"[[surfaces]] '{surface.name}': the mesh has no surface '{surface.where}': {known}"
            )
        listed = {tuple(face) for face in np.sort(file.surfaces[surface.where], axis=1).tolist()}
        there = [tuple(face) in listed for face in np.sort(faces, axis=1).tolist()]
        surfaces[surface.name] = np.array(there, dtype=bool)
    tissues += [surface.behind for surface in case.surfaces]
    tissues.append(Tissue(OUTSIDE, Role.VOID))
    return body_mesh(file, tissues, region, surfaces, len(tissues) - 1)
