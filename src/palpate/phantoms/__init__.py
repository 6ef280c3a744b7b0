"""Scenes with a known truth: concentric spheres, pelves, and the noise of their images."""

from palpate.phantoms.exact_targets import TriangulatedDistance, exact_target, target_of_truth
from palpate.phantoms.motion import (
    AffineMotion,
    ScaledMotion,
    SmoothField,
    WallMotion,
    filling_of,
    smooth_field,
    wall_filling,
)
from palpate.phantoms.pelvis import PelvisOptions, pelvis, pelvis_anatomy, pelvis_grid, pelvis_motions
from palpate.phantoms.pelvis_shapes import PelvisShapes, draw_pelvis
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
from palpate.phantoms.shapes import Complement, Ellipsoid, Tube, ball, rotation_about
from palpate.phantoms.spheres import SpheresOptions, spheres

__all__ = [
    "AffineMotion",
    "BoundaryMotion",
    "Complement",
    "Ellipsoid",
    "Noise",
    "PelvisOptions",
    "PelvisShapes",
    "ScaledMotion",
    "Scene",
    "SmoothField",
    "SpheresOptions",
    "TriangulatedDistance",
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
    "pelvis",
    "pelvis_anatomy",
    "pelvis_grid",
    "pelvis_motions",
    "refuse_folded",
    "reimaged",
    "rescaled",
    "rotation_about",
    "smooth_field",
    "spheres",
    "target_of_truth",
    "wall_filling",
]
