"""The pictures of docs/export.md: a result's files in each format, read and drawn by libraries that are not ours.

    make demo && pip install --editable ".[export-check]" pyvista
    python docs/pictures/exports.py demo-output [--only abaqus,gmsh]

Writes `export.jpg` (ParaView) and `export-PAGE.jpg` or `.png` beside this file. `abaqus` needs CalculiX' `ccx` and a
minute and a half; `view` and `notebook` need a Chromium, the latter estimates the case again. No other program is run:
PyVista (VTK), gmsh's module, SimpleITK, pydicom, highdicom, xarray and Python's XML read what was exported.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import palpate

HERE = Path(__file__).parent


class Picture(NamedTuple):
    """Its file, the module in `exported` with the page's function, the format; without one the result is drawn."""

    file: str
    module: str
    format: str | None = None


PICTURES = {
    "paraview": Picture("export.jpg", "bodies", "paraview"),
    "abaqus": Picture("export-abaqus.jpg", "bodies", "abaqus"),
    "febio": Picture("export-febio.jpg", "bodies", "febio"),
    "gmsh": Picture("export-gmsh.jpg", "bodies", "gmsh"),
    "sofa": Picture("export-sofa.jpg", "bodies", "sofa"),
    "surfaces": Picture("export-surfaces.jpg", "bodies", "stl"),
    "slicer": Picture("export-slicer.jpg", "images", "slicer"),
    "warp": Picture("export-warp.jpg", "images", "warp"),
    "dicom": Picture("export-dicom.jpg", "images", "dicom"),
    "tables": Picture("export-tables.png", "tables", "netcdf"),
    "view": Picture("export-view.jpg", "view"),
    "notebook": Picture("export-notebook.jpg", "view"),
}


def main() -> None:
    """Draw those that are wanted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="what `palpate demo` wrote")
    parser.add_argument("--only", default=",".join(PICTURES), help="pages, separated by commas")
    arguments = parser.parse_args()
    for name in arguments.only.split(","):
        picture = PICTURES[name]
        draw = getattr(import_module(f"exported.{picture.module}"), name)
        with tempfile.TemporaryDirectory() as place:
            source = (
                arguments.folder if picture.format is None else exported(arguments.folder, Path(place), picture.format)
            )
            draw(source, HERE / picture.file)
        print(f"{picture.file}: {(HERE / picture.file).stat().st_size // 1000} kB")


def exported(result: Path, place: Path, name: str) -> Path:
    """A folder with the result in a format, and for programs of images the case's own beside it."""
    folder = place / name
    palpate.export(result, folder, format=name)
    images = palpate.read_case(result / "case.toml").images
    assert images is not None, "the demo's case has images"
    if name == "warp":
        shutil.copy(images.before, folder / "before.nii.gz")
        shutil.copy(images.after[0], folder / "after.nii.gz")
    if name == "slicer" and images.intensities_before is not None:
        shutil.copy(images.intensities_before, folder / "before.nii.gz")
    return folder


if __name__ == "__main__":
    main()
