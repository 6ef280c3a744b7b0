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
from palpate.export.groups import face_groups, material_parts, plain_names, write_script
from palpate.mechanics.laws.linear import Linear
from palpate.mechanics.laws.mooney_rivlin import MooneyRivlin
from palpate.mechanics.laws.neo_hookean import NeoHookean
from palpate.study.outputs import write_bytes, write_json

PLUGINS = (
    "Sofa.Component.Constraint.Projective",
    "Sofa.Component.LinearSolver.Direct",
    "Sofa.Component.ODESolver.Backward",
    "Sofa.Component.SolidMechanics.FEM.Elastic",
    "Sofa.Component.SolidMechanics.FEM.HyperElastic",
    "Sofa.Component.StateContainer",
    "Sofa.Component.Topology.Container.Dynamic",
)


def write(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write scene.py, model.npz and model.json.

    Raises `ConfigurationError` for known loads, and for faces that slide on an image askew to the world's axes.
    """
    linear = body.with_linear_tetrahedra()
    held = prescribed(linear, linear.space, outer=model.outer_boundary)
    if any(body.loads) or not held.along_world:
        raise ConfigurationError(
            "a SOFA scene can hold neither known loads nor faces that slide obliquely to the world's axes; export to"
            " abaqus or febio"
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
    names, law = plain_names(of.name for of in parts), model.law_among(Linear, NeoHookean, MooneyRivlin)
    tissues = list[dict[str, object]]()  # the force field of each part with its parameters, moduli in kPa
    for number, of in enumerate(parts):
        modulus, ratio = float(model.moduli[of.tissue] * np.exp(of.log_ratio)), body.tissues[of.tissue].poisson_ratio
        shear, bulk = modulus / (2.0 * (1.0 + ratio)), modulus / (3.0 * (1.0 - 2.0 * ratio))
        lame = 2.0 * shear * ratio / (1.0 - 2.0 * ratio)
        parameters: dict[str, object] = {"materialName": "NeoHookean", "ParameterSet": f"{shear:.12g} {lame:.12g}"}
        field = "TetrahedronHyperelasticityFEMForceField"
        if not law.finite:
            field = "TetrahedronFEMForceField"
            parameters = {"method": "small", "youngModulus": modulus, "poissonRatio": ratio}
        elif isinstance(law, MooneyRivlin):
            first, second = (shear * coefficient for coefficient in law.coefficients)
            parameters = {"materialName": "MooneyRivlin", "ParameterSet": f"{first:.12g} {second:.12g} {bulk:.12g}"}
        what = {"name": of.name, "id": names[of.name], "part": number, "force_field": field}
        tissues.append(what | {"parameters": parameters})
    document = {
        "schema": "palpate.sofa/1",
        "units": model.units,
        "plugins": list(PLUGINS),
        "tissues": tissues,
        "groups": {f"group_{number}": group.name for number, group in enumerate(face_groups(mesh))},
    }
    write_bytes(folder / "model.npz", memory.getvalue())
    write_json(folder / "model.json", document)
    write_script(folder / "scene.py")
