"""Our exports in other programs: CalculiX solves them, and readers of each format read them back.

    make export-check
    python benchmarks/export_check.py [--edge 12] [--only calculix,meshes,...] [--json]

The demo's pelvis is estimated three times: linear with P2, neo-Hookean with P2 and with the default element. A box that
is turned in space slides along its image's own faces, under gravity, a pressure in a cavity and a traction, twice.
Every line has a figure and its limit. A program that is not installed has a line without a figure. The exit code is 5
where a figure exceeds its limit.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import nibabel
import numpy as np
from numpy.typing import NDArray
from rows import said, table_of
from scipy.spatial.transform import Rotation

import palpate
from palpate.demo import DATA
from palpate.export import face_groups, write_estimate_files
from palpate.images import VoxelGrid, write_label_image
from palpate.mesh import TetMesh, modulus_image, tissue_surface

Array = NDArray[np.float64]
Results = dict[tuple[str, str], palpate.CaseResult]  # by law, and element or "turned"

CASES = (("linear", "P2"), ("neo-hookean", "P2"), ("neo-hookean", "auto"))
SOLVED = {"linear": 0.1, "neo-hookean": 0.5}  # per cent of the largest motion; at finite strain its law is another one
VOLUME, SAME = 1e-4, 1e-6  # of a tissue's volume, of a modulus, relative
OFF_GRID = 1e-3  # voxels, by which a place may lie off ours
WARP_MM = 0.05
LPS = np.array([-1.0, -1.0, 1.0])
LONG = ("Nodes", "Elements", "Surface", "NodeData", "ElementData")  # lists of FEBio's
TURNED = """
[images]
before = "before.nii.gz"
{after}
[domain]
outer_boundary = "sliding"
[tissues]
ball = {{label = 1, role = "estimate", youngs_modulus_kpa = 40.0}}
tube = {{label = 2, role = "driver"}}
cavity = {{label = 3, role = "void"}}
surroundings = {{label = "remaining", role = "known", youngs_modulus_kpa = 10.0}}
[mesh]
edge_length_mm = 8.0
[mechanics]
law = "{law}"
element = "P2"
[discrepancy]
heterogeneity_sd = 0.0
layer_sd = 0.0
poisson_sd = 0.0
[estimate]
start_ratios = [4.0]
{motion}
[[loads]]
kind = "gravity"
acceleration_m_s2 = [0.0, -9.81, 0.0]
[[loads]]
kind = "pressure"
surface = "cavity"
pressure_kpa = 1.0
[[loads]]
kind = "traction"
surface = "outer"
traction_kpa = [0.02, 0.05, -0.03]
"""


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

    @property
    def text(self) -> str:
        """The figure, as it stands in the table."""
        return "not installed" if self.figure is None else f"{self.figure:.2g} {self.unit}".strip()


def main() -> int:
    """Check all, print the table; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--edge", type=float, default=12.0, help="edge length at the organs, mm (default: %(default)s)")
    parser.add_argument("--only", default=",".join(PARTS), help=f"some of {', '.join(PARTS)}")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    wanted, rows, results = asked.only.split(","), list[Row](), Results()
    with tempfile.TemporaryDirectory() as folder:
        for law, element in CASES if "calculix" in wanted else CASES[1:2]:
            overrides = [f"mechanics.law={law}", f"mechanics.element={element}", f"mesh.edge_length_mm={asked.edge}"]
            case = palpate.read_case(DATA / "demo.toml", [*overrides, "estimate.start_ratios=[2.0]"])
            results[law, element] = palpate.estimate(case)
        for law in SOLVED if "calculix" in wanted else ("linear",):
            results[law, "turned"] = turned_result(Path(folder) / f"turned-{law}", law)
        for name in wanted:
            for row in PARTS[name](results, Path(folder)):
                rows.append(row)
                said(f"{row.part}: {row.what}: {row.text}")
    if asked.json:
        print(json.dumps([{**row.__dict__, "kept": row.kept} for row in rows], indent=1))
    else:
        cells = [[row.part, row.what, row.text, f"{row.limit:g} {row.unit}"] for row in rows]
        print(table_of(["program", "what", "found", "limit"], cells))
    return 0 if all(row.kept for row in rows) else 5


