"""B9 and B10: homogeneous finite strain, incompressible closed forms at Poisson's ratio 0.4999.

With mu = 2 (c1 + c2): uniaxial Cauchy stress 2 (l^2 - 1/l)(c1 + c2 / l), equibiaxial 2 (l^2 - l^-4)(c1 + c2 l^2)
(Ogden, Non-linear Elastic Deformations, 1984, section 4.3; the table is these formulas). Plane strain, F a unit face:
2 w (2 + w)(1 + (1 + w)^2) / (1 + w)^3 (c10 + c01) (Code_Aster V6.04.187, without its third coefficient).
"""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.laws.contract import stress
from palpate.mechanics.laws.registry import law_named
from palpate.mechanics.stiffness import lame_parameters
from palpate.mesh.space import lagrange_space

NU, MU = 0.4999, 10.0
E = 2.0 * MU * (1.0 + NU)
NEO = law_named("neo-hookean")
MOONEY = law_named("mooney-rivlin", c01_over_c10=0.25)

# stretch: neo-Hookean mu = 10 kPa uniaxial nominal, equibiaxial Cauchy; Mooney-Rivlin c10 = 4, c01 = 1 kPa likewise
TABLE = {
    0.8: (-7.62500, -18.01406, -8.00625, -16.71705),
    1.2: (5.05556, 9.57747, 4.88704, 10.42029),
    1.5: (10.55556, 20.52469, 9.85185, 25.65586),
    2.0: (17.50000, 39.37500, 15.75000, 63.00000),
}
PLANE_STRAIN = {-0.1: -4.717421, -0.2: -11.531250, -0.3: -22.154519}


def nominal_stress(meshes, law, stretches):
    """Force a unit face of rest (kPa) along z of a unit cube; `stretches` along x, y, z, None for a free direction."""
    space = lagrange_space(meshes.box_mesh(1, tissues=[meshes.known("block", nu=NU)]), "P2")
    held, values = np.zeros((2, *space.points.shape), dtype=bool)[0], np.zeros_like(space.points)
    for axis, stretch in enumerate(stretches):
        low, high = space.points[:, axis] < 1e-9, space.points[:, axis] > 1.0 - 1e-9
        held[low, axis] = True
        if stretch is not None:
            held[high, axis], values[high, axis] = True, stretch - 1.0
    model = finite_strain_model(space, meshes.held_components(held, values), law)
    equilibrium = model.solve(np.array([E]), np.zeros(0))
    forces = equilibrium.balance.residual(equilibrium.values)[0].reshape(-1, 3)
    return forces[space.points[:, 2] > 1.0 - 1e-9, 2].sum()


@pytest.mark.parametrize("stretch", sorted(TABLE))
def test_uniaxial_stretch(meshes, stretch):
    neo, _, mooney, _ = TABLE[stretch]
    assert nominal_stress(meshes, NEO, (None, None, stretch)) == pytest.approx(neo, rel=2e-3)
    assert nominal_stress(meshes, MOONEY, (None, None, stretch)) == pytest.approx(mooney, rel=2e-3)


@pytest.mark.parametrize("stretch", sorted(TABLE))
def test_equibiaxial_stretch(meshes, stretch):
    """Nominal times stretch is Cauchy."""
    _, neo, _, mooney = TABLE[stretch]
    assert nominal_stress(meshes, NEO, (stretch, None, stretch)) * stretch == pytest.approx(neo, rel=2e-3)
    assert nominal_stress(meshes, MOONEY, (stretch, None, stretch)) * stretch == pytest.approx(mooney, rel=2e-3)


@pytest.mark.parametrize("w", sorted(PLANE_STRAIN))
def test_plane_strain_compression(meshes, w):
    found = nominal_stress(meshes, MOONEY, (1.0, None, 1.0 + w))
    assert found == pytest.approx(PLANE_STRAIN[w], rel=5e-3)


@pytest.mark.parametrize("law", [NEO, MOONEY], ids=lambda law: law.name)
@pytest.mark.parametrize("shear", [0.2, 1.0])
def test_simple_shear(law, shear):
    """s12 = mu g and s11 - s22 = mu g^2, exactly: the volume does not change."""
    F = np.eye(3)
    F[0, 1] = shear
    lame, mu = lame_parameters(E, NU)
    cauchy = stress(law, F[None], mu=mu, lame=lame)[0] @ F.T
    assert cauchy[0, 1] == pytest.approx(MU * shear, rel=1e-12)
    assert cauchy[0, 0] - cauchy[1, 1] == pytest.approx(MU * shear**2, rel=1e-12)
