"""What dolfinx reads of palpate.msh and palpate.xdmf, as a line of JSON; for the system's Python, see export_meshes.py."""

from __future__ import annotations

import json
import sys

import dolfinx
import gmsh
import numpy as np
from dolfinx.io import XDMFFile, gmshio
from mpi4py import MPI


def main() -> None:
    """Read both files that are named and tell of them."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.open(sys.argv[1])
    mesh, cells, faces = gmshio.model_to_mesh(gmsh.model, MPI.COMM_WORLD, 0, 3)
    names = {group: gmsh.model.getPhysicalName(*group) for group in gmsh.model.getPhysicalGroups()}
    tissues = {tag: name for (dimension, tag), name in names.items() if dimension == 3}
    counts = {name: len(faces.find(tag)) for (dimension, tag), name in names.items() if dimension == 2}
    gmsh.finalize()
    with XDMFFile(MPI.COMM_WORLD, sys.argv[2], "r") as file:
        again = file.read_mesh(name="Grid")
        tags = file.read_meshtags(again, name="Grid")
    found = {
        "version": dolfinx.__version__,
        "gmshio": told(mesh, cells, tissues),
        "xdmf": told(again, tags, tissues),
        "faces": {name: count for name, count in counts.items() if count},
    }
    print(json.dumps(found))


def told(mesh, tags, tissues):
    """Nodes, cells, and the volume of each tissue, mm^3, by the corners of its tetrahedra."""
    places = mesh.geometry.dofmap
    rows = np.array([places.links(cell)[:4] for cell in range(places.num_nodes)])
    corner = mesh.geometry.x[rows]
    sizes = np.abs(np.linalg.det(corner[:, 1:] - corner[:, :1])) / 6.0
    volumes = {name: float(sizes[tags.find(tag)].sum()) for tag, name in tissues.items()}
    return {"nodes": len(mesh.geometry.x), "cells": len(rows), "volumes": volumes}


if __name__ == "__main__":
    main()
