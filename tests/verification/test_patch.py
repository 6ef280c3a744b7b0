"""B0 in layers of several tissues, and with every law and dilatation."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.laws.registry import LAWS
from palpate.mechanics.linear_model import linear_model
from palpate.mesh.space import lagrange_space
from palpate_validation.conditions import prescribe
from palpate_validation.problems.patch import finite_affine_error
from palpate_validation.structured_meshes import VOID, box_mesh, known


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_layers_in_series_share_the_strain_by_their_moduli(element):
    """Piecewise affine, exact: with nu = 0 each layer takes the strain sigma / E, sigma = d / sum(h / E)."""
    size, moduli = 40.0, np.array([1.0, 3.0, 12.0])
    heights = np.array([10.0, 10.0, 20.0])
    mesh = box_mesh(
        4,
        size=size,
        tissues=[known(name, nu=0.0) for name in ("low", "middle", "high")] + [VOID],
        region=lambda c: np.searchsorted([10.0, 20.0], c[:, 2]),
    )
    space = lagrange_space(mesh, element)
    ends = np.flatnonzero((space.points[:, 2] < 1e-9) | (space.points[:, 2] > size - 1e-9))
    pull = np.zeros((len(ends), 3))
    pull[space.points[ends, 2] > 1.0, 2] = 1.0
    model = linear_model(space, outer_constraint(space, outer="sliding", **prescribe(space, ends, pull)))
    found = model.solve(moduli, np.zeros(0)).displacement
    stress = 1.0 / np.sum(heights / moduli)
    exact = np.interp(space.points[:, 2], [0, 10, 20, 40], np.append(0.0, np.cumsum(stress * heights / moduli)))
    assert abs(found[:, 2] - exact).max() < 1e-10
    assert abs(found[:, :2]).max() < 1e-10


@pytest.mark.parametrize("law", ["neo-hookean", "mooney-rivlin"])
@pytest.mark.parametrize("dilatation", Dilatation)
def test_an_affine_finite_strain_is_reproduced_on_a_distorted_mesh(law, dilatation):
    assert finite_affine_error(LAWS[law], dilatation) < 1e-8
