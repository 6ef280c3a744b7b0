"""ParaView: the mesh in each state and its groups, and a script that shows the moduli on the moved body."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from palpate.export import vtu
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.formats import Options
from palpate.images.segmentation import first_labels
from palpate.study.outputs import write_json, write_text

SCRIPT = '''"""Show what Palpate exported in ParaView: paraview --script=load_in_paraview.py

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
    """Write load_in_paraview.py and scene.json beside what the format "vtu" has."""
    vtu.write(model, body, folder, options)
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
    write_text(folder / "load_in_paraview.py", SCRIPT)
