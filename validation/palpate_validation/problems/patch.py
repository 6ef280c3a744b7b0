"""B0: patch tests, rigid motions and the failure of the linear law under large rotations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics import (
    LAWS,
    Dilatation,
    FiniteStrainModel,
    Law,
    LinearModel,
    finite_strain_model,
    linear_model,
    outer_constraint,
)
from palpate.mesh import LagrangeSpace, lagrange_space
from palpate_validation.conditions import all_prescribed
from palpate_validation.problems.contract import Check, Problem
from palpate_validation.structured_meshes import box_mesh, known

__all__ = ["GRADIENT", "PATCH_PROBLEMS", "affine_error", "finite_affine_error", "moved", "rotation", "rotation_effect"]

Array = NDArray[np.float64]

GRADIENT = np.array([[0.02, -0.01, 0.03], [0.015, -0.03, 0.005], [-0.02, 0.01, 0.04]])
EXACT = 1e-8  # per cent: the round-off of 1e-10
FINITE_EXACT = 1e-6  # per cent: what Newton's iteration leaves
SOURCE = "exact, to round-off"


def distorted(element: str, *, n: int, size: float, nu: float = 0.3) -> LagrangeSpace:
    """A box of `size` mm with n cells a side, inner nodes moved by a quarter of a cell."""
    return lagrange_space(box_mesh(n, size=size, distortion=0.25, tissues=[known("block", nu=nu)]), element)


def moved(space: LagrangeSpace, displacement: Array) -> LinearModel:
    """The linear model whose boundary moves by `displacement` (n_points, 3) mm."""
    return linear_model(space, outer_constraint(space, outer="free", **all_prescribed(space, displacement)))


def rotation(degrees: float) -> Array:
    """Rotation (3, 3), dimensionless, about y."""
    angle = np.deg2rad(degrees)
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def affine_error(element: str, nu: float) -> float:
    """Largest error of an affine displacement that is prescribed on the boundary, over its largest value."""
    space = distorted(element, n=4, size=40.0, nu=nu)
    exact = space.points @ GRADIENT.T + 1.0
    found = moved(space, exact).solve(np.array([3.0]), np.zeros(0)).displacement
    return float(abs(found - exact).max() / abs(exact).max())


def finite_affine_error(law: Law, dilatation: Dilatation) -> float:
    """The same at finite strain, with ten times the gradient."""
    space = distorted("P2", n=3, size=30.0, nu=0.49)
    exact = 10.0 * space.points @ GRADIENT.T
    constraint = outer_constraint(space, outer="free", **all_prescribed(space, exact))
    model = finite_strain_model(space, constraint, law, dilatation=dilatation)
    found = model.solve(np.array([3.0]), np.zeros(0)).displacement
    return float(abs(found - exact).max() / abs(exact).max())


def held_block(law: Law) -> FiniteStrainModel:
    """A distorted block of 10 mm whose boundary is prescribed."""
    space = distorted("P2", n=2, size=10.0)
    constraint = outer_constraint(space, outer="fixed", **all_prescribed(space, np.zeros_like(space.points)))
    return finite_strain_model(space, constraint, law)


def rotation_effect(law: Law, degrees: float) -> tuple[float, float]:
    """What a superposed rotation adds: to the forces (over their size) and to the energy (over itself)."""
    model, turn = held_block(law), rotation(degrees)
    points, moduli = model.space.points, np.array([3.0])
    strained = 5.0 * points @ GRADIENT.T + 0.05 * np.sin(points)
    turned = (points + strained) @ turn.T - points
    balance, constants = model.balance(moduli), model.moduli_of(moduli)
    forces, size = balance.residual(strained.ravel())
    after, _ = balance.residual(turned.ravel())
    extra = abs(after.reshape(-1, 3) - forces.reshape(-1, 3) @ turn.T).max() / size
    energies = [model.elements.energy(u, constants) for u in (strained, turned)]
    return float(extra), float(abs(energies[1] / energies[0] - 1.0))


def translation_forces() -> float:
    """Largest nodal force of a rigid translation by 1 mm, over the largest entry of the stiffness."""
    space = distorted("P2", n=3, size=30.0)
    model = moved(space, np.ones_like(space.points))
    u = model.solve(np.array([5.0]), np.zeros(0)).values[:, None]
    return float(abs(model.forces(np.array([5.0]), u)).max() / (5.0 * abs(model.stiffness[0]).max()))


def rotation_energy(degrees: float) -> float:
    """Energy density (kPa) that the linear law gives to a rotation, at E = 1 kPa and nu = 0.3."""
    space = lagrange_space(box_mesh(2, size=10.0), "P2")
    model = moved(space, space.points @ (rotation(degrees) - np.eye(3)).T)
    u = model.solve(np.array([1.0]), np.zeros(0)).values
    return float(0.5 * u @ model.forces(np.array([1.0]), u[:, None])[:, 0] / 1000.0)


def _zero(quantity: str, value: float, tolerance: float) -> Check:
    return Check(quantity, 0.0, value, tolerance, scale=1.0)


def _patch_checks() -> tuple[Check, ...]:
    small = [
        _zero(f"largest relative error, {element}, nu = {nu:g}, small strain", affine_error(element, nu), EXACT)
        for element in ("P1", "P2")
        for nu in (0.3, 0.49)
    ]
    finite = [
        _zero(f"largest relative error, {name}, finite strain", finite_affine_error(LAWS[name], d), FINITE_EXACT)
        for name, d in (("neo-hookean", Dilatation.BLENDED), ("mooney-rivlin", Dilatation.MEAN))
    ]
    return (*small, *finite)


def _rotation_checks() -> tuple[Check, ...]:
    checks = []
    for name in ("neo-hookean", "mooney-rivlin"):
        for degrees in (30.0, 90.0):
            force, energy = rotation_effect(LAWS[name], degrees)
            checks.append(_zero(f"added force, {name}, {degrees:g} degrees", force, EXACT))
            checks.append(_zero(f"added energy, {name}, {degrees:g} degrees", energy, EXACT))
    return tuple(checks)


def _linear_rotation_checks() -> tuple[Check, ...]:
    """In its plane a turn by 30 degrees counts as the strain cos 30 - 1."""
    strain, nu = np.cos(np.deg2rad(30.0)) - 1.0, 0.3
    lame, mu = nu / ((1 + nu) * (1 - 2 * nu)), 1 / (2 * (1 + nu))
    density = float(0.5 * lame * (2 * strain) ** 2 + mu * 2 * strain**2)
    return (Check("false energy density of the linear law, 30 degrees (kPa)", density, rotation_energy(30.0), EXACT),)


PATCH_PROBLEMS = (
    Problem("B0a", "Patch test on a distorted mesh", SOURCE, _patch_checks),
    Problem("B0b", "A superposed rotation adds no stress", SOURCE, _rotation_checks),
    Problem(
        "B0c",
        "A rigid translation needs no force",
        SOURCE,
        lambda: (_zero("largest relative force", translation_forces(), EXACT),),
    ),
    Problem("B0d", "The linear law takes a rotation for strain (documented failure)", SOURCE, _linear_rotation_checks),
)
