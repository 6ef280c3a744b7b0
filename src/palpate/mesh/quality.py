"""Is a mesh good enough to compute with: angles, volumes, conformity, connection; and the gate that decides."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.errors import GeometryError, MeshQualityError
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.mesh.anatomy import Anatomy
from palpate.mesh.cutting import face_pieces
from palpate.mesh.space import lagrange_space
from palpate.mesh.tet_mesh import FACES, TetMesh, tet_dihedrals
from palpate.mesh.voxelise import voxelise
from palpate.parallel import mapped

NEIGHBOURHOOD_MM = 10.0
MIN_DIHEDRAL_DEG = 5.0
P5_DIHEDRAL_DEG = 25.0
LEVEL_SET_TOLERANCE = 0.01
VOXEL_TOLERANCE = 0.03
COARSE_CELL_MM = 8.0
LEAST_SLOPE = 0.25  # least slope of a level set at its surface, for places where two surfaces of an organ nearly meet
HALVINGS = 4  # how often cells that a surface crosses are halved


def in_words(point: NDArray[np.float64], grid: VoxelGrid | None) -> str:
    """A point (3,) in RAS mm with its voxel and the nearest axial slice of `grid`, if there is one."""
    place = f"RAS {np.round(point, 1).tolist()} mm"
    if grid is None:
        return place
    voxel = np.clip(np.rint(grid.index(np.asarray(point)[None])[0]), 0, np.array(grid.shape) - 1).astype(int)
    return (
        f"{place} (voxel {voxel.tolist()}, counted from 0 to the right, front and head; axial slice {voxel[2] + 1} of"
        f" {grid.shape[2]} from the feet)"
    )


def largest_difference(mesh: TetMesh, image: Segmentation, tissue: int) -> NDArray[np.float64] | None:
    """Where (3,) RAS mm, within some 10 mm, mesh and image differ most in voxels of that tissue; None: nowhere.

    Within the image's part that is meshed or enclosed by it; None, too, where the mesh's surfaces cross.
    """
    space = lagrange_space(mesh, "P1")
    try:
        shown = voxelise(space, np.zeros_like(space.points), image.grid, subdivisions=0, crossing=True)
    except GeometryError:
        return None
    index = image.grid.index(mesh.nodes)
    first = np.clip(np.floor(index.min(axis=0) + 0.5).astype(np.int64), 0, image.grid.shape)
    last = np.clip(np.ceil(index.max(axis=0) + 0.5).astype(np.int64), 0, image.grid.shape)
    inside = [slice(low, high) for low, high in zip(first, last, strict=True)]
    differ = ((shown == tissue) != image.mask(tissue))[tuple(inside)]
    if not differ.any():
        return None
    size = np.maximum(np.rint(NEIGHBOURHOOD_MM / image.grid.spacing), 1).astype(int)
    density = np.where(differ, ndimage.uniform_filter(differ.astype(float), size.tolist(), mode="constant"), 0.0)
    voxel = np.array(np.unravel_index(int(density.argmax()), density.shape)) + [s.start for s in inside]
    return np.asarray(image.grid.world(voxel[None].astype(float))[0])


@dataclass(frozen=True, slots=True)
class MeshQuality:
    """Figures of a mesh; angles in degrees, volumes in mm^3, errors relative to the level sets' or voxels' volumes.

    `p5_dihedral_deg` is the 5th percentile over tetrahedra of their smallest angle. `components` counts the pieces
    that tetrahedra form through shared faces; `overfull_faces` those shared by more than two.
    """

    nodes: int
    tets: int
    min_dihedral_deg: float
    p5_dihedral_deg: float
    max_dihedral_deg: float
    worst_place: tuple[float, float, float]
    worst_tissue: str
    min_volume: float
    volume: Mapping[str, float]
    volume_error: Mapping[str, float]
    voxel_volume_error: Mapping[str, float] = field(default_factory=dict)
    components: int = 1
    overfull_faces: int = 0


def dihedral_angles(mesh: TetMesh) -> NDArray[np.float64]:
    """Dihedral angles (n_tets, 6) of each tetrahedron, degrees."""
    return tet_dihedrals(mesh.nodes[mesh.tets])


def mesh_quality(mesh: TetMesh, anatomy: Anatomy, *, voxel_volumes: Mapping[str, float] | None = None) -> MeshQuality:
    """Measure a mesh against the anatomy that it was made from, and against counted voxels where they are given.

    `voxel_volumes`: tissue name -> mm^3 inside the box.
    """
    found = mesh_figures(mesh)
    errors = _errors(found.volume, level_set_volumes(anatomy))
    return replace(found, volume_error=errors, voxel_volume_error=_errors(found.volume, voxel_volumes or {}))


def mesh_figures(mesh: TetMesh) -> MeshQuality:
    """Measure a mesh by itself."""
    angles = dihedral_angles(mesh)
    smallest = angles.min(axis=1)
    worst = int(smallest.argmin())
    place = mesh.nodes[mesh.tets[worst]].mean(axis=0)
    sums = np.bincount(mesh.region, mesh.volumes, minlength=len(mesh.tissues))
    volume = {tissue.name: float(sums[i]) for i, tissue in enumerate(mesh.tissues) if tissue.meshed}
    piece, with_face = face_pieces(mesh.tets)
    return MeshQuality(
        nodes=len(mesh.nodes),
        tets=len(mesh.tets),
        min_dihedral_deg=float(smallest[worst]),
        p5_dihedral_deg=float(np.percentile(smallest, 5.0)),
        max_dihedral_deg=float(angles.max()),
        worst_place=(float(place[0]), float(place[1]), float(place[2])),
        worst_tissue=mesh.tissues[mesh.region[worst]].name,
        min_volume=float(mesh.volumes.min()),
        volume=volume,
        volume_error={},
        components=int(piece.max()) + 1,
        overfull_faces=int(np.count_nonzero(with_face > 2)),
    )


def check_mesh(
    mesh: TetMesh,
    anatomy: Anatomy,
    *,
    voxel_volumes: Mapping[str, float] | None = None,
    thin: tuple[str, ...] = (),
    image: Segmentation | None = None,
) -> MeshQuality:
    """The gate: the mesh's quality, or `MeshQualityError` that names every region and place that fails.

    Smallest dihedral angle >= 5 degrees, 5th percentile >= 25; every region within 1 % of its level set's volume and
    within 3 % of its voxels' (regions in `thin`, under four voxels thick: only reported); no inverted tetrahedron; one
    piece; no face in more than two tetrahedra. `voxel_volumes`: tissue name -> mm^3 inside the box; `image`: the one
    that was meshed, to name voxels and slices.
    """
    quality = mesh_quality(mesh, anatomy, voxel_volumes=voxel_volumes)
    failures = _shape_failures(quality, mesh, image.grid if image else None)
    checks = (
        ("level set", quality.volume_error, LEVEL_SET_TOLERANCE),
        ("voxels", quality.voxel_volume_error, VOXEL_TOLERANCE),
    )
    for of, errors, limit in checks:
        for name, error in errors.items():
            if abs(error) > limit and name not in thin:
                place = largest_difference(mesh, image, mesh.tissue_index(name)) if image else None
                where = f", most of it near {in_words(place, image.grid)}" if image and place is not None else ""
                failures.append(
                    f"region '{name}' of {quality.volume[name]:.0f} mm^3 differs by {100 * error:+.1f} % from the"
                    f" volume of its {of} (limit {100 * limit:g} %){where}"
                )
    if failures:
        raise MeshQualityError(f"the mesh of {quality.tets} tetrahedra does not pass its gate: {'; '.join(failures)}")
    return quality


def level_set_volumes(anatomy: Anatomy) -> dict[str, float]:
    """Volume (mm^3) of each tissue inside the box, from the level sets alone: tissue name -> mm^3.

    Cells of 8 mm that a surface crosses are halved, and their parts again, to 1/2 mm; of a cell of 1 mm and less the
    share clip(1/2 - d / edge, 0, 1) counts as inside, d the distance to the surface.
    """
    counts = np.ceil(anatomy.box.lengths / COARSE_CELL_MM).astype(int)
    coarse = anatomy.box.lengths / counts
    centres = _cell_centres(counts) * coarse

    def volumes(block: NDArray[np.int64]) -> NDArray[np.float64]:
        """Volumes (n_tissues,) mm^3 in coarse cells (n,), by number."""
        local, size, total = centres[block], coarse, np.zeros(len(anatomy.tissues))
        values = anatomy.values(anatomy.box.world(local))
        for halving in range(HALVINGS):
            cell, reach = float(np.prod(size)), float(np.linalg.norm(size))
            near, edge = (reach, 1e-9) if halving < HALVINGS - 1 else (cell ** (1 / 3),) * 2
            crossed = (np.abs(values) < near).any(axis=0)
            total += cell * _shares(values[:, ~crossed], edge).sum(axis=1)
            local, values = _divided(anatomy, local[crossed], values[:, crossed], size, within_mm=reach)
            size = 0.5 * size
        cell = float(np.prod(size))
        return np.asarray(total + cell * _shares(values, cell ** (1 / 3)).sum(axis=1))

    blocks = np.array_split(np.arange(len(centres)), max(1, len(centres) // 1000))
    total = np.sum(mapped(volumes, blocks), axis=0)
    order = (*anatomy.priority, anatomy.filler)
    return {anatomy.tissues[i].name: float(total[rank]) for rank, i in enumerate(order)}


def _divided(
    anatomy: Anatomy,
    centres: NDArray[np.float64],
    values: NDArray[np.float64],
    size: NDArray[np.float64],
    *,
    within_mm: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centres (8 n_cells, 3) mm along the box's axes of the eighths of each cell, and distances to surfaces there.

    `centres` (n_cells, 3), `values` (n_surfaces, n_cells) mm and `size` (3,) mm are the cells'; a distance is new where
    the cell's own is less than `within_mm`: |phi| / |grad phi| next to the surface, where phi alone would be a bias.
    """
    parts = (_cell_centres(np.full(3, 2)) / 2 - 0.5) * size
    local = (centres[:, None] + parts).reshape(-1, 3)
    points, inside = anatomy.box.world(local), np.repeat(values, 8, axis=1)
    for rank, tissue in enumerate(anatomy.priority):
        near, phi = np.flatnonzero(np.abs(inside[rank]) < within_mm), anatomy.level_sets[tissue]
        if phi is None or not len(near):
            continue
        distance = phi.at(points[near])
        close = np.abs(distance) < 0.5 * float(size.max())
        slope = np.linalg.norm(phi.gradient_at(points[near[close]]), axis=1)
        distance[close] /= np.maximum(slope, LEAST_SLOPE)
        inside[rank, near] = distance
    return local, inside


