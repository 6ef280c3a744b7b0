"""VTK: the mesh in each state, an animation, the groups as blocks with their names, and a script for ParaView."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from palpate.export.case_files import file_name
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.formats import Options
from palpate.export.groups import face_groups
from palpate.export.vtk_xml import write_pvd, write_vtp, write_vtu
from palpate.images.segmentation import first_labels
from palpate.mechanics.element import largest_strains
from palpate.study.outputs import make_folder, write_json, write_text

PARAVIEW_SCRIPT = '''"""Show what Palpate exported in ParaView: paraview --script=load_in_paraview.py

(or in its Python shell: Run Script). The moved body, cut open, with Young's modulus on a logarithmic scale; the
play button goes from image to image.
pvpython load_in_paraview.py picture.png draws the same picture without a window.
"""

import json
import sys
from pathlib import Path

from paraview import simple

HERE = Path(__file__).resolve().parent
SCENE = json.loads((HERE / "scene.json").read_text(encoding="utf-8"))


def show():
    mesh = simple.PVDReader(registrationName="mesh", FileName=str(HERE / "mesh.pvd"))
    moved = simple.WarpByVector(registrationName="moved", Input=mesh)
    moved.Vectors = ["POINTS", "displacement_mm"]
    view = simple.GetActiveViewOrCreate("RenderView")
    opened = simple.Clip(registrationName="cut open", Input=moved)
    opened.ClipType.Origin, opened.ClipType.Normal = SCENE["middle"], [1.0, 0.0, 0.0]
    display = simple.Show(opened, view)
    simple.ColorBy(display, ("CELLS", SCENE["modulus"]))
    table = simple.GetColorTransferFunction(SCENE["modulus"])
    table.RescaleTransferFunction(*SCENE["range"])
    table.MapControlPointsToLogSpace()
    table.UseLogScale = 1
    display.SetScalarBarVisibility(view, True)
    for tissue in SCENE["tissues"]:
        part = simple.Threshold(registrationName=tissue["name"], Input=moved)
        part.Scalars = ["CELLS", "label"]
        part.LowerThreshold = part.UpperThreshold = tissue["label"]
        simple.Hide(part, view)
    groups = simple.XMLMultiBlockDataReader(registrationName="groups", FileName=[str(HERE / "groups.vtm")])
    simple.Hide(groups, view)
    simple.GetAnimationScene().GoToLast()
    simple.ResetCamera(view)
    if len(sys.argv) > 1:
        simple.SaveScreenshot(sys.argv[1], view, ImageResolution=[1200, 900])


show()
'''


def write(model: FittedModel, body: FittedBody, folder: Path, options: Options) -> None:
    """Write mesh_0.vtu (at rest), mesh_1.vtu ... (each later image), mesh.pvd, and groups.vtm with groups/*.vtp."""
    del options
    blocks = [("mesh", write_states(model, body, folder)[-1])]
    make_folder(folder / "groups")
    moved = {"displacement_mm": body.displacements[-1][: len(body.mesh.nodes)]}
    for number, group in enumerate(face_groups(body.mesh)):
        name = f"groups/{number:02d}_{file_name(group.name)}.vtp"
        write_vtp(folder / name, body.mesh.nodes, group.triangles, point_data=moved)
        blocks.append((group.name, name))
    sets = "".join(
        f'<DataSet index="{index}" name={quoteattr(name)} file={quoteattr(file)}/>'
        for index, (name, file) in enumerate(blocks)
    )
    heading = '<?xml version="1.0"?>\n<VTKFile type="vtkMultiBlockDataSet" version="1.0">'
    write_text(folder / "groups.vtm", f"{heading}<vtkMultiBlockDataSet>{sets}</vtkMultiBlockDataSet></VTKFile>\n")


def write_states(model: FittedModel, body: FittedBody, folder: Path) -> list[str]:
    """Write the mesh at rest and as each later image has it, each with its displacement; gives the files' names."""
    space, region = body.space, body.mesh.region
    poisson = np.array([tissue.poisson_ratio for tissue in body.tissues])
    modulus = "youngs_modulus_kpa" if model.unit == "kPa" else "youngs_modulus_ratio"
    cells: dict[str, NDArray[Any]] = {
        "label": first_labels(body.tissues)[region],
        modulus: body.element_moduli(model.moduli),
        "poisson_ratio": poisson[region],
    }
    names = []
    for number, displacement in enumerate((np.zeros_like(space.points), *body.displacements)):
        names.append(f"mesh_{number}.vtu")
        strained = {**cells, "largest_strain": largest_strains(space, displacement)}
        write_vtu(folder / names[-1], space, point_data={"displacement_mm": displacement}, cell_data=strained)
    write_pvd(folder / "mesh.pvd", [(float(number), name) for number, name in enumerate(names)])
    return names


def write_paraview(model: FittedModel, body: FittedBody, folder: Path, options: Options) -> None:
    """Write load_in_paraview.py and scene.json beside what the format "vtu" has."""
    write(model, body, folder, options)
    known = model.moduli[np.isfinite(model.moduli)]
    nodes, labels = body.mesh.nodes, first_labels(body.tissues)
    scene = {
        "schema": "palpate.paraview/1",
        "modulus": "youngs_modulus_kpa" if model.unit == "kPa" else "youngs_modulus_ratio",
        "range": [0.9 * float(known.min()), 1.1 * float(known.max())],
        "middle": (0.5 * (nodes.min(axis=0) + nodes.max(axis=0))).tolist(),
        "tissues": [
            {"name": tissue.name, "label": int(label)}
            for tissue, label in zip(body.tissues, labels, strict=True)
            if tissue.meshed
        ],
    }
    write_json(folder / "scene.json", scene)
    write_text(folder / "load_in_paraview.py", PARAVIEW_SCRIPT)
