"""DICOM files as others write them: CT slices, segmentations, contours; a patient's name stands in all of them."""

from __future__ import annotations

from pathlib import Path

import contourpy
import highdicom
import numpy as np
from highdicom.seg import Segmentation, SegmentDescription
from numpy.typing import NDArray
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sr.codedict import codes
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, RTStructureSetStorage, generate_uid

PLANTED = "Meyer^Erika"
BORN = "19520229"
TILTED = {  # direction cosines of a row and of a column
    "axial": ((1, 0, 0), (0, 1, 0)),
    "sagittal": ((0, 1, 0), (0, 0, -1)),
    "oblique": ((0.9553364891, 0.2955202067, 0), (-0.2955202067, 0.9553364891, 0)),
}
Names = dict[int, tuple[str, str]]  # number -> name, #rrggbb


def axes_of(slices: list[Dataset]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Steps (3, 3) from slice to slice, row to row, column to column, and the first voxel's place; LPS mm."""
    across, down = np.reshape(np.array(slices[0].ImageOrientationPatient, dtype=float), (2, 3))
    rows, columns = (float(spacing) for spacing in slices[0].PixelSpacing)
    through = float(slices[0].SliceThickness) * np.cross(across, down)
    origin = np.array(slices[0].ImagePositionPatient, dtype=float)
    return np.stack([through, rows * down, columns * across]), origin


def ct_slices(
    shape: tuple[int, ...], spacing: tuple[float, ...], origin: tuple[float, ...], orientation: str = "axial"
) -> list[Dataset]:
    """A CT series without pixels worth a look: `shape`, `spacing` (mm) by slices, rows, columns; `origin` LPS mm."""
    across, down = (np.array(v, dtype=float) for v in TILTED[orientation])
    study, uid, frame = generate_uid(), generate_uid(), generate_uid()
    found = []
    for k in range(shape[0]):
        ds = Dataset()
        ds.file_meta = FileMetaDataset()
        ds.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        ds.file_meta.MediaStorageSOPClassUID = ds.SOPClassUID = CTImageStorage
        ds.file_meta.MediaStorageSOPInstanceUID = ds.SOPInstanceUID = generate_uid()
        ds.PatientName, ds.PatientID, ds.PatientBirthDate, ds.PatientSex = PLANTED, PLANTED, BORN, "F"
        ds.StudyInstanceUID, ds.SeriesInstanceUID, ds.FrameOfReferenceUID = study, uid, frame
        ds.StudyID, ds.StudyDate, ds.StudyTime, ds.AccessionNumber = "1", "20200101", "120000", PLANTED
        ds.ReferringPhysicianName, ds.Modality, ds.SeriesNumber, ds.InstanceNumber = PLANTED, "CT", 1, k + 1
        ds.ImagePositionPatient = [f"{v:.8g}" for v in np.array(origin) + spacing[0] * k * np.cross(across, down)]
        ds.ImageOrientationPatient = [*across.tolist(), *down.tolist()]
        ds.PixelSpacing, ds.SliceThickness = list(spacing[1:]), spacing[0]
        ds.Rows, ds.Columns = shape[1:]
        ds.SamplesPerPixel, ds.PhotometricInterpretation, ds.PixelRepresentation = 1, "MONOCHROME2", 0
        ds.BitsAllocated, ds.BitsStored, ds.HighBit = 16, 16, 15
        ds.PixelData = bytes(2 * shape[1] * shape[2])
        found.append(ds)
    return found


def save_series(folder: Path, slices: list[Dataset]) -> None:
    folder.mkdir(exist_ok=True)
    for ds in slices:
        ds.save_as(folder / f"{ds.SOPInstanceUID}.dcm", enforce_file_format=True)


def descriptions(names: Names) -> list[SegmentDescription]:
    return [
        SegmentDescription(
            segment_number=number,
            segment_label=name,
            segmented_property_category=codes.SCT.Organ,
            segmented_property_type=codes.SCT.Prostate,
            algorithm_type="MANUAL",
            display_color=highdicom.color.CIELabColor.from_string(colour),
        )
        for number, (name, colour) in names.items()
    ]


def save_segmentation(
    path: Path, slices: list[Dataset], kind: str, names: Names, organs: dict[int, NDArray[np.bool_]]
) -> Path:
    """`organs`: masks (slices, rows, columns) by the numbers from 1; empty frames are left out."""
    stacked = np.stack([organs[number] for number in sorted(organs)], axis=-1)
    pixels = stacked.astype(np.uint8)
    if kind == "LABELMAP":
        pixels = (stacked * np.arange(1, stacked.shape[-1] + 1)).sum(axis=-1).astype(np.uint8)
    if kind == "FRACTIONAL":
        pixels = stacked.astype(np.float32) * 0.5
    Segmentation(
        source_images=slices,
        pixel_array=pixels,
        segmentation_type=kind,
        segment_descriptions=descriptions(names),
        series_instance_uid=generate_uid(),
        series_number=2,
        sop_instance_uid=generate_uid(),
        instance_number=1,
        manufacturer="Palpate",
        manufacturer_model_name="tests",
        software_versions="1",
        device_serial_number="1",
        content_creator_name=PLANTED,
        content_description=PLANTED,
    ).save_as(path)
    return path


def save_contours(
    path: Path, slices: list[Dataset], names: Names, contours: dict[int, list[tuple[NDArray[np.float64], str]]]
) -> Path:
    """`contours`: by structure, points (n, 3) of slice, row, column, and a geometric type."""
    axes, origin = axes_of(slices)
    ds = Dataset()
    ds.file_meta = FileMetaDataset()
    ds.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    ds.file_meta.MediaStorageSOPClassUID = ds.SOPClassUID = RTStructureSetStorage
    ds.file_meta.MediaStorageSOPInstanceUID = ds.SOPInstanceUID = generate_uid()
    ds.PatientName, ds.PatientID, ds.Modality = PLANTED, PLANTED, "RTSTRUCT"
    ds.StructureSetLabel, ds.StructureSetDescription, ds.PatientBirthDate = PLANTED, PLANTED, BORN
    referenced, study, frame = Dataset(), Dataset(), Dataset()
    referenced.SeriesInstanceUID = slices[0].SeriesInstanceUID
    study.RTReferencedSeriesSequence = [referenced]
    frame.RTReferencedStudySequence = [study]
    ds.ReferencedFrameOfReferenceSequence = [frame]
    ds.StructureSetROISequence, ds.ROIContourSequence = [], []
    for number, lines in contours.items():
        roi, item = Dataset(), Dataset()
        roi.ROINumber, roi.ROIName = number, names[number][0]
        item.ReferencedROINumber = number
        item.ROIDisplayColor = list(bytes.fromhex(names[number][1][1:]))
        item.ContourSequence = []
        for points, kind in lines:
            contour = Dataset()
            contour.ContourGeometricType, contour.NumberOfContourPoints = kind, len(points)
            contour.ContourData = [f"{value:.4f}" for value in (points @ axes + origin).ravel()]
            item.ContourSequence.append(contour)
        ds.StructureSetROISequence.append(roi)
        ds.ROIContourSequence.append(item)
    ds.SpecificCharacterSet = "ISO_IR 192"
    ds.save_as(path, enforce_file_format=True)
    return path


def traced(mask: NDArray[np.bool_], level: float) -> list[tuple[NDArray[np.float64], str]]:
    """Contours of a mask, slice by slice: at 0.5 between voxels, near 1 through the centres of the outermost ones."""
    lines = []
    for k, area in enumerate(mask):
        for line in contourpy.contour_generator(z=np.pad(area, 1).astype(float)).lines(level):
            points = np.column_stack([np.full(len(line) - 1, k), line[:-1, ::-1] - 1.0])
            lines.append((points, "CLOSED_PLANAR"))
    return lines
