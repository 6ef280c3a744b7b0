"""From an anatomy to conforming tetrahedra: grid, cuts, remeshing, exact surfaces, smoothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.errors import GeometryError
from palpate.images.tissue import Role, Tissue
from palpate.mesh.anatomy import Anatomy
from palpate.mesh.closing import closed
from palpate.mesh.cutting import Grid, cut, face_pieces, graded_grid, signed_volumes
from palpate.mesh.remeshing import compact, remeshed
from palpate.mesh.smoothing import smoothed
from palpate.mesh.snapping import contacts_of, debiased, snapped
from palpate.mesh.tet_mesh import FACES, OUTER, TetMesh, tet_dihedrals
from palpate.progress import Progress, silent

COARSEST = 4.0  # longest edge far from all surfaces, over the longest edge at organs
GRADING = 0.45  # growth of the edge length with the distance from a surface, mm per mm
GRID_FACTOR = 1.5  # longest over mean edge of the grid's tetrahedra
SAG = 0.15  # how far remeshing may move a surface, over the longest edge at organs; snapping moves it back
GAPS = (0.4, 0.75, 0.55)  # gaps and slivers thinner than 3/4 of this share of the edge length are closed
GOOD_ENOUGH_DEG = 8.0  # smallest dihedral angle with which no further attempt is made
TOUCH = 0.25  # grid nodes so near to a surface, in edge lengths, are moved onto it
CRUMB = 0.001  # share of the meshed volume; smaller pieces that touch no other are dropped
SMOOTHING_SWEEPS = (20, 12)
RESCUE_SWEEPS = 40
RESCUE_DEG = 10.0
COARSER = 1.5  # edge length on bones, air and known tissues, over the longest edge at organs


@dataclass(frozen=True, slots=True)
class SizeField:
    """Edge lengths that a mesh shall have, h(x) = min(min_i (h_i + 0.45 |d_i(x)|), 4 h_max), all mm.

    d_i is the distance to the surface of tissue i, h_i the edge length there: `on_surfaces` (n_tissues,). It is an
    organ's own on `estimate` tissues and drivers, between `shortest` and `longest` (h_max), and 1.5 h_max on others.
    """

    on_surfaces: NDArray[np.float64]
    shortest: float
    longest: float

    @classmethod
    def of(cls, tissues: Sequence[Tissue], edge_length_mm: float, longer_mm: Mapping[str, float]) -> SizeField:
        """One edge length (mm) for all organs, but for those that have a longer one by their name."""
        organs = {t.name for t in tissues if t.role in (Role.ESTIMATE, Role.DRIVER)}
        own = {name: max(edge_length_mm, longer_mm.get(name, 0.0)) for name in organs}
        longest = max(own.values(), default=edge_length_mm)
        on_surfaces = np.array([own.get(t.name, COARSER * longest) for t in tissues])
        return cls(on_surfaces, edge_length_mm, longest)

    @property
    def coarsest(self) -> float:
        """The edge length far from all surfaces, mm."""
        return COARSEST * self.longest

    def at(self, distances: NDArray[np.float64]) -> NDArray[np.float64]:
        """Edge lengths (...) mm where the tissues' surfaces are so far away, (n_tissues, ...) mm of either sign."""
        starts = self.on_surfaces.reshape(-1, *[1] * (distances.ndim - 1))
        return np.asarray((starts + GRADING * np.abs(distances)).min(axis=0, initial=self.coarsest))


def tetrahedralise(
    anatomy: Anatomy,
    *,
    edge_length_mm: float,
    longer_mm: Mapping[str, float] | None = None,
    progress: Progress = silent,
) -> TetMesh:
    """Conforming tetrahedra of the meshed tissues; hollow tissues (driver, rigid, void) are left out.

    `edge_length_mm` holds on the surfaces of `estimate` tissues and drivers, but of those that have a longer one by
    their name in `longer_mm`; elsewhere edges are those of `SizeField`. Surface nodes lie on the level sets.
    Deterministic. `progress` is called with a sentence at each step. Raises `GeometryError` when nothing is left to
    mesh or the remeshing fails, `ResourceError` when Mmg has no memory for it.
    """
    if not 0.0 < edge_length_mm < float(anatomy.box.lengths.min()):
        raise GeometryError(
            f"mesh.edge_length_mm is {edge_length_mm}; it must be positive and less than the smallest side of the"
            f" domain, {anatomy.box.lengths.min():.1f} mm"
        )
    sizes = SizeField.of([anatomy.tissues[i] for i in anatomy.priority], edge_length_mm, longer_mm or {})
    # the first mesh without a bad angle, or the best one: a gap about as wide as the closing's reach closes in patches
    grid, best_angle = None, -np.inf
    failure = GeometryError("no attempt at meshing was made")
    for number, gap in enumerate(GAPS, start=1):

        def say(step: str, line: str = f"meshing, attempt {number} of at most {len(GAPS)}") -> None:
            """What happens in this attempt."""
            progress(f"{line}: {step}")

        try:
            attempt = _grid(closed(anatomy, gap_mm=gap * edge_length_mm), sizes, say)
        except GeometryError as error:
            failure = error
            continue
        angle = float(tet_dihedrals(attempt.nodes[attempt.tets]).min())
        if grid is None or angle > best_angle:
            grid, best_angle = attempt, angle
        if angle > GOOD_ENOUGH_DEG:
            break
    if grid is None:
        raise failure
    boundary = boundary_of(grid.tets)
    beyond = _beyond(anatomy, grid.nodes, boundary)
    return TetMesh(grid.nodes, grid.tets, grid.region, boundary, beyond, anatomy.tissues)


