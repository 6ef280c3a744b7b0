#!/usr/bin/env bash
# SimpleITK reads NaN and infinity in a NIfTI file as 0. The same image keeps them through NRRD and MetaImage.
# Source: seen here with SimpleITK 2.5.7 (PyPI); nibabel 5.3.2 reads the very file with its NaN.
# The guess most would make: floating-point voxels come back as they were written.
# Who is hurt: maps that mark what is unknown by NaN, as those of fits and of elastography do. Means over a region
# count the unknown as 0, and a mask of finite voxels takes all of them in; a file converted by SimpleITK loses them.
set -euo pipefail
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/python" -m pip install --quiet --disable-pip-version-check simpleitk==2.5.7 nibabel==5.3.2 numpy==2.2.6
cat > "$place/check.py" <<'PY'
import sys
from importlib.metadata import version

import nibabel
import numpy as np
import SimpleITK as sitk

place = sys.argv[1]
print(*(f"{name} {version(name)}" for name in ("SimpleITK", "nibabel", "numpy")))
values = np.full((3, 3, 3), 8.0, dtype=np.float32)
values[1, 1, 1], values[0, 0, 0] = np.nan, np.inf
found = {}
for ending in ("nii", "nii.gz", "nrrd", "mha"):
    path = f"{place}/image.{ending}"
    sitk.WriteImage(sitk.GetImageFromArray(values), path)
    read = sitk.GetArrayFromImage(sitk.ReadImage(path))
    found[ending] = [float(read[1, 1, 1]), float(read[0, 0, 0])]
    print(ending, "NaN and infinity come back as", found[ending])
kept = np.asarray(nibabel.load(f"{place}/image.nii").dataobj)
print("the .nii holds, by nibabel,", float(kept[1, 1, 1]), float(kept[0, 0, 0]))
same = found["nii"] == found["nii.gz"] == [0.0, 0.0] and np.isnan(found["nrrd"][0]) and np.isnan(found["mha"][0])
same &= bool(np.isnan(kept[1, 1, 1]))
print("as known" if same else "changed")
sys.exit(not same)
PY
"$place/venv/bin/python" "$place/check.py" "$place"
