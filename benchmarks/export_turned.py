"""A body turned in space, for the check of our exports: its cut slides along the image's own faces, under known loads.

A box of soft tissue with a stiff ball, a driver and an air cavity; the axes of its image are turned by 37 degrees about
an oblique axis. Gravity acts on it, a pressure in the cavity, and a traction on the cut.
"""

from __future__ import annotations

from pathlib import Path

import nibabel
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import palpate
from palpate.images import write_label_image

VOXEL_MM = 2.0
SHAPE = (24, 22, 20)
AFTER = 'after = ["after.nii.gz"]'
CASE = """
[images]
before = "before.nii.gz"
{after}

[domain]
outer_boundary = "sliding"

[tissues.ball]
label = 1
role = "estimate"
youngs_modulus_kpa = 40.0

[tissues.tube]
label = 2
role = "driver"

[tissues.cavity]
label = 3
role = "void"

[tissues.surroundings]
label = "remaining"
role = "known"
youngs_modulus_kpa = 10.0

[mesh]
edge_length_mm = 8.0

[mechanics]
law = "{law}"
element = "P2"

[discrepancy]
heterogeneity_sd = 0.0
layer_sd = 0.0
poisson_sd = 0.0

[estimate]
start_ratios = [4.0]

{motion}

[[loads]]
kind = "gravity"
acceleration_m_s2 = [0.0, -9.81, 0.0]

[[loads]]
kind = "pressure"
surface = "cavity"
pressure_kpa = 1.0

[[loads]]
kind = "traction"
surface = "outer"
traction_kpa = [0.02, 0.05, -0.03]
"""


def turned_labels() -> nibabel.Nifti1Image:
    """The image of the body, in RAS mm."""
    affine = np.eye(4)
    turn = Rotation.from_rotvec(np.radians(37.0) * np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)).as_matrix()
    affine[:3, :3], affine[:3, 3] = VOXEL_MM * turn, [11.0, -7.0, 5.0]
    places = VOXEL_MM * np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1)
    labels: NDArray[np.uint8] = np.zeros(SHAPE, dtype=np.uint8)
    labels[np.linalg.norm(places - [15.0, 22.0, 18.0], axis=-1) < 9.0] = 1
    labels[np.linalg.norm((places - [30.0, 14.0, 0.0])[..., :2], axis=-1) < 5.0] = 2
    labels[np.linalg.norm(places - [31.0, 30.0, 20.0], axis=-1) < 6.0] = 3
    return nibabel.Nifti1Image(labels, affine)


def turned_result(folder: Path, law: str) -> palpate.CaseResult:
    """The estimate of the ball's modulus from a motion that was simulated with the same loads."""
    folder.mkdir()
    nibabel.save(turned_labels(), folder / "before.nii.gz")
    (folder / "simulated.toml").write_text(CASE.format(after="", law=law, motion="[motion]\nfilling_mm = 1.5"))
    (folder / "case.toml").write_text(CASE.format(after=AFTER, law=law, motion=""))
    simulated = palpate.simulate(palpate.read_case(folder / "simulated.toml"))
    write_label_image(folder / "after.nii.gz", simulated.after)
    return palpate.estimate(palpate.read_case(folder / "case.toml"))
