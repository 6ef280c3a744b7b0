#!/bin/bash
# meshio reads an Abaqus file of two parts, each with nodes numbered from 1, as if both had the nodes of the last part:
# the elements of the first part come out in the place of the second. It says nothing.
#
# Source: meshio 5.3.5, abaqus reader: each *NODE replaces the nodes that were read before, and elements keep their rows.
# The guess most would make: parts are added to each other, or refused. Abaqus numbers the nodes of every part from 1.
# Who is hurt: whoever converts an assembly (an organ in a bath, an indenter on a gel) to VTU or MSH: one part is lost,
# its elements lie on the other part, volumes and masses are wrong, and all counts of elements are right.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check "meshio==5.3.5" "numpy==2.4.6"
cd "$work"
cat > assembly.inp <<'DECK'
*HEADING
two parts, 100 mm apart; the second is twice as large
*PART, NAME=GEL
*NODE
1, 0.0, 0.0, 0.0
2, 1.0, 0.0, 0.0
3, 0.0, 1.0, 0.0
4, 0.0, 0.0, 1.0
*ELEMENT, TYPE=C3D4, ELSET=GEL
1, 1, 2, 3, 4
*END PART
*PART, NAME=PLATE
*NODE
1, 100.0, 0.0, 0.0
2, 102.0, 0.0, 0.0
3, 100.0, 2.0, 0.0
4, 100.0, 0.0, 2.0
*ELEMENT, TYPE=C3D4, ELSET=PLATE
1, 1, 2, 3, 4
*END PART
DECK
"$work/venv/bin/python" - <<'PYTHON'
import meshio
import numpy as np

mesh = meshio.read("assembly.inp")
volumes = [np.abs(np.linalg.det(mesh.points[b.data[:, 1:]] - mesh.points[b.data[:, :1]])).sum() / 6 for b in mesh.cells]
middles = [mesh.points[b.data].mean(axis=(0, 1)) for b in mesh.cells]
print(f"meshio {meshio.__version__}: {len(mesh.points)} nodes of 8, {sum(map(len, mesh.cells))} elements of 2")
print(f"volumes: {np.round(volumes, 4).tolist()} (of the file: [0.1667, 1.3333]); middles: {np.round(middles, 2).tolist()}")
raise SystemExit(not (len(mesh.points) == 4 and np.allclose(volumes, 8 / 6) and np.allclose(*middles)))
PYTHON
