"""Element forces and stiffness are derivatives of the energy, for every law and every dilatation."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.hyperelastic import Moduli, elements_of
from palpate.mechanics.laws.registry import LAWS
from palpate.mechanics.pattern import block_pattern
from palpate.mesh.space import lagrange_space

CASES = [
    *[("P1", law, Dilatation.POINTWISE) for law in sorted(LAWS)],
    *[("P2", law, d) for law in sorted(LAWS) for d in Dilatation],
]


@pytest.fixture(params=CASES, ids=lambda case: "-".join(map(str, case)))
def body(request, meshes, rng):
    """Elements, their moduli, and a large displacement (n_points, 3)."""
    name, law, dilatation = request.param
    space = lagrange_space(meshes.box_mesh(2, size=10.0, distortion=0.2), name)
    n = len(space.cells)
    shares = {Dilatation.POINTWISE: 1.0, Dilatation.MEAN: 0.0, Dilatation.BLENDED: 0.3}
    lame = rng.uniform(3.0, 9.0, n)
    moduli = Moduli(rng.uniform(1.0, 3.0, n), shares[dilatation] * lame, (1.0 - shares[dilatation]) * lame)
    slope = np.array([[0.3, 0.4, 0.0], [-0.2, 0.2, 0.1], [0.1, 0.0, -0.2]])
    displacement = space.points @ slope.T + 0.2 * rng.standard_normal(space.points.shape)
    elements = elements_of(space, LAWS[law], dilatation)
    assert elements.smallest_volume(displacement)[0] > 0.1
    return space, elements, moduli, displacement


def summed(space, forces):
    total = np.zeros_like(space.points)
    np.add.at(total, space.cells, forces)
    return total.ravel()


def test_forces_are_the_derivative_of_the_energy(body, rng):
    space, elements, moduli, u = body
    for _ in range(3):
        d, h = rng.standard_normal(u.shape), 1e-5
        expected = (elements.energy(u + h * d, moduli) - elements.energy(u - h * d, moduli)) / (2 * h)
        assert summed(space, elements.forces(u, moduli)) @ d.ravel() == pytest.approx(expected, rel=1e-6)


def test_stiffness_is_the_derivative_of_the_forces_and_symmetric(body, rng):
    space, elements, moduli, u = body
    K = block_pattern(space.cells, len(space.points)).assemble(elements.stiffness(u, moduli))
    assert abs(K - K.T).max() < 1e-12 * abs(K).max()
    for _ in range(3):
        d, h = rng.standard_normal(u.shape), 1e-5
        ahead, behind = (summed(space, elements.forces(u + s * h * d, moduli)) for s in (1, -1))
        expected = (ahead - behind) / (2 * h)
        assert np.allclose(K @ d.ravel(), expected, atol=1e-6 * abs(expected).max())


def test_forces_on_each_element_are_in_balance(body):
    _, elements, moduli, u = body
    forces = elements.forces(u, moduli)
    assert np.allclose(forces.sum(axis=1), 0.0, atol=1e-12 * abs(forces).max())
