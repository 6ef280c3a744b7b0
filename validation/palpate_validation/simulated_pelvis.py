"""A simulated later state for the real pelvis: the scan that Palpate ships shows one state only.

The labels of a real male pelvis CT (3 mm voxels; Wasserthal et al. 2023, doi 10.1148/ryai.230024) become a mesh that is
finer than the one that inverts it. The rectum is filled, and a neo-Hookean body with known moduli follows. Both states
of that mesh are turned into label images of 1 mm voxels. The scan ends inside the prostate. Below its last slice the
mirror image of the upper part completes the prostate, and the last slice all else. Surfaces are smoothed more than
usual, because both images would else show the scan's steps of 3 mm. `python -m palpate_validation.simulated_pelvis`
makes the two images again.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from palpate.case import Mechanics
from palpate.demo import DATA, FILLING_MM, LAW, TISSUES, TRUTH_EDGE_MM
from palpate.images import (
    LabelImage,
    Role,
    Segmentation,
    VoxelGrid,
    read_label_image,
    read_label_table,
    segment,
    write_label_image,
)
from palpate.mesh import LagrangeSpace, anatomy_of, check_mesh, domain_box, lagrange_space, margin_box, tetrahedralise
from palpate.phantoms import imaged
from palpate.study import filled

__all__ = ["MARGIN_MM", "SimulatedPelvis", "simulate_pelvis"]

MARGIN_MM = 12.0
PROSTATE, REST = 1, 20  # labels of the scan
BELOW = 7  # slices that are added below the scan
SMOOTHING_MM = 4.0  # of the truth's surfaces: no stairs of the scan's 3 mm are left that run along every later grid
VOXEL_MM = 1.0


@dataclass(frozen=True, slots=True)
class SimulatedPelvis:
    """The truth (P2 space and displacement (n_points, 3) mm) and both label images at 1 mm."""

    space: LagrangeSpace
    displacement: np.ndarray[tuple[int, int], np.dtype[np.float64]]
    before: LabelImage
    after: LabelImage


def simulate_pelvis(progress: Callable[[str], None]) -> SimulatedPelvis:
    """Make the truth and its two images, which takes some minutes."""
    names = read_label_table(DATA / "labels.json")
    labels = _completed(read_label_image(DATA / "labels.nii.gz", names=names))
    scan = segment(labels, TISSUES)
    # what lies within 12 mm of prostate, bladder and rectum
    observed = [i for i, t in enumerate(scan.tissues) if t.role in (Role.ESTIMATE, Role.DRIVER)]
    voxels = np.argwhere(np.isin(scan.index, observed)).astype(float)
    box = margin_box(domain_box([scan.grid]), scan.grid.world(voxels), margin_mm=MARGIN_MM)
    box = replace(box, lengths=np.floor(box.lengths / VOXEL_MM) * VOXEL_MM)
    anatomy = anatomy_of(scan, box=box, smoothing_mm=SMOOTHING_MM)
    progress(f"meshing {np.round(box.lengths).astype(int).tolist()} mm at {TRUTH_EDGE_MM:g} mm")
    mesh = tetrahedralise(anatomy, edge_length_mm=TRUTH_EDGE_MM)
    check_mesh(mesh, anatomy)
    space = lagrange_space(mesh, "P2")
    progress(f"solving {3 * len(space.points)} unknowns")
    mechanics = Mechanics(law=LAW, element="P2")
    displacement = filled(space, scan, filling_mm=FILLING_MM, outer="fixed", mechanics=mechanics)
    progress("turning both states into voxels")
    # 1 mm, filling the box exactly
    shape = np.round(box.lengths / VOXEL_MM).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = box.axes.T * VOXEL_MM
    affine[:3, 3] = box.origin + 0.5 * VOXEL_MM * box.axes.sum(axis=0)
    grid = VoxelGrid((int(shape[0]), int(shape[1]), int(shape[2])), affine)
    still = np.zeros_like(displacement)
    before, after = (_labelled(imaged(space, motion, grid), scan, labels) for motion in (still, displacement))
    return SimulatedPelvis(space, displacement, before, after)


def _completed(scan: LabelImage) -> LabelImage:
    """The scan with slices below it: the prostate's are those above its widest one, mirrored, the rest's the last."""
    prostate = scan.labels == PROSTATE
    widest = int(np.argmax(prostate.sum(axis=(0, 1))))
    below = np.where(prostate[:, :, :1], REST, scan.labels[:, :, :1]).repeat(BELOW, axis=2)
    for depth in range(1, BELOW + 1):
        below[:, :, BELOW - depth][prostate[:, :, 2 * widest + depth]] = PROSTATE
    affine = scan.grid.affine.copy()
    affine[:3, 3] -= BELOW * affine[:3, 2]
    labels = np.concatenate([below, scan.labels], axis=2)
    return LabelImage(labels, VoxelGrid((labels.shape[0], labels.shape[1], labels.shape[2]), affine), scan.names)


def _labelled(image: LabelImage, scan: Segmentation, labels: LabelImage) -> LabelImage:
    """The image with the labels of the scan instead of the tissues' numbers, a bone's the nearest one's; the rest's 20.

    labels: of the grid that was segmented as `scan`.
    """
    table = np.array([0] + [tissue.labels[0] if tissue.labels else REST for tissue in TISSUES], dtype=np.int32)
    found = table[image.labels]
    bones = [tissue.name for tissue in TISSUES].index("bones")
    nearest = ndimage.distance_transform_edt(scan.index != bones, return_distances=False, return_indices=True)
    voxels = np.argwhere(image.labels == bones + 1)
    there = np.rint(scan.grid.index(image.grid.world(voxels.astype(float)))).astype(int)
    there = np.clip(there, 0, np.array(scan.index.shape) - 1)
    found[tuple(voxels.T)] = labels.labels[tuple(nearest[(slice(None), *there.T)])]
    return LabelImage(found, image.grid, labels.names)


def main() -> None:
    """Write the two images into the package's data folder."""
    pelvis = simulate_pelvis(lambda message: print(message, file=sys.stderr, flush=True))  # noqa: T201
    write_label_image(DATA / "simulated_before.nii.gz", pelvis.before)
    write_label_image(DATA / "simulated_after.nii.gz", pelvis.after)


if __name__ == "__main__":
    main()
