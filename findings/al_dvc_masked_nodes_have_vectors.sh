#!/usr/bin/env bash
# pyALDVC's .vti of a masked run: nodes outside the mask hold finite displacements, continued from their neighbours. Only
# the magnitude beside them is NaN.
# Source: seen here with al-dvc 1.2.1 (export_vtk), on volumes that move by one voxel, with half of them masked.
# The guess most would make: a vector that was not measured is NaN, or 0, as its magnitude in the same file suggests.
# Who is hurt: whoever reads `displacement` without `node_valid`. Here half of the vectors were never measured.
set -euo pipefail
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  numpy==2.4.6 scipy==1.17.1 numba==0.68.1 h5py matplotlib pyyaml tifffile
"$place/venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps al-dvc==1.2.1
cat > "$place/check.py" <<'PY'
import base64
import re
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
from al_dvc.core.config import dvcpara_default
from al_dvc.core.pipeline import run_aldvc
from al_dvc.export.export_vtk import export_vtk
from al_dvc.synthetic import generate_speckle_volume

place = Path(sys.argv[1])
print("al-dvc", version("al-dvc"))
first = generate_speckle_volume((56, 56, 56), sigma=1.5, seed=1)
later = np.roll(first, 1, axis=2)
mask = np.ones(first.shape, dtype=bool)
mask[:, :, 28:] = False
result = run_aldvc(dvcpara_default(winsize=16, winstepsize=8), [first, later], masks=[mask, mask])
text = export_vtk(result, place)[0].read_text()
found = {}
for head, body in re.findall(r"<DataArray ([^>]*)>([^<]*)<", text):
    name = re.search(r'Name="([^"]*)"', head)[1]
    found[name] = np.frombuffer(base64.b64decode(body), "<f4", offset=4)
out = found["node_valid"] < 0.5
vectors = found["displacement"].reshape(-1, 3)[out]
magnitude = found["disp_magnitude"][out]
print(f"{out.sum()} of {len(out)} nodes outside the mask")
print(f"finite vectors there: {np.isfinite(vectors).all(axis=1).sum()}, the largest {np.abs(vectors).max():.3f}")
print(f"magnitudes there that are NaN: {np.isnan(magnitude).sum()}")
same = out.any() and np.isfinite(vectors).all() and np.abs(vectors).max() > 0.5 and np.isnan(magnitude).all()
sys.exit(0 if same else "the behaviour has changed")
PY
NUMBA_NUM_THREADS=1 "$place/venv/bin/python" "$place/check.py" "$place"
