"""SOFA: a Python scene of linear tetrahedra, a force field a tissue, whose walls move as they were fitted.

SOFA's NeoHookean (mu, lambda) is our law; its MooneyRivlin (c1, c2, K) is decoupled, with the same moduli at small
strain; its TetrahedronFEMForceField is the linear law. SOFA has no quadratic tetrahedra, and linear ones lock.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from palpate.errors import ConfigurationError
from palpate.export.conditions import prescribed
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.formats import Options
from palpate.export.groups import MaterialPart, face_groups, material_parts, plain_names
from palpate.mechanics.laws.linear import Linear
from palpate.mechanics.laws.mooney_rivlin import MooneyRivlin
from palpate.mechanics.laws.neo_hookean import NeoHookean
from palpate.study.outputs import write_bytes, write_json, write_text

SCENE = '''"""A body that Palpate fitted, as a SOFA scene: runSofa -l SofaPython3 scene.py

Millimetres and kPa (or ratios, as "units" in model.json says); RAS coordinates. Beside it: model.npz (arrays) and
model.json (tissues and groups). Each second of the simulation moves walls, bones and the cut of the image on to where
the next later image has them.
"""

import json
from pathlib import Path

import numpy as np

try:
    import Sofa
except ImportError:  # so that the scene can be read, and checked, without SOFA
    Sofa = None

HERE = Path(__file__).resolve().parent
ARRAYS = np.load(HERE / "model.npz", allow_pickle=False)
MODEL = json.loads((HERE / "model.json").read_text(encoding="utf-8"))
STEP = 0.05


def positions(time):
    """Where the prescribed nodes are at a time: on straight lines from image to image."""
    states = np.concatenate([np.zeros_like(ARRAYS["motion"][:1]), ARRAYS["motion"]])
    first = min(int(time), len(states) - 2)
    share = min(time - first, 1.0)
    way = (1.0 - share) * states[first] + share * states[first + 1]
    return ARRAYS["nodes"][ARRAYS["prescribed"]] + way


def createScene(root):
    root.gravity = [0.0, 0.0, 0.0]
    root.dt = STEP
    root.addObject("RequiredPlugin", pluginName=MODEL["plugins"])
    root.addObject("DefaultAnimationLoop")
    body = root.addChild("body")
    body.addObject("StaticSolver")
    body.addObject("NewtonRaphsonSolver", maxNbIterationsNewton=50)
    body.addObject("SparseLDLSolver", template="CompressedRowSparseMatrixMat3x3d")
    nodes = ARRAYS["nodes"].tolist()
    tets = ARRAYS["tets"].tolist()
    body.addObject("TetrahedronSetTopologyContainer", name="topology", position=nodes, tetrahedra=tets)
    state = body.addObject("MechanicalObject", name="state", template="Vec3d", position=nodes)
    for tissue in MODEL["tissues"]:
        child = body.addChild(tissue["id"])
        tets = ARRAYS["tets"][ARRAYS["part"] == tissue["part"]].tolist()
        child.addObject("TetrahedronSetTopologyContainer", name="topology", position=nodes, tetrahedra=tets)
        child.addObject("TetrahedronSetGeometryAlgorithms", template="Vec3d")
        child.addObject(tissue["force_field"], name="law", template="Vec3d", **tissue["parameters"])
    if len(ARRAYS["sliding"]):
        for axis in range(3):
            still = ARRAYS["sliding"][ARRAYS["held"][:, axis]].tolist()
            directions = [int(other == axis) for other in range(3)]
            body.addObject("PartialFixedProjectiveConstraint", indices=still, fixedDirections=directions)
    body.addObject("FixedProjectiveConstraint", indices=ARRAYS["prescribed"].tolist())
    if Sofa is not None:
        root.addObject(Motion(name="motion", state=state, root=root))
    return root


if Sofa is not None:

    class Motion(Sofa.Core.Controller):
        """Puts the prescribed nodes in their places at the start of each step."""

        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            self.state, self.root = kwargs["state"], kwargs["root"]

        def onAnimateBeginEvent(self, event):
            time = self.root.time.value + self.root.dt.value
            with self.state.position.writeable() as position:
                position[ARRAYS["prescribed"]] = positions(time)
'''
PLUGINS = (
    "Sofa.Component.Constraint.Projective",
    "Sofa.Component.LinearSolver.Direct",
    "Sofa.Component.ODESolver.Backward",
    "Sofa.Component.SolidMechanics.FEM.Elastic",
    "Sofa.Component.SolidMechanics.FEM.HyperElastic",
    "Sofa.Component.StateContainer",
    "Sofa.Component.Topology.Container.Dynamic",
)


def write(model: FittedModel, body: FittedBody, folder: Path, options: Options) -> None:
    """Write scene.py, model.npz and model.json.

    Raises `ConfigurationError` for known loads, and for faces that slide on an image askew to the world's axes.
    """
    del options
    linear = body.with_linear_tetrahedra()
    held = prescribed(linear, linear.space, outer=model.outer_boundary)
    if any(body.loads) or not held.along_world:
        raise ConfigurationError(
            "the SOFA scene has neither known loads nor faces that slide askew to the world's axes; export to abaqus or"
            " febio"
        )
    mesh, parts = body.mesh, material_parts(body.mesh, body.log_ratio)
    part = np.empty(len(mesh.tets), dtype=np.int64)
    for number, of in enumerate(parts):
        part[of.cells] = number
    arrays = {
        "nodes": mesh.nodes,
        "tets": mesh.tets,
        "region": mesh.region,
        "part": part,
        "prescribed": held.whole,
        "motion": np.stack([motion[held.whole] for motion in linear.displacements]),
        "sliding": held.sliding,
        "held": held.held,
    }
    groups = {f"group_{number}": np.unique(group.triangles) for number, group in enumerate(face_groups(mesh))}
    memory = io.BytesIO()
    np.savez_compressed(memory, allow_pickle=False, **arrays, **groups)
    names = plain_names(of.name for of in parts)
    document = {
        "schema": "palpate.sofa/1",
        "units": model.units,
        "plugins": list(PLUGINS),
        "tissues": [_tissue(model, body, number, of, names[of.name]) for number, of in enumerate(parts)],
        "groups": {f"group_{number}": group.name for number, group in enumerate(face_groups(mesh))},
    }
    write_bytes(folder / "model.npz", memory.getvalue())
    write_json(folder / "model.json", document)
    write_text(folder / "scene.py", SCENE)


def _tissue(model: FittedModel, body: FittedBody, number: int, part: MaterialPart, plain: str) -> dict[str, object]:
    """The force field of a part of a tissue with its parameters, moduli in kPa."""
    tissue, modulus = body.tissues[part.tissue], float(model.moduli[part.tissue] * np.exp(part.log_ratio))
    ratio, law = tissue.poisson_ratio, model.law_among(Linear, NeoHookean, MooneyRivlin)
    shear = modulus / (2.0 * (1.0 + ratio))
    lame, bulk = 2.0 * shear * ratio / (1.0 - 2.0 * ratio), modulus / (3.0 * (1.0 - 2.0 * ratio))
    parameters: dict[str, object] = {"materialName": "NeoHookean", "ParameterSet": f"{shear:.12g} {lame:.12g}"}
    force_field = "TetrahedronHyperelasticityFEMForceField"
    if not law.finite:
        force_field = "TetrahedronFEMForceField"
        parameters = {"method": "small", "youngModulus": modulus, "poissonRatio": ratio}
    elif isinstance(law, MooneyRivlin):
        first, second = (shear * coefficient for coefficient in law.coefficients)
        parameters = {"materialName": "MooneyRivlin", "ParameterSet": f"{first:.12g} {second:.12g} {bulk:.12g}"}
    return {"name": part.name, "id": plain, "part": number, "force_field": force_field, "parameters": parameters}
