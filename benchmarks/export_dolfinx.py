"""dolfinx reads palpate.msh and palpate.xdmf; prints a line of JSON. export_meshes.py runs it in Debian's Python."""

from __future__ import annotations

import json
import sys
from importlib import import_module
from typing import Any

import numpy as np


def main() -> None:
    """Read the two named files and print what they hold."""
    gmsh, dolfinx, io = (import_module(name) for name in ("gmsh", "dolfinx", "dolfinx.io"))
    world = import_module("mpi4py.MPI").COMM_WORLD
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.open(sys.argv[1])
    mesh, cells, faces = import_module("dolfinx.io.gmshio").model_to_mesh(gmsh.model, world, 0, 3)
    names = {group: gmsh.model.getPhysicalName(*group) for group in gmsh.model.getPhysicalGroups()}
    tissues = {tag: name for (dimension, tag), name in names.items() if dimension == 3}
    counts = {name: len(faces.find(tag)) for (dimension, tag), name in names.items() if dimension == 2}
    gmsh.finalize()
    with io.XDMFFile(world, sys.argv[2], "r") as file:
        again = file.read_mesh(name="Grid")
        tags = file.read_meshtags(again, name="Grid")
    found = {
        "version": dolfinx.__version__,
        "gmshio": told(mesh, cells, tissues),
        "xdmf": told(again, tags, tissues),
        "faces": {name: count for name, count in counts.items() if count},
    }
    print(json.dumps(found))


def told(mesh: Any, tags: Any, tissues: dict[int, str]) -> dict[str, Any]:
    """Nodes, cells, and the volume of each tissue, mm^3, by the corners of its tetrahedra."""
    places = mesh.geometry.dofmap
    rows = np.array([places.links(cell)[:4] for cell in range(places.num_nodes)])
    corner = mesh.geometry.x[rows]
    sizes = np.abs(np.linalg.det(corner[:, 1:] - corner[:, :1])) / 6.0
    volumes = {name: float(sizes[tags.find(tag)].sum()) for tag, name in tissues.items()}
    return {"nodes": len(mesh.geometry.x), "cells": len(rows), "volumes": volumes}


if __name__ == "__main__":
    main()