def _cell_centres(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    steps = [np.arange(n) + 0.5 for n in counts]
    return np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)


def _shares(values: NDArray[np.float64], edge: float) -> NDArray[np.float64]:
    """Share (n_tissues, n) of each cell that each tissue has, by priority; the last row is the filler's."""
    left = np.ones(values.shape[1])
    shares = []
    for value in values:
        reach = np.clip(0.5 - value / edge, 0.0, 1.0)
        shares.append(np.minimum(reach, left))
        left = left - shares[-1]
    return np.array([*shares, left])


def _errors(volume: Mapping[str, float], target: Mapping[str, float]) -> dict[str, float]:
    return {name: volume[name] / target[name] - 1.0 for name in volume if target.get(name, 0.0) > 0.0}


def _shape_failures(quality: MeshQuality, mesh: TetMesh, grid: VoxelGrid | None) -> list[str]:
    where = f"in '{quality.worst_tissue}' near {in_words(np.array(quality.worst_place), grid)}"
    failures = []
    if quality.min_volume <= 0.0:
        failures.append(f"an inverted tetrahedron of {quality.min_volume:.3g} mm^3, the worst one {where}")
    if quality.min_dihedral_deg < MIN_DIHEDRAL_DEG:
        failures.append(f"a dihedral angle of {quality.min_dihedral_deg:.1f} deg (limit {MIN_DIHEDRAL_DEG:g}) {where}")
    if quality.p5_dihedral_deg < P5_DIHEDRAL_DEG:
        flat = mesh.region[dihedral_angles(mesh).min(axis=1) < P5_DIHEDRAL_DEG]
        most = mesh.tissues[int(np.bincount(flat).argmax())].name
        failures.append(
            f"5 % of the tetrahedra have an angle below {quality.p5_dihedral_deg:.1f} deg (limit {P5_DIHEDRAL_DEG:g}),"
            f" most of them in '{most}', the worst {where}"
        )
    if quality.components != 1:
        piece, _ = face_pieces(mesh.tets)
        loose = piece != np.bincount(piece).argmax()
        failures.append(
            f"it falls into {quality.components} pieces that share no face, one of them {_around(mesh, loose, grid)}"
        )
    if quality.overfull_faces:
        _, number, count = np.unique(
            np.sort(mesh.tets[:, FACES].reshape(-1, 3), axis=1), axis=0, return_inverse=True, return_counts=True
        )
        over = np.asarray((count[number.ravel()] > 2).reshape(-1, 4).any(axis=1))
        failures.append(
            f"{quality.overfull_faces} faces belong to more than two tetrahedra, one {_around(mesh, over, grid)}"
        )
    return failures


def _around(mesh: TetMesh, chosen: NDArray[np.bool_], grid: VoxelGrid | None) -> str:
    """Tissue and place of the first of the chosen (n_tets,) tetrahedra."""
    first = int(np.flatnonzero(chosen)[0])
    middle = mesh.nodes[mesh.tets[first]].mean(axis=0)
    return f"in '{mesh.tissues[mesh.region[first]].name}' near {in_words(middle, grid)}"
