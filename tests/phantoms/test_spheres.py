import functools

import numpy as np
import pytest

from palpate.errors import ConfigurationError, GeometryError
from palpate.images.tissue import Role
from palpate.mechanics.element import deformation_determinants
from palpate.phantoms.scene import Noise, imaged
from palpate.phantoms.spheres import SPHERES_KINDS, SpheresOptions, spheres


@functools.cache
def scene(kind, noise=None):
    return spheres(SpheresOptions(seed=4, kind=kind, truth_edge_mm=10.0, spacing_mm=(2.0, 2.0, 2.0), noise=noise))


@pytest.mark.parametrize("kind", SPHERES_KINDS)
def test_images_show_every_tissue_with_its_volume(kind):
    truth = scene(kind)
    for number, tissue in enumerate(truth.tissues):
        voxels = np.count_nonzero(truth.before.labels == number + 1) * truth.before.grid.voxel_volume
        assert truth.before.names[number + 1] == tissue.name
        assert tissue.labels == (number + 1,)
        if tissue.meshed:
            assert voxels == pytest.approx(truth.mesh.volumes[truth.mesh.region == number].sum(), rel=0.03)


@pytest.mark.parametrize("kind", SPHERES_KINDS)
def test_driver_wall_moves_as_the_scene_says(kind):
    truth = scene(kind)
    (name,) = [tissue.name for tissue in truth.tissues if tissue.role is Role.DRIVER]
    faces = truth.mesh.boundary[truth.mesh.beyond == truth.mesh.tissue_index(name)]
    wall = np.unique(truth.space.facets(faces))
    assert truth.displacement[wall] == pytest.approx(truth.motions[name].at(truth.space.points[wall]), abs=1e-12)
    assert np.linalg.norm(truth.displacement[wall], axis=1).max() == pytest.approx(3.0, rel=0.15)


def test_truth_does_not_fold_over_and_moduli_are_stated():
    truth = scene("tumour")
    assert deformation_determinants(truth.space, truth.displacement).min() > 0.5
    assert truth.moduli_kpa == {"tumour": 75.0, "organ": 30.0, "surroundings": 10.0}


def test_squeezed_frame_keeps_its_volume_to_first_order():
    truth = scene("squeezed")
    moved = (truth.space.points + truth.displacement)[truth.space.cells[:, :4]]
    volume = np.linalg.det(moved[:, 1:] - moved[:, :1]).sum() / 6.0
    assert volume == pytest.approx(truth.mesh.volumes.sum(), rel=0.01)


def test_noise_moves_both_images_apart_and_leaves_the_truth_alone():
    clean, noisy = scene("pushed"), scene("pushed", Noise(0.4, 6.0))
    assert noisy.displacement == pytest.approx(clean.displacement, abs=1e-9)
    assert np.array_equal(clean.before.labels, imaged(clean.space, 0.0 * clean.displacement, clean.before.grid).labels)
    changed = [np.mean(a.labels != b.labels) for a, b in ((clean.before, noisy.before), (clean.after, noisy.after))]
    assert 0.002 < min(changed) < max(changed) < 0.05


def test_same_seed_gives_the_same_scene_and_another_seed_another():
    again = spheres(SpheresOptions(seed=4, kind="pushed", truth_edge_mm=10.0, spacing_mm=(2.0, 2.0, 2.0)))
    other = spheres(SpheresOptions(seed=5, kind="pushed", truth_edge_mm=10.0, spacing_mm=(2.0, 2.0, 2.0)))
    assert np.array_equal(again.after.labels, scene("pushed").after.labels)
    assert not np.array_equal(other.after.labels, again.after.labels)


def test_too_large_a_push_and_unknown_names_are_refused():
    with pytest.raises(GeometryError, match="folds over"):
        spheres(SpheresOptions(seed=1, kind="pushed", push_mm=25.0, truth_edge_mm=12.0))
    with pytest.raises(ConfigurationError, match="kind is 'cubes'"):
        spheres(SpheresOptions(seed=1, kind="cubes"))
    with pytest.raises(ConfigurationError, match=r"names \['liver'\]"):
        spheres(SpheresOptions(seed=1, moduli_kpa={"liver": 3.0}))