def turned_result(folder: Path, law: str) -> palpate.CaseResult:
    """The estimate of the modulus of a ball in a turned box, from a motion that was simulated with the same loads."""
    folder.mkdir()
    affine = np.eye(4)
    turn = Rotation.from_rotvec(np.radians(37.0) * np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)).as_matrix()
    affine[:3, :3], affine[:3, 3] = 2.0 * turn, [11.0, -7.0, 5.0]
    places = 2.0 * np.stack(np.meshgrid(*map(np.arange, (24, 22, 20)), indexing="ij"), axis=-1)
    labels = np.zeros(places.shape[:3], dtype=np.uint8)
    labels[np.linalg.norm(places - [15.0, 22.0, 18.0], axis=-1) < 9.0] = 1
    labels[np.linalg.norm((places - [30.0, 14.0, 0.0])[..., :2], axis=-1) < 5.0] = 2
    labels[np.linalg.norm(places - [31.0, 30.0, 20.0], axis=-1) < 6.0] = 3
    nibabel.save(nibabel.Nifti1Image(labels, affine), folder / "before.nii.gz")
    (folder / "simulated.toml").write_text(TURNED.format(after="", law=law, motion="[motion]\nfilling_mm = 1.5"))
    (folder / "case.toml").write_text(TURNED.format(after='after = ["after.nii.gz"]', law=law, motion=""))
    simulated = palpate.simulate(palpate.read_case(folder / "simulated.toml"))
    write_label_image(folder / "after.nii.gz", simulated.after)
    return palpate.estimate(palpate.read_case(folder / "case.toml"))


def any_of(results: Results) -> palpate.CaseResult:
    """The neo-Hookean result with plain quadratic elements, on which formats are checked."""
    return results["neo-hookean", "P2"]


def worst_volume(found: dict[str, float], mesh: TetMesh) -> float:
    """Largest relative difference of a meshed tissue's volume; infinite where one is missing."""
    sizes = {t.name: float(mesh.volumes[mesh.region == i].sum()) for i, t in enumerate(mesh.tissues) if t.meshed}
    return max(abs(found.get(name, np.inf) / size - 1.0) for name, size in sizes.items())


def tetrahedra(points: NDArray[np.float64], cells: NDArray[np.int64]) -> float:
    """Volume of tetrahedra by their corners, mm^3."""
    corner = points[cells[:, :4]]
    return float(np.linalg.det(corner[:, 1:] - corner[:, :1]).sum() / 6.0)


def percent(found: NDArray[np.float64], expected: NDArray[np.float64]) -> float:
    """RMS over the nodes of the distance of two vectors, in per cent of the largest that is expected."""
    distance = np.linalg.norm(found - expected, axis=1)
    return float(100.0 * np.sqrt((distance**2).mean()) / np.linalg.norm(expected, axis=1).max())


def installed(name: str) -> Any:
    """The module of that name; None where it is not installed."""
    try:
        return import_module(name)
    except ImportError:
        return None


def ran(command: Sequence[str | Path], folder: Path) -> str:
    """What a program prints that ends well; raises `RuntimeError` with it where it does not."""
    done = subprocess.run(
        [str(word) for word in command], cwd=folder, capture_output=True, text=True, check=False, timeout=1800
    )
    if done.returncode:
        raise RuntimeError(f"{command[0]} ended with {done.returncode}: {(done.stdout + done.stderr)[-2000:]}")
    return done.stdout + done.stderr


def calculix(results: Results, folder: Path) -> Iterator[Row]:
    """Solve each case with CalculiX and compare the displacement of every node with ours."""
    for (law, kind), result in results.items():
        what = f"{law}, {kind}: RMS of the nodes' displacements to ours, of the largest motion"
        if shutil.which("ccx") is None:
            yield Row("CalculiX", what, None, SOLVED[law], "%")
            continue
        place, n = folder / f"{law}-{kind}", len(result.space.points)
        palpate.export(result, place, format="abaqus")
        printed = ran(["ccx", "palpate"], place)
        if "Job finished" not in printed:
            raise RuntimeError(f"CalculiX ended without a result: {printed[-2000:]}")
        data = [line.split() for line in (place / "palpate.dat").read_text().splitlines()]
        last = [[float(x) for x in words] for words in data if words and words[0].isdigit()][-2 * n :]
        table = np.array(last)  # every node twice: displacements, then forces, in the axes of the world
        if not np.array_equal(table[:, 0], np.tile(np.arange(1.0, n + 1), 2)):
            raise RuntimeError("palpate.dat does not have every node twice")
        yield Row("CalculiX", what, percent(table[:n, 1:], result.estimation.displacements[-1]), SOLVED[law], "%")
        yield Row("CalculiX", f"{law}, {kind}: warnings", printed.count("*WARNING"), 0)


