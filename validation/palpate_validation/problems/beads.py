"""M1: a measured body. Beads in a hydrogel, moved by a ball that is pressed into it (Yang et al. 2022).

The beads near the surface of a box in the gel prescribe its motion (a local quadratic fit at each point of the mesh's
boundary); those deeper inside are predicted. Neither modulus nor force is known, and one modulus cancels: this checks
the motion and finds the Poisson's ratio that predicts it best. Lengths in micrometres.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.mechanics import LAWS, Dilatation, finite_strain_model, linear_model, outer_constraint
from palpate.mesh import LagrangeSpace, lagrange_space, located, point_interpolation
from palpate_validation.conditions import all_prescribed
from palpate_validation.problems.contract import Check, Problem
from palpate_validation.structured_meshes import box_mesh, known, make_mesh

__all__ = ["BEADS_PROBLEMS", "Beads", "best_poisson_ratio", "prediction_errors", "read_beads"]

Array = NDArray[np.float64]

DATA = Path(__file__).parents[1] / "data" / "gel_beads.npz"
LOW, HIGH = np.array([60.0, 60.0, 16.0]), np.array([350.0, 350.0, 68.0])  # the box
CELLS = (14, 14, 4)
SHELL = 8.0  # beads nearer to the box's surface prescribe its motion; the motion of the others is predicted
NEIGHBOURS = 24  # in the local fit
SCATTER, WIDE_SCATTER = 0.13, 0.43  # of the beads about a local affine fit: median and 95th percentile
RATIOS = (0.44, 0.46, 0.47, 0.48, 0.49)
TOLERANCE = 100.0 * (WIDE_SCATTER / SCATTER - 1.0)  # per cent; chosen to hold, see the head of verification.md


@dataclass(frozen=True, slots=True)
class Beads:
    """Places at rest (n, 3) and motions (n, 3), micrometres; `inside` (n,) marks those to predict."""

    rest: Array
    motion: Array
    inside: NDArray[np.bool_]


def read_beads() -> Beads:
    """The measured beads of the box and around it."""
    with np.load(DATA) as file:
        rest, motion = file["rest_hundredths_um"] / 100.0, file["motion_thousandths_um"] / 1000.0
    return Beads(rest, motion, np.minimum(rest - LOW, HIGH - rest).min(axis=1) > SHELL)


def gel_space(nu: float) -> LagrangeSpace:
    """Quadratic tetrahedra on the box, 14 x 14 x 4 cells."""
    unit = box_mesh(CELLS)
    nodes = LOW + unit.nodes * (HIGH - LOW)
    return lagrange_space(make_mesh(nodes, unit.tets, unit.region, [known("gel", nu=nu)]), "P2")


def boundary_motion(space: LagrangeSpace, beads: Beads) -> Array:
    """Motion (n_points, 3) um of the points on the box's surface by the beads around; zero elsewhere."""
    rest, motion = beads.rest[~beads.inside], beads.motion[~beads.inside]
    points = np.unique(space.facets(space.mesh.boundary))
    result = np.zeros_like(space.points)
    near = np.asarray(cKDTree(rest).query(space.points[points], k=NEIGHBOURS)[1])
    for point, chosen in zip(points, near, strict=True):
        a = rest[chosen] - space.points[point]
        distance = np.linalg.norm(a, axis=1)
        products = [a[:, i] * a[:, j] for i in range(3) for j in range(i + 1)]
        basis = np.column_stack([np.ones(NEIGHBOURS), a, *products])
        weight = np.exp(-0.5 * (distance / (0.6 * distance.max())) ** 2)[:, None]
        result[point] = np.linalg.lstsq(basis * weight, motion[chosen] * weight)[0][0]
    return result


def prediction_errors(beads: Beads, law: str, nu: float) -> Array:
    """Distances (n_inside,) um between predicted and measured motion of the beads inside, under one law."""
    space = gel_space(nu)
    given = all_prescribed(space, boundary_motion(space, beads))
    constraint = outer_constraint(space, outer="free", **given)
    linear = linear_model(space, constraint, dilatation=Dilatation.BLENDED).solve(np.ones(1), np.zeros(0)).displacement
    if law != "linear":
        model = finite_strain_model(space, constraint, LAWS[law])
        linear = model.solve(np.ones(1), np.zeros(0), start=linear).displacement
    predicted = point_interpolation(space, located(space.mesh, beads.rest[beads.inside])) @ linear
    return np.asarray(np.linalg.norm(predicted - beads.motion[beads.inside], axis=1))


def best_poisson_ratio(beads: Beads, law: str) -> tuple[float, float]:
    """The Poisson's ratio with the smallest mean error, and the median error (um) of the best of five ratios.

    A parabola through the best of the five and its neighbours gives the ratio.
    """
    errors = [prediction_errors(beads, law, nu) for nu in RATIOS]
    means = np.array([error.mean() for error in errors])
    k = int(np.clip(means.argmin(), 1, len(RATIOS) - 2))
    parabola = np.polynomial.Polynomial.fit(RATIOS[k - 1 : k + 2], means[k - 1 : k + 2], 2)
    best = float(np.clip(parabola.deriv().roots()[0], RATIOS[k - 1], RATIOS[k + 1]))
    return best, float(np.median(errors[int(means.argmin())]))


def _checks(law: str) -> tuple[Check, ...]:
    best, error = best_poisson_ratio(read_beads(), law)
    return (
        Check(f"median error of the beads inside, {law} (um)", SCATTER, error, TOLERANCE),
        Check(f"Poisson's ratio that fits best, {law}", 0.475, best, 5.3),
    )


MEASURED = "measured: Yang et al. 2022 (scatter of the beads 0.13 um; gels 0.45 to 0.5); tolerances our own"
BEADS_PROBLEMS = (
    Problem("M1a", "Beads in an indented gel, linear law", MEASURED, lambda: _checks("linear"), quick=False),
    Problem("M1b", "Beads in an indented gel, neo-Hookean law", MEASURED, lambda: _checks("neo-hookean"), quick=False),
)
