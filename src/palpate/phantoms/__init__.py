"""Scenes with a known truth: concentric spheres, pelves, and the noise of their images."""

from palpate.phantoms.boundary_noise import SmoothField, smooth_field
from palpate.phantoms.exact_targets import exact_target, target_of_truth
from palpate.phantoms.motion import filling_of
from palpate.phantoms.pelvis import PelvisOptions, pelvis, pelvis_anatomy, pelvis_grid
from palpate.phantoms.pelvis_shapes import PelvisShapes, draw_pelvis
from palpate.phantoms.scene import Noise, Scene, centred_grid, grid_box, imaged, reimaged, rescaled
from palpate.phantoms.shapes import Complement, Ellipsoid, Tube, ball, rotation_about
from palpate.phantoms.spheres import SpheresOptions, spheres
from palpate.phantoms.wall_filling import wall_filling

__all__ = [
    "Complement",
    "Ellipsoid",
    "Noise",
    "PelvisOptions",
    "PelvisShapes",
    "Scene",
    "SmoothField",
    "SpheresOptions",
    "Tube",
    "ball",
    "centred_grid",
    "draw_pelvis",
    "exact_target",
    "filling_of",
    "grid_box",
    "imaged",
    "pelvis",
    "pelvis_anatomy",
    "pelvis_grid",
    "reimaged",
    "rescaled",
    "rotation_about",
    "smooth_field",
    "spheres",
    "target_of_truth",
    "wall_filling",
]
