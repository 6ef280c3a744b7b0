"""The fitted model on a slice: which tetrahedron each pixel lies in, its Young's modulus, and how far it moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.images.label_image import VoxelGrid
from palpate.images.tissue import Role, Tissue
from palpate.mesh.locate import tetrahedron_image
from palpate.mesh.tet_mesh import TetMesh
from palpate.report.report_data import LaterImage, MeshPicture, ReportData
from palpate.report.scales import shown_moduli, shown_stiffness
from palpate.report.section import Plane

NO_FACES = np.zeros((0, 3), dtype=np.int64)


@dataclass(frozen=True, slots=True)
class MeshCut:
    """A mesh cut by a plane: `tet` (n_up, n_across) of each pixel, -1 outside; `barycentric` (n_up, n_across, 4) in it.

    tets (n_tets, 4): node numbers of the mesh.
    """

    tet: NDArray[np.int64]
    barycentric: NDArray[np.float64]
    tets: NDArray[np.int64]

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Which pixels (n_up, n_across) lie in the mesh."""
        return np.asarray(self.tet >= 0)

    def of_elements(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values (n_tets,) of the elements, in any unit, on the pixels (n_up, n_across); NaN outside the mesh."""
        return np.asarray(np.append(values.astype(np.float64), np.nan)[self.tet])

    def of_nodes(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values (n_nodes, k) of the nodes, in any unit, interpolated to (n_up, n_across, k); NaN outside the mesh."""
        corners = values[self.tets[np.maximum(self.tet, 0)]]  # (n_up, n_across, 4, k)
        found = np.einsum("uab,uabk->uak", self.barycentric, corners)
        return np.asarray(np.where(self.inside[..., None], found, np.nan))


def cut_mesh(data: ReportData, plane: Plane, *, motion: NDArray[np.float64] | None = None) -> MeshCut:
    """The mesh of the first reference state cut by a plane; motion (n_nodes, 3) mm: cut it where that has moved it to.

    Raises `ValueError` where there is no mesh.
    """
    if data.mesh is None:
        raise ValueError("there is no mesh")
    nodes = data.mesh.nodes.astype(np.float64)
    mesh = _tet_mesh(data, data.mesh, nodes if motion is None else nodes + motion)
    across, up = plane.axes
    axes = (plane.view.normal, plane.view.across, plane.view.up)
    starts, steps, shape = np.zeros(3), np.ones(3), [1, 1, 1]
    starts[list(axes)] = plane.position, across[0], up[0]
    for axis, ticks in zip(axes[1:], (across, up), strict=True):
        steps[axis], shape[axis] = ticks[1] - ticks[0], len(ticks)
    affine = np.diag([*steps, 1.0])
    affine[:3, 3] = starts
    image = tetrahedron_image(mesh, VoxelGrid((shape[0], shape[1], shape[2]), affine))
    tet = np.moveaxis(image, axes, (0, 2, 1))[0].astype(np.int64)
    corners = mesh.nodes[mesh.tets[np.maximum(tet, 0)]]
    edges = corners[..., 1:, :] - corners[..., :1, :]
    shares = np.linalg.solve(np.swapaxes(edges, -1, -2), (plane.points - corners[..., 0, :])[..., None])[..., 0]
    barycentric = np.concatenate([1.0 - shares.sum(axis=-1, keepdims=True), shares], axis=-1)
    return MeshCut(tet, barycentric, mesh.tets)


def element_moduli(data: ReportData) -> NDArray[np.float64]:
    """Young's modulus (n_tets,) of each element in the unit that is shown, NaN where none was sought or found.

    Of tissues whose modulus the case gives there is none: only what the images told is coloured. Raises `ValueError`
    where there is no mesh, or no modulus.
    """
    if data.mesh is None:
        raise ValueError("there is no mesh")
    sought = np.array([tissue.role == Role.ESTIMATE for tissue in data.tissues])
    moduli = np.where(sought, shown_moduli(data), np.nan)[data.mesh.region]
    for of in data.maps:
        moduli[of.elements] = shown_stiffness(data).factor * of.moduli
    return np.asarray(moduli)


def motion_of(later: LaterImage) -> NDArray[np.float64]:
    """The fitted motion (n_nodes, 3) mm of the mesh's nodes; raises `ValueError` where none is kept."""
    if not len(later.motion):
        raise ValueError("no motion of the mesh is kept for this image; run the estimate again")
    return later.motion.astype(np.float64)


def _tet_mesh(data: ReportData, mesh: MeshPicture, nodes: NDArray[np.float64]) -> TetMesh:
    tissues = tuple(Tissue(tissue.name, Role.VOID) for tissue in data.tissues)  # only their number matters here
    tets, region = mesh.tets.astype(np.int64), mesh.region.astype(np.int64)
    return TetMesh(nodes, tets, region, NO_FACES, NO_FACES[:, 0], tissues)