def meshes(results: Results, folder: Path) -> Iterator[Row]:
    """Counts, groups, volumes and displacement by meshio, closed surfaces by trimesh."""
    result, meshio, trimesh = any_of(results), import_module("meshio"), installed("trimesh")
    mesh = result.space.mesh
    for name, file in (("abaqus", "palpate.inp"), ("gmsh", "palpate.msh"), ("vtu", "mesh_1.vtu")):
        palpate.export(result, folder / f"meshio-{name}", format=name)
        read = meshio.read(folder / f"meshio-{name}" / file)
        blocks = [(number, block) for number, block in enumerate(read.cells) if block.type.startswith("tetra")]
        lost = abs(len(read.points) - len(result.space.points))
        lost += abs(sum(len(block.data) for _, block in blocks) - len(mesh.tets))
        yield Row("meshio", f"{name}: nodes and tetrahedra lost or gained", lost, 0)
        if name != "abaqus":
            off = percent(read.point_data["displacement_mm"], result.estimation.displacements[-1])
            yield Row("meshio", f"{name}: displacement, RMS to ours", off, 1e-5, "%")
        if name == "gmsh":
            counts = {key: sum(len(ids) for ids in sets if ids is not None) for key, sets in read.cell_sets.items()}
            groups = face_groups(mesh)
            wrong = sum(counts.get(group.name) != len(group.triangles) for group in groups)
            yield Row("meshio", "gmsh: groups of faces with lost or gained ones", wrong, 0)
        if name != "vtu":
            sizes = dict[str, float]()
            for tissue in (t.name for t in mesh.tissues if t.meshed):
                sets = read.cell_sets[tissue.upper() if name == "abaqus" else tissue]
                own = [block.data[sets[number]] for number, block in blocks if sets[number] is not None]
                sizes[tissue] = sum(tetrahedra(read.points, cells) for cells in own if len(cells))
            yield Row("meshio", f"{name}: volume of a tissue, relative difference", worst_volume(sizes, mesh), VOLUME)
    for name in ("stl", "obj", "ply"):
        what = f"{name}: surfaces that are not closed and outward, or of another volume"
        if trimesh is None:
            yield Row("trimesh", what, None, 0)
            continue
        wrong, sizes = 0, {}
        for path in palpate.export(result, folder / name, format=name):
            surface = trimesh.load(path)
            ways = np.asarray(surface.edges)  # each is passed as often one way as the other
            keys = ways @ [len(surface.vertices), 1]
            closed = np.array_equal(np.sort(keys), np.sort(ways[:, ::-1] @ [len(surface.vertices), 1]))
            wrong += not (closed and surface.volume > 0.0)
            number, rest = path.stem.split("_", 1)
            if rest.endswith("_before"):
                sizes[result.tissues[int(number)].name] = float(surface.volume)
        yield Row("trimesh", what, wrong + (worst_volume(sizes, mesh) > VOLUME), 0)


def febio(results: Results, folder: Path) -> Iterator[Row]:
    """The schema of elements as pyfebio has it, on a file whose long lists are cut; it knows no maps as values."""
    module = installed("pyfebio.model")
    if module is None:
        yield Row("pyfebio", "errors of the schema", None, 0)
        return
    (path,) = palpate.export(any_of(results), folder / "febio", format="febio")
    root = ET.parse(path).getroot()
    for parent in root.iter():
        for child in list(parent)[20:] if parent.tag in LONG else []:
            parent.remove(child)
        if parent.attrib.get("type") == "map":
            del parent.attrib["type"]
            parent.text = "1.0"
        if parent.tag in ("NodeSet", "ElementSet"):
            parent.text = ",".join((parent.text or "").split(",")[:20])
    try:
        module.Model.from_xml(ET.tostring(root))
        errors = 0
    except ValueError as error:
        said(str(error)[:3000])
        errors = str(error).count("\n  [line ")
    yield Row("pyfebio", "errors of the schema", errors, 0)


def nifti(results: Results, folder: Path) -> Iterator[Row]:
    """Stiffness and labels by SimpleITK; voxels outside the mesh are NaN, which it reads as 0."""
    sitk = import_module("SimpleITK")
    for (law, kind), result in results.items():
        place = folder / f"files-{law}-{kind}"
        write_estimate_files(result, place)
        for name in ("stiffness", "labels"):
            expected = np.nan_to_num(np.asarray(nibabel.load(place / f"{name}.nii.gz").dataobj, dtype=float))
            image = sitk.ReadImage(str(place / f"{name}.nii.gz"), sitk.sitkFloat64)
            affine = np.eye(4)
            turn = np.reshape(image.GetDirection(), (3, 3)) * np.array(image.GetSpacing())
            affine[:3, :3], affine[:3, 3] = LPS[:, None] * turn, LPS * np.array(image.GetOrigin())
            found = nibabel.Nifti1Image(sitk.GetArrayFromImage(image).transpose(2, 1, 0), affine)
            wrong = differing(result.before.grid, expected, found)
            yield Row("SimpleITK", f"{law}, {kind}, {name}.nii.gz: voxels of another value or place", wrong, 0)


