"""Scenes with a known truth: concentric spheres, pelves, and the noise of their images."""

from palpate.phantoms.boundary_noise import SmoothField, smooth_field
from palpate.phantoms.exact_targets import exact_target, target_of_truth
from palpate.phantoms.motion import AffineMotion, ScaledMotion, WallMotion, filling_of
from palpate.phantoms.patches import patched
from palpate.phantoms.pelvis import PelvisOptions, pelvis, pelvis_anatomy, pelvis_grid, pelvis_motions
from palpate.phantoms.pelvis_shapes import PelvisShapes, draw_pelvis
from palpate.phantoms.redrawn import redrawn
from palpate.phantoms.scene import (
    BoundaryMotion,
    Noise,
    Scene,
    centred_grid,
    displacements,
    grid_box,
    imaged,
    refuse_folded,
    reimaged,
    rescaled,
)
from palpate.phantoms.shapes import Complement, Ellipsoid, Grown, Tube, ball, rotation_about
from palpate.phantoms.spheres import SpheresOptions, spheres
from palpate.phantoms.wall_filling import wall_filling

__all__ = [
    "AffineMotion",
    "BoundaryMotion",
    "Complement",
    "Ellipsoid",
    "Grown",
    "Noise",
    "PelvisOptions",
    "PelvisShapes",
    "ScaledMotion",
    "Scene",
    "SmoothField",
    "SpheresOptions",
    "Tube",
    "WallMotion",
    "ball",
    "centred_grid",
    "displacements",
    "draw_pelvis",
    "exact_target",
    "filling_of",
    "grid_box",
    "imaged",
    "patched",
    "pelvis",
    "pelvis_anatomy",
    "pelvis_grid",
    "pelvis_motions",
    "redrawn",
    "refuse_folded",
    "reimaged",
    "rescaled",
    "rotation_about",
    "smooth_field",
    "spheres",
    "target_of_truth",
    "wall_filling",
]
