"""The part of a tissue's surface that is observed, and what a later image shows of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import NDArray

from palpate.errors import GeometryError
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.surface_alignment import shown_tissues
from palpate.images.tissue import Role
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.surface import tissue_surface, triangle_normals
from palpate.mesh.tet_mesh import OUTER

SUBTRIANGLES = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])  # of a quadratic triangle
MIN_SHARE = 0.1
NEEDED = (Role.ESTIMATE, Role.DRIVER)
WIDTHS = 3.0  # widths of the smoothing Gaussian: nearer to a cut, surfaces are continued, not seen
SAME_FIELD = 0.5  # voxels by which fields of view may differ and still count as equal


@dataclass(frozen=True, slots=True)
class ObservedSurface:
    """Surface of `tissue` (index into the mesh's tissues), all of it, with the part that is observed marked.

    points (n_vertices,) numbers of its points in the space; rest (n_vertices, 3) mm; triangles (n_triangles, 3) into
    `points`, normals out of the tissue; observed (n_triangles,) is False where the tissue touches a driver, a bone or
    the cut of the image; rim (n_triangles, 3) marks edges (opposite each corner) where the observed part ends;
    share of the area that is observed; faces (n_faces, 6): the vertices of each face that its four triangles stand for,
    corners and then the middles of the edges 01, 12, 20, none where faces are plane; driver: whether it is the wall of
    one, whose motion is prescribed; needed: whether it is an `estimate` tissue's or a driver's, without which there is
    no estimate.
    """

    tissue: int
    name: str
    points: NDArray[np.int64]
    rest: NDArray[np.float64]
    triangles: NDArray[np.int64]
    observed: NDArray[np.bool_]
    rim: NDArray[np.bool_]
    share: float
    faces: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 6), dtype=np.int64))
    driver: bool = False
    needed: bool = True

    @property
    def dofs(self) -> NDArray[np.int64]:
        """Numbers (n_dofs,) of its 3 n_vertices unknowns in the space, 3 point + axis."""
        return np.asarray((3 * self.points[:, None] + np.arange(3)).ravel())


def observed_surface(space: LagrangeSpace, tissue: int) -> ObservedSurface:
    """Surface of a tissue on `space`.

    Raises `GeometryError` when the mesh has nothing of it, or under 10 % of its surface is left to observe.
    """
    mesh = space.mesh
    surface, name = tissue_surface(mesh, tissue), mesh.tissues[tissue].name
    if not len(surface.triangles):
        raise GeometryError(
            f"nothing of '{name}' is left in the mesh: it is so thin that the smoothing of the images' voxels takes it"
            " away; use finer images, or join it to its neighbour"
        )
    driver = mesh.tissues[tissue].role is Role.DRIVER  # all of its wall is seen: it is itself an unknown
    prescribed = [i for i, other in enumerate(mesh.tissues) if other.role in (Role.DRIVER, Role.RIGID)]
    seen = ~np.isin(surface.other, [OUTER, *prescribed]) | driver
    facets = space.facets(surface.triangles)
    split = facets[:, SUBTRIANGLES].reshape(-1, 3) if space.order == 2 else facets
    observed = np.repeat(seen, len(split) // max(len(facets), 1))
    points, local = np.unique(split, return_inverse=True)
    triangles = local.reshape(-1, 3)
    rest = space.points[points]
    area = np.linalg.norm(triangle_normals(rest, triangles), axis=1)
    share = float(area[observed].sum() / area.sum())
    if share < MIN_SHARE:
        raise GeometryError(
            f"'{name}': only {100 * share:.0f} % of its surface is free of drivers, bones and the image's border, so"
            " its modulus cannot be observed; enlarge the image, or make the tissue `known`"
        )
    faces = np.searchsorted(points, facets if space.order == 2 else np.zeros((0, 6), dtype=np.int64))
    # edges (n_triangles, 3), each opposite its corner, that belong to a single observed triangle
    edges = np.sort(triangles[:, [[1, 2], [0, 2], [0, 1]]], axis=2)
    keys = edges[..., 0] * (triangles.max() + 1) + edges[..., 1]
    shown = np.sort(keys[observed].ravel())
    count = np.searchsorted(shown, keys, side="right") - np.searchsorted(shown, keys, side="left")
    rim = (count == 1) & observed[:, None]
    needed = mesh.tissues[tissue].role in NEEDED
    return ObservedSurface(tissue, name, points, rest, triangles, observed, rim, share, faces, driver, needed)


def observed_surfaces(space: LagrangeSpace, before: Segmentation) -> tuple[ObservedSurface, ...]:
    """Every surface that the reference image shows, in the order of the tissues.

    Those of `estimate` tissues, drivers, `void` tissues beside meshed ones, and `known` tissues, but for one that
    fills what the others leave; bones' motion is prescribed. Raises `GeometryError` as `observed_surface` for
    `estimate` tissues and drivers; others of which little is seen are left out.
    """
    found, shown = [], shown_tissues(before)
    for i, tissue in enumerate(before.tissues):
        role = tissue.role
        beside = i in shown and role is not Role.RIGID and bool(before.mask(i).any())
        if role not in NEEDED and not beside:
            continue
        try:
            found.append(observed_surface(space, i))
        except GeometryError:
            if role in NEEDED:
                raise
    return tuple(found)


def seen_in(surface: ObservedSurface, image: Segmentation, view: FieldOfView, *, name: str) -> bool:
    """Whether the later image called `name`, which shows `view`, has enough of a surface to be compared.

    Raises `GeometryError` where under 10 % of an `estimate` tissue's or a driver's surface is seen in it.
    """
    normals = triangle_normals(surface.rest, surface.triangles)
    area, centres = np.linalg.norm(normals, axis=1), surface.rest[surface.triangles].mean(axis=1)
    share = float(area[surface.observed & view.shows(centres)].sum() / area.sum())
    if share >= MIN_SHARE or not surface.needed:
        return share >= MIN_SHARE and bool(image.mask(surface.tissue).any())
    raise GeometryError(
        f"'{surface.name}': the field of view of '{name}' shows only {100 * share:.0f} % of its surface free of"
        f" drivers, bones and borders, and {100 * MIN_SHARE:.0f} % are needed; use an image that shows more of it"
    )


@dataclass(frozen=True, slots=True)
class FieldOfView:
    """Where an image shows the reference state: where inward . x >= least for every cut.

    inward (n_cuts, 3): unit normals into the image; least (n_cuts,) mm: of the cuts, the margin included.
    """

    inward: NDArray[np.float64]
    least: NDArray[np.float64]

    def shows(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points (n, 3) in RAS mm of the later state the image shows, away from its cuts."""
        return np.asarray((points @ self.inward.T >= self.least).all(axis=1))


def field_of_view(before: VoxelGrid, after: VoxelGrid, *, smoothing_mm: float) -> FieldOfView:
    """What the later image's grid shows of the reference image's.

    Only a border that cuts something off of the reference image, by more than half a voxel, is a cut: where both end
    together, both are continued alike. What lies within three smoothing widths of a cut is not shown.
    """
    ends = np.array(list(product(*[(-0.5, n - 0.5) for n in before.shape])))
    corners = before.world(ends)
    inward, least = [], []
    for axis, direction in product(range(3), (1.0, -1.0)):
        inverse = np.linalg.inv(after.affine[:3, :3])
        normal = direction * inverse[axis] / np.linalg.norm(inverse[axis])
        last = np.full(3, 0.0)
        last[axis] = -0.5 if direction > 0.0 else after.shape[axis] - 0.5
        border = float(normal @ after.world(last[None])[0])
        if border - float((corners @ normal).min()) > SAME_FIELD * float(after.spacing[axis]):
            inward.append(normal)
            least.append(border + WIDTHS * smoothing_mm)
    return FieldOfView(np.array(inward).reshape(-1, 3), np.array(least))
