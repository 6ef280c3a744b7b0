"""What other programs make of our exports: CalculiX solves them, the readers of each format read them back.

    make export-check
    python benchmarks/export_check.py [--edge 12] [--only calculix,gmsh,...] [--json]

The demo's pelvis is estimated three times: linear with P2, neo-Hookean with P2 and with the default element. Every line
has a figure and its limit; a program or library that is not installed is a line without a figure, and the exit code is
5 where a limit is not kept. CalculiX: https://www.calculix.de.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from export_laws import Decoupled
from numpy.typing import NDArray
from scipy import sparse

import palpate
from palpate.demo import DATA
from palpate.export import fitted_bodies, material_parts
from palpate.mechanics import Dilatation, equilibrium
from palpate.mesh import OUTER, Constraint, TetMesh, tissue_surface

VOLUME, WARP_MM = 1e-4, 0.05
CASES = (("linear", "P2"), ("neo-hookean", "P2"), ("neo-hookean", "auto"))
LONG = ("Nodes", "Elements", "Surface", "NodeData", "ElementData")  # lists of FEBio's
LPS = np.array([-1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Row:
    """A line of the table: what was checked by which program, its figure and the limit for it; None: not installed."""

    part: str
    what: str
    figure: float | None
    limit: float
    unit: str = ""

    @property
    def kept(self) -> bool:
        """Whether the limit is kept, or nothing was checked."""
        return self.figure is None or self.figure <= self.limit


def main() -> int:
    """Check all, print the table; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--edge", type=float, default=12.0, help="edge length at the organs, mm (default: %(default)s)")
    parser.add_argument("--only", default=",".join(PARTS), help=f"some of {', '.join(PARTS)}")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    wanted = arguments.only.split(",")
    rows: list[Row] = []
    results: dict[tuple[str, str], palpate.CaseResult] = {}
    for law, element in CASES if "calculix" in wanted else CASES[1:2]:
        results[law, element] = estimated(law, element, arguments.edge)
    with tempfile.TemporaryDirectory() as folder:
        for name in wanted:
            for row in PARTS[name](results, Path(folder)):
                rows.append(row)
                print(f"{row.part}: {row.what}: {text(row)}", file=sys.stderr, flush=True)
    if arguments.json:
        print(json.dumps([{**row.__dict__, "kept": row.kept} for row in rows], indent=1))
    else:
        print("| program | what | found | limit |\n|---|---|---|---|")
        for row in rows:
            print(f"| {row.part} | {row.what} | {text(row)} | {row.limit:g} {row.unit} |")
    return 0 if all(row.kept for row in rows) else 5


def text(row: Row) -> str:
    """The figure of a row, as it stands in the table."""
    return "not installed" if row.figure is None else f"{row.figure:.2g} {row.unit}".strip()


def estimated(law: str, element: str, edge: float) -> palpate.CaseResult:
    """The demo's estimate under a law, with an element."""
    overrides = [f"mechanics.law={law}", f"mechanics.element={element}", f"mesh.edge_length_mm={edge}"]
    case = palpate.read_case(DATA / "demo.toml", [*overrides, "estimate.start_ratios=[2.0]"])
    return palpate.estimate(case, progress=lambda message: print(f"  {law} {element}: {message}", file=sys.stderr))


Results = dict[tuple[str, str], palpate.CaseResult]


def any_of(results: Results) -> palpate.CaseResult:
    """The neo-Hookean result with plain quadratic elements, on which formats are checked."""
    return results["neo-hookean", "P2"]


def calculix(results: Results, folder: Path) -> Iterator[Row]:
    """Solve each case with CalculiX and compare the displacement of every node with ours."""
    limits = {("linear", "P2"): 0.1, ("neo-hookean", "P2"): 0.5, ("neo-hookean", "auto"): 0.5}
    for key, result in results.items():
        what = f"{key[0]}, {key[1]}: RMS of the nodes' displacements to ours, of the largest motion"
        if shutil.which("ccx") is None:
            yield Row("CalculiX", what, None, limits[key], "%")
            continue
        place = folder / "-".join(key)
        palpate.export(result, place, format="abaqus")
        theirs = solved_by_calculix(place, len(result.space.points))
        ours = result.estimation.displacements[-1]
        yield Row("CalculiX", what, percent(theirs, ours), limits[key], "%")
        if key == ("neo-hookean", "P2"):
            same = under_decoupled_law(result, place / "palpate.inp")
            words = "neo-hookean, P2: RMS to ours under its own volumetric term"
            yield Row("CalculiX", words, percent(theirs, same), 0.01, "%")
            yield Row("Palpate", "our law to that of CalculiX, both solved by us", percent(same, ours), 0.5, "%")


