"""B16: observed orders of convergence on manufactured solutions, linear and neo-Hookean.

u_i = c_i s with s = sin(pi x) sin(pi y) sin(pi z) vanishes on the unit box's border. Linear: the body force is
f = -mu lap u - (lambda + mu) grad div u; neo-Hookean: f = -Div P, by differences of the exact stress.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics import (
    LAWS,
    DeadLoad,
    Dilatation,
    barycentric_gradients,
    finite_strain_model,
    lame_parameters,
    quadrature,
    shape_derivatives,
    stress,
)
from palpate.mesh import Constraint, LagrangeSpace, lagrange_space, shape_functions
from palpate_validation.conditions import held_components, loaded
from palpate_validation.problems.contract import Check, Problem
from palpate_validation.structured_meshes import box_mesh, known

__all__ = ["MANUFACTURED_PROBLEMS", "linear_errors", "neo_hookean_errors", "observed_orders"]

Array = NDArray[np.float64]

DIRECTION = np.array([1.0, -0.5, 0.7])
SMALL, LARGE = 1.0, 0.15  # amplitude of the linear and of the finite solution
NU = 0.3
LAW = LAWS["neo-hookean"]
TOLERANCE = 0.2  # of the observed order


def solution(x: Array, amplitude: float) -> tuple[Array, Array]:
    """Displacement u (..., 3) mm and grad u (..., 3, 3), dimensionless, at places x (..., 3) mm."""
    sine, cosine = np.sin(np.pi * x), np.cos(np.pi * x)
    c = amplitude * DIRECTION
    gradient = np.empty_like(x)
    for i in range(3):
        factors = sine.copy()
        factors[..., i] = np.pi * cosine[..., i]
        gradient[..., i] = factors.prod(axis=-1)
    return sine.prod(axis=-1)[..., None] * c, c[:, None] * gradient[..., None, :]


def linear_force(x: Array) -> Array:
    """Body force (..., 3) mN/mm^3 of the linear solution at E = 1 kPa and places x (..., 3) mm."""
    sine, cosine = np.sin(np.pi * x), np.cos(np.pi * x)
    hessian = np.empty((*x.shape, 3))
    for i in range(3):
        for j in range(3):
            factors = sine.copy()
            factors[..., i] = cosine[..., i]
            factors[..., j] = cosine[..., j] if i != j else -sine[..., i]
            hessian[..., i, j] = np.pi**2 * factors.prod(axis=-1)
    lame, mu = lame_parameters(1.0, NU)
    laplacian = np.einsum("...ii->...", hessian)[..., None] * DIRECTION
    return np.asarray(SMALL * (-mu * laplacian - (lame + mu) * hessian @ DIRECTION))


def finite_force(x: Array) -> Array:
    """Body force (..., 3) mN/mm^3 of the neo-Hookean solution at E = 1 kPa, x (..., 3) mm; by central differences."""
    lame, mu = lame_parameters(1.0, NU)
    force, step = np.zeros_like(x), 1e-5
    for axis in range(3):
        ahead, behind = (
            stress(LAW, (np.eye(3) + solution(x + shift, LARGE)[1]).reshape(-1, 3, 3), mu=mu, lame=lame)
            for shift in (step * np.eye(3)[axis], -step * np.eye(3)[axis])
        )
        force -= ((ahead - behind)[:, :, axis] / (2.0 * step)).reshape(x.shape)
    return force


@dataclass(frozen=True, slots=True)
class _Box:
    """The unit box with n cells a side, and the quadrature on it: places (n_tets, n_q, 3), measure (n_tets, n_q)."""

    space: LagrangeSpace
    constraint: Constraint
    places: Array
    measure: Array
    shape: Array
    by_lambda: Array
    gradients: Array

    def load(self, force: Array) -> Array:
        """Nodal forces (n_dof,) mN of a body force (n_tets, n_q, 3) mN/mm^3."""
        result = np.zeros_like(self.space.points)
        nodal = np.einsum("eq,qa,eqi->eai", self.measure, self.shape, force, optimize=True)
        np.add.at(result, self.space.cells, nodal)
        return result.ravel()

    def errors(self, displacement: Array, amplitude: float) -> Array:
        """Errors (2,) of u (mm) and of grad u (dimensionless) in the L2 norm, of a displacement (n_points, 3) mm."""
        nodal = displacement[self.space.cells]
        u, grad_u = solution(self.places, amplitude)
        off = np.einsum("qa,eai->eqi", self.shape, nodal) - u
        slope = np.einsum("qak,ekj,eai->eqij", self.by_lambda, self.gradients, nodal, optimize=True) - grad_u
        squares = [np.sum(off**2, axis=2), np.sum(slope**2, axis=(2, 3))]
        return np.sqrt([np.sum(self.measure * square) for square in squares])


def _box(element: str, n: int) -> _Box:
    space = lagrange_space(box_mesh(n, tissues=[known("block", nu=NU)]), element)
    barycentric, weights = quadrature(5)
    gradients, volumes = barycentric_gradients(space.mesh.nodes, space.mesh.tets)
    held = np.repeat((np.abs(space.points - 0.5).max(axis=1) > 0.5 - 1e-9)[:, None], 3, axis=1)
    return _Box(
        space,
        held_components(held, 0.0 * space.points),
        np.einsum("qk,eki->eqi", barycentric, space.mesh.nodes[space.mesh.tets]),
        volumes[:, None] * weights,
        shape_functions(space.order, barycentric),
        shape_derivatives(space.order, barycentric),
        gradients,
    )


def linear_errors(element: str, dilatation: Dilatation, n: int) -> Array:
    """Errors (2,) of u (mm) and of grad u (dimensionless) in the L2 norm on n cells a side, linear law."""
    box = _box(element, n)
    load = box.load(linear_force(box.places))
    u = loaded(box.space, box.constraint, load, moduli=[1.0], dilatation=dilatation)
    return box.errors(u.reshape(-1, 3), SMALL)


def neo_hookean_errors(element: str, dilatation: Dilatation, n: int) -> Array:
    """Errors (2,) of u (mm) and of grad u (dimensionless) in the L2 norm on n cells a side, neo-Hookean law."""
    box = _box(element, n)
    loads = (DeadLoad(box.load(finite_force(box.places))),)
    model = finite_strain_model(box.space, box.constraint, LAW, dilatation=dilatation, loads=loads)
    return box.errors(model.solve(np.ones(1), np.zeros(0)).displacement, LARGE)


def observed_orders(coarse: Array, fine: Array) -> Array:
    """Orders log2(e_coarse / e_fine) (n,), dimensionless, of errors (n,) on a mesh and one of half the edge length."""
    return np.asarray(np.log2(coarse / fine))


def _order_checks(errors: Callable[[str, Dilatation, int], Array], cells: dict[str, int]) -> tuple[Check, ...]:
    """cells: along a side, by element; and then twice as many."""
    checks = []
    for element, orders in (("P1", (2.0, 1.0)), ("P2", (3.0, 2.0))):
        n = cells[element]
        observed = observed_orders(*(errors(element, Dilatation.POINTWISE, m) for m in (n, 2 * n)))
        for what, expected, value in zip(("u", "grad u"), orders, map(float, observed), strict=True):
            name = f"order of {what}, {element}"
            checks.append(Check(name, expected, value, 100.0 * TOLERANCE, order=value, scale=1.0))
    return tuple(checks)


MANUFACTURED_PROBLEMS = (
    Problem(
        "B16a",
        "Manufactured solution, linear law: observed orders",
        "theory of finite elements",
        lambda: _order_checks(linear_errors, {"P1": 8, "P2": 4}),
    ),
    Problem(
        "B16b",
        "Manufactured solution, neo-Hookean law: observed orders",
        "theory of finite elements",
        lambda: _order_checks(neo_hookean_errors, {"P1": 8, "P2": 5}),
        quick=False,
    ),
)
