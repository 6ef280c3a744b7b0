"""A scene: a body with known moduli, imaged at rest and deformed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from palpate.errors import GeometryError
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.tissue import Role, Tissue
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.element import deformation_determinants
from palpate.mechanics.equilibrium import equilibrium
from palpate.mechanics.laws.contract import Law
from palpate.mechanics.linear_model import linear_model
from palpate.mesh.anatomy import Anatomy, Box
from palpate.mesh.space import LagrangeSpace, lagrange_space
from palpate.mesh.tet_mesh import OUTER, TetMesh
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.mesh.voxelise import Warp, voxelise
from palpate.phantoms.motion import WallMotion, smooth_field


@dataclass(frozen=True, slots=True)
class Noise:
    """Smooth noise of the imaged surfaces, drawn for each image: standard deviation of a component and length, mm."""

    surface_sd_mm: float
    correlation_length_mm: float


@dataclass(frozen=True, slots=True)
class BoundaryMotion:
    """How a body's boundary moves: `walls` by name of a hollow tissue, and the `border` of the body (None: held).

    A hollow tissue that has no entry in `walls` is held.
    """

    walls: Mapping[str, WallMotion] = field(default_factory=dict)
    border: WallMotion | None = None


@dataclass(frozen=True, slots=True)
class Scene:
    """A body with known moduli and its two images.

    `space` (P2) holds the mesh; its tissues' `youngs_modulus_kpa` are the truth. `displacement` (n_points, 3) mm.
    `before` and `after` show the rest state and the deformed state of that mesh, label = index of the tissue + 1.
    `motions`: how walls move, by name of the hollow tissue; a hollow tissue without an entry is held.
    """

    space: LagrangeSpace
    displacement: NDArray[np.float64]
    before: LabelImage
    after: LabelImage
    motions: Mapping[str, WallMotion]
    seed: int

    @property
    def mesh(self) -> TetMesh:
        """The truth mesh."""
        return self.space.mesh

    @property
    def tissues(self) -> tuple[Tissue, ...]:
        """The tissues, with their true moduli."""
        return self.space.mesh.tissues

    @property
    def moduli_kpa(self) -> dict[str, float]:
        """True Young's modulus (kPa) of every meshed tissue, by name."""
        return {t.name: t.youngs_modulus_kpa for t in self.tissues if t.meshed and t.youngs_modulus_kpa is not None}


def make_scene(
    anatomy: Anatomy,
    motions: Mapping[str, WallMotion],
    grid: VoxelGrid,
    *,
    edge_length_mm: float,
    noise: Noise | None,
    seed: int,
    law: Law,
) -> Scene:
    """Mesh the anatomy, move the walls of its hollow tissues with the outer border held, and image both states.

    `law`: that of all tissues; at finite strain the elements do not lock. Every meshed tissue of the anatomy needs its
    `youngs_modulus_kpa`. `edge_length_mm` is the mesh's at the surfaces. `seed` only draws the noise. Raises
    `GeometryError` where the truth folds over or cannot be meshed.
    """
    space = lagrange_space(tetrahedralise(anatomy, edge_length_mm=edge_length_mm), "P2")
    displacement = displacements(space, [BoundaryMotion(motions)], law=law)[0]
    refuse_folded(space, displacement)
    before, after = _images(space, displacement, grid, noise, seed)
    return Scene(space, displacement, before, after, dict(motions), seed)


def displacements(space: LagrangeSpace, motions: Sequence[BoundaryMotion], *, law: Law) -> list[NDArray[np.float64]]:
    """Displacement (n_points, 3) mm of a body under each of several motions of its boundary; all tissues have one law.

    Every meshed tissue of the space needs its `youngs_modulus_kpa`. At finite strain the elements do not lock. Under
    the linear law all motions share one factorisation.
    """
    tissues = space.mesh.tissues
    hollow = [i for i, tissue in enumerate(tissues) if tissue.role in (Role.DRIVER, Role.RIGID)]
    moduli = np.array([tissue.youngs_modulus_kpa or np.nan for tissue in tissues if tissue.meshed])
    found = []
    if law.finite:
        for motion in motions:
            offset, moved = _prescribed(space, motion, hollow)
            no_modes = np.zeros((offset.size, 0))
            constraint = outer_constraint(space, outer="fixed", modes=no_modes, offset=offset, prescribed=moved)
            found.append(equilibrium(space, constraint, moduli, law=law, dilatation=Dilatation.BLENDED).displacement)
    else:
        given = [_prescribed(space, motion, hollow) for motion in motions]
        modes = np.stack([offset for offset, _ in given], axis=1)
        prescribed = np.any([moved for _, moved in given], axis=0)
        still = np.zeros(len(modes))
        constraint = outer_constraint(space, outer="fixed", modes=modes, offset=still, prescribed=prescribed)
        system = linear_model(space, constraint).system(moduli)
        found = [system.solve(q).displacement for q in np.eye(len(motions))]
    return found


