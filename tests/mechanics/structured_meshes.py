"""Small structured meshes of known shape, for the laws of mechanics."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from scipy import sparse

from palpate.images.tissue import Role, Tissue
from palpate.mesh.constraint import Constraint
from palpate.mesh.surface import triangle_normals
from palpate.mesh.tet_mesh import FACES, OUTER, TetMesh

VOID = Tissue("void", Role.VOID)


def kuhn_tets(n: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Grid places (n_nodes, 3) in steps and tetrahedra (6 a cell) of a box of n cells."""
    grid = np.stack(np.meshgrid(*[np.arange(k + 1) for k in n], indexing="ij"), axis=-1)
    number = np.arange(grid[..., 0].size).reshape(grid.shape[:3])
    tets = []
    for order in permutations(range(3)):
        steps = np.cumsum(np.vstack([np.zeros(3, int), np.eye(3, dtype=int)[list(order)]]), axis=0)
        corners = [number[s[0] : s[0] + n[0], s[1] : s[1] + n[1], s[2] : s[2] + n[2]].ravel() for s in steps]
        tets.append(np.stack(corners, axis=1))
    return grid.reshape(-1, 3).astype(float), np.concatenate(tets)


def oriented(nodes: np.ndarray, tets: np.ndarray) -> np.ndarray:
    corner = nodes[tets]
    flip = np.linalg.det(corner[:, 1:] - corner[:, :1]) < 0
    result = tets.copy()
    result[flip] = result[flip][:, [1, 0, 2, 3]]
    return result


def boundary_faces(tets: np.ndarray) -> np.ndarray:
    faces = tets[:, FACES].reshape(-1, 3)
    _, place, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[place[count == 1]]


def make_mesh(nodes, tets, region, tissues, beyond=None) -> TetMesh:
    """A mesh; beyond(centroids (n, 3)) gives the neighbour of each outer face, OUTER by default."""
    tets = oriented(nodes, tets)
    boundary = boundary_faces(tets)
    behind = np.full(len(boundary), OUTER) if beyond is None else beyond(nodes[boundary].mean(axis=1))
    return TetMesh(nodes, tets, region, boundary, behind, tuple(tissues))


def known(name: str, modulus: float = 1.0, nu: float = 0.3) -> Tissue:
    return Tissue(name, Role.KNOWN, poisson_ratio=nu, youngs_modulus_kpa=modulus)


def unknown(name: str, nu: float = 0.3) -> Tissue:
    return Tissue(name, Role.ESTIMATE, poisson_ratio=nu)


def box_mesh(n=3, *, size=1.0, tissues=None, region=None, distortion=0.0, beyond=None) -> TetMesh:
    """Box of edge `size` with n cells a side; region(centroids) -> tissue index; inner nodes moved by `distortion`."""
    n = (n, n, n) if isinstance(n, int) else n
    places, tets = kuhn_tets(n)
    inner = np.all((places > 0) & (places < np.array(n)), axis=1)
    nodes = places / np.array(n)
    nodes[inner] += distortion / np.array(n) * np.random.default_rng(1).uniform(-1, 1, (int(inner.sum()), 3))
    nodes *= size
    number = np.zeros(len(tets), int) if region is None else region(nodes[tets].mean(axis=1))
    return make_mesh(nodes, tets, number, tissues or [known("block")], beyond)


def octant_mesh(radii, n_radial, n_surface, tissues, *, solid=False) -> TetMesh:
    """Layers between `radii` (> 0) of an eighth of a ball; its flat sides lie on the three planes and are OUTER.

    The spherical triangle is a regular grid of barycentric places, lifted to the sphere; each prism is split in 3.
    The spheres' facets enclose the volume of the true spheres: their corners lie a little outside of them.
    The spherical sides face the last tissue, `VOID`. solid: a centre joins the innermost triangles, in region 0.
    """
    places = [(i, j) for i in range(n_surface + 1) for j in range(n_surface + 1 - i)]
    index = {p: k for k, p in enumerate(places)}
    flat = np.array([[i, j, n_surface - i - j] for i, j in places]) / n_surface
    # equal angles along the edges: better elements than central projection
    lifted = np.sin(0.5 * np.pi * flat)
    directions = lifted / np.linalg.norm(lifted, axis=1, keepdims=True)
    triangles = []
    for i, j in places:
        if i + j < n_surface:
            triangles.append((index[i, j], index[i + 1, j], index[i, j + 1]))
        if i + j < n_surface - 1:
            triangles.append((index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]))
    triangles = np.sort(np.array(triangles), axis=1)
    volume = np.abs(np.linalg.det(directions[triangles])).sum() / 6.0
    directions = directions * (np.pi / 6.0 / volume) ** (1 / 3)
    levels = np.concatenate(
        [np.linspace(a, b, m + 1)[:-1] for a, b, m in zip(radii[:-1], radii[1:], n_radial, strict=True)] + [radii[-1:]]
    )
    nodes = (levels[:, None, None] * directions).reshape(-1, 3)
    tets, region = [], []
    layer_of = np.repeat(np.arange(len(n_radial)), n_radial)
    for level in range(len(levels) - 1):
        low, high = triangles + level * len(places), triangles + (level + 1) * len(places)
        a, b, c = low.T
        d, e, f = high.T
        for corners in ((a, b, c, f), (a, b, e, f), (a, d, e, f)):
            tets.append(np.stack(corners, axis=1))
            region.append(np.full(len(triangles), layer_of[level]))
    if solid:
        tets.append(np.column_stack([np.full(len(triangles), len(nodes)), triangles]))
        region.append(np.zeros(len(triangles), int))
        nodes = np.vstack([nodes, np.zeros(3)])
    nodes[np.abs(nodes) < 1e-12] = 0.0

    def beyond(faces):
        return np.where(np.any(np.abs(faces) < 1e-9, axis=1), OUTER, len(tissues))

    return make_mesh(nodes, np.concatenate(tets), np.concatenate(region), [*tissues, VOID], beyond)


