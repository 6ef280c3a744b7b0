#!/usr/bin/env bash
# SimpleITK writes a composite transform as an MNI .xfm file, and reads one part of it back, without an exception.
#
# Behaviour: WriteTransform of a CompositeTransform of an affine map and a displacement field gives an .xfm with a grid
# and a linear section; the file holds both. ReadTransform of it returns the last section alone, an AffineTransform, and
# prints a warning on standard error. The displacement field is lost. The same composite in .h5 and .tfm comes back whole.
# Source: SimpleITK's reading of transforms takes the first of ITK's list; ITK's MINC reader lists sections, and makes no
# composite of them.
# The guess most would make: what a library writes it reads back, or it raises.
# Who is hurt: whoever passes warps of MNI tools (minctracc, ANTs in CIVET-like pipelines: linear, then grid) to
# SimpleITK: points move by the linear part alone, by plausible numbers.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check simpleitk==2.5.2 numpy==2.3.2
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import sys
import numpy as np
import SimpleITK as sitk

print("SimpleITK", sitk.Version_VersionString(), "numpy", np.__version__)
shift = sitk.AffineTransform(3)
shift.SetTranslation((1.0, 0.0, 0.0))
vectors = np.zeros((6, 6, 6, 3))
vectors[..., 1] = 5.0
field = sitk.DisplacementFieldTransform(sitk.GetImageFromArray(vectors, isVector=True))
both = sitk.CompositeTransform([shift, field])
point = (2.0, 2.0, 2.0)
found = {}
for ending in ("h5", "tfm", "xfm"):
    sitk.WriteTransform(both, f"both.{ending}")
    read = sitk.ReadTransform(f"both.{ending}")
    found[ending] = read.TransformPoint(point)
    print(f"{ending}: {read.GetName()} moves {point} to {found[ending]}; written was {both.TransformPoint(point)}")
print(open("both.xfm").read())
whole = both.TransformPoint(point)
as_described = np.allclose(found["h5"], whole) and np.allclose(found["tfm"], whole) and found["xfm"][1] == point[1]
sys.exit(0 if as_described else 1)
PYTHON
