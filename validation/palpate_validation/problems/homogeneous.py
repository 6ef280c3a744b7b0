"""B9 and B10: homogeneous finite strain of incompressible blocks.

With mu = 2 (c1 + c2): uniaxial Cauchy stress 2 (l^2 - 1/l)(c1 + c2 / l), equibiaxial 2 (l^2 - l^-4)(c1 + c2 l^2)
(Ogden, Non-linear Elastic Deformations, 1984, section 4.3; the table is these formulas). Plane strain, F a unit face:
2 w (2 + w)(1 + (1 + w)^2) / (1 + w)^3 (c10 + c01) (Code_Aster V6.04.187, without its third coefficient).
"""

from __future__ import annotations

import numpy as np

from palpate.mechanics import Law, finite_strain_model, lame_parameters, law_named, stress
from palpate.mesh import lagrange_space
from palpate_validation.conditions import held_components
from palpate_validation.problems.contract import Check, Problem, checked
from palpate_validation.structured_meshes import box_mesh, known

__all__ = ["HOMOGENEOUS_PROBLEMS", "nominal_stress"]

NU, MU = 0.4999, 10.0
E = 2.0 * MU * (1.0 + NU)
NEO = law_named("neo-hookean")
MOONEY = law_named("mooney-rivlin", c01_over_c10=0.25)
TOLERANCE = 0.1

# stretch: neo-Hookean mu = 10 kPa uniaxial nominal, equibiaxial Cauchy; Mooney-Rivlin c10 = 4, c01 = 1 kPa likewise
TABLE = {
    0.8: (-7.62500, -18.01406, -8.00625, -16.71705),
    1.2: (5.05556, 9.57747, 4.88704, 10.42029),
    1.5: (10.55556, 20.52469, 9.85185, 25.65586),
    2.0: (17.50000, 39.37500, 15.75000, 63.00000),
}
PLANE_STRAIN = {-0.1: -4.717421, -0.2: -11.531250, -0.3: -22.154519}


def nominal_stress(law: Law, stretches: tuple[float | None, float | None, float | None]) -> float:
    """Force a unit face of rest (kPa) along z of a unit cube; `stretches` along x, y, z, None for a free direction."""
    space = lagrange_space(box_mesh(1, tissues=[known("block", nu=NU)]), "P2")
    held, values = np.zeros(space.points.shape, dtype=bool), np.zeros_like(space.points)
    for axis, stretch in enumerate(stretches):
        low, high = space.points[:, axis] < 1e-9, space.points[:, axis] > 1.0 - 1e-9
        held[low, axis] = True
        if stretch is not None:
            held[high, axis], values[high, axis] = True, stretch - 1.0
    model = finite_strain_model(space, held_components(held, values), law)
    equilibrium = model.solve(np.array([E]), np.zeros(0))
    forces = equilibrium.balance.residual(equilibrium.values)[0].reshape(-1, 3)
    return float(forces[space.points[:, 2] > 1.0 - 1e-9, 2].sum())


def _stretch_checks(*, equibiaxial: bool) -> tuple[Check, ...]:
    checks = []
    for stretch, row in TABLE.items():
        for law, (uniaxial, biaxial) in ((NEO, row[:2]), (MOONEY, row[2:])):
            name = f"stress, {law.name}, stretch {stretch:g} (kPa)"
            if equibiaxial:  # nominal times stretch is Cauchy
                found = stretch * nominal_stress(law, (stretch, None, stretch))
                checks.append(Check(f"Cauchy {name}", biaxial, found, TOLERANCE))
            else:
                checks.append(Check(f"nominal {name}", uniaxial, nominal_stress(law, (None, None, stretch)), TOLERANCE))
    return tuple(checks)


def _shear_checks() -> tuple[Check, ...]:
    """s12 = mu g and s11 - s22 = mu g^2, exactly: the volume does not change."""
    lame, mu = lame_parameters(E, NU)
    checks = []
    for law in (NEO, MOONEY):
        for shear in (0.2, 1.0):
            F = np.eye(3)
            F[0, 1] = shear
            cauchy = stress(law, F[None], mu=mu, lame=lame)[0] @ F.T
            difference = float(cauchy[0, 0] - cauchy[1, 1])
            name = f"{law.name}, shear {shear:g} (kPa)"
            checks.append(Check(f"s12, {name}", MU * shear, float(cauchy[0, 1]), TOLERANCE))
            checks.append(Check(f"s11 - s22, {name}", MU * shear**2, difference, TOLERANCE))
    return tuple(checks)


OGDEN = "closed form (Ogden 1984, section 4.3)"
HOMOGENEOUS_PROBLEMS = (
    Problem("B9a", "Uniaxial stretch", OGDEN, lambda: _stretch_checks(equibiaxial=False)),
    Problem("B9b", "Equibiaxial stretch", OGDEN, lambda: _stretch_checks(equibiaxial=True)),
    Problem("B9c", "Simple shear", OGDEN, _shear_checks),
    Problem(
        "B10",
        "Plane-strain compression, Mooney-Rivlin",
        "Code_Aster V6.04.187; closed form",
        lambda: checked(
            {f"nominal stress, w = {w:g} (kPa)": value for w, value in PLANE_STRAIN.items()},
            (nominal_stress(MOONEY, (1.0, None, 1.0 + w)) for w in PLANE_STRAIN),
            0.5,
        ),
    ),
)
