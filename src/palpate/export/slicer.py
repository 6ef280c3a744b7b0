"""3D Slicer: labels with names and colours, the stiffness over them, surfaces and warp, and a script that loads all."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from palpate.export import warp
from palpate.export.case_files import write_labels
from palpate.export.closed_surfaces import closed_surfaces, write_ply
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.groups import write_script
from palpate.images.readers import write_scalar_image
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import tissue_colours
from palpate.mesh.locate import modulus_image
from palpate.statement.stiffness_scale import StiffnessScale, stiffness_scale
from palpate.study.outputs import write_json


def write(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write load_in_slicer.py, labels.nii.gz and .csv, stiffness.nii.gz, the surfaces (.ply), the warp, scene.json."""
    write_labels(Segmentation(body.index, body.grid, body.tissues), folder)
    scale = shown_scale(model)
    stiffness = modulus_image(body.mesh, body.grid, scale.factor * model.moduli)
    write_scalar_image(folder / "stiffness.nii.gz", stiffness, body.grid)
    write_ply(model, body, folder)
    warp.write(model, body, folder)
    shown = zip(body.tissues, tissue_colours(body.tissues), strict=True)
    colours = {tissue.name: [part / 255.0 for part in bytes.fromhex(colour[1:])] for tissue, colour in shown}
    roles = {tissue.name: str(tissue.role) for tissue in body.tissues}
    scene = {
        "schema": "palpate.slicer/1",
        "stiffness": {
            "name": scale.label,
            "range": [scale.low, scale.high],
            "least": scale.low,
            "colours": np.round(scale.linear_table(), 4).tolist(),
        },
        "models": [
            {
                "file": f"{surface.stem}.ply",
                "name": f"{surface.name}, {surface.state.replace('_', ' ')}",
                "colour": colours[surface.name],
                "visible": surface.state == "before" and roles[surface.name] in ("estimate", "driver"),
            }
            for surface in closed_surfaces(body)
        ],
        "warps": sorted(path.name for path in folder.glob("*warp*.nii.gz")),
    }
    write_json(folder / "scene.json", scene)
    write_script(folder / "load_in_slicer.py")


def shown_scale(model: FittedModel) -> StiffnessScale:
    """The colours of the stiffness: those of the report, in ratios where a modulus is known as a ratio alone."""
    unit, factor = model.unit, 1.0
    ratios = (item.value / item.ratio for item in model.estimates if item.value and item.ratio)
    if unit == "kPa" and any(item.verdict == "ratio only" for item in model.estimates):
        unit, factor = "ratio", 1.0 / next(ratios, 1.0)
    return stiffness_scale(model.moduli.tolist(), unit=unit, relative_to=model.relative_to, factor=factor)
