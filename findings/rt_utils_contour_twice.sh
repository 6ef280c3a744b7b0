#!/usr/bin/env bash
# A contour that an RTSTRUCT holds twice, point for point, leaves of its slice the outline alone when rt-utils 1.2.7 makes
# a mask of it: all contours of a slice go into one cv.fillPoly, whose even-odd rule lets a copy cancel its original.
# Nothing is said. A line of the type OPEN_PLANAR, which encloses nothing, is filled like a closed contour.
# Source: rt_utils/image_helper.py (cv.fillPoly with all polygons of a slice), https://github.com/qurit/rt-utils
# The guess most would make: a contour that stands twice changes nothing, and lines that are not closed enclose nothing.
# Who is hurt: whoever takes volumes, doses or training masks from structure sets that planning systems wrote with copies.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet rt-utils==1.2.7 pydicom==3.0.2 opencv-python==5.0.0.93 numpy==2.4.6 2>/dev/null
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import copy, importlib.metadata, sys
from pathlib import Path
import numpy as np
import pydicom
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid
from rt_utils import RTStructBuilder

folder = Path(sys.argv[1])
series = folder / "series"
series.mkdir()
study, uid, frame = generate_uid(), generate_uid(), generate_uid()
for k in range(9):
    ds = Dataset()
    ds.file_meta = FileMetaDataset()
    ds.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    ds.SOPClassUID = ds.file_meta.MediaStorageSOPClassUID = CTImageStorage
    ds.SOPInstanceUID = ds.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    ds.StudyInstanceUID, ds.SeriesInstanceUID, ds.FrameOfReferenceUID = study, uid, frame
    ds.Modality, ds.InstanceNumber, ds.SeriesNumber, ds.StudyID = "CT", k + 1, 1, "1"
    ds.PatientName, ds.PatientID, ds.PatientBirthDate, ds.PatientSex = "Phantom", "P", "", ""
    ds.StudyDate = ds.SeriesDate = "20200101"
    ds.StudyTime = ds.SeriesTime = "120000"
    ds.StudyDescription, ds.PatientAge, ds.PatientSize, ds.PatientWeight = "", "", "1", "1"
    ds.ImageOrientationPatient, ds.ImagePositionPatient = [1, 0, 0, 0, 1, 0], [0, 0, 2 * k]
    ds.PixelSpacing, ds.SliceThickness, ds.Rows, ds.Columns = [1, 1], 2, 40, 40
    ds.BitsAllocated, ds.BitsStored, ds.HighBit, ds.PixelRepresentation, ds.SamplesPerPixel = 16, 16, 15, 1, 1
    ds.PhotometricInterpretation, ds.PixelData = "MONOCHROME2", np.zeros((40, 40), np.int16).tobytes()
    ds.save_as(series / f"{k}.dcm", enforce_file_format=True)
row, column, slice_ = np.indices((40, 40, 9))
ball = (row - 20) ** 2 + (column - 18) ** 2 + (3 * (slice_ - 4)) ** 2 < 150
builder = RTStructBuilder.create_new(dicom_series_path=str(series))
builder.add_roi(mask=ball, name="ball")
builder.save(str(folder / "once.dcm"))


def per_slice(name, change):
    ds = pydicom.dcmread(folder / "once.dcm")
    change(ds.ROIContourSequence[0].ContourSequence)
    ds.save_as(folder / f"{name}.dcm")
    read = RTStructBuilder.create_from(dicom_series_path=str(series), rt_struct_path=str(folder / f"{name}.dcm"))
    counts = read.get_roi_mask_by_name("ball").sum(axis=(0, 1)).tolist()
    print(f"{name:6}", counts)
    return counts


for package in ("rt-utils", "pydicom", "opencv-python", "numpy"):
    print(package, importlib.metadata.version(package))
print("drawn ", ball.sum(axis=(0, 1)).tolist())
once = per_slice("same", lambda contours: None)
twice = per_slice("twice", lambda contours: contours.append(copy.deepcopy(contours[len(contours) // 2])))
opened = per_slice("open", lambda contours: [setattr(each, "ContourGeometricType", "OPEN_PLANAR") for each in contours])
lost = [k for k in range(9) if twice[k] < 0.2 * once[k]]
print("slices that lose over four fifths once a contour stands twice:", lost)
sys.exit(0 if len(lost) == 1 and opened == once else 1)
PYTHON
