"""B16 at finite strain: observed orders of a manufactured neo-Hookean solution; body force -Div P by differences."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.element import barycentric_gradients, quadrature, shape_derivatives, shape_functions
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.laws.contract import stress
from palpate.mechanics.laws.registry import LAWS
from palpate.mechanics.loads import DeadLoad
from palpate.mechanics.stiffness import lame_parameters
from palpate.mesh.space import lagrange_space

C = 0.15 * np.array([1.0, -0.5, 0.7])
NU = 0.3
LAW = LAWS["neo-hookean"]


def solution(x):
    """u (..., 3) and grad u (..., 3, 3)."""
    sine, cosine = np.sin(np.pi * x), np.cos(np.pi * x)
    gradient = np.empty_like(x)
    for i in range(3):
        factors = sine.copy()
        factors[..., i] = np.pi * cosine[..., i]
        gradient[..., i] = factors.prod(axis=-1)
    return sine.prod(axis=-1)[..., None] * C, C[:, None] * gradient[..., None, :]


def body_force(x):
    lame, mu = lame_parameters(1.0, NU)
    force, step = np.zeros_like(x), 1e-5
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        ahead, behind = (
            stress(LAW, (np.eye(3) + solution(x + s * shift)[1]).reshape(-1, 3, 3), mu=mu, lame=lame) for s in (1, -1)
        )
        force -= ((ahead - behind)[:, :, axis] / (2.0 * step)).reshape(x.shape)
    return force


def errors(meshes, element, dilatation, n):
    """Errors of u and of grad u in L2 on n cells a side of the unit cube."""
    space = lagrange_space(meshes.box_mesh(n, tissues=[meshes.known("block", nu=NU)]), element)
    places, weights = quadrature(5)
    shape, by_lambda = shape_functions(space.order, places), shape_derivatives(space.order, places)
    gradients, volumes = barycentric_gradients(space.mesh.nodes, space.mesh.tets)
    x = np.einsum("qk,eki->eqi", places, space.mesh.nodes[space.mesh.tets])
    load = np.zeros_like(space.points)
    np.add.at(load, space.cells, np.einsum("e,q,qa,eqi->eai", volumes, weights, shape, body_force(x), optimize=True))
    held = np.repeat((np.abs(space.points - 0.5).max(axis=1) > 0.5 - 1e-9)[:, None], 3, axis=1)
    constraint = meshes.held_components(held, 0.0 * space.points)
    model = finite_strain_model(space, constraint, LAW, dilatation=dilatation, loads=(DeadLoad(load.ravel()),))
    nodal = model.solve(np.ones(1), np.zeros(0)).displacement[space.cells]
    u, grad_u = solution(x)
    difference = np.einsum("qa,eai->eqi", shape, nodal) - u
    slope = np.einsum("qak,ekj,eai->eqij", by_lambda, gradients, nodal, optimize=True) - grad_u
    measure = volumes[:, None] * weights
    return [np.sqrt(np.sum(measure * np.sum(d**2, axis=axes))) for d, axes in ((difference, 2), (slope, (2, 3)))]


@pytest.mark.parametrize(
    ("element", "dilatation", "sizes", "orders"),
    [("P1", Dilatation.POINTWISE, (6, 12), (2, 1)), ("P2", Dilatation.POINTWISE, (4, 8), (3, 2))],
)
def test_errors_fall_with_the_orders_of_theory(meshes, element, dilatation, sizes, orders):
    coarse, fine = (errors(meshes, element, dilatation, n) for n in sizes)
    observed = np.log2(np.array(coarse) / np.array(fine))
    assert np.all(np.abs(observed - orders) < 0.25), observed


def test_the_automatic_element_is_at_least_as_good_as_its_mixed_theory(meshes):
    """P2/P0: second order in u, first in grad u (Boffi, Brezzi & Fortin, 2013, section 8.4); the blend's are better."""
    coarse, fine = (errors(meshes, "P2", Dilatation.BLENDED, n) for n in (4, 8))
    observed = np.log2(np.array(coarse) / np.array(fine))
    assert np.all(observed > [2.0, 1.0]), observed