def _grid(anatomy: Anatomy, sizes: SizeField, progress: Progress) -> Grid:
    progress("a graded grid, cut along every surface")

    def longest_edge(points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Longest edge (n,) mm that the grid may have at points (n, 3) mm."""
        return GRID_FACTOR * sizes.at(anatomy.values(points))

    grid = graded_grid(anatomy.box, longest_edge, coarsest_mm=sizes.coarsest, region=anatomy.filler)
    for tissue in anatomy.priority:
        phi = anatomy.level_sets[tissue]
        if phi is not None:
            touch = TOUCH * sizes.at(anatomy.values(grid.nodes))
            free = grid.region == anatomy.filler
            grid = cut(grid, phi, inside=tissue, splittable=free, touch_mm=touch, box=anatomy.box)
    keep = np.array([tissue.meshed for tissue in anatomy.tissues])[grid.region]
    if not keep.any():
        raise GeometryError("no tetrahedron is left: the `estimate` and `known` tissues lie outside the domain")
    tets, region = grid.tets[keep], grid.region[keep]
    piece, _ = face_pieces(tets)  # small ones share no face with the rest, as between bones that touch
    volume = np.bincount(piece, signed_volumes(grid.nodes, tets))
    keep = volume[piece] > CRUMB * volume.sum()
    grid = compact(grid.nodes, tets[keep], region[keep])
    grid = _better(grid, anatomy, sizes, progress)
    try:
        return _better(grid, anatomy, sizes, progress)
    except GeometryError:  # the second remeshing only saves tetrahedra; the mesh exists already
        return grid


def _better(grid: Grid, anatomy: Anatomy, sizes: SizeField, progress: Progress) -> Grid:
    """The grid remeshed, its surface nodes put back where they belong and its bad tetrahedra opened."""
    progress(f"remeshing {len(grid.tets)} tetrahedra")
    wanted = sizes.at(anatomy.values(grid.nodes))
    grid = remeshed(grid, wanted, box=anatomy.box, sag_mm=SAG * sizes.longest)
    progress(f"fitting the surfaces of {len(grid.tets)} tetrahedra")
    contacts = contacts_of(grid, anatomy)
    grid = snapped(grid, contacts, limit_mm=sizes.shortest)
    for sweeps in SMOOTHING_SWEEPS:
        grid = smoothed(grid, contacts, step_mm=0.15 * sizes.shortest, sweeps=sweeps)
        grid, contacts = debiased(grid, contacts)
    grid = smoothed(grid, contacts, step_mm=0.05 * sizes.shortest, sweeps=SMOOTHING_SWEEPS[-1])
    # where surfaces meet in too thin a wedge, a good element is worth more than a tenth of a millimetre of surface
    step = 0.03 * sizes.shortest
    return smoothed(grid, contacts.released(), step_mm=step, sweeps=RESCUE_SWEEPS, below_deg=RESCUE_DEG)


def boundary_of(tets: NDArray[np.int64]) -> NDArray[np.int64]:
    """Faces (n, 3) that belong to one of the tets (n_tets, 4) only, normals pointing out of it."""
    return outer_faces(tets)[0]


def outer_faces(tets: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """As `boundary_of`, and of which tetrahedron (n,) each is."""
    faces = tets[:, FACES].reshape(-1, 3)
    _, place, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outside = np.sort(place[count == 1])
    return np.asarray(faces[outside]), outside // 4


def _beyond(anatomy: Anatomy, nodes: NDArray[np.float64], boundary: NDArray[np.int64]) -> NDArray[np.int64]:
    """Hollow tissue (n,) behind each boundary face (n, 3): the nearest one, OUTER on the faces of the box."""
    corners = nodes[boundary]
    on_box = np.any(anatomy.box.faces_of(corners), axis=1)
    centres = corners.mean(axis=1)
    hollow = [rank for rank, i in enumerate(anatomy.priority) if not anatomy.tissues[i].meshed]
    index = np.array([anatomy.priority[rank] for rank in hollow])
    if not anatomy.tissues[anatomy.filler].meshed:
        index = np.append(index, anatomy.filler)
    if not len(index):
        return np.full(len(boundary), OUTER)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    reach = 0.25 * np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    values = anatomy.values(centres + reach[:, None] * normals)
    chosen = values[hollow]
    if len(index) > len(hollow):
        chosen = np.concatenate([chosen, -np.abs(values).min(axis=0, keepdims=True)])
    return np.asarray(np.where(on_box, OUTER, index[chosen.argmin(axis=0)]))
