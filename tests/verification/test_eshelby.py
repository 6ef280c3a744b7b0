"""B5: Eshelby's sphere in a large matrix, why stiff inclusions saturate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.linear_model import linear_model
from palpate.mesh.space import lagrange_space

VOLUMETRIC, DEVIATORIC = np.eye(3), np.diag([1.0, -0.5, -0.5])


@pytest.fixture(scope="module")
def ball(meshes):
    """Unit ball in a matrix of thirty radii (ten are 2 % off); modes: a volumetric and a deviatoric far field."""

    def model(nu):
        tissues = [meshes.known("inclusion", nu=nu), *[meshes.known("matrix", nu=nu)] * 4]
        radii = np.array([0.4, 1.0, 2.0, 4.0, 10.0, 30.0])
        layered = meshes.octant_mesh(radii, [2, 4, 3, 3, 3], 8, tissues, solid=True)
        mesh = replace(
            layered,
            region=np.array([0, 0, 1, 1, 1])[layered.region],
            tissues=(*tissues[:2], meshes.VOID),
            beyond=np.minimum(layered.beyond, 2),
        )
        space = lagrange_space(mesh, "P2")
        points = np.unique(space.facets(mesh.boundary[mesh.beyond == 2]))
        modes = np.stack([space.points[points] @ strain for strain in (VOLUMETRIC, DEVIATORIC)], axis=2)
        given = meshes.prescribe(space, points, np.zeros((len(points), 3)), modes)
        return linear_model(space, outer_constraint(space, outer="sliding", **given))

    return model


def factors(model, contrast):
    """Strain of the inclusion along x over the far strain, for the two modes."""
    responses = model.responses(np.array([contrast, 1.0]))
    points = model.space.points
    inside = np.flatnonzero((np.linalg.norm(points, axis=1) < 0.9) & (points[:, 0] > 0.1))
    return np.mean(responses[3 * inside, :2] / points[inside, :1], axis=0)


def test_strain_of_the_inclusion_follows_eshelby(ball):
    model = ball(0.3)
    published = {2: (0.61765, 0.67742), 5: (0.28767, 0.34426), 10: (0.15217, 0.18919), 100: (0.01606, 0.02077)}
    for contrast, expected in published.items():
        assert np.allclose(factors(model, float(contrast)), expected, rtol=2e-2)


def test_strain_of_a_nearly_incompressible_inclusion_follows_eshelby(ball):
    assert np.allclose(factors(ball(0.45), 10.0), (0.11224, 0.20755), rtol=2e-2)


def test_a_stiff_inclusion_hides_its_modulus(ball):
    """A factor of ten in E moves the border of the inclusion less and less: what the interval must show."""
    model = ball(0.3)
    change = [abs(np.subtract(factors(model, 10.0 * c), factors(model, c))).max() for c in (1.0, 10.0, 100.0)]
    assert change[0] > 4 * change[1] > 16 * change[2]
