"""VTK XML files in RAS millimetres: unstructured grids (.vtu), surfaces (.vtp), collections to animate (.pvd).

Format: "VTK XML formats", https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html; arrays are written
inline, base64 of zlib-compressed little-endian blocks. In surfaces the field SPACE=RAS tells 3D Slicer not to flip the
model; grids say it in a comment only, because meshio refuses files with a text field.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.mesh.space import LagrangeSpace
from palpate.study.outputs import write_bytes

Arrays = Mapping[str, NDArray[Any]]

VTK_TETRA = {1: 10, 2: 24}  # linear and quadratic tetrahedron; VTK numbers the edges as TET_EDGES does
NAMES = {"f": "Float", "i": "Int", "u": "UInt"}
BLOCK = 2**20  # bytes compressed at once
SPACE_FIELD = (  # the text RAS as VTK writes it: codes that end in zero
    '<FieldData><Array type="String" Name="SPACE" NumberOfTuples="1" format="ascii">82 65 83 0</Array></FieldData>'
)


def write_vtu(path: Path, space: LagrangeSpace, *, point_data: Arrays, cell_data: Arrays) -> None:
    """Write the tetrahedra of `space` to `path` (.vtu).

    point_data: name -> (n_points,) or (n_points, 3); cell_data: name -> (n_tets,) or (n_tets, 3); units belong into the
    names. Raises `InputDataError` on an array of another length, `ResourceError` when the disk refuses.
    """
    _check(point_data, len(space.points), "points")
    _check(cell_data, len(space.cells), "tetrahedra")
    n_cells, size = space.cells.shape
    cells = {
        "connectivity": space.cells.astype(np.int64).ravel(),
        "offsets": size * np.arange(1, n_cells + 1, dtype=np.int64),
        "types": np.full(n_cells, VTK_TETRA[space.order], dtype=np.uint8),
    }
    piece = (
        f'<Piece NumberOfPoints="{len(space.points)}" NumberOfCells="{n_cells}">'
        + _data("PointData", point_data)
        + _data("CellData", cell_data)
        + _points(space.points)
        + f"<Cells>{_arrays(cells)}</Cells></Piece>"
    )
    write_bytes(path, _file("UnstructuredGrid", piece))


def write_vtp(
    path: Path, points: NDArray[np.float64], triangles: NDArray[np.int64], *, point_data: Arrays | None = None
) -> None:
    """Write a surface to `path` (.vtp): points (n_points, 3) RAS mm, triangles (n_faces, 3); point_data as `write_vtu`.

    Points that no triangle uses are left out. Raises as `write_vtu` does.
    """
    _check(point_data or {}, len(points), "points")
    used, local = np.unique(triangles, return_inverse=True)
    polygons = {
        "connectivity": local.astype(np.int64).ravel(),
        "offsets": 3 * np.arange(1, len(triangles) + 1, dtype=np.int64),
    }
    piece = (
        f'<Piece NumberOfPoints="{len(used)}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0"'
        f' NumberOfPolys="{len(triangles)}">'
        + _data("PointData", {name: array[used] for name, array in (point_data or {}).items()})
        + _points(points[used])
        + f"<Polys>{_arrays(polygons)}</Polys></Piece>"
    )
    write_bytes(path, _file("PolyData", piece, field=SPACE_FIELD))


def write_pvd(path: Path, files: Sequence[tuple[float, str]]) -> None:
    """Write a collection to `path` (.pvd): (time, file name beside it) of each step.

    Raises `ResourceError` when the disk refuses.
    """
    sets = "".join(f'<DataSet timestep="{time:g}" part="0" file={quoteattr(name)}/>' for time, name in files)
    text = (
        f'<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1"><Collection>{sets}</Collection></VTKFile>\n'
    )
    write_bytes(path, text.encode())


def _check(data: Arrays, size: int, what: str) -> None:
    for name, array in data.items():
        if len(array) != size:
            raise InputDataError(f"the array '{name}' has {len(array)} rows for {size} {what}: give one row each")


def _file(kind: str, piece: str, *, field: str = "") -> bytes:
    return (
        '<?xml version="1.0"?>\n<!-- SPACE=RAS; lengths in mm -->\n'
        f'<VTKFile type="{kind}" version="1.0" byte_order="LittleEndian" header_type="UInt64"'
        f' compressor="vtkZLibDataCompressor"><{kind}>{field}{piece}</{kind}></VTKFile>\n'
    ).encode()


def _points(points: NDArray[np.float64]) -> str:
    return f"<Points>{_arrays({'Points': points.astype(np.float64)})}</Points>"


def _data(tag: str, arrays: Arrays) -> str:
    return f"<{tag}>{_arrays(arrays)}</{tag}>"


def _arrays(arrays: Arrays) -> str:
    """Each array with its header (number of blocks, block size, size of the last, compressed sizes), base64 both."""
    elements = []
    for name, array in arrays.items():
        kind = f"{NAMES[array.dtype.kind]}{8 * array.dtype.itemsize}"
        width = f' NumberOfComponents="{array.shape[1]}"' if array.ndim == 2 else ""
        raw = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
        blocks = [zlib.compress(raw[start : start + BLOCK], 6) for start in range(0, len(raw), BLOCK)]
        header = np.array([len(blocks), BLOCK, len(raw) % BLOCK, *map(len, blocks)], dtype="<u8")
        content = (base64.b64encode(header.tobytes()) + base64.b64encode(b"".join(blocks))).decode()
        head = f'type="{kind}" Name={quoteattr(name)}{width} format="binary"'
        elements.append(f"<DataArray {head}>{content}</DataArray>")
    return "".join(elements)
