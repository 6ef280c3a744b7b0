#!/bin/bash
# gmsh with Mesh.SaveAll = 1 writes MSH 2.2 without any physical group: every element gets the tag 0, while the table of
# their names stays in the file. The same mesh as MSH 4.1 keeps its groups.
#
# Source: gmsh 4.15.2, gmsh.write and gmsh.open themselves; no other program takes part.
# The guess most would make: saving all elements adds those of no group, and the others keep theirs, as in 4.1.
# Who is hurt: whoever exports 2.2 for a solver or a converter (FEniCS, Elmer, meshio) and saves all elements: names of
# materials and of surfaces are listed, but nothing belongs to them; a reader that falls back on one material is silent.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check "gmsh==4.15.2"
cd "$work"
"$work/venv/bin/python" - <<'PYTHON'
import gmsh

gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)
gmsh.model.occ.synchronize()
gmsh.model.addPhysicalGroup(3, [1], 7, "gel")
gmsh.model.addPhysicalGroup(2, [1, 2], 8, "grips")
gmsh.model.mesh.generate(3)
gmsh.option.setNumber("Mesh.SaveAll", 1)
for version in (2.2, 4.1):
    gmsh.option.setNumber("Mesh.MshFileVersion", version)
    gmsh.write(f"{version}.msh")
found = {}
for version in (2.2, 4.1):
    named = [line for line in open(f"{version}.msh") if '"gel"' in line or '"grips"' in line]
    gmsh.clear()
    gmsh.open(f"{version}.msh")
    found[version] = gmsh.model.getPhysicalGroups(), len(named)
    print(f"gmsh {gmsh.__version__}, MSH {version}: {len(named)} names in the file, groups read back: {found[version][0]}")
raise SystemExit(found != {2.2: ([], 2), 4.1: ([(2, 8), (3, 7)], 2)})
PYTHON
