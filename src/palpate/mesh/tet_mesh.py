"""Tetrahedra of several tissues that share their faces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from palpate.errors import GeometryError
from palpate.images.tissue import Tissue

OUTER = -1  # what lies beyond the domain's own border: the cut of the image
FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])  # faces of a tetrahedron, seen from outside
FACE_PAIRS = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])


@dataclass(frozen=True, slots=True)
class TetMesh:
    """A conforming mesh of the meshed tissues.

    nodes (n_nodes, 3) RAS mm; tets (n_tets, 4) node numbers, positive volume; region (n_tets,) index into `tissues`;
    boundary (n_boundary, 3) the mesh's outer faces, normals pointing out of the mesh; beyond (n_boundary,) the hollow
    tissue behind each of them (index into `tissues`) or OUTER where the image is cut; surfaces: all faces (n_boundary,)
    of a hollow tissue, by its name, where others have some of them too.
    """

    nodes: NDArray[np.float64]
    tets: NDArray[np.int64]
    region: NDArray[np.int64]
    boundary: NDArray[np.int64]
    beyond: NDArray[np.int64]
    tissues: tuple[Tissue, ...]
    surfaces: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, dtype in (("nodes", float), ("tets", int), ("region", int), ("boundary", int), ("beyond", int)):
            array = np.array(getattr(self, name), dtype=dtype)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if len(self.region) != len(self.tets) or len(self.beyond) != len(self.boundary):
            raise GeometryError(
                f"{len(self.tets)} tetrahedra with {len(self.region)} regions and {len(self.boundary)} boundary faces"
                f" with {len(self.beyond)} neighbours: each tetrahedron needs one region, and each face one neighbour"
            )

        for what, numbers, low, count in (
            ("a tetrahedron has a corner", self.tets, 0, len(self.nodes)),
            ("a boundary face has a corner", self.boundary, 0, len(self.nodes)),
            ("a tetrahedron has a region", self.region, 0, len(self.tissues)),
            ("a boundary face has a neighbour", self.beyond, OUTER, len(self.tissues)),
        ):
            if numbers.size and not low <= int(numbers.min()) <= int(numbers.max()) < count:
                raise GeometryError(
                    f"{what} between {numbers.min()} and {numbers.max()}, but only {low} to {count - 1} exist"
                )

    @property
    def volumes(self) -> NDArray[np.float64]:
        """Signed volumes of the tetrahedra, (n_tets,) mm^3."""
        corner = self.nodes[self.tets]
        return np.asarray(np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6.0)

    @property
    def usual_edge_mm(self) -> float:
        """Edge of the regular tetrahedron that has the volume V of the median one, (6 sqrt(2) V)^(1/3), mm."""
        return float(np.cbrt(6.0 * np.sqrt(2.0) * np.median(self.volumes)))

    def tissue_index(self, name: str) -> int:
        """Index of the tissue of that name in `tissues`; raises `GeometryError` when there is none."""
        names = [tissue.name for tissue in self.tissues]
        if name not in names:
            raise GeometryError(f"the mesh has no tissue '{name}'; it has {names}")
        return names.index(name)


def tet_dihedrals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles (n, 6) in degrees between the faces of tetrahedra with `corners` (n, 4, 3) mm, at their six edges.

    180 degrees less the angle between outward normals; the same for an inverted tetrahedron.
    """
    a, b, c = (corners[:, FACES[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-300)
    cosine = np.einsum("npi,npi->np", normals[:, FACE_PAIRS[:, 0]], normals[:, FACE_PAIRS[:, 1]])
    return np.asarray(180.0 - np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
