"""A body that comes as a mesh instead of images: its tissues, its named surfaces, and voxels to show it by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError
from palpate.images.alignment import RigidMotion
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.mesh.mesh_file import PLANES, WHOLE, MeshFile, body_mesh, plane_faces, read_mesh_file
from palpate.mesh.space import lagrange_space
from palpate.mesh.tet_mesh import TetMesh
from palpate.mesh.tetrahedralise import boundary_of
from palpate.mesh.voxelise import voxelise
from palpate.progress import Progress
from palpate.study.body import ImagedStates
from palpate.study.case import Case, CaseSurface, MeshBody
from palpate.study.schema import nearest

__all__ = ["mesh_states"]

OUTSIDE = "outside"
ROLES = {"moving": Role.DRIVER, "fixed": Role.RIGID, "free": Role.VOID}
VOXELS_AN_EDGE, MOST_VOXELS, BORDER = 2.5, 4e6, 3  # of the label image that shows the mesh


def mesh_states(body: MeshBody, case: Case, *, progress: Progress) -> ImagedStates:
    """The reference state of a [body], with as many later states as the case speaks of, none of which is imaged.

    Raises `InputDataError` for a mesh that cannot be used, `ConfigurationError` for tissues, surfaces that it has not.
    """
    file = read_mesh_file(body.mesh, data=body.tissue_data)
    progress(f"'{body.mesh.name}': {len(file.tets)} tetrahedra, {len(file.nodes)} nodes")
    mesh = _mesh(file, case)
    grid = _grid(mesh)
    index = voxelise(lagrange_space(mesh, "P1"), np.zeros_like(mesh.nodes), grid, crossing=True)
    before = Segmentation(index, grid, mesh.tissues)
    bones = tuple(dict[int, RigidMotion]() for _ in range(case.n_states))
    return ImagedStates(before, (), bones, (), inputs={"mesh": file.digest}, mesh=mesh)


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
    faces = boundary_of(file.tets)
    surfaces = {surface.name: _faces(file, faces, surface) for surface in case.surfaces}
    tissues += [Tissue(surface.name, ROLES[surface.boundary]) for surface in case.surfaces]
    tissues.append(Tissue(OUTSIDE, Role.VOID))
    return body_mesh(file, tissues, region, surfaces, len(tissues) - 1)


def _faces(file: MeshFile, faces: NDArray[np.int64], surface: CaseSurface) -> NDArray[np.bool_]:
    """Which boundary faces (n_boundary, 3) belong to a surface of the case."""
    if surface.where in (WHOLE, *PLANES):
        return plane_faces(file.nodes, faces, surface.where, surface.within_mm)
    if surface.where not in file.surfaces:
        known = nearest(surface.where, [WHOLE, *PLANES, *file.surfaces])
        raise ConfigurationError(f"[[surfaces]] '{surface.name}': the mesh has no surface '{surface.where}': {known}")
    own = {tuple(face) for face in np.sort(file.surfaces[surface.where], axis=1).tolist()}
    return np.array([tuple(face) in own for face in np.sort(faces, axis=1).tolist()], dtype=bool)


def _grid(mesh: TetMesh) -> VoxelGrid:
    """Voxels that show the mesh: some along an edge, and a border around."""
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    size = max(mesh.usual_edge_mm / VOXELS_AN_EDGE, float(np.cbrt(np.prod(high - low) / MOST_VOXELS)))
    shape = np.ceil((high - low) / size).astype(int) + 2 * BORDER
    affine = np.diag([size, size, size, 1.0])
    affine[:3, 3] = 0.5 * (low + high) - 0.5 * size * (shape - 1)
    return VoxelGrid((int(shape[0]), int(shape[1]), int(shape[2])), affine)