def quarter_ring_mesh(inner, outer, n_radial, n_turn, tissue) -> TetMesh:
    """A slice of a quarter of a tube, its flat sides OUTER, its round sides facing `VOID`."""
    places, tets = kuhn_tets((n_radial, n_turn, 1))
    radius = inner + (outer - inner) * places[:, 0] / n_radial
    angle = 0.5 * np.pi * places[:, 1] / n_turn
    thick = (outer - inner) / n_radial
    nodes = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), thick * places[:, 2]])
    nodes[np.abs(nodes) < 1e-12] = 0.0

    def beyond(faces):
        flat = np.any(np.abs(faces) < 1e-9, axis=1) | (np.abs(faces[:, 2] - thick) < 1e-9)
        return np.where(flat, OUTER, 1)

    return make_mesh(nodes, tets, np.zeros(len(tets), int), [tissue, VOID], beyond)


def every_node_prescribed(space, value):
    """Keywords for `outer_constraint`: the points on the mesh's boundary move as value(points), one offset."""
    points = np.unique(space.facets(space.mesh.boundary))
    return prescribe(space, points, value(space.points[points]))


def prescribe(space, points, displacement, modes=None):
    """Keywords for `outer_constraint`: `points` move by `displacement` (n, 3) plus modes (n, 3, n_modes)."""
    prescribed = np.zeros(len(space.points), bool)
    prescribed[points] = True
    offset = np.zeros((len(space.points), 3))
    offset[points] = displacement
    n_modes = 0 if modes is None else modes.shape[2]
    columns = np.zeros((len(space.points), 3, n_modes))
    if modes is not None:
        columns[points] = modes
    return {"prescribed": prescribed, "offset": offset.ravel(), "modes": columns.reshape(3 * len(columns), n_modes)}


def held_components(held, values, modes=None):
    """Constraint that holds components (n_points, 3) marked in `held` at values (n_points, 3) mm, plus modes."""
    unknown = np.flatnonzero(~held.ravel())
    n = held.size
    free = sparse.csr_matrix((np.ones(len(unknown)), (unknown, np.arange(len(unknown)))), shape=(n, len(unknown)))
    columns = np.zeros((n, 0)) if modes is None else modes.reshape(n, -1) * held.reshape(n, 1)
    return Constraint(free=free, modes=columns, offset=np.where(held, values, 0.0).ravel())


def pressure_load(space, triangles, pressure):
    """Nodal forces (n_dof,) mN of a pressure (kPa) on plane faces whose normals point out of the body."""
    normals = triangle_normals(space.mesh.nodes, triangles)
    share = np.full(3, 1 / 3) if space.order == 1 else np.array([0, 0, 0, 1, 1, 1]) / 3  # mean of the shape functions
    forces = np.zeros((len(space.points), 3))
    for column, weight in zip(space.facets(triangles).T, share, strict=True):
        np.add.at(forces, column, -pressure * weight * normals)
    return forces.ravel()


def sphere_faces(mesh, radius):
    """Faces (n, 3) of the mesh that approximate a sphere around the origin, normals pointing outwards."""
    distance = np.linalg.norm(mesh.nodes, axis=1)
    faces = np.unique(np.sort(mesh.tets[:, FACES].reshape(-1, 3), axis=1), axis=0)
    faces = faces[np.all(np.abs(distance[faces] / radius - 1.0) < 0.02, axis=1)]
    inwards = np.einsum("ij,ij->i", triangle_normals(mesh.nodes, faces), mesh.nodes[faces[:, 0]]) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    return faces


def mean_radial(space, radius):
    """Row (n_dof,): the volume that an eighth of a sphere sweeps over its exact area, its mean radial displacement."""
    return pressure_load(space, sphere_faces(space.mesh, radius), -1.0) / (0.5 * np.pi * radius**2)
