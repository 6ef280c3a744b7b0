"""The files of an estimate and of a simulation that other programs read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.export.fitted_model import fitted_model
from palpate.export.model_file import MODEL, write_model
from palpate.export.netcdf import write_posterior
from palpate.export.vtk_xml import write_pvd, write_vtp, write_vtu
from palpate.images.label_image import LabelImage
from palpate.images.label_table import slicer_table
from palpate.images.named_labels import NamedLabel
from palpate.images.readers import write_label_image, write_scalar_image
from palpate.images.segmentation import Segmentation, first_labels
from palpate.images.tissue import Tissue, tissue_colours
from palpate.mechanics.element import largest_strains
from palpate.mesh.locate import tetrahedron_image
from palpate.mesh.space import LagrangeSpace
from palpate.mesh.surface import tissue_surface
from palpate.mesh.tet_mesh import TetMesh
from palpate.statement.known_images import FORMAT
from palpate.statement.result import CaseResult, MeshResult, Simulation
from palpate.statement.samples import POSTERIOR
from palpate.study.archive import write_archive
from palpate.study.earlier import seal_of
from palpate.study.outputs import KNOWN_IMAGES, make_folder, write_text

MOST_BYTES = 60  # of a tissue's name in a file's: file systems count bytes, not letters


def write_label_table(path: Path, tissues: tuple[Tissue, ...]) -> Path:
    """Write number, name and colour of each tissue, but for the background's, as 3D Slicer's CSV.

    Returns the path; raises `ResourceError` when the disk refuses.
    """
    described = zip(first_labels(tissues), tissues, tissue_colours(tissues), strict=True)
    rows = [NamedLabel(int(number), tissue.name, colour) for number, tissue, colour in described if number]
    write_text(path, slicer_table(sorted(rows, key=lambda row: row.label)))
    return path


def write_estimate_files(result: CaseResult, folder: Path) -> tuple[Path, ...]:
    """Write mesh.vtu (displacement of the last image), stiffness.nii.gz (`result.unit`), labels.nii.gz and labels.csv.

    stiffness_sd.nii.gz, the standard deviation of ln E, where the modulus of a tissue is a field. Each further pair has
    its own mesh_2.vtu, mesh_3.vtu ...; a converged result leaves model.npz for `palpate export`, and posterior.nc where
    it has samples; known-images.npz is left where later images can be added. Returns the paths written; raises
    `ResourceError` when the disk refuses.
    """
    make_folder(folder)
    paths = [folder / "mesh.vtu", folder / "stiffness.nii.gz"]
    _write_fitted(paths[0], result, 0)
    grid, images = result.before.grid, result.stiffness_map()
    if result.estimation.maps:
        paths.append(folder / "stiffness_sd.nii.gz")
    element = tetrahedron_image(result.space.mesh, grid)
    for path, values in zip(paths[1:], images, strict=False):
        write_scalar_image(path, np.append(values, np.nan)[element], grid)  # -1, outside the mesh, takes the last entry
    paths += write_labels(result.before, folder)
    for number in range(1, len(result.pairs)):
        paths.append(folder / f"mesh_{number + 1}.vtu")
        _write_fitted(paths[-1], result, number)
    if result.known is not None:
        paths.append(folder / KNOWN_IMAGES)
        write_archive(result.known, paths[-1], version=FORMAT)
    if result.estimation.status == "converged":
        model = fitted_model(result, seal=seal_of(result.to_dict()))
        paths.append(folder / MODEL)
        write_model(model, paths[-1])
        if model.samples is not None:
            paths.append(folder / POSTERIOR)
            write_posterior(model, paths[-1])
    return tuple(paths)


def _write_fitted(path: Path, result: CaseResult, number: int) -> None:
    """The mesh of a pair with the moduli of the result and the last of its displacements."""
    pair, (stiffness, sd, resolution) = result.pairs[number], result.stiffness_map(number)
    extra = {} if result.unit == "kPa" else {"youngs_modulus_ratio": stiffness}
    if result.estimation.maps:
        extra |= {"ln_modulus_sd": sd, "resolution": resolution}
    last = [np.zeros_like(pair.space.points), *result.displacements_of(number)][-1]
    kilopascals = stiffness if result.unit == "kPa" else np.full_like(stiffness, np.nan)
    write_moved(path, pair.space, last, cell_data(pair.space.mesh, kilopascals) | extra)


def write_moved(
    path: Path, space: LagrangeSpace, displacement: NDArray[np.float64], cells: Mapping[str, NDArray[Any]]
) -> None:
    """A mesh (.vtu) with a displacement (n_points, 3) mm, the strain that it makes of each tetrahedron, and cell data.

    cells: name -> (n_tets,). Raises `ResourceError` when the disk refuses.
    """
    strained = {**cells, "largest_strain": largest_strains(space, displacement)}
    write_vtu(path, space, point_data={"displacement_mm": displacement}, cell_data=strained)


def write_mesh_files(result: MeshResult, folder: Path) -> tuple[Path, ...]:
    """Write mesh.vtu (moduli: NaN where the case gives none), labels as above and a surface of each tissue."""
    make_folder(folder)
    mesh, space = result.space.mesh, result.space
    given = np.array([tissue.youngs_modulus_kpa or np.nan for tissue in mesh.tissues])
    path = folder / "mesh.vtu"
    still = np.zeros_like(space.points)
    write_vtu(path, space, point_data={"displacement_mm": still}, cell_data=cell_data(mesh, given[mesh.region]))
    labels = write_labels(result.before, folder)
    return (path, *labels, *_write_surfaces(space, still, folder / "surfaces", ending="before"))


def write_simulation_files(result: Simulation, folder: Path) -> tuple[Path, ...]:
    """Write both label images, labels.csv, mesh.vtu, surfaces before and after, mesh.pvd for steps; as above."""
    make_folder(folder)
    images = (folder / "before.nii.gz", folder / "after.nii.gz")
    write_label_image(images[0], result.before)
    write_label_image(images[1], result.after)
    space, last = result.space, result.displacements[-1]
    moduli = np.array([result.moduli_kpa.get(tissue.name, np.nan) for tissue in space.mesh.tissues])
    cells = cell_data(space.mesh, moduli[space.mesh.region])
    write_moved(folder / "mesh.vtu", space, last, cells)
    table = write_label_table(folder / "labels.csv", space.mesh.tissues)
    surfaces, still = folder / "surfaces", np.zeros_like(last)
    paths = [*images, folder / "mesh.vtu", table]
    paths += _write_surfaces(space, still, surfaces, ending="before")
    paths += _write_surfaces(space, last, surfaces, ending="after")
    if len(result.displacements) > 1:
        states = (still, *result.displacements)
        steps_folder = make_folder(folder / "steps")
        steps = [steps_folder / f"step_{number:03d}.vtu" for number in range(len(states))]
        for path, displacement in zip(steps, states, strict=True):
            write_moved(path, space, displacement, cells)
        times = np.linspace(0.0, 1.0, len(steps))
        write_pvd(folder / "mesh.pvd", [(float(t), f"steps/{path.name}") for t, path in zip(times, steps, strict=True)])
        paths += [folder / "mesh.pvd", *steps]
    return tuple(paths)


def write_labels(before: Segmentation, folder: Path) -> tuple[Path, Path]:
    """Write labels.nii.gz, the earlier image with our numbers of the tissues, and labels.csv, which names them.

    Returns the paths; raises `ResourceError` when the disk refuses.
    """
    image, numbers = folder / "labels.nii.gz", first_labels(before.tissues)
    write_label_image(image, LabelImage(numbers[before.index], before.grid))
    return image, write_label_table(folder / "labels.csv", before.tissues)


def file_name(name: str) -> str:
    """A tissue's name as a part of a file name: letters, digits, hyphen and underscore only, of 60 bytes at most."""
    plain = "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in name)
    return plain.encode("utf-8")[:MOST_BYTES].decode("utf-8", errors="ignore") or "tissue"


def _write_surfaces(
    space: LagrangeSpace, displacement: NDArray[np.float64], folder: Path, *, ending: str
) -> tuple[Path, ...]:
    make_folder(folder)
    mesh = space.mesh
    moved = mesh.nodes + displacement[: len(mesh.nodes)]
    paths = []
    for number, tissue in enumerate(mesh.tissues):
        triangles = tissue_surface(mesh, number).triangles
        if len(triangles):
            paths.append(folder / f"{number:02d}_{file_name(tissue.name)}_{ending}.vtp")
            write_vtp(paths[-1], moved, triangles)
    return tuple(paths)


def cell_data(
    mesh: TetMesh, moduli: NDArray[np.float64], *, called: str = "youngs_modulus_kpa"
) -> dict[str, NDArray[Any]]:
    """Label, modulus (n_tets,) under the name `called`, and Poisson's ratio of each tetrahedron."""
    poisson = np.array([tissue.poisson_ratio for tissue in mesh.tissues])
    return {"label": first_labels(mesh.tissues)[mesh.region], called: moduli, "poisson_ratio": poisson[mesh.region]}
