"""B5 and B6: a sphere in a large matrix (Eshelby), and a spherical cavity under remote tension (Southwell & Gough).

Eshelby 1957: the inclusion's strain over the far one is 1 / (1 + alpha (K_i / K_m - 1)) for a change of volume, with
alpha = (1 + nu) / (3 (1 - nu)), and 1 / (1 + beta (G_i / G_m - 1)) for a change of shape, with
beta = 2 (4 - 5 nu) / (15 (1 - nu)). Cavity: largest stress over the remote one (27 - 15 nu) / (2 (7 - 5 nu))
(Timoshenko & Goodier 1970, article 137).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.mechanics import LinearModel, lame_parameters, linear_model, outer_constraint
from palpate.mesh import lagrange_space, triangle_normals
from palpate_validation.conditions import loaded, nodal_gradients, prescribe, sliding_sides, sphere_faces
from palpate_validation.problems.contract import Check, Problem, checked
from palpate_validation.structured_meshes import VOID, known, octant_mesh

__all__ = ["INCLUSION_PROBLEMS", "ball_in_matrix", "cavity_stress", "strain_factors"]

Array = NDArray[np.float64]

TOLERANCE = 2.0
VOLUMETRIC, DEVIATORIC = np.eye(3), np.diag([1.0, -0.5, -0.5])
CAVITY = np.array([1.0, 1.3, 1.8, 3.0, 6.0, 20.0])  # radii of the layers around the cavity, of its own
ESHELBY = {  # nu, E_i / E_m: volumetric and deviatoric factor
    (0.3, 2.0): (0.61765, 0.67742),
    (0.3, 5.0): (0.28767, 0.34426),
    (0.3, 10.0): (0.15217, 0.18919),
    (0.3, 100.0): (0.01606, 0.02077),
    (0.45, 10.0): (0.11224, 0.20755),
}


def ball_in_matrix(nu: float) -> LinearModel:
    """Unit ball in a matrix of thirty radii (ten are 2 % off); modes: a volumetric and a deviatoric far field."""
    tissues = [known("inclusion", nu=nu), *[known("matrix", nu=nu)] * 4]
    radii = np.array([0.4, 1.0, 2.0, 4.0, 10.0, 30.0])
    layered = octant_mesh(radii, [2, 4, 3, 3, 3], 8, tissues, solid=True)
    mesh = replace(
        layered,
        region=np.array([0, 0, 1, 1, 1])[layered.region],
        tissues=(*tissues[:2], VOID),
        beyond=np.minimum(layered.beyond, 2),
    )
    space = lagrange_space(mesh, "P2")
    points = np.unique(space.facets(mesh.boundary[mesh.beyond == 2]))
    modes = np.stack([space.points[points] @ strain for strain in (VOLUMETRIC, DEVIATORIC)], axis=2)
    given = prescribe(space, points, np.zeros((len(points), 3)), modes)
    return linear_model(space, outer_constraint(space, outer="sliding", **given))


def strain_factors(model: LinearModel, contrast: float) -> Array:
    """Strain of the inclusion along x over the far strain (2,), dimensionless, of both modes; contrast: E_i / E_m."""
    responses = model.responses(np.array([contrast, 1.0]))
    points = model.space.points
    inside = np.flatnonzero((np.linalg.norm(points, axis=1) < 0.9) & (points[:, 0] > 0.1))
    return np.asarray(np.mean(responses[3 * inside, :2] / points[inside, :1], axis=0))


def cavity_stress(nu: float) -> float:
    """Largest tension along z, over the remote one, at the equator of a cavity in a ball of twenty radii."""
    mesh = octant_mesh(CAVITY, [4, 3, 3, 3, 3], 12, [known(f"layer {i}", nu=nu) for i in range(5)])
    space = lagrange_space(mesh, "P2")
    # nodal forces of the traction n_z e_z on the outer sphere, by the means of quadratic shape functions
    faces = sphere_faces(space.mesh, float(CAVITY[-1]))
    normals = triangle_normals(space.mesh.nodes, faces)
    forces = np.zeros((len(space.points), 3))
    for column in space.facets(faces).T[3:]:
        np.add.at(forces[:, 2], column, normals[:, 2] / 3.0)
    u = loaded(space, sliding_sides(space), np.asarray(forces.ravel()), moduli=np.ones(5))
    distance = np.linalg.norm(mesh.nodes, axis=1)
    equator = np.flatnonzero((distance < 1.05) & (np.abs(mesh.nodes[:, 2]) < 1e-9))
    gradient = nodal_gradients(space, u.reshape(-1, 3), equator)
    lame, mu = lame_parameters(1.0, nu)
    return float(np.mean(lame * np.einsum("nii->n", gradient) + 2.0 * mu * gradient[:, 2, 2]))


def _eshelby_checks(nu: float) -> tuple[Check, ...]:
    model, checks = ball_in_matrix(nu), list[Check]()
    for contrast, expected in ((contrast, of) for (ratio, contrast), of in ESHELBY.items() if ratio == nu):
        kinds = zip(("volumetric", "deviatoric"), expected, strict=True)
        references = {f"{kind} factor, nu = {nu:g}, contrast {contrast:g}": factor for kind, factor in kinds}
        checks += checked(references, strain_factors(model, contrast), TOLERANCE)
    return tuple(checks)


def _cavity_checks(nu: float, reference: float) -> tuple[Check, ...]:
    return (Check(f"peak stress over the remote one, nu = {nu:g}", reference, cavity_stress(nu), TOLERANCE),)


INCLUSION_PROBLEMS = (
    Problem("B5a", "Eshelby's sphere in a large matrix", "Eshelby 1957", lambda: _eshelby_checks(0.3)),
    Problem(
        "B5b", "Eshelby's sphere, nearly incompressible", "Eshelby 1957", lambda: _eshelby_checks(0.45), quick=False
    ),
    Problem("B6a", "Spherical cavity under tension", "Southwell & Gough 1926", lambda: _cavity_checks(0.3, 2.04545)),
    Problem(
        "B6b",
        "Spherical cavity under tension, nearly incompressible",
        "Southwell & Gough 1926",
        lambda: _cavity_checks(0.45, 2.13158),
        quick=False,
    ),
)
