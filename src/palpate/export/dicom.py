"""DICOM: stiffness as a Parametric Map, tissues as a Segmentation, both on the grid of the first image.

With `--source`, the folder of the series that was segmented, both belong to its patient, study and frame of reference,
and refer to its slices; else to a patient called "palpate" and a study of their own. highdicom writes them.
"""

from __future__ import annotations

import io
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from palpate.body.provenance import software_versions
from palpate.errors import InputDataError, ResourceError
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.images.input_file import read_input, similar_names
from palpate.images.segmentation import first_labels
from palpate.images.tissue import tissue_colours
from palpate.mesh.locate import modulus_image
from palpate.study.outputs import write_bytes

if TYPE_CHECKING:
    from pydicom.dataset import Dataset


LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
MOST_SLICES = 5000
MOST_BYTES = 2**26  # of a slice
ORGANS = {  # SNOMED CT, by words in a tissue's name
    "prostate": ("41216001", "Prostate"),
    "bladder": ("89837001", "Bladder"),
    "rectum": ("34402009", "Rectum"),
    "uterus": ("35039007", "Uterus"),
    "liver": ("10200004", "Liver"),
    "kidney": ("64033007", "Kidney"),
    "bone": ("272673000", "Bone"),
}


def write(model: FittedModel, body: FittedBody, folder: Path, source: Path | None = None) -> None:
    """Write stiffness.dcm and segmentation.dcm.

    Raises `ResourceError` without the extra `dicom`, `InputDataError` where the series of `--source` cannot be read or
    shows another place.
    """
    try:
        highdicom = import_module("highdicom")
    except ImportError as error:
        raise ResourceError(
            "DICOM files are written by highdicom, which is not installed: pip install 'palpate[dicom]'"
        ) from error
    slices = [_placeholder()] if source is None else _series(source, body)
    frame = str(slices[0].FrameOfReferenceUID)
    affine = LPS @ body.grid.affine[:, [2, 1, 0, 3]]  # slices, rows, columns
    across, down = np.reshape(np.array(slices[0].ImageOrientationPatient, dtype=float), (2, 3))
    axes = highdicom.spatial.get_closest_patient_orientation(np.stack([np.cross(across, down), down, across], axis=1))

    def volume(array: NDArray[Any]) -> Any:
        """An image (n_x, n_y, n_z) on the grid of the first image, its frames as the series' slices lie."""
        turned = np.ascontiguousarray(array.transpose(2, 1, 0))
        found = highdicom.Volume(turned, affine, coordinate_system="PATIENT", frame_of_reference_uid=frame)
        return found.to_patient_orientation(axes)

    stiffness = volume(modulus_image(body.mesh, body.grid, model.moduli).astype(np.float32))
    common = {
        "manufacturer": "Palpate",
        "manufacturer_model_name": "Palpate",
        "software_versions": software_versions().get("palpate", "0"),
        "device_serial_number": "none",
        "content_label": "PALPATE",
        "instance_number": 1,
    }
    made = {
        "stiffness.dcm": _map(highdicom, slices, stiffness, model, common),
        "segmentation.dcm": _segmentation(highdicom, slices, volume, body, common),
    }
    for name, dataset in made.items():
        if source is None:  # references to the placeholder are removed, because it does not exist as a file
            for reference in ("ReferencedSeriesSequence", "SourceImageSequence", "ReferencedImageEvidenceSequence"):
                if reference in dataset:
                    delattr(dataset, reference)
            frames = dataset.get("PerFrameFunctionalGroupsSequence", [])
            for group in (*dataset.get("SharedFunctionalGroupsSequence", []), *frames):
                if "DerivationImageSequence" in group:
                    del group.DerivationImageSequence
        content = io.BytesIO()
        dataset.save_as(content, enforce_file_format=True)
        write_bytes(folder / name, content.getvalue())


