"""Simulated bodies that several files of tests look at, each made once in a process."""

from functools import cache

from palpate.phantoms.scene import Scene
from palpate.phantoms.spheres import SpheresOptions, spheres

VOXEL_MM = 1.5


@cache
def balls() -> Scene:
    """Two balls in one another, of 60 and 30 kPa in 10 kPa, that a frame squeezes, on voxels of `VOXEL_MM`."""
    return spheres(SpheresOptions(seed=2, spacing_mm=(VOXEL_MM,) * 3, truth_edge_mm=5.0))
