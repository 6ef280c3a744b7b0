"""PLY, binary little-endian: a file a tissue and state, double precision."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from palpate.export.closed_surfaces import ClosedSurface, write_surfaces
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.formats import Options

__all__ = ["write"]

FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])


def write(model: FittedModel, body: FittedBody, folder: Path, options: Options) -> None:
    """Write NN_tissue_before.ply and NN_tissue_after.ply."""
    del model, options
    write_surfaces(body, folder, "ply", _content)


def _content(surface: ClosedSurface) -> bytes:
    heading = (
        "ply\nformat binary_little_endian 1.0\ncomment SPACE=RAS; lengths in mm\n"
        f"element vertex {len(surface.points)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(surface.triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.zeros(len(surface.triangles), dtype=FACE)
    faces["count"], faces["corners"] = 3, surface.triangles
    return heading.encode() + surface.points.astype("<f8").tobytes() + faces.tobytes()
