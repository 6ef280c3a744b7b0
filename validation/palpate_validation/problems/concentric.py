"""B4: concentric organs under prescribed displacements, with their log-sensitivities (the paper's experiment I, exact).

Each layer moves by u = A r + B / r^2, with continuous u and radial stress (Timoshenko & Goodier 1970, article 136).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics import LinearModel, linear_model, outer_constraint
from palpate.mesh import lagrange_space
from palpate_validation.conditions import mean_radial, prescribe
from palpate_validation.problems.contract import Check, Problem, checked
from palpate_validation.structured_meshes import known, octant_mesh

__all__ = ["CONCENTRIC_PROBLEMS", "SENSITIVITIES", "hollow_spheres", "radial", "solid_spheres"]

Array = NDArray[np.float64]
Motions = dict[tuple[float, ...], tuple[float, float]]  # of moduli (kPa): at 10 and 20 mm, mm

SOURCE = "closed form u = A r + B / r^2 in each layer"
TISSUES = ("core", "middle", "outer")
RISING = np.array([50.0, 100.0, 150.0])  # kPa
SENSITIVITIES = np.array([[0.36443, -0.30645, -0.05798], [0.05522, 0.02853, -0.08376]])  # d u / d ln E, mm
HOLLOW: Motions = {(50.0, 100.0, 150.0): (0.193361, 0.029300), (150.0, 100.0, 50.0): (0.265434, 0.061048)}  # kPa: u, mm
SOLID: Motions = {
    (50.0, 100.0, 150.0): (-0.645299, -0.851437),
    (100.0, 200.0, 300.0): (-0.645299, -0.851437),
    (77.0, 77.0, 77.0): (-1 / 3, -2 / 3),
}


def hollow_spheres(n_surface: int = 8) -> LinearModel:
    """Radii 5, 10, 20, 30 mm, nu = 0.4; u(5) = 1 mm as a mode, u(30) = 0."""
    tissues = [known(name, nu=0.4) for name in TISSUES]
    mesh = octant_mesh(np.array([5.0, 10.0, 20.0, 30.0]), [n_surface // 2] * 2 + [n_surface // 4], n_surface, tissues)
    space = lagrange_space(mesh, "P2")
    points = np.unique(space.facets(mesh.boundary[mesh.beyond != -1]))
    inner = np.linalg.norm(space.points[points], axis=1) < 7.0
    mode = np.where(inner[:, None], space.points[points] / 5.0, 0.0)[:, :, None]
    given = prescribe(space, points, np.zeros((len(points), 3)), mode)
    return linear_model(space, outer_constraint(space, outer="sliding", **given))


def solid_spheres() -> LinearModel:
    """Radii 10, 20, 30 mm, nu = 0.4; u(30) = -1 mm."""
    tissues = [known(name, nu=0.4) for name in TISSUES]
    mesh = octant_mesh(np.array([2.5, 10.0, 20.0, 30.0]), [3, 4, 4], 8, tissues, solid=True)
    space = lagrange_space(mesh, "P2")
    points = np.unique(space.facets(mesh.boundary[mesh.beyond != -1]))
    given = prescribe(space, points, -space.points[points] / 30.0)
    return linear_model(space, outer_constraint(space, outer="sliding", **given))


def radial(model: LinearModel) -> Array:
    """Matrix (2, n_dof) from a displacement to its mean radial part at the radii 10 and 20 mm."""
    return np.stack([mean_radial(model.space, radius) for radius in (10.0, 20.0)])


def _radial_checks(model: LinearModel, cases: Motions) -> tuple[Check, ...]:
    """cases: moduli (kPa) and the motions (mm) at 10 and 20 mm that they give, a unit of every mode."""
    observe, checks = radial(model), list[Check]()
    for moduli, expected in cases.items():
        references = {f"u({r} mm), E = {list(moduli)} kPa (mm)": u for r, u in zip((10, 20), expected, strict=True)}
        checks += checked(references, observe @ model.solve(np.array(moduli), np.ones(model.n_modes)).values, 0.5)
    return tuple(checks)


def _sensitivity_checks() -> tuple[Check, ...]:
    model = hollow_spheres(12)
    tangent = radial(model) @ model.solve(RISING, np.array([5.0])).tangent()[:, :3]
    largest = np.abs(SENSITIVITIES).max(axis=1)
    return tuple(
        Check(
            f"d u({radius} mm) / d ln E of {name} (mm)",
            float(SENSITIVITIES[i, j]),
            float(tangent[i, j]),
            0.5,
            scale=size,
        )
        for i, (radius, size) in enumerate(zip((10, 20), map(float, largest), strict=True))
        for j, name in enumerate(TISSUES)
    )


CONCENTRIC_PROBLEMS = (
    Problem(
        "B4a", "Hollow concentric organs, the cavity grows", SOURCE, lambda: _radial_checks(hollow_spheres(12), HOLLOW)
    ),
    Problem(
        "B4b",
        "Solid concentric organs, squeezed: ratios, not the scale",
        SOURCE,
        lambda: _radial_checks(solid_spheres(), SOLID),
    ),
    Problem("B4c", "Log-sensitivities of the hollow organs (of the row's largest)", SOURCE, _sensitivity_checks),
)
