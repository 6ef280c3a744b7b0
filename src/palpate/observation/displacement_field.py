"""A measured displacement field: many points, whose errors may be alike."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.errors import InputDataError
from palpate.images.tissue import Role
from palpate.mesh.tet_mesh import TetMesh
from palpate.observation.contract import DataFile
from palpate.observation.dvc_file import read_dvc
from palpate.observation.field_file import read_field
from palpate.observation.measured_points import MeasuredPoints
from palpate.observation.point_table import PointTable, checked_table, read_point_table, stated_sd

OWN_AXES = {".csv": "RAS"} | dict.fromkeys((".npz", ".vti"), "the axes of its volume, taken for RAS")
FEWEST = 4  # points that are needed to measure a motion that varies in space
COARSER = 2  # how often the edge of a cell is doubled at the most
OF_LENGTH, OF_EDGE = 0.5, 0.6  # edge of a cell, over the correlation length and over an edge of the mesh


@dataclass(frozen=True, slots=True)
class DisplacementField(MeasuredPoints):
    """Points that are many, whose errors may be alike; implements `DataSource`."""

    description = "the difference between the model's displacement and a measured field"

    def cells(self, mesh: TetMesh, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """The cell (n, 4) of each point (n, 3) mm: three numbers and its level, by which edges are doubled.

        What is nearer than half a correlation length, or six tenths of an edge, says the same. How an organ's stiffness
        moves what lies outside varies over as much as lies between (Saint-Venant): there means are of twice as much at
        each twofold distance.
        """
        size = max(OF_LENGTH * (self.file.correlation_mm or 0.0), OF_EDGE * mesh.usual_edge_mm)
        sought = [n for n, tissue in enumerate(mesh.tissues) if tissue.role is Role.ESTIMATE]
        nodes = mesh.nodes[np.unique(mesh.tets[np.isin(mesh.region, sought)])]
        away = np.asarray(cKDTree(nodes).query(points)[0])
        level = np.minimum(np.floor(np.log2(np.maximum(away / size, 1.0))), COARSER)[:, None]
        cells = np.hstack([(points - points.min(axis=0)) / (size * 2.0**level), level])
        return np.asarray(np.floor(cells), dtype=np.int64)


def read_displacement_field(file: DataFile) -> DisplacementField:
    """Read a field that maps the first state to the later one, mm: .csv as landmarks have it, .npz, .vti, `field_file`.

    Voxels without a finite vector, or whose vector is exactly 0, are taken for empty. Raises `InputDataError`.
    """
    path = file.paths[0]
    if len(file.paths) != 1:
        raise InputDataError(f"a displacement field is one file, but {len(file.paths)} are named; remove file_after")
    if file.axes and path.suffix.lower() in OWN_AXES:
        raise InputDataError(
            f"'{path}' is in {OWN_AXES[path.suffix.lower()]}, but the case states {file.axes}; turn its places and"
            " motions, and remove the key axes from [[data]]"
        )
    if path.suffix.lower() == ".csv":
        table = read_point_table(file)
        if len(table.before) < FEWEST:
            raise InputDataError(
                f"'{path}' holds {len(table.before)} points, and a field needs at least {FEWEST}; give them as"
                " landmarks"
            )
        return DisplacementField(file, table)
    if path.suffix.lower() in (".npz", ".vti"):
        table, edges = read_dvc(file)
        edges, length = file.subset_mm or edges, file.correlation_mm
        length = 0.5 * float(np.mean(edges)) if length is None else length  # half a subset is common to both
        return DisplacementField(replace(file, subset_mm=edges, correlation_mm=length), checked_table(table, path))
    vectors, grid, digests = read_field(path, file.axes)
    given = np.isfinite(vectors).all(axis=-1) & vectors.any(axis=-1)
    if not given.any():
        raise InputDataError(f"'{path}' holds only zero vectors; give a field with a motion")
    before = grid.world(np.argwhere(given).astype(np.float64))
    sd = stated_sd(file, len(before))
    table = PointTable(before, before + vectors[given], sd, ("",) * len(before), digests)
    return DisplacementField(file, checked_table(table, path))
