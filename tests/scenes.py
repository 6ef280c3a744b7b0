"""Simulated bodies that several files of tests look at, each made once in a process."""

from functools import cache

from palpate.phantoms.scene import Scene
from palpate.phantoms.spheres import SpheresOptions, spheres


@cache
def balls() -> Scene:
    """Two balls in one another, of 60 and 30 kPa in 10 kPa, that a frame squeezes, on voxels of 1.5 mm."""
    return spheres(SpheresOptions(seed=2, spacing_mm=(1.5, 1.5, 1.5), truth_edge_mm=5.0))
