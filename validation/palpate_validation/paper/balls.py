"""Three concentric balls that a known traction pulls: the paper's first model, with a load that gives kPa.

No displacement is prescribed (six numbers hold the rigid motion, and are estimated), so the load alone sets the scale:
the traction t = S n of one constant stress S acts on the outside, all over. Under it a body of one modulus deforms by
the same strain everywhere, as in the paper, where all three regions are deformed alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.images import Role, Tissue, VoxelGrid
from palpate.mechanics import DeadLoad, barycentric_gradients, boundary_named, pressure, shape_derivatives
from palpate.mesh import Anatomy, Constraint, LagrangeSpace, lagrange_space, tetrahedralise
from palpate.phantoms import Complement, ball, centred_grid, grid_box, rotation_about

__all__ = [
    "AIR",
    "BODIES",
    "Balls",
    "balls_space",
    "balls_tissues",
    "floating",
    "mean_deformations",
    "pulled",
    "random_grid",
    "uniform_stress",
]

BODIES = ("sphere1", "sphere2", "sphere3")  # the innermost ball, and the two shells around it
AIR = "air"
POISSON_RATIO = 0.45  # the paper gives none for its spheres
PIN_PRIOR_MM = 5.0  # standard deviation of each of the six numbers that hold the rigid motion
MARGIN_MM = 9.0  # of the images around the outermost ball
AXIS = np.array([1.0, 0.0, 0.0])  # of the pull
STILL = np.zeros(3)


@dataclass(frozen=True, slots=True)
class Balls:
    """Radii of the three spheres, edges of the meshes and of a voxel, all mm.

    `edge_mm` is the edge of the mesh that inverts, `truth_edge_mm` that of the finer one which makes the data.
    """

    radii_mm: tuple[float, float, float] = (16.0, 32.0, 48.0)
    edge_mm: float = 8.0
    truth_edge_mm: float = 6.4
    voxel_mm: float = 1.0


def balls_tissues(moduli_kpa: tuple[float, ...]) -> tuple[Tissue, ...]:
    """The three bodies, with their true moduli (kPa), and the air around them."""
    bodies = [
        Tissue(name, Role.ESTIMATE, (label,), POISSON_RATIO, modulus)
        for label, (name, modulus) in enumerate(zip(BODIES, moduli_kpa, strict=True), start=1)
    ]
    return (*bodies, Tissue(AIR, Role.VOID, (len(BODIES) + 1,)))


def balls_space(balls: Balls, edge_mm: float, *, element: str = "P2") -> LagrangeSpace:
    """The space of `element` "P1" or "P2" on a mesh of the balls with that edge (mm); moduli of 100 kPa stand in."""
    inner, middle, outer = (ball(STILL, radius) for radius in balls.radii_mm)
    field = 2.0 * (balls.radii_mm[2] + MARGIN_MM)
    box = grid_box(centred_grid((field,) * 3, (1.0,) * 3))
    anatomy = Anatomy(balls_tissues((100.0,) * 3), (inner, middle, None, Complement(outer)), box)
    return lagrange_space(tetrahedralise(anatomy, edge_length_mm=edge_mm), element)


def random_grid(balls: Balls, rng: np.random.Generator) -> VoxelGrid:
    """A voxel grid around the balls, turned and shifted at random."""
    count = int(np.ceil(2.0 * (balls.radii_mm[2] + MARGIN_MM) / balls.voxel_mm))
    turn = rotation_about(rng.normal(size=3), rng.uniform(0.0, 90.0))
    affine = np.eye(4)
    affine[:3, :3] = balls.voxel_mm * turn
    affine[:3, 3] = -affine[:3, :3] @ (0.5 * (count - 1) + rng.uniform(-0.5, 0.5, 3))
    return VoxelGrid((count, count, count), affine)


def floating(space: LagrangeSpace) -> Constraint:
    """All displacements free but for a rigid motion, which six unknown components at three points hold.

    One point near the middle along x, y and z, one beside it on the x axis along y and z, one on the y axis along z:
    statically determinate, so that a load in equilibrium meets no resistance there.
    """
    reach = 0.6 * float(space.points[:, 0].max())
    places = np.array([[0.0, 0.0, 0.0], [reach, 0.0, 0.0], [0.0, reach, 0.0]])
    middle, aside, before = (int(np.argmin(np.linalg.norm(space.points - place, axis=1))) for place in places)
    pins = np.array([3 * middle, 3 * middle + 1, 3 * middle + 2, 3 * aside + 1, 3 * aside + 2, 3 * before + 2])
    n_dof = 3 * len(space.points)
    modes = np.zeros((n_dof, len(pins)))
    modes[pins, np.arange(len(pins))] = PIN_PRIOR_MM
    kept = np.setdiff1d(np.arange(n_dof), pins)
    free = sparse.csr_matrix((np.ones(len(kept)), (kept, np.arange(len(kept)))), shape=(n_dof, len(kept)))
    return Constraint(free, modes, np.zeros(n_dof))


def uniform_stress(space: LagrangeSpace, stress_kpa: NDArray[np.float64]) -> DeadLoad:
    """The dead load t = S n of a symmetric stress S (3, 3) kPa on the outside of the balls, n out of them.

    A closed surface under it is in equilibrium: the integrals of n and, for a symmetric S, of x cross S n vanish.
    """
    faces = boundary_named(space.mesh, AIR)
    normals = pressure(space, faces, -1.0, following=False).forces(np.zeros_like(space.points))
    return DeadLoad((normals.reshape(-1, 3) @ stress_kpa).ravel())


def pulled(space: LagrangeSpace, stress_kpa: float) -> DeadLoad:
    """A pull by `stress_kpa` along x."""
    return uniform_stress(space, stress_kpa * np.outer(AXIS, AXIS))


def mean_deformations(space: LagrangeSpace, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the largest |stretch - 1| over each body (n_bodies,), dimensionless, at u (n_points, 3) mm.

    The stretches are the singular values of F = I + grad u at the centres of the tetrahedra.
    """
    centre = np.full((1, 4), 0.25)
    gradients, _ = barycentric_gradients(space.mesh.nodes, space.mesh.tets)
    slopes = np.einsum("ak,nai->nik", shape_derivatives(space.order, centre)[0], displacement[space.cells])
    stretches = np.linalg.svd(np.eye(3) + slopes @ gradients, compute_uv=False)
    largest = np.abs(stretches - 1.0).max(axis=1)
    region, volumes = space.mesh.region, space.mesh.volumes
    return np.array([np.average(largest[region == r], weights=volumes[region == r]) for r in np.unique(region)])
