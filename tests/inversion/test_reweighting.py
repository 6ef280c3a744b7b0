"""How residuals count: by the area of their surface, and at first by the rounding of the voxels."""

from __future__ import annotations

import numpy as np
import pytest
from palpate.inversion.surrogate import first_surrogate
from palpate.inversion.tukey import Tukey
from palpate.inversion.weighting import EXACT_LAW, first_law, objective_of, robust_loss

from palpate.images.distance import distance_map
from palpate.images.label_image import VoxelGrid


def test_surfaces_count_by_their_area(voxels):
    moduli = voxels.modulus_map.moduli(np.zeros(2))
    models = tuple(first_surrogate(model, moduli).reduced for model in voxels.models)
    weightings = objective_of(voxels, models, first_law(voxels)).weighting[0]
    ratios = [w.precision / t.area.sum() for w, t in zip(weightings, voxels.targets[0], strict=True)]
    assert len(ratios) > 1
    assert ratios == pytest.approx([ratios[0]] * len(ratios))


def test_without_voxels_the_first_law_is_that_of_exact_surfaces(exact):
    assert first_law(exact) is EXACT_LAW


def test_the_first_law_is_what_rounding_leaves_of_a_plane(voxels):
    """h^4 / (24 pi sigma^2) of two images: the scatter of voxelised planes of any direction, which lie anywhere."""
    law = first_law(voxels)
    image = voxels.targets[0][0].voxels[0]
    edge, width = float(image.grid.spacing[0]), image.smoothing_mm
    assert law.lengths == pytest.approx([np.sqrt(2.0) * width])
    grid = VoxelGrid((24, 24, 24), np.diag([edge] * 3 + [1.0]))
    centres = grid.world(np.indices(grid.shape).reshape(3, -1).T.astype(float))
    rng, errors = np.random.default_rng(3), []
    for _ in range(40):
        normal = rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        depth = centres @ normal - centres.mean(axis=0) @ normal - edge * rng.uniform(-0.5, 0.5)
        found = distance_map((depth < 0.0).reshape(grid.shape), grid, smoothing_mm=width).node_values().ravel()
        inner = (np.abs(centres - centres.mean(axis=0)).max(axis=1) < 5.0 * edge) & (np.abs(depth) < 0.5 * edge)
        errors.append(found[inner] - depth[inner])
    rounding = 2.0 * float(np.mean(np.concatenate(errors) ** 2))  # of both images
    assert rounding == pytest.approx(law.variances[0], rel=0.5)


def test_terraces_that_flip_as_a_whole_are_no_outliers(voxels, rng):
    """Surfaces along the grid that move by a fifth of a voxel: a fifth of them is seen one voxel further, the rest not.

    The best motion is that fifth; with a cutoff by the quiet residuals alone it would be nearly zero.
    """
    target = voxels.targets[0][0]
    edge = float(target.voxels[0].grid.spacing[0])
    seen = np.where(rng.random(4000) < 0.2, edge, 0.0) + 0.03 * edge * rng.standard_normal(4000)

    def fitted(loss):
        motions = np.linspace(-0.2, 0.6, 161) * edge
        return motions[np.argmin([loss.rho(motion - seen).mean() for motion in motions])]

    loss = robust_loss(seen, target)
    assert fitted(loss) == pytest.approx(seen.mean(), abs=0.01 * edge)
    assert abs(fitted(Tukey(loss.cutoff))) < 0.02 * edge


def test_what_no_voxel_explains_counts_nothing(voxels, rng):
    target = voxels.targets[0][0]
    edge = float(target.voxels[0].grid.spacing[0])
    values = np.append(0.1 * edge * rng.standard_normal(1000), [-2.0 * edge, 2.0 * edge])
    loss = robust_loss(values, target)
    assert loss.rejects(values).nonzero()[0].tolist() == [1000, 1001]
    assert loss.weight(values[-2:]).tolist() == [0.0, 0.0]