def solved_by_calculix(folder: Path, n_points: int) -> NDArray[np.float64]:
    """Displacement (n_points, 3) mm at the end of the last step."""
    environment = {**os.environ, "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "2")}
    command = [shutil.which("ccx") or "ccx", "palpate"]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if "Job finished" not in done.stdout:
        raise RuntimeError(f"CalculiX ended without a result: {done.stdout[-2000:]}")
    found = np.full((n_points, 3), np.nan)
    for line in (folder / "palpate.dat").read_text().splitlines():
        words = line.split()
        if len(words) == 4 and words[0].isdigit():
            found[int(words[0]) - 1] = [float(word) for word in words[1:]]
    return found


def percent(found: NDArray[np.float64], expected: NDArray[np.float64]) -> float:
    """RMS over the nodes of the distance of two displacements, in per cent of the largest motion."""
    distance = np.linalg.norm(found - expected, axis=1)
    return float(100.0 * np.sqrt((distance**2).mean()) / np.linalg.norm(expected, axis=1).max())


def under_decoupled_law(result: palpate.CaseResult, path: Path) -> NDArray[np.float64]:
    """Our displacement (n_points, 3) mm under CalculiX's law and the conditions of its input file."""
    lines = path.read_text().split("*BOUNDARY\n")[1].split("*")[0].splitlines()
    given = np.array([[float(x) for x in line.split(",")] for line in lines if line.count(",") == 3])
    dofs = 3 * (given[:, 0].astype(int) - 1) + given[:, 1].astype(int) - 1
    n = 3 * len(result.space.points)
    offset, free = np.zeros(n), np.ones(n, dtype=bool)
    offset[dofs], free[dofs] = given[:, 3], False
    constraint = Constraint(sparse.csr_matrix(sparse.identity(n, format="csc")[:, free]), np.zeros((n, 0)), offset)
    body = fitted_bodies(result)[0]
    parts, region = material_parts(body.mesh, body.log_ratio), np.empty_like(body.mesh.region)
    for number, part in enumerate(parts):
        region[part.cells] = number
    tissues = tuple(replace(body.tissues[part.tissue], name=part.name) for part in parts)
    mesh = replace(body.mesh, region=region, tissues=tissues, beyond=np.full_like(body.mesh.beyond, OUTER))
    moduli = np.array([result.stiffness[part.tissue] * np.exp(part.log_ratio) for part in parts])
    space = replace(result.space, mesh=mesh)
    return equilibrium(space, constraint, moduli, law=Decoupled(), dilatation=Dilatation.POINTWISE).displacement


def volumes_of(mesh: TetMesh) -> dict[str, float]:
    """Volume of each meshed tissue, mm^3."""
    regions = {t.name: i for i, t in enumerate(mesh.tissues) if t.meshed}
    return {name: float(mesh.volumes[mesh.region == i].sum()) for name, i in regions.items()}


def worst_volume(found: dict[str, float], mesh: TetMesh) -> float:
    """Largest relative difference of a tissue's volume; infinite where one is missing."""
    expected = volumes_of(mesh)
    return max(abs(found.get(name, np.inf) / size - 1.0) for name, size in expected.items())


def tetrahedra(points: NDArray[np.float64], cells: NDArray[np.int64]) -> float:
    """Volume of tetrahedra by their corners, mm^3."""
    corner = points[cells[:, :4]]
    return float(np.linalg.det(corner[:, 1:] - corner[:, :1]).sum() / 6.0)


def gmsh(results: Results, folder: Path) -> Iterator[Row]:
    """Read, name, measure and write again by gmsh itself."""
    result = any_of(results)
    module = installed("gmsh")
    what = "volume of a tissue, relative difference", "physical groups lost when gmsh writes the file again"
    if module is None:
        yield from (Row("gmsh", words, None, limit) for words, limit in zip(what, (VOLUME, 0), strict=True))
        return
    (path,) = palpate.export(result, folder / "gmsh", format="gmsh")
    module.initialize()
    try:
        module.option.setNumber("General.Terminal", 0)
        module.open(str(path))
        found = {}
        for dimension, tag in module.model.getPhysicalGroups(3):
            tags = [
                tag
                for entity in module.model.getEntitiesForPhysicalGroup(dimension, tag)
                for tags in module.model.mesh.getElements(3, entity)[1]
                for tag in tags
            ]
            name = module.model.getPhysicalName(dimension, tag)
            found[name] = float(np.sum(module.model.mesh.getElementQualities(tags, "volume")))
        names = physical_names(module)
        module.write(str(folder / "again.msh"))
        module.clear()
        module.open(str(folder / "again.msh"))
        again = physical_names(module)
    finally:
        module.finalize()
    yield Row("gmsh", what[0], worst_volume(found, result.space.mesh), VOLUME)
    yield Row("gmsh", what[1], len(names - again) + (len(names) < 10), 0)


def physical_names(module: Any) -> set[str]:
    """Names of all physical groups of gmsh's model that have elements."""
    groups = module.model.getPhysicalGroups()
    return {module.model.getPhysicalName(*g) for g in groups if len(module.model.getEntitiesForPhysicalGroup(*g))}


def meshes(results: Results, folder: Path) -> Iterator[Row]:
    """Volumes and sets by meshio, closed surfaces by trimesh."""
    result = any_of(results)
    mesh, meshio = result.space.mesh, importlib.import_module("meshio")
    for name, file in (("abaqus", "palpate.inp"), ("gmsh", "palpate.msh")):
        palpate.export(result, folder / f"meshio-{name}", format=name)
        read = meshio.read(folder / f"meshio-{name}" / file)
        plain = {tissue: tissue.upper() if name == "abaqus" else tissue for tissue in volumes_of(mesh)}
        sizes = {
            tissue: sum(
                tetrahedra(read.points, block.data[ids])
                for block, ids in zip(read.cells, read.cell_sets[key], strict=True)
                if ids is not None and len(ids) and block.type.startswith("tetra")
            )
            for tissue, key in plain.items()
        }
        yield Row("meshio", f"{name}: volume of a tissue, relative difference", worst_volume(sizes, mesh), VOLUME)
    trimesh = installed("trimesh")
    for name in ("stl", "obj", "ply"):
        words = f"{name}: volume of a tissue, relative difference", f"{name}: surfaces that are not closed and outward"
        if trimesh is None:
            yield from (Row("trimesh", what, None, limit) for what, limit in zip(words, (VOLUME, 0), strict=True))
            continue
        sizes, open_ones = {}, 0
        for path in palpate.export(result, folder / name, format=name):
            surface = trimesh.load(path)
            open_ones += not (closed(surface) and surface.volume > 0.0)
            number, rest = path.stem.split("_", 1)
            if rest.endswith("_before"):
                sizes[result.tissues[int(number)].name] = float(surface.volume)
        yield Row("trimesh", words[0], worst_volume(sizes, mesh), VOLUME)
        yield Row("trimesh", words[1], open_ones, 0)


def closed(surface: Any) -> bool:
    """Whether every edge is passed as often one way as the other: where a body touches itself, twice each."""
    ways = np.asarray(surface.edges)
    keys = ways @ [len(surface.vertices), 1]
    return bool(np.array_equal(np.sort(keys), np.sort(ways[:, ::-1] @ [len(surface.vertices), 1])))


def febio(results: Results, folder: Path) -> Iterator[Row]:
    """The schema of elements as pyfebio has it, on a file whose long lists are cut; it knows no maps as values."""
    result, what = any_of(results), "errors of the schema"
    module = installed("pyfebio.model")
    if module is None:
        yield Row("pyfebio", what, None, 0)
        return
    (path,) = palpate.export(result, folder / "febio", format="febio")
    root = ET.parse(path).getroot()
    points = np.array(
        [[float(x) for x in node.text.split(",")] for node in root.iter("node") if node.text and "id" in node.attrib]
    )
    sizes = {
        str(part.get("name")): tetrahedra(points, np.array([integers(e) for e in part]) - 1)
        for part in root.iter("Elements")
    }
    yield Row("XML", "FEBio: volume of a tissue, relative difference", worst_volume(sizes, result.space.mesh), VOLUME)
    for parent in root.iter():
        for child in list(parent)[20:] if parent.tag in LONG else []:
            parent.remove(child)
        if parent.attrib.get("type") == "map":
            del parent.attrib["type"]
            parent.text = "1.0"
        if parent.tag in ("NodeSet", "ElementSet"):
            parent.text = ",".join(map(str, integers(parent)[:20]))
    try:
        model = module.Model.from_xml(ET.tostring(root))
        errors = int(len(model.material_.all_materials) != len(sizes))
    except ValueError as error:
        print(str(error)[:3000], file=sys.stderr)
        errors = str(error).count("\n  [line ")
    yield Row("pyfebio", what, errors, 0)


def integers(element: ET.Element) -> list[int]:
    """The numbers in the text of an element."""
    return [int(x) for x in (element.text or "").split(",")]


def warp(results: Results, folder: Path) -> Iterator[Row]:
    """Points of before's surfaces through SimpleITK's transform to where the model has them, and back."""
    result, sitk = any_of(results), importlib.import_module("SimpleITK")
    palpate.export(result, folder / "warp", format="warp")
    space, displacement = result.space, result.estimation.displacements[-1]
    meshed = [i for i, tissue in enumerate(result.tissues) if tissue.meshed]
    faces = np.concatenate([tissue_surface(space.mesh, i).triangles for i in meshed])
    points = np.unique(space.facets(faces))
    before = space.points[points]
    after = before + displacement[points]
    if result.alignments:
        after = result.alignments[-1].motion.apply(after)
    for name, start, goal in (("warp", before, after), ("inverse_warp", after, before)):
        image = sitk.ReadImage(str(folder / "warp" / f"{name}.nii.gz"), sitk.sitkVectorFloat64)
        transform = sitk.DisplacementFieldTransform(image)
        found = np.array([transform.TransformPoint(p) for p in (start * LPS).tolist()]) * LPS
        rms = float(np.sqrt(((found - goal) ** 2).sum(axis=1).mean()))
        yield Row("SimpleITK", f"{name}: RMS distance of all surfaces' nodes to the model's", rms, WARP_MM, "mm")


def dicom(results: Results, folder: Path) -> Iterator[Row]:
    """Voxels of each modulus by pydicom, of each tissue by highdicom."""
    result, highdicom = any_of(results), importlib.import_module("highdicom")
    pydicom = importlib.import_module("pydicom")
    palpate.export(result, folder / "dicom", format="dicom")
    stiffness = pydicom.dcmread(folder / "dicom" / "stiffness.dcm")
    values = np.frombuffer(stiffness.FloatPixelData, dtype="<f4")
    moduli = [m for m in result.stiffness if np.isfinite(m)]
    found = sorted(set(np.unique(values).tolist()) - {0.0})
    off = max(abs(a / b - 1.0) for a, b in zip(found, sorted(set(moduli)), strict=True))
    yield Row("pydicom", "stiffness.dcm: relative difference of a modulus", off, 1e-6)
    segmentation = highdicom.seg.segread(folder / "dicom" / "segmentation.dcm")
    wrong = 0
    for item in segmentation.SegmentSequence:
        volume = segmentation.get_volume(segment_numbers=[int(item.SegmentNumber)], combine_segments=True)
        number = [tissue.name for tissue in result.tissues].index(str(item.SegmentLabel))
        wrong += abs(int(np.count_nonzero(volume.array)) - int(np.count_nonzero(result.before.index == number)))
    yield Row("highdicom", "segmentation.dcm: voxels of a tissue lost or gained", wrong, 0)


def netcdf(results: Results, folder: Path) -> Iterator[Row]:
    """Samples by xarray: their mean and spread are those of the result."""
    result, what = any_of(results), "posterior.nc: difference of a sample's log-mean, in standard deviations"
    xarray = installed("xarray")
    if xarray is None or installed("h5netcdf") is None:
        yield Row("xarray", what, None, 0.1)
        return
    palpate.export(result, folder / "netcdf", format="netcdf")
    samples = xarray.open_dataset(folder / "netcdf" / "posterior.nc", group="posterior", engine="h5netcdf")
    estimates = {item.tissue: item.value or np.nan for item in result.estimation.estimates}
    logs = np.log(samples["youngs_modulus"]).stack(sample=("chain", "draw"))
    expected = np.log([estimates[str(name)] for name in samples["tissue"].values])
    off = np.abs(logs.mean("sample").values - expected) / logs.std("sample").values
    yield Row("xarray", what, float(off.max()), 0.1)


def installed(name: str) -> Any:
    """The module of that name; None where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


PARTS: dict[str, Callable[[Results, Path], Iterator[Row]]] = {
    "calculix": calculix,
    "gmsh": gmsh,
    "meshes": meshes,
    "febio": febio,
    "warp": warp,
    "dicom": dicom,
    "netcdf": netcdf,
}

if __name__ == "__main__":
    sys.exit(main())
