"""STL, binary: a file a tissue and state; its heading tells 3D Slicer that the coordinates are RAS."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from palpate.export.closed_surfaces import ClosedSurface, write_surfaces
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.formats import Options
from palpate.mesh.surface import triangle_normals

__all__ = ["write"]

HEADING = b"SPACE=RAS; lengths in mm"
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def write(model: FittedModel, body: FittedBody, folder: Path, options: Options) -> None:
    """Write NN_tissue_before.stl and NN_tissue_after.stl."""
    del model, options
    write_surfaces(body, folder, "stl", _content)


def _content(surface: ClosedSurface) -> bytes:
    facets = np.zeros(len(surface.triangles), dtype=FACET)
    normals = triangle_normals(surface.points, surface.triangles)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    facets["normal"] = normals / np.maximum(lengths, np.finfo(float).tiny)
    facets["corners"] = surface.points[surface.triangles]
    return HEADING.ljust(80) + np.uint32(len(facets)).tobytes() + facets.tobytes()