def refuse_folded(space: LagrangeSpace, displacement: NDArray[np.float64]) -> None:
    """Raise `GeometryError` where a displacement (n_points, 3) mm folds the body over."""
    smallest = float(deformation_determinants(space, displacement).min())
    if smallest <= 0.0:
        raise GeometryError(
            f"the truth folds over (smallest determinant of the deformation gradient {smallest:.3f}): move the walls"
            " less or leave more room around them"
        )


def _prescribed(
    space: LagrangeSpace, motion: BoundaryMotion, hollow: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Prescribed displacement (n_dof,) mm of the boundary, and which points (n_points,) have one.

    Points that a moving wall shares with the border move with the wall.
    """
    offset = np.zeros_like(space.points)
    prescribed = np.zeros(len(space.points), dtype=np.bool_)
    moves = [(OUTER, motion.border)] if motion.border is not None else []
    for beyond, moved in [*moves, *((i, motion.walls.get(space.mesh.tissues[i].name)) for i in hollow)]:
        points = np.unique(space.facets(space.mesh.boundary[space.mesh.beyond == beyond]))
        prescribed[points] = True
        if moved is not None:
            offset[points] = moved.at(space.points[points])
    return offset.ravel(), prescribed


def reimaged(scene: Scene, grid: VoxelGrid, *, noise: Noise | None) -> Scene:
    """The same truth imaged on another voxel grid, with other noise (drawn with the scene's seed) or none."""
    before, after = _images(scene.space, scene.displacement, grid, noise, scene.seed)
    return replace(scene, before=before, after=after)


def _images(
    space: LagrangeSpace, displacement: NDArray[np.float64], grid: VoxelGrid, noise: Noise | None, seed: int
) -> tuple[LabelImage, LabelImage]:
    warps: list[Warp | None] = [None, None]
    if noise is not None:
        size, length = noise.surface_sd_mm, noise.correlation_length_mm
        rngs = np.random.default_rng([seed, 1]).spawn(2)
        warps = [smooth_field(rng, sd_mm=size, correlation_mm=length).warp for rng in rngs]
    before = imaged(space, np.zeros_like(displacement), grid, warp=warps[0])
    return before, imaged(space, displacement, grid, warp=warps[1])


def imaged(
    space: LagrangeSpace, displacement: NDArray[np.float64], grid: VoxelGrid, *, warp: Warp | None = None
) -> LabelImage:
    """Label image on `grid` of the mesh under `displacement` (n_points, 3) mm; label = index of the tissue + 1."""
    index = voxelise(space, displacement, grid, subdivisions=2, warp=warp)
    names = {label + 1: tissue.name for label, tissue in enumerate(space.mesh.tissues)}
    return LabelImage(index.astype(np.int32) + 1, grid, names)


def centred_grid(field_mm: tuple[float, float, float], spacing_mm: tuple[float, float, float]) -> VoxelGrid:
    """The smallest grid of voxels of `spacing_mm` that covers `field_mm`, centred at the world's origin."""
    spacing = np.asarray(spacing_mm, dtype=np.float64)
    shape = np.ceil(np.asarray(field_mm) / spacing - 1e-9).astype(int)
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = -0.5 * (shape - 1) * spacing
    return VoxelGrid((int(shape[0]), int(shape[1]), int(shape[2])), affine)


def grid_box(grid: VoxelGrid) -> Box:
    """The box that the voxels of a grid along the world's axes fill, up to their outer faces."""
    lengths = np.array(grid.shape) * grid.spacing
    return Box(grid.world(np.full((1, 3), -0.5))[0], np.eye(3), lengths)
