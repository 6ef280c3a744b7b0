#!/usr/bin/env bash
# ITK places the grid of an NRRD vector image by its header, and gives the vectors as numbers of another frame and unit.
#
# Behaviour: a displacement field is stored twice, with one meaning: in `space: left-posterior-superior`, and in
# `space: right-anterior-superior` with the identity as its measurement frame. SimpleITK turns origin and directions of
# the second one to LPS, and leaves its vectors in RAS: x and y have the wrong sign. No frame other than the identity is
# applied, either, and `space units` of centimetres change neither spacing nor vectors. `GetMetaData` gives the space as
# LPS and the frame as an unprintable object: a caller cannot find out.
# Source: NRRD format, "measurement frame" and "space units"; ITK's NrrdImageIO.
# The guess most would make: the library that turns the grid turns the vectors that the header describes with it.
# Who is hurt: whoever reads displacement fields or diffusion vectors of NRRD in RAS by SimpleITK or ITK: motion is
# mirrored, or ten times too small beside other images in mm.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -qq --disable-pip-version-check simpleitk==2.5.2 numpy==2.3.2 pynrrd==1.1.3
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import sys
import nrrd
import numpy as np
import SimpleITK as sitk

print("SimpleITK", sitk.Version_VersionString(), "pynrrd", nrrd.__version__)
vectors = np.tile(np.array([3.0, 2.0, 1.0])[:, None, None, None], (1, 4, 4, 4))  # LPS mm
signs = np.array([-1.0, -1.0, 1.0])
none = np.full(3, np.nan)


def write(name, space, turn, unit, **more):
    edges = np.array([none, *(np.diag(turn) * 2.0 / unit)])
    header = {"space": space, "kinds": ["vector", "domain", "domain", "domain"], "space directions": edges,
              "space origin": turn * np.array([10.0, 20.0, 30.0]) / unit}
    nrrd.write(name, vectors * turn[:, None, None, None] / unit, header | more)


write("lps.nrrd", "left-posterior-superior", np.ones(3), 1.0)
write("ras.nrrd", "right-anterior-superior", signs, 1.0, **{"measurement frame": np.eye(3)})
write("cm.nrrd", "left-posterior-superior", np.ones(3), 10.0, **{"space units": ["cm", "cm", "cm"]})
found = {}
for name in ("lps", "ras", "cm"):
    image = sitk.ReadImage(f"{name}.nrrd")
    found[name] = (image.GetOrigin(), image.GetPixel(1, 1, 1))
    print(f"{name}: origin {image.GetOrigin()}, vector {image.GetPixel(1, 1, 1)}, space {image.GetMetaData('NRRD_space')}")
same_place = np.allclose(found["ras"][0], found["lps"][0])
mirrored = np.allclose(found["ras"][1], np.array(found["lps"][1]) * signs)
in_cm = np.allclose(found["cm"][0], np.array(found["lps"][0]) / 10.0)
sys.exit(0 if same_place and mirrored and in_cm else 1)
PYTHON
