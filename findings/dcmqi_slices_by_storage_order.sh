#!/usr/bin/env bash
# dcmqi's paramap2itkimage puts the frames of a DICOM Parametric Map at slices in the order in which they are stored,
# from the lowest position up; the position that each frame states counts for the origin and the spacing alone.
# Source: seen here with dcmqi 1.5.7 (PyPI) on an object that highdicom 0.28.2 (PyPI) makes of a volume.
# The guess most would make: a frame goes where its own Image Position (Patient) says, in whatever order it is stored.
# Who is hurt: highdicom stores the frames of a volume from the highest slice down, so a map that it wrote comes out
# of dcmqi mirrored head to foot, with the right origin, spacing and directions, and no warning.
set -euo pipefail
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  dcmqi==1.5.7 highdicom==0.28.2 pydicom==3.0.2 numpy==2.2.6 nibabel==5.3.2
cat > "$place/check.py" <<'PY'
import subprocess, sys
from importlib.metadata import version
from pathlib import Path

import highdicom
import nibabel
import numpy as np
import pydicom
from pydicom.sr.codedict import codes

place = Path(sys.argv[1])
print(*(f"{name} {version(name)}" for name in ("dcmqi", "highdicom", "pydicom", "nibabel")))
image = pydicom.Dataset()
image.file_meta = pydicom.dataset.FileMetaDataset()
image.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
image.SOPClassUID, image.Modality = pydicom.uid.CTImageStorage, "CT"
for name in ("SOPInstanceUID", "StudyInstanceUID", "SeriesInstanceUID", "FrameOfReferenceUID"):
    setattr(image, name, highdicom.UID())
image.PatientName, image.PatientID, image.StudyDate, image.StudyTime = "a^b", "1", "20200101", "120000"
for name in ("PatientBirthDate", "PatientSex", "StudyID", "AccessionNumber", "ReferringPhysicianName",
             "PositionReferenceIndicator"):
    setattr(image, name, "")
image.Rows = image.Columns = 3
image.ImagePositionPatient, image.ImageOrientationPatient = [0, 0, 0], [1, 0, 0, 0, 1, 0]
image.PixelSpacing, image.SliceThickness = [1, 1], 1
affine = np.array([[0, 0, 1, 0], [0, 1, 0, 0], [2, 0, 0, 10], [0, 0, 0, 1.0]])  # slices 2 mm apart, from z = 10 mm up
values = np.repeat(np.arange(1.0, 5.0, dtype=np.float32), 9).reshape(4, 3, 3)  # 1 in the lowest slice, 4 in the highest
volume = highdicom.Volume(values, affine, coordinate_system="PATIENT", frame_of_reference_uid=image.FrameOfReferenceUID)
mapping = highdicom.pm.RealWorldValueMapping(
    lut_label="x", lut_explanation="x", unit=codes.UCUM.NoUnits, value_range=(0.0, 5.0), slope=1.0, intercept=0.0,
    quantity_definition=highdicom.sr.CodedConcept("x", "99X", "X"))
made = highdicom.pm.ParametricMap(
    [image], volume, series_instance_uid=highdicom.UID(), series_number=1, sop_instance_uid=highdicom.UID(),
    instance_number=1, manufacturer="m", manufacturer_model_name="m", software_versions="1", device_serial_number="1",
    contains_recognizable_visual_features=False, real_world_value_mappings=[mapping], content_creator_name="a^b",
    voi_lut_transformations=[highdicom.VOILUTTransformation(window_center=2.5, window_width=5.0)])
anatomy = pydicom.Dataset()  # the Frame Anatomy macro, mandatory by PS3.3 table A.75-2
anatomy.AnatomicRegionSequence = [highdicom.sr.CodedConcept("38266002", "SCT", "Entire body")]
anatomy.FrameLaterality = "U"
made.SharedFunctionalGroupsSequence[0].FrameAnatomySequence = [anatomy]
made.save_as(place / "map.dcm", enforce_file_format=True)
heights = [float(f.PlanePositionSequence[0].ImagePositionPatient[2]) for f in made.PerFrameFunctionalGroupsSequence]
stored = np.frombuffer(made.FloatPixelData, "<f4").reshape(4, 9)[:, 0].tolist()
print("stored: heights of the frames, mm", heights, "values", stored)
assert dict(zip(heights, stored)) == {10.0: 1.0, 12.0: 2.0, 14.0: 3.0, 16.0: 4.0}, "highdicom wrote something else"
program = Path(sys.executable).parent / "paramap2itkimage"
subprocess.run([program, "--inputDICOM", place / "map.dcm", "--outputDirectory", place, "-t", "nii"], check=True,
               capture_output=True)
read = nibabel.load(place / "pmap.nii.gz")
found = {float(read.affine[2, 2] * k + read.affine[2, 3]): float(np.asarray(read.dataobj)[1, 1, k]) for k in range(4)}
print("read by dcmqi: value by height, mm", found)
turned = {10.0: 4.0, 12.0: 3.0, 14.0: 2.0, 16.0: 1.0}
print("mirrored, as known" if found == turned else "changed: no longer mirrored")
sys.exit(found != turned)
PY
"$place/venv/bin/python" "$place/check.py" "$place"