def _map(highdicom: Any, slices: list[Dataset], volume: Any, model: FittedModel, common: dict[str, Any]) -> Dataset:
    codes = import_module("pydicom.sr.codedict").codes
    unit = codes.UCUM.Kilopascal if model.unit == "kPa" else codes.UCUM.NoUnits
    quantity = highdicom.sr.CodedConcept("youngs-modulus", "99PALPATE", "Young's modulus")
    mapping = highdicom.pm.RealWorldValueMapping(
        lut_label="stiffness",
        lut_explanation="Young's modulus" if model.unit == "kPa" else "Young's modulus relative to another tissue's",
        unit=unit,
        value_range=(0.0, float(volume.array.max())),
        slope=1.0,
        intercept=0.0,
        quantity_definition=quantity,
    )
    largest = float(volume.array.max())
    found: Dataset = highdicom.pm.ParametricMap(
        slices,
        volume,
        series_instance_uid=highdicom.UID(),
        sop_instance_uid=highdicom.UID(),
        series_number=901,
        contains_recognizable_visual_features=False,
        real_world_value_mappings=[mapping],
        voi_lut_transformations=[highdicom.VOILUTTransformation(window_center=0.5 * largest, window_width=largest)],
        content_description="Young's modulus",
        content_qualification="RESEARCH",
        **common,
    )
    found.SeriesDescription = f"Young's modulus ({unit.value}), Palpate"
    return _upwards(_with_anatomy(found))


def _with_anatomy(found: Dataset) -> Dataset:
    """With the frame anatomy that PS3.3 A.75.5 demands and highdicom leaves out: the body, which is no paired part."""
    sequence = import_module("pydicom").Sequence
    anatomy, region = type(found.SharedFunctionalGroupsSequence[0])(), import_module("highdicom").sr.CodedConcept
    anatomy.AnatomicRegionSequence = sequence([region("38266002", "SCT", "Entire body")])
    anatomy.FrameLaterality = "U"
    found.SharedFunctionalGroupsSequence[0].FrameAnatomySequence = sequence([anatomy])
    return found


def _upwards(found: Dataset) -> Dataset:
    """With its frames along the normal of their rows and columns, the order in which dcmqi takes them to lie.

    highdicom stores them the other way round.
    """
    frames = list(found.PerFrameFunctionalGroupsSequence)
    turned = found.SharedFunctionalGroupsSequence[0].PlaneOrientationSequence[0].ImageOrientationPatient
    normal = np.cross(*np.reshape(np.array(turned, dtype=float), (2, 3)))
    order = np.argsort([normal @ np.array(f.PlanePositionSequence[0].ImagePositionPatient, float) for f in frames])
    for place, frame in enumerate(order.tolist(), start=1):
        frames[frame].FrameContentSequence[0].DimensionIndexValues = [place]
    found.PerFrameFunctionalGroupsSequence = [frames[frame] for frame in order]
    pixels = np.frombuffer(found.FloatPixelData, dtype="<f4").reshape(len(frames), -1)
    found.FloatPixelData = pixels[order].tobytes()
    return found


def _segmentation(
    highdicom: Any, slices: list[Dataset], volume: Any, body: FittedBody, common: dict[str, Any]
) -> Dataset:
    algorithm = highdicom.AlgorithmIdentificationSequence(
        name="labels given to Palpate",
        family=highdicom.sr.CodedConcept("unknown", "99PALPATE", "Unknown"),
        version="0",
    )
    labels = first_labels(body.tissues)
    numbers = {number: place for place, number in enumerate(np.argsort(labels).tolist(), start=1)}
    colours, organs = tissue_colours(body.tissues), []
    for tissue in body.tissues:
        known = [code for word, code in ORGANS.items() if word in tissue.name.lower()]
        code, meaning = known[0] if known else ("85756007", "Tissue")
        organs.append(highdicom.sr.CodedConcept(code, "SCT", meaning))
    segments = [
        highdicom.seg.SegmentDescription(
            segment_number=place,
            segment_label=body.tissues[number].name[:64],
            segmented_property_category=highdicom.sr.CodedConcept("85756007", "SCT", "Tissue"),
            segmented_property_type=organs[number],
            algorithm_type="SEMIAUTOMATIC",
            algorithm_identification=algorithm,
            display_color=highdicom.color.CIELabColor.from_string(colours[number]),
        )
        for number, place in numbers.items()
    ]
    index = np.array([numbers[number] for number in range(len(labels))], dtype=np.uint8)[body.index]
    found: Dataset = highdicom.seg.Segmentation(
        slices,
        volume(index),
        segmentation_type="BINARY",
        segment_descriptions=segments,
        series_instance_uid=highdicom.UID(),
        sop_instance_uid=highdicom.UID(),
        series_number=902,
        content_description="Tissues",
        **common,
    )
    found.SeriesDescription = "Tissues, Palpate"
    return found


