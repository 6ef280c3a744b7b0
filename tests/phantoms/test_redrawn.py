import numpy as np
import pytest

from palpate.phantoms.motion import smooth_field
from palpate.phantoms.scene import imaged
from palpate.phantoms.spheres import SpheresOptions, spheres
from palpate_validation.mismatch import redrawn

SHELL_MM, CORE_MM = 20.0, 10.0


@pytest.fixture(scope="module")
def scene():
    return spheres(SpheresOptions(seed=2, kind="pushed", push_mm=0.0, truth_edge_mm=5.0))


def radius(scene, image, name, beyond_mm=0.0):
    """Outer radius (mm) of a tissue that fills all from a radius `beyond_mm` on, by its voxels."""
    centres = image.grid.world(np.argwhere(image.labels == scene.mesh.tissue_index(name) + 1).astype(float))
    middle = scene.after.grid.world(np.argwhere(scene.after.labels == scene.mesh.tissue_index("cavity") + 1)).mean(0)
    count = np.count_nonzero(np.linalg.norm(centres - middle, axis=1) > beyond_mm)
    return (count * image.grid.voxel_volume * 0.75 / np.pi + beyond_mm**3) ** (1.0 / 3.0)


@pytest.mark.parametrize("off", [-1.0, -0.25, 0.25, 1.0])
def test_a_surface_lies_as_far_off_as_it_is_drawn(scene, off):
    image = redrawn(scene.after, scene.space, scene.displacement, ["shell"], outwards_mm=off, into="surroundings")
    before, found = (radius(scene, seen, "shell", beyond_mm=15.0) for seen in (scene.after, image))
    assert before == pytest.approx(SHELL_MM, abs=0.1)
    assert found - before == pytest.approx(off, abs=0.03)
    if off > 0.0:  # the wall of the cavity is no border to the surroundings
        assert radius(scene, image, "cavity") == radius(scene, scene.after, "cavity")


def test_a_driver_that_is_drawn_thinner_leaves_the_tissue_that_is_named(scene):
    image = redrawn(scene.after, scene.space, scene.displacement, ["cavity"], outwards_mm=-1.0, into="shell")
    assert radius(scene, image, "cavity") == pytest.approx(CORE_MM - 1.0, abs=0.05)
    assert radius(scene, image, "shell", 15.0) == radius(scene, scene.after, "shell", 15.0)


def test_noise_of_the_image_is_that_of_what_is_redrawn(scene):
    warp = smooth_field(np.random.default_rng(1), sd_mm=0.5, correlation_mm=8.0).warp
    noisy = imaged(scene.space, scene.displacement, scene.after.grid, warp=warp)
    image = redrawn(noisy, scene.space, scene.displacement, ["shell"], outwards_mm=0.0, into="surroundings", warp=warp)
    assert np.count_nonzero(image.labels != noisy.labels) < 20  # of the mesh's facets, in voxels at their edge
