#!/bin/bash
# A volume that lies in two physical groups has every tetrahedron twice in gmsh's MSH 2.2, and meshio gives both: the
# body has twice its volume, each face of its boundary belongs to two elements, and the boundary is empty. In MSH 4.1 of
# the same mesh, which lists an element once with the groups of its entity, meshio keeps the number of one group alone.
#
# Source: gmsh 4.15.2 writes, meshio 5.3.5 reads.
# The guess most would make: a second group is a second name, and the mesh is the same in both versions.
# Who is hurt: whoever names a whole ("body") beside its materials ("muscle", "fat"): masses and stiffness double, or
# the outer surface vanishes; in 4.1 a triangle of two named surfaces is missing in one of them by number.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check "gmsh==4.15.2" "meshio==5.3.5" "numpy==2.4.6"
cd "$work"
"$work/venv/bin/python" - <<'PYTHON'
import gmsh
import meshio
import numpy as np

gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)
gmsh.model.occ.synchronize()
gmsh.model.addPhysicalGroup(3, [1], 7, "body")
gmsh.model.addPhysicalGroup(3, [1], 9, "muscle")
gmsh.model.mesh.generate(3)
found = {}
for version in (2.2, 4.1):
    gmsh.option.setNumber("Mesh.MshFileVersion", version)
    gmsh.write(f"{version}.msh")
    mesh = meshio.read(f"{version}.msh")
    tets = np.concatenate([block.data for block in mesh.cells if block.type == "tetra"])
    volume = float(np.abs(np.linalg.det(mesh.points[tets[:, 1:]] - mesh.points[tets[:, :1]])).sum() / 6)
    _, count = np.unique(np.sort(tets[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3)), axis=0, return_counts=True)
    numbers = np.unique(np.concatenate(mesh.cell_data["gmsh:physical"])).tolist()
    found[version] = round(volume, 6), int((count == 1).sum()) > 0, numbers
    print(
        f"gmsh {gmsh.__version__}, meshio {meshio.__version__}, MSH {version}: volume {volume:.6f} of a unit cube,"
        f" {(count == 1).sum()} faces of one element, groups {numbers}"
    )
raise SystemExit(found != {2.2: (2.0, False, [7, 9]), 4.1: (1.0, True, [7])})
PYTHON
