"""B16: observed orders of convergence on a manufactured solution.

u_i = c_i s with s = sin(pi x) sin(pi y) sin(pi z) vanishes on the unit box's border; the body force is
f = -mu lap u - (lambda + mu) grad div u.
"""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.element import barycentric_gradients, quadrature, shape_derivatives, shape_functions
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.solvers.registry import factorise
from palpate.mechanics.stiffness import lame_parameters
from palpate.mesh.space import lagrange_space

C = np.array([1.0, -0.5, 0.7])
NU = 0.3


def solution(x):
    """u (..., 3), grad u (..., 3, 3) and body force (..., 3) at E = 1."""
    sine, cosine = np.sin(np.pi * x), np.cos(np.pi * x)
    s = sine.prod(axis=-1)
    hessian = np.empty((*x.shape, 3))
    gradient = np.empty_like(x)
    for i in range(3):
        factors = sine.copy()
        factors[..., i] = cosine[..., i]
        gradient[..., i] = np.pi * factors.prod(axis=-1)
        for j in range(3):
            both = factors.copy()
            both[..., j] = cosine[..., j] if i != j else -sine[..., i]
            hessian[..., i, j] = np.pi**2 * both.prod(axis=-1)
    lam, mu = lame_parameters(1.0, NU)
    laplacian = np.einsum("...ii->...", hessian)[..., None] * C
    force = -mu * laplacian - (lam + mu) * hessian @ C
    return s[..., None] * C, C[:, None] * gradient[..., None, :], force


def errors(meshes, element, n):
    """Errors of u in L2 and of grad u in L2 on n cells a side."""
    space = lagrange_space(meshes.box_mesh(n, tissues=[meshes.known("block", nu=NU)]), element)
    nothing = meshes.prescribe(space, np.zeros(0, int), np.zeros((0, 3)))
    model = linear_model(space, outer_constraint(space, outer="fixed", **nothing))
    places, weights = quadrature(5)
    shape, by_lambda = shape_functions(space.order, places), shape_derivatives(space.order, places)
    gradients, volumes = barycentric_gradients(space.mesh.nodes, space.mesh.tets)
    u, grad_u, force = solution(np.einsum("qk,eki->eqi", places, space.mesh.nodes[space.mesh.tets]))
    load = np.zeros((len(space.points), 3))
    np.add.at(load, space.cells, np.einsum("e,q,qa,eqi->eai", volumes, weights, shape, force, optimize=True))
    free = model.constraint.free
    z = factorise(model.free_stiffness[0]).solve((free.T @ load.ravel())[:, None])
    nodal = (free @ z).reshape(-1, 3)[space.cells]
    difference = np.einsum("qa,eai->eqi", shape, nodal) - u
    slope = np.einsum("qak,ekj,eai->eqij", by_lambda, gradients, nodal, optimize=True) - grad_u
    measure = volumes[:, None] * weights
    return [np.sqrt(np.sum(measure * np.sum(d**2, axis=axes))) for d, axes in ((difference, 2), (slope, (2, 3)))]


@pytest.mark.parametrize(("element", "sizes", "orders"), [("P1", (8, 16), (2, 1)), ("P2", (4, 8), (3, 2))])
def test_errors_fall_with_the_orders_of_theory(meshes, element, sizes, orders):
    coarse, fine = (errors(meshes, element, n) for n in sizes)
    observed = np.log2(np.array(coarse) / np.array(fine))
    assert np.all(np.abs(observed - orders) < 0.2), observed
