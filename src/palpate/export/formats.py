"""The formats of `palpate export`: another format is another file here, and a line in FORMATS."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Protocol, cast

from palpate.errors import ConfigurationError

if TYPE_CHECKING:  # the command line names the formats before numpy is loaded
    from pathlib import Path

    from palpate.export.fitted_model import FittedBody, FittedModel


@dataclass(frozen=True, slots=True)
class Options:
    """What a user may say of an export: linear tetrahedra in place of quadratic ones; a DICOM series to refer to."""

    linear: bool = False
    source: Path | None = None


class Write(Protocol):
    """The function that writes a format: one body's files into a folder that is there."""

    def __call__(self, model: FittedModel, body: FittedBody, folder: Path, *source: Path | None) -> None:
        """Write them; raises `ResourceError` when the disk refuses, or a library is missing."""
        ...


@dataclass(frozen=True, slots=True)
class Format:
    """A format: the module of `palpate.export` that writes it, and what it is, in a few words.

    every_pair: whether each pair of images has files of its own; function: of the module; refers: whether that takes
    the folder of a DICOM series, too.
    """

    module: str
    description: str
    every_pair: bool = True
    function: str = "write"
    refers: bool = False

    @property
    def write(self) -> Write:
        """The function that writes it."""
        return cast("Write", getattr(import_module(f"palpate.export.{self.module}"), self.function))


FORMATS = {
    "abaqus": Format("abaqus", "Abaqus and CalculiX, .inp"),
    "csv": Format("csv_tables", "tidy tables of moduli, fits and samples, .csv"),
    "dicom": Format("dicom", "DICOM Parametric Map and Segmentation, .dcm", refers=True),
    "febio": Format("febio", "FEBio 4, .feb"),
    "gmsh": Format("gmsh", "gmsh 4.1 with physical groups, .msh"),
    "netcdf": Format("netcdf", "posterior samples for ArviZ and xarray, .nc", every_pair=False),
    "obj": Format("closed_surfaces", "Wavefront surfaces before and after, .obj", function="write_obj"),
    "paraview": Format("vtu", "a ParaView script with its data, .py", function="write_paraview"),
    "ply": Format("closed_surfaces", "polygon surfaces before and after, .ply", function="write_ply"),
    "slicer": Format("slicer", "a 3D Slicer script with its data, .py"),
    "sofa": Format("sofa", "a SOFA scene with its mesh, .py"),
    "stl": Format("closed_surfaces", "surfaces before and after, .stl", function="write_stl"),
    "vtu": Format("vtu", "VTK meshes with an animation, .vtu, .pvd, .vtm"),
    "warp": Format("warp", "the fitted motion as a displacement field for ITK, .nii.gz"),
}


def format_named(name: str) -> Format:
    """The format of that name; raises `ConfigurationError` for another."""
    if name not in FORMATS:
        raise ConfigurationError(f"there is no format '{name[:40]}' to export to; choose among {', '.join(FORMATS)}")
    return FORMATS[name]
