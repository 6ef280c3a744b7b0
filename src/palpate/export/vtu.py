"""VTK: the mesh in each state, an animation, the groups as blocks with their names, and a script for ParaView."""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from palpate.export.case_files import cell_data, file_name, write_moved
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.groups import face_groups, write_script
from palpate.export.vtk_xml import write_pvd, write_vtp
from palpate.images.segmentation import first_labels
from palpate.study.outputs import make_folder, write_json, write_text


def write(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write mesh_0.vtu (at rest), mesh_1.vtu ... (each later image), mesh.pvd, and groups.vtm with groups/*.vtp."""
    space, states = body.space, list[str]()
    cells = cell_data(body.mesh, body.element_moduli(model.moduli), called=model.modulus_name)
    for number, displacement in enumerate((np.zeros_like(space.points), *body.displacements)):
        states.append(f"mesh_{number}.vtu")
        write_moved(folder / states[-1], space, displacement, cells)
    write_pvd(folder / "mesh.pvd", [(float(number), name) for number, name in enumerate(states)])
    blocks = [("mesh", states[-1])]
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


def write_paraview(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write load_in_paraview.py and scene.json beside what the format "vtu" has."""
    write(model, body, folder)
    known = model.moduli[np.isfinite(model.moduli)]
    nodes, labels = body.mesh.nodes, first_labels(body.tissues)
    scene = {
        "schema": "palpate.paraview/1",
        "modulus": model.modulus_name,
        "range": [0.9 * float(known.min()), 1.1 * float(known.max())],
        "middle": (0.5 * (nodes.min(axis=0) + nodes.max(axis=0))).tolist(),
        "tissues": [
            {"name": tissue.name, "label": int(label)}
            for tissue, label in zip(body.tissues, labels, strict=True)
            if tissue.meshed
        ],
    }
    write_json(folder / "scene.json", scene)
    write_script(folder / "load_in_paraview.py")
