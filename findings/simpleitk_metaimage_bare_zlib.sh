#!/usr/bin/env bash
# SimpleITK (ITK's MetaIO) reads a compressed MetaImage with its voxels behind the header (LOCAL), whose header does not
# state CompressedDataSize, as memory that nothing was read into: no exception, right size and place, wrong voxels.
# In a file of their own (.zraw) the same voxels are read right.
# Source: measured by this script; the format: https://itk.org/Wiki/MetaIO/Documentation
# Most would guess: a zlib stream says itself where it ends, so the file is read, or else an exception is raised.
# Hurt: who writes .mha by zlib.compress and a header of their own, and who trusts ReadImage to fail where it cannot read.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check simpleitk==2.5.7 numpy==2.4.6
"$folder/venv/bin/python" - "$folder" <<'CODE' 2> "$folder/messages"
import sys, zlib
from pathlib import Path
import numpy as np, SimpleITK as sitk
folder = Path(sys.argv[1])
labels = np.random.default_rng(3).integers(0, 5, (40, 50, 60), dtype=np.uint8)
packed = zlib.compress(labels.tobytes(order="F"))
HEAD = """ObjectType = Image
NDims = 3
BinaryData = True
BinaryDataByteOrderMSB = False
CompressedData = True
{}TransformMatrix = 1 0 0 0 1 0 0 0 1
Offset = 0 0 0
ElementSpacing = 1 1 1
DimSize = 40 50 60
ElementType = MET_UCHAR
ElementDataFile = {}
"""
(folder / "voxels.zraw").write_bytes(packed)
(folder / "stated.mha").write_bytes(HEAD.format(f"CompressedDataSize = {len(packed)}\n", "LOCAL").encode() + packed)
(folder / "bare.mha").write_bytes(HEAD.format("", "LOCAL").encode() + packed)
(folder / "bare.mhd").write_bytes(HEAD.format("", "voxels.zraw").encode())
print("SimpleITK", sitk.Version.VersionString(), "numpy", np.__version__)
share = {}
for name in ("stated.mha", "bare.mhd", "bare.mha"):
    image = sitk.ReadImage(str(folder / name))  # none of them raises
    share[name] = float((sitk.GetArrayFromImage(image).T == labels).mean())
    print(f"{name}: size {image.GetSize()}, {100 * share[name]:.1f} % of the voxels are right")
sys.exit(0 if share["stated.mha"] == share["bare.mhd"] == 1.0 > share["bare.mha"] else 1)
CODE
