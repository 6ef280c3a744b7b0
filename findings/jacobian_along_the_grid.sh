#!/usr/bin/env bash
# Jacobian determinants of a displacement field: ITK's filter differentiates along the axes of the grid as if they were
# those of the world, and greedy's -rj along the voxels, unscaled by the spacing, though both hold vectors in LPS mm and
# resample with them rightly.
# Source: seen here with SimpleITK 2.5.7 (DisplacementFieldJacobianDeterminant) and picsl-greedy 1.4.0.3 (PyPI).
# The guess most would make: both heed spacing and direction of the field's header, as resampling with it does.
# Who is hurt: maps of volume change. A field whose exact determinant is 1.0589 everywhere reads 1.0209 on an image
# whose axes lead RAS, as most NIfTI files do, and 1.0511 on one turned by 37 degrees; greedy is wrong wherever a voxel
# is not 1 mm, also on a straight LPS image (1.0723). The numbers are smooth and near the truth, so nothing is noticed.
set -euo pipefail
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  simpleitk==2.5.7 picsl-greedy==1.4.0.3 numpy==2.2.6
cat > "$place/check.py" <<'PY'
import sys
from importlib.metadata import version

import numpy as np
import SimpleITK as sitk
from picsl_greedy import Greedy3D

place = sys.argv[1]
print(*(f"{name} {version(name)}" for name in ("SimpleITK", "picsl-greedy", "numpy")))
A = np.array([[0.1, 0.05, -0.02], [0.03, -0.08, 0.04], [-0.06, 0.02, 0.05]])  # u(x) = A x, x in LPS mm
TRUE = np.linalg.det(np.eye(3) + A)
axis, angle = np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0), np.radians(37.0)
K = np.cross(np.eye(3), axis)
OBLIQUE = np.eye(3) - np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K)
N = 12


def field(direction, spacing):
    index = np.stack(np.meshgrid(*[np.arange(N)] * 3, indexing="ij"), -1).reshape(-1, 3)
    u = ((index * spacing) @ direction.T @ A.T).reshape(N, N, N, 3)
    image = sitk.GetImageFromArray(np.ascontiguousarray(u.transpose(2, 1, 0, 3)), isVector=True)
    image.SetSpacing(spacing)
    image.SetDirection(direction.ravel().tolist())
    return image


def by_greedy(image):
    sitk.WriteImage(image, f"{place}/field.nii.gz")
    fixed = sitk.Image(image.GetSize(), sitk.sitkFloat32)
    fixed.CopyInformation(image)
    sitk.WriteImage(fixed, f"{place}/fixed.nii.gz")
    Greedy3D().execute(f"-V 0 -rf {place}/fixed.nii.gz -rj {place}/jacobian.nii.gz -r {place}/field.nii.gz")
    return sitk.ReadImage(f"{place}/jacobian.nii.gz")


same = True
for name, direction in (("LPS", np.eye(3)), ("RAS", np.diag([-1.0, -1.0, 1.0])), ("oblique", OBLIQUE)):
    for spacing in ((1.0, 1.0, 1.0), (1.5, 2.0, 2.5)):
        image = field(direction, spacing)
        itk = sitk.DisplacementFieldJacobianDeterminant(image)[6, 6, 6]
        greedy = by_greedy(image)[6, 6, 6]
        print(f"{name:8} spacing {spacing}: exact {TRUE:.6f}, SimpleITK {itk:.6f}, greedy {greedy:.6f}")
        same &= abs(itk - np.linalg.det(np.eye(3) + A @ direction)) < 1e-5
        same &= abs(greedy - np.linalg.det(np.eye(3) + A @ direction @ np.diag(spacing))) < 1e-5
point = sitk.DisplacementFieldTransform(sitk.Image(field(OBLIQUE, (1.5, 2.0, 2.5)))).TransformPoint((4.0, 5.0, 6.0))
print("the same oblique field moves (4, 5, 6) rightly:", np.allclose(point, (np.eye(3) + A) @ [4.0, 5.0, 6.0]))
print("as known" if same else "changed")
sys.exit(not same)
PY
"$place/venv/bin/python" "$place/check.py" "$place"