def warp(results: Results, folder: Path) -> Iterator[Row]:
    """Points of before's surfaces through SimpleITK's transform to where the model has them, and back."""
    result, sitk = any_of(results), import_module("SimpleITK")
    palpate.export(result, folder / "warp", format="warp")
    space, displacement = result.space, result.estimation.displacements[-1]
    meshed = [i for i, tissue in enumerate(result.tissues) if tissue.meshed]
    faces = np.concatenate([tissue_surface(space.mesh, i).triangles for i in meshed])
    points = np.unique(space.facets(faces))
    before = space.points[points]
    after = before + displacement[points]
    if alignment := result.pairs[0].later[-1].alignment:
        after = alignment.motion.apply(after)
    for name, start, goal in (("warp", before, after), ("inverse_warp", after, before)):
        image = sitk.ReadImage(str(folder / "warp" / f"{name}.nii.gz"), sitk.sitkVectorFloat64)
        transform = sitk.DisplacementFieldTransform(image)
        found = np.array([transform.TransformPoint(p) for p in (start * LPS).tolist()]) * LPS
        rms = float(np.sqrt(((found - goal) ** 2).sum(axis=1).mean()))
        yield Row("SimpleITK", f"{name}: RMS distance of all surfaces' nodes to the model's", rms, WARP_MM, "mm")


def dicom(results: Results, folder: Path) -> Iterator[Row]:
    """Voxels of each modulus by pydicom, of each tissue by highdicom, both at their places by dcmqi."""
    highdicom, pydicom = import_module("highdicom"), import_module("pydicom")
    for (law, kind), result in results.items():
        place, names = folder / f"dicom-{law}-{kind}", [tissue.name for tissue in result.tissues]
        palpate.export(result, place, format="dicom")
        values = np.frombuffer(pydicom.dcmread(place / "stiffness.dcm").FloatPixelData, dtype="<f4")
        found = sorted(set(np.unique(values).tolist()) - {0.0})
        moduli = sorted({m for m in result.stiffness if np.isfinite(m)})
        off = max(abs(a / b - 1.0) for a, b in zip(found, moduli, strict=True))
        yield Row("pydicom", f"{law}, {kind}: relative difference of a modulus", off, SAME)
        segmentation = highdicom.seg.segread(place / "segmentation.dcm")
        organs = {int(item.SegmentNumber): names.index(item.SegmentLabel) for item in segmentation.SegmentSequence}
        wrong: int = 0
        for number, organ in organs.items():
            volume = segmentation.get_volume(segment_numbers=[number], combine_segments=True)
            wrong += abs(int(np.count_nonzero(volume.array)) - int(np.count_nonzero(result.before.index == organ)))
        yield Row("highdicom", f"{law}, {kind}: voxels of a tissue lost or gained", wrong, 0)
        if installed("dcmqi") is None:
            yield Row("dcmqi", f"{law}, {kind}: values and places", None, 0)
            continue
        for name, program in (("stiffness", "paramap2itkimage"), ("segmentation", "segimage2itkimage")):
            converter = Path(sys.executable).parent / program
            ran([converter, "--inputDICOM", place / f"{name}.dcm", "--outputDirectory", place, "-t", "nii"], place)
        grid, expected = result.before.grid, modulus_image(result.space.mesh, result.before.grid, result.stiffness)
        wrong = differing(grid, expected, nibabel.load(place / "pmap.nii.gz"))  # the name that dcmqi gives it
        for number, organ in organs.items():
            wrong += differing(grid, number * (result.before.index == organ), nibabel.load(place / f"{number}.nii.gz"))
        yield Row("dcmqi", f"{law}, {kind}: voxels lost, gained, displaced or of another value", wrong, 0)


def differing(grid: VoxelGrid, expected: NDArray[Any], image: Any) -> int:
    """How many voxels of `expected` (n_x, n_y, n_z) on our grid an image has otherwise; all of an image off it."""
    values = np.asarray(image.dataobj, dtype=float)
    index = np.argwhere(np.ones(values.shape, dtype=bool)).astype(float)
    places = grid.index(index @ image.affine[:3, :3].T + image.affine[:3, 3])
    near = np.rint(places).astype(int)
    if np.abs(places - near).max() > OFF_GRID or (near < 0).any() or (near >= np.array(grid.shape)).any():
        return expected.size
    found = np.zeros(expected.shape)
    found[tuple(near.T)] = values.ravel()
    return int(np.count_nonzero(~np.isclose(found, expected, rtol=SAME)))


PARTS: dict[str, Callable[[Results, Path], Iterator[Row]]] = {
    "calculix": calculix,
    "meshes": meshes,
    "febio": febio,
    "nifti": nifti,
    "warp": warp,
    "dicom": dicom,
}

if __name__ == "__main__":
    sys.exit(main())
