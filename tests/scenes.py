"""Simulated bodies that several files of tests look at, each made once in a process."""

from functools import cache

from palpate.phantoms.scene import Scene
from palpate.phantoms.spheres import SpheresOptions, spheres

VOXEL_MM = 1.5


@cache
def balls() -> Scene:
    """Two balls in one another, of 60 and 30 kPa in 10 kPa, that a frame squeezes, on voxels of `VOXEL_MM`."""
    return spheres(SpheresOptions(seed=2, spacing_mm=(VOXEL_MM,) * 3, truth_edge_mm=6.0))


@cache
def coarse_balls(seed: int = 2, voxel_mm: float = 2.5) -> Scene:
    """The same on few elements and voxels, where what is tested is not how near the truth is found."""
    return spheres(SpheresOptions(seed=seed, spacing_mm=(voxel_mm,) * 3, truth_edge_mm=8.0))
