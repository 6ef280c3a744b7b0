"""Points of the body that were measured before and after: what landmarks and displacement fields have in common."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.alignment import RigidMotion
from palpate.images.label_image import LPS_TO_RAS
from palpate.images.segmentation import Segmentation
from palpate.mesh.locate import located
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.tet_mesh import TetMesh
from palpate.observation.contract import DataFile, ReactionOf
from palpate.observation.point_displacement import PointDisplacement, point_displacement
from palpate.observation.point_table import MOST_POINTS, PointTable

ALIKE = 0.05  # of a standard deviation: less is told as one number
SLIP = 0.5  # share of the points by which another reading must place more of them inside the mesh to be proposed
TELLING = 20  # least number of points at whose place the later image shows another tissue
NEAR = 0.1  # of the body's largest distance from the origin: a reading with all points nearer to it is no evidence
CLEARLY = 0.4  # share of the points by which another reading must agree better
PLACES = {  # of points that were written otherwise, by what turns them
    "x and y had the other sign: LPS read as RAS": LPS_TO_RAS,
    "they were written in metres": np.full(3, 1e3),
    "they were written in centimetres": np.full(3, 10.0),
    "they were written in micrometres, or the mesh in metres": np.full(3, 1e-3),
}
MOTIONS = {
    "as they are written": np.ones(3),
    "from the later state to the first: give those that lead from the first to the later one": -np.ones(3),
    "in LPS where RAS is read, or the other way round: write tables in RAS, and state the axes of an image": LPS_TO_RAS,
    "from the later state to the first, and in LPS where RAS is read, or the other way round": -LPS_TO_RAS,
}


@dataclass(frozen=True, slots=True)
class MeasuredPoints:
    """Pairs of points as they were read: a `DataSource`, of which each kind says how it makes a term of them."""

    file: DataFile
    table: PointTable

    description = ""

    def cells(self, mesh: TetMesh, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Numbers (n, k) that points (n, 3) mm have in common whose mean is compared; here each stands alone."""
        del mesh
        return np.arange(len(points))[:, None]

    def named(self, inside: NDArray[np.bool_]) -> tuple[tuple[str, ...], tuple[Finding, ...]]:
        """Names of the points inside the mesh, a mask (n,), or none, and what is to be said of the others."""
        del inside
        return (), ()

    @property
    def digests(self) -> tuple[str, ...]:
        """SHA-256 of each file."""
        return self.table.digests

    @property
    def in_words(self) -> str:
        """Number of pairs, how far they move, how large their errors are, and what was left out."""
        n, rms = len(self.table.before), np.sqrt(np.mean(np.sum(self.table.moved**2, axis=1)))
        low, high = np.quantile(self.table.sd, (0.05, 0.95))
        sd = f"{low:.2g}" if high - low < ALIKE * low else f"{low:.2g} to {high:.2g}"
        told = f"{n} pair{'s' * (n > 1)} of points, moved by {rms:.2g} mm (root mean square), sd {sd} mm"
        return "; ".join(part for part in (told, self.table.remark) if part)

    def brought(self, motion: RigidMotion) -> Self:
        """The same with the later points, and the axes of errors, moved back by the rigid motion of the later state."""
        back = motion.inverse()
        sd = np.sqrt(self.table.sd**2 @ (back.rotation**2).T)
        return replace(self, table=replace(self.table, after=back.apply(self.table.after), sd=sd))

    def against(self, before: Segmentation, after: Segmentation) -> None:
        """Raise `InputDataError` where the displacements lead into the wrong tissues.

        Those points tell whose place shows another tissue in the later image: they must arrive in their own.
        """
        step = -(-len(self.table.before) // MOST_POINTS)
        points, moved = self.table.before[::step], self.table.moved[::step]
        own = _tissue(before, points)
        telling = (own >= 0) & (_tissue(after, points) != own)
        if np.count_nonzero(telling) < TELLING:
            return
        points, moved, own = points[telling], moved[telling], own[telling]
        agreement = {words: np.mean(_tissue(after, points + signs * moved) == own) for words, signs in MOTIONS.items()}
        plain, (words, best) = next(iter(agreement.values())), max(agreement.items(), key=lambda found: found[1])
        if best > plain + CLEARLY:
            raise InputDataError(
                f"the displacements of '{self.file.paths[0]}' bring {plain:.0%} of the moved points into their own"
                f" tissue, but would bring {best:.0%} if they led {words}"
            )

    def on(self, space: LagrangeSpace, reaction_of: ReactionOf) -> tuple[PointDisplacement, tuple[Finding, ...]]:
        """The term of the points in the mesh; raises `InputDataError` where none is, or a slip explains the others."""
        del reaction_of
        before, places = self.table.before, located(space.mesh, self.table.before)
        inside = places.inside
        _refuse_slips(space.mesh, before, inside, self.file.paths[0])
        (labels, findings), cells = self.named(inside), self.cells(space.mesh, before[inside])
        seen = (self.table.where(inside), places.of(inside))
        return point_displacement(space, *seen, self.file, self.description, cells=cells, labels=labels), findings


def _refuse_slips(mesh: TetMesh, points: NDArray[np.float64], inside: NDArray[np.bool_], path: Path) -> None:
    """Raise `InputDataError` where points (n, 3) mm lie outside the mesh and a slip would explain that, or all do."""
    share, points = float(inside.mean()), points[:: -(-len(inside) // MOST_POINTS)]
    least = NEAR * np.abs(mesh.nodes).max()
    for words, turn in PLACES.items():
        there = float(located(mesh, points * turn).inside.mean())
        if there > max(SLIP, share + SLIP) and np.abs(points * turn).max() > least:
            raise InputDataError(
                f"{share:.0%} of the points of '{path}' lie in the mesh, and {there:.0%} would if {words}; write RAS mm"
            )
    if not inside.any():
        low, high = points.min(axis=0).round(1).tolist(), points.max(axis=0).round(1).tolist()
        raise InputDataError(
            f"no point of '{path}' lies in the mesh: they span {low} to {high} mm (RAS); give those of this body"
        )


def _tissue(image: Segmentation, points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Index (n,) of the tissue at points (n, 3) mm; -1 outside of the image."""
    index = image.grid.index(points).T
    return map_coordinates(image.index, index, np.int64, order=0, mode="grid-constant", cval=-1)
