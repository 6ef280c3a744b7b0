"""B11, B12, B13: inflation of thick spheres, in one layer and in two, and of a thick tube; incompressible.

Sphere: P = sum over layers of mu (g(l_out) - g(l_in)), g(l) = 2 / l + 1 / (2 l^4), for b^3 = B^3 + a^3 - A^3 and
l = b / B (Green & Zerna, Theoretical Elasticity, 1968, section 3.10, integrated). Tube in plane strain:
P = mu (ln(la / lb) + (lb^-2 - la^-2) / 2). The wall is moved; its pressure is the work of its forces over the volume
that it sweeps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics import FiniteStrainModel, Law, finite_strain_model, law_named, pressure
from palpate.mesh import LagrangeSpace, TetMesh, lagrange_space
from palpate_validation.conditions import held_components
from palpate_validation.problems.contract import Check, Problem, checked
from palpate_validation.structured_meshes import known, octant_mesh, quarter_ring_mesh

__all__ = ["BALLOON", "INFLATION_PROBLEMS", "NU", "bore_of", "inflated_model", "wall_pressures", "youngs"]

Array = NDArray[np.float64]

NU = 0.4999
TOLERANCE = 1.0
NEO = law_named("neo-hookean")
MOONEY = law_named("mooney-rivlin", c01_over_c10=0.25)

# stretch of the bore: pressure in kPa; A = 10, B = 20 mm, mu = 10 kPa (Mooney-Rivlin: c10 = 4, c01 = 1 kPa)
BALLOON = {
    "neo-hookean": {1.05: 1.580814, 1.1: 2.871548, 1.2: 4.801598, 1.5: 7.554331, 2.0: 8.069266},
    "mooney-rivlin": {1.1: 2.936591, 1.2: 5.021742, 1.5: 8.474268, 2.0: 10.338302},
}
TWO_LAYERS = {1.001: 0.048628, 1.1: 4.209372, 1.2: 7.374801, 1.5: 12.899483}  # radii 10, 15, 20 mm, mu = 10, 30 kPa
TUBE = {1.1: 1.315623, 1.2: 2.333698, 1.5: 4.282284}  # A = 10, B = 20 mm, mu = 10 kPa
LIMIT = (0.063557, 1.4058)  # of the thin shell A = 0.95, B = 1 mm, mu = 1 kPa: pressure (kPa) and stretch


def youngs(model: FiniteStrainModel, mu: Sequence[float]) -> Array:
    """Young's moduli (n_regions,) of shear moduli mu (n_regions,), kPa."""
    return 2.0 * np.asarray(mu, dtype=float) * (1.0 + model.poisson_ratios)


def bore_of(mesh: TetMesh, radius: float, axes: int = 3) -> NDArray[np.int64]:
    """Boundary faces (n, 3) at `radius` mm from the centre, or for two axes from the tube's."""
    distance = np.linalg.norm(mesh.nodes[:, :axes], axis=1)
    return mesh.boundary[np.all(distance[mesh.boundary] < 1.03 * radius, axis=1)]


def inflated_model(space: LagrangeSpace, bore: NDArray[np.int64], law: Law, *, axes: int = 3) -> FiniteStrainModel:
    """The flat sides slide; a unit of the one mode moves the bore (n_faces, 3) outwards by its own radius, mm."""
    points = np.unique(space.facets(bore))
    outwards = space.points[points].copy()
    outwards[:, axes:] = 0.0
    held = np.abs(space.points) < 1e-9
    held[points, :axes] = True
    held[:, axes:] = True
    modes = np.zeros(space.points.shape)
    modes[points] = outwards
    return finite_strain_model(space, held_components(held, 0.0 * modes, modes), law)


def wall_pressures(
    mesh: TetMesh, law: Law, *, moduli: Sequence[float], stretches: Sequence[float], radius: float = 10.0, axes: int = 3
) -> Array:
    """Pressures (n,) kPa on the bore when its wall has been moved outwards by each of the stretches (n,).

    moduli: shear moduli (n_regions,) kPa; radius: of the bore, mm.
    """
    space = lagrange_space(mesh, "P2")
    bore = bore_of(mesh, radius, axes)
    model = inflated_model(space, bore, law, axes=axes)
    mode = model.constraint.modes[:, 0]
    unit, found, start = pressure(space, bore, 1.0), [], None
    for stretch in stretches:
        equilibrium = model.solve(youngs(model, moduli), np.array([stretch - 1.0]), start=start)
        start = equilibrium.displacement
        work = equilibrium.balance.residual(equilibrium.values)[0] @ mode
        found.append(work / (unit.forces(start) @ mode))
    return np.array(found)


def _pressure_checks(
    table: dict[float, float], mesh: TetMesh, moduli: Sequence[float], law: Law = NEO, *, axes: int = 3
) -> tuple[Check, ...]:
    found = wall_pressures(mesh, law, moduli=moduli, stretches=list(table), axes=axes)
    return checked({f"pressure at the stretch {s:g} (kPa)": p for s, p in table.items()}, found, TOLERANCE)


def _balloon_checks(law: Law) -> tuple[Check, ...]:
    mesh = octant_mesh(np.array([10.0, 20.0]), [4], 6, [known("shell", nu=NU)])
    return _pressure_checks(BALLOON[law.name], mesh, [10.0], law)


def _limit_checks() -> tuple[Check, ...]:
    """The wall's motion is given, so the way passes the largest pressure; a cubic through the last places finds it."""
    mesh = octant_mesh(np.array([0.95, 1.0]), [1], 12, [known("shell", nu=0.499)])
    stretches = np.arange(1.04, 1.49, 0.04)
    found = wall_pressures(mesh, NEO, moduli=[1.0], stretches=stretches.tolist(), radius=0.95)
    cubic = np.polynomial.Polynomial.fit(stretches[-5:], found[-5:], 3)
    fine = np.linspace(stretches[-5], stretches[-1], 2001)
    top = float(fine[cubic(fine).argmax()])
    return (
        Check("largest pressure (kPa)", LIMIT[0], float(cubic(fine).max()), TOLERANCE),
        Check("stretch there", LIMIT[1], top, TOLERANCE),
    )


GREEN = "closed form (Green & Zerna 1968, section 3.10)"
INFLATION_PROBLEMS = (
    Problem("B11a", "Thick neo-Hookean balloon", GREEN, lambda: _balloon_checks(NEO)),
    Problem("B11b", "Thick Mooney-Rivlin balloon", GREEN, lambda: _balloon_checks(MOONEY), quick=False),
    Problem("B11c", "Limit point of a thin balloon", GREEN, _limit_checks, quick=False),
    Problem(
        "B12",
        "Neo-Hookean balloon of two layers",
        f"{GREEN}, summed over the layers",
        lambda: _pressure_checks(
            TWO_LAYERS,
            octant_mesh(np.array([10.0, 15.0, 20.0]), [2, 2], 6, [known("inner", nu=NU), known("outer", nu=NU)]),
            [10.0, 30.0],
        ),
    ),
    Problem(
        "B13",
        "Thick neo-Hookean tube in plane strain",
        "closed form, two routes",
        lambda: _pressure_checks(TUBE, quarter_ring_mesh(10.0, 20.0, 4, 6, known("tube", nu=NU)), [10.0], axes=2),
    ),
)
