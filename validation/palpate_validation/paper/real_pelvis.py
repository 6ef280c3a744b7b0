"""The real pelvis that Palpate brings along, with other moduli and on other meshes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from palpate.demo import DATA, TISSUES
from palpate.images import Role, Segmentation, VoxelGrid, read_label_image, read_label_table, segment
from palpate.mesh import Anatomy, Box, LagrangeSpace, anatomy_of, domain_box, lagrange_space, margin_box, tetrahedralise
from palpate.phantoms import wall_filling
from palpate_validation.simulated_pelvis import MARGIN_MM

__all__ = ["ORGANS", "SMOOTHING_MM", "RealPelvis", "grid_within", "real_pelvis"]

ORGANS = ("prostate", "bladder")
DRIVER = "rectum"
SHIFT = 0.5  # of a voxel: a random grid's place
SMOOTHING_MM = 4.0  # of the truth's surfaces: no stairs of the scan's 3 mm are left that run along every later grid
LENGTH_MM = 35.0  # of the filling along the rectum (Gaussian): a short one hardly moves a prostate 9 mm away


@dataclass(frozen=True, slots=True)
class RealPelvis:
    """The labelled scan (3 mm voxels), the box around its organs and the smooth surfaces in it."""

    scan: Segmentation
    anatomy: Anatomy

    @property
    def box(self) -> Box:
        """The domain."""
        return self.anatomy.box

    def space(self, edge_mm: float, *, element: str = "P2") -> LagrangeSpace:
        """The space of `element` on a mesh with that edge (mm) at the organs."""
        return lagrange_space(tetrahedralise(self.anatomy, edge_length_mm=edge_mm), element)

    def filling(self, space: LagrangeSpace, filling_mm: float) -> NDArray[np.float64]:
        """Displacement (n_points, 3) mm of the rectum's wall that fills by `filling_mm`; zero elsewhere."""
        offset, mesh = np.zeros_like(space.points), space.mesh
        wall = np.unique(space.facets(mesh.boundary[mesh.beyond == mesh.tissue_index(DRIVER)]))
        number = [tissue.name for tissue in self.scan.tissues].index(DRIVER)
        short = wall_filling(self.scan, number, filling_mm=filling_mm)
        bend = (LENGTH_MM / short.length_mm) ** 2 * short.bend  # the same middle line
        offset[wall] = replace(short, length_mm=LENGTH_MM, bend=bend).at(space.points[wall])
        return offset


def real_pelvis(surroundings_kpa: float) -> RealPelvis:
    """The scan with surroundings of that known modulus (kPa); whoever computes with it sets the organs'.

    As in the paper's scene there are organs and a box around them: bones are part of the surroundings. The organs are
    smoother than the scan's surfaces usually are: what is imaged again must not have the first image's voxels in it.
    """
    shown = [tissue for tissue in TISSUES if tissue.role in (Role.ESTIMATE, Role.DRIVER)]
    rest = next(tissue for tissue in TISSUES if tissue.role is Role.KNOWN)
    tissues = (*shown, replace(rest, youngs_modulus_kpa=surroundings_kpa))
    names = read_label_table(DATA / "labels.json")
    scan = segment(read_label_image(DATA / "labels.nii.gz", names=names), tissues)
    observed = [i for i, t in enumerate(scan.tissues) if t.role in (Role.ESTIMATE, Role.DRIVER)]
    voxels = np.argwhere(np.isin(scan.index, observed)).astype(float)
    box = margin_box(domain_box([scan.grid]), scan.grid.world(voxels), margin_mm=MARGIN_MM)
    return RealPelvis(scan, anatomy_of(scan, box=box, smoothing_mm=SMOOTHING_MM))


def grid_within(box: Box, voxel_mm: float, rng: np.random.Generator) -> VoxelGrid:
    """A grid of cubic voxels along a box's axes, shifted at random, all of whose centres lie in the box.

    It ends where the body does, as a scan does: beyond its border there is nothing to be seen, not no organ.
    """
    shape = np.floor(box.lengths / voxel_mm).astype(int)
    first = 0.5 * (box.lengths - (shape - 1) * voxel_mm) + voxel_mm * rng.uniform(-SHIFT, SHIFT, 3)
    affine = np.eye(4)
    affine[:3, :3] = box.axes.T * voxel_mm
    affine[:3, 3] = box.origin + first @ box.axes
    return VoxelGrid((int(shape[0]), int(shape[1]), int(shape[2])), affine)
