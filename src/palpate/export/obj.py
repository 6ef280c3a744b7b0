"""Wavefront OBJ: a file a tissue and state, the tissue's name its object's."""

from __future__ import annotations

from pathlib import Path

from palpate.export.closed_surfaces import ClosedSurface, write_surfaces
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.formats import Options
from palpate.export.text_lines import rows

__all__ = ["write"]


def write(model: FittedModel, body: FittedBody, folder: Path, options: Options) -> None:
    """Write NN_tissue_before.obj and NN_tissue_after.obj."""
    del model, options
    write_surfaces(body, folder, "obj", _content)


def _content(surface: ClosedSurface) -> bytes:
    heading = f"# SPACE=RAS; lengths in mm\no {surface.name}\n"
    text = heading + rows("v %.9g %.9g %.9g", surface.points) + rows("f %d %d %d", surface.triangles + 1)
    return text.encode()
