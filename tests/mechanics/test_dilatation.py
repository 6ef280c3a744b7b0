"""How lambda is shared between the points and the mean of an element, and what that does to locking."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.errors import ConfigurationError
from palpate.mechanics.dilatation import Dilatation, choose_element, pointwise_lame, pointwise_lame_slope
from palpate.mechanics.rigid import rigid_modes
from palpate.mechanics.stiffness import lame_by_poisson, lame_parameters, tissue_stiffness
from palpate.mesh.space import lagrange_space


@pytest.mark.parametrize("dilatation", Dilatation)
def test_the_share_at_the_points_is_between_nothing_and_all(dilatation):
    for nu in (0.0, 0.2, 0.45, 0.4999):
        lame, mu = lame_parameters(1.0, nu)
        assert 0.0 <= pointwise_lame(dilatation, lame, mu) <= lame


def test_the_blend_is_pointwise_for_small_lambda_and_bounded_for_large():
    assert pointwise_lame(Dilatation.BLENDED, 1e-6, 1.0) == pytest.approx(1e-6, rel=1e-5)
    assert pointwise_lame(Dilatation.BLENDED, 1e9, 1.0) == pytest.approx(3.0, rel=1e-6)


@pytest.mark.parametrize("nu", [0.1, 0.45, 0.499])
def test_lame_constants_have_their_derivatives_by_poissons_ratio(nu):
    step = 1e-6
    above, below = (np.array(lame_parameters(3.0, nu + s * step)) for s in (1, -1))
    assert np.allclose(lame_by_poisson(3.0, nu), (above - below) / (2 * step), rtol=1e-5)


@pytest.mark.parametrize("dilatation", Dilatation)
@pytest.mark.parametrize("nu", [0.1, 0.45])
def test_the_share_at_the_points_has_its_derivative(dilatation, nu):
    step = 1e-6
    values = [pointwise_lame(dilatation, *lame_parameters(1.0, nu + s * step)) for s in (1, -1)]
    found = pointwise_lame_slope(dilatation, *lame_parameters(1.0, nu), by=lame_by_poisson(1.0, nu))
    assert found == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("dilatation", Dilatation)
def test_only_rigid_motions_cost_no_energy(meshes, dilatation):
    space = lagrange_space(meshes.box_mesh(2, size=30.0, distortion=0.2), "P2")
    values, vectors = np.linalg.eigh(tissue_stiffness(space, 0, 0.4999, dilatation=dilatation).toarray())
    assert np.all(np.abs(values[:6]) < 1e-12 * values[-1])
    assert values[6] > 1e-8 * values[-1]
    modes = rigid_modes(space.points)
    assert np.allclose(vectors[:, :6] @ (vectors[:, :6].T @ modes), modes, atol=1e-7)


def test_a_linear_tetrahedron_knows_no_difference(meshes):
    space = lagrange_space(meshes.box_mesh(2, size=30.0, distortion=0.2), "P1")
    plain, mean = (tissue_stiffness(space, 0, 0.49, dilatation=d) for d in (Dilatation.POINTWISE, Dilatation.MEAN))
    assert abs(plain - mean).max() < 1e-12 * abs(plain).max()


def test_the_mean_is_never_stiffer_than_the_points(meshes, rng):
    space = lagrange_space(meshes.box_mesh(2, size=30.0, distortion=0.2), "P2")
    stiffness = {d: tissue_stiffness(space, 0, 0.49, dilatation=d) for d in Dilatation}
    for _ in range(10):
        u = rng.standard_normal(3 * len(space.points))
        energies = [u @ (stiffness[d] @ u) for d in (Dilatation.MEAN, Dilatation.BLENDED, Dilatation.POINTWISE)]
        assert energies == sorted(energies)


def test_an_unknown_element_is_refused_with_the_names_of_all():
    with pytest.raises(ConfigurationError, match=r"P1.*P2.*auto"):
        choose_element("Q2")
    assert choose_element("auto").dilatation is Dilatation.BLENDED