def _placeholder() -> Dataset:
    """An anonymous slice, which gives patient, study and frame of reference where there is no series."""
    highdicom, pydicom = import_module("highdicom"), import_module("pydicom")
    found: Dataset = pydicom.Dataset()
    found.file_meta = pydicom.dataset.FileMetaDataset()
    found.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    found.SOPClassUID, found.Modality = pydicom.uid.CTImageStorage, "OT"
    for name in ("SOPInstanceUID", "StudyInstanceUID", "SeriesInstanceUID", "FrameOfReferenceUID"):
        setattr(found, name, highdicom.UID())
    found.PatientName, found.PatientID = "palpate^", "palpate"
    empty = ("PatientBirthDate", "PatientSex", "StudyID", "StudyDate", "StudyTime", "AccessionNumber")
    for name in (*empty, "ReferringPhysicianName", "PositionReferenceIndicator"):
        setattr(found, name, "")
    found.Rows = found.Columns = 1
    found.ImagePositionPatient, found.ImageOrientationPatient = [0, 0, 0], [1, 0, 0, 0, 1, 0]
    found.PixelSpacing, found.SliceThickness = [1, 1], 1
    return found


def _series(folder: Path, body: FittedBody) -> list[Dataset]:
    """The slices, without their pixels, of the one series in a folder; the frame of reference of the first image."""
    pydicom = import_module("pydicom")
    if not folder.is_dir():
        advice = similar_names(folder) or "; name the folder of the first image's DICOM series"
        raise InputDataError(f"there is no folder {folder}{advice}")
    found: list[Dataset] = []
    for path in islice(sorted(folder.iterdir()), MOST_SLICES):
        if path.is_symlink() or not path.is_file():
            continue
        content, _ = read_input(path, MOST_BYTES)
        if content[128:132] != b"DICM" or len(content) > MOST_BYTES:
            continue
        try:
            head = pydicom.dcmread(io.BytesIO(content), stop_before_pixels=True)
            if "ImagePositionPatient" in head and "FrameOfReferenceUID" in head:
                found.append(head)
        except Exception as error:
            raise InputDataError(f"{path} cannot be read as DICOM ({type(error).__name__})") from error
    series = {str(head.SeriesInstanceUID) for head in found}
    if len(series) != 1:
        raise InputDataError(f"{folder} holds the slices of {len(series)} series; keep only the one that was segmented")
    # raise `InputDataError` where the middle of the first image does not lie within the series
    across, down = np.array(found[0].ImageOrientationPatient, dtype=float).reshape(2, 3)
    axes = np.stack([across, down, np.cross(across, down)])
    places = np.array([head.ImagePositionPatient for head in found], dtype=float) @ axes.T
    rows, columns = (float(spacing) for spacing in found[0].PixelSpacing)
    size = np.array([columns * found[0].Columns, rows * found[0].Rows, 0.0])
    middle = LPS[:3, :3] @ body.grid.world(0.5 * (np.array(body.grid.shape) - 1.0)[None])[0] @ axes.T
    if not ((places.min(axis=0) <= middle) & (middle <= places.max(axis=0) + size)).all():
        raise InputDataError(
            f"the series in {folder} lies elsewhere than the first image of the result; name the series of that image"
        )
    return found
