"""Pictures of what programs for images get: 3D Slicer, the displacement field for ITK, DICOM."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch
from numpy.typing import NDArray

from .sheet import COLOURS, LEGEND, WIDTH, Bar, add_bar, drawn, saved, trimmed

Array = NDArray[Any]
LABELS = {"prostate": (1,), "bladder": (2,), "rectum": (3,), "bones": (6, 7, 8, 9, 10)}  # of the demo
PLANES = {"axial": 2, "coronal": 1, "sagittal": 0}  # the axis x, y, z across each


def slicer(folder: Path, picture: Path) -> None:
    """The layers and models that load_in_slicer.py sets up, as three slices and a view of the models."""
    import pyvista

    scene = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    stiffness = _read(folder / "stiffness.nii.gz")
    labels, grey = _read(folder / "labels.nii.gz"), _read(folder / "before.nii.gz")
    grey = SimpleITK.Resample(grey, stiffness, SimpleITK.Transform(), SimpleITK.sitkLinear, -1000.0)
    low, high = scene["stiffness"]["range"]
    bar = Bar(scene["stiffness"]["name"], low, high)
    figure, places = plt.subplots(2, 2, figsize=(WIDTH, 9.6), width_ratios=(1.0, 1.1))
    figure.subplots_adjust(left=0.01, right=0.99, top=0.96, bottom=0.12, wspace=0.02, hspace=0.12)
    middle = _centre(labels, LABELS["prostate"])
    for axes, plane in zip((places[0, 0], places[1, 0], places[1, 1]), PLANES, strict=True):
        _show(axes, _slice(grey, middle, plane), cmap="gray", vmin=-160, vmax=240)
        values = _slice(stiffness, middle, plane)
        shown = np.ma.masked_less(values, scene["stiffness"]["least"])
        _show(axes, shown, cmap=bar.colours, vmin=low, vmax=high, alpha=0.5, interpolation="nearest")
        _outline(axes, _slice(labels, middle, plane))
        _upright(axes, plane)
        axes.set_title(plane)
    models = [model for model in scene["models"] if model["visible"]]
    parts = [(pyvista.read(folder / model["file"]), {"color": model["colour"], "opacity": 0.4}) for model in models]
    bounds = pyvista.merge([mesh for mesh, _ in parts]).bounds
    places[0, 1].imshow(trimmed(drawn(parts, bounds))[0])
    places[0, 1].set_axis_off()
    places[0, 1].set_title("models shown")
    add_bar(figure, bar, (0.05, 0.075, 0.38, 0.02))
    _names(figure, (*LABELS,), (0.75, 0.06))
    saved(figure, picture)


def warp(folder: Path, picture: Path) -> None:
    """The label images, the later one brought to the first by SimpleITK with warp.nii.gz, and a grid taken along."""
    field = SimpleITK.ReadImage(str(folder / "warp.nii.gz"), SimpleITK.sitkVectorFloat64)
    transform = SimpleITK.DisplacementFieldTransform(field)
    before, after = _read(folder / "before.nii.gz"), _read(folder / "after.nii.gz")
    nearest = SimpleITK.sitkNearestNeighbor
    on_before = SimpleITK.Resample(after, before, transform, nearest, 0.0)
    after = SimpleITK.Resample(after, before, SimpleITK.Transform(), nearest, 0.0)  # where it lies, on the same slice
    middle = _centre(before, LABELS["prostate"])
    first = _slice(before, middle, "sagittal")
    figure, places = plt.subplots(2, 2, figsize=(WIDTH, 9.4))
    figure.subplots_adjust(left=0.01, right=0.99, top=0.96, bottom=0.07, wspace=0.03, hspace=0.09)
    titles = "before", "after", "after, brought on before", "a grid of 6 mm, from before to after"
    for axes, image, title in zip(places.flat, (before, after, on_before, after), titles, strict=True):
        _fill(axes, _slice(image, middle, "sagittal"), 0.35 if image is after and "grid" in title else 1.0)
        axes.set_title(title)
    for axes in places.flat[1:3]:
        _outline(axes, first, "black")
    start, end = before.GetOrigin(), before.TransformIndexToPhysicalPoint([n - 1 for n in before.GetSize()])
    ys, zs = (np.arange(start[axis], end[axis], 6.0) for axis in (1, 2))
    x = before.TransformIndexToPhysicalPoint(middle)[0]
    moved = np.array([[transform.TransformPoint((x, y, z)) for z in zs] for y in ys])[..., 1:]
    for lines in (moved, moved.transpose(1, 0, 2)):
        for line in lines:
            places[1, 1].plot(*((line - start[1:]) / before.GetSpacing()[1:]).T, color="black", linewidth=0.9)
    for axes in places.flat:
        _upright(axes, "sagittal")
    _names(figure, (*LABELS,), (0.5, 0.03))
    saved(figure, picture)


def dicom(folder: Path, picture: Path) -> None:
    """One frame of the segmentation by highdicom, in the colours that it names, and that of the map by pydicom."""
    import highdicom
    import pydicom

    segmentation = highdicom.seg.segread(folder / "segmentation.dcm")
    items = {int(item.SegmentNumber): item for item in segmentation.SegmentSequence}
    volume = segmentation.get_volume(combine_segments=True)
    organs = [n for n, item in items.items() if str(item.SegmentLabel) in ("prostate", "bladder", "rectum")]
    chosen = int(np.argmax(np.min([(volume.array == n).sum(axis=(1, 2)) for n in organs], axis=0)))
    height = float(volume.get_plane_position(chosen)[0].ImagePositionPatient[2])
    stiffness = pydicom.dcmread(folder / "stiffness.dcm")
    frames = np.frombuffer(stiffness.FloatPixelData, "<f4").reshape(-1, stiffness.Rows, stiffness.Columns)
    groups = stiffness.PerFrameFunctionalGroupsSequence
    heights = [float(group.PlanePositionSequence[0].ImagePositionPatient[2]) for group in groups]
    frame = frames[int(np.argmin(np.abs(np.array(heights) - height)))]
    bar = Bar(_quantity(stiffness), 0.0, float(frames.max()))
    figure, axes = plt.subplots(1, 2, figsize=(WIDTH, 7.6))
    figure.subplots_adjust(left=0.02, right=0.98, top=0.94, bottom=0.14, wspace=0.05)
    _show(axes[1], frame, cmap=bar.colours, vmin=bar.low, vmax=bar.high, interpolation="nearest")
    handles = []
    for number in np.unique(volume.array[chosen][volume.array[chosen] > 0]):
        colour, area = _srgb(items[number].RecommendedDisplayCIELabValue), volume.array[chosen] == number
        _show(axes[0], np.ma.masked_where(~area, area), cmap=ListedColormap([colour]), interpolation="nearest")
        axes[1].contour(area, [0.5], colors=["white"], linewidths=1.5)
        handles.append(Patch(color=colour, label=str(items[number].SegmentLabel)))
    axes[0].set_title("segmentation.dcm")
    axes[1].set_title("stiffness.dcm, outlines of segmentation.dcm")
    add_bar(figure, bar, (0.55, 0.09, 0.38, 0.025))
    figure.legend(handles=handles, loc="center", bbox_to_anchor=(0.26, 0.06), ncols=3, **LEGEND)
    saved(figure, picture)


def _quantity(stiffness: Any) -> str:
    """The meaning of a parametric map's values with its unit, as its real-world mapping has them."""
    groups = [*stiffness.SharedFunctionalGroupsSequence, *stiffness.PerFrameFunctionalGroupsSequence]
    mapping = next(g for g in groups if "RealWorldValueMappingSequence" in g).RealWorldValueMappingSequence[0]
    return f"{mapping.LUTExplanation} ({mapping.MeasurementUnitsCodeSequence[0].CodeValue})"


def _srgb(value: Any) -> tuple[float, float, float]:
    """DICOM's CIELab of 16 bits, D50, as the screen's red, green and blue from 0 to 1."""
    lightness, a, b = float(value[0]) / 655.35, float(value[1]) / 257.0 - 128.0, float(value[2]) / 257.0 - 128.0
    y = (lightness + 16.0) / 116.0
    around = np.array([y + a / 500.0, y, y - b / 200.0])
    scaled = np.where(around > 6 / 29, around**3, 3 * (6 / 29) ** 2 * (around - 4 / 29))
    xyz = scaled * (0.9642, 1.0, 0.8251)
    matrix = [[3.1339, -1.6169, -0.4906], [-0.9788, 1.9161, 0.0335], [0.0719, -0.2290, 1.4052]]  # adapted to D65
    linear = np.clip(np.array(matrix) @ xyz, 0.0, 1.0)
    red, green, blue = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return float(red), float(green), float(blue)


def _read(path: Path) -> SimpleITK.Image:
    """An image with its axes to the left, to the back and up, as radiologists look at slices."""
    return SimpleITK.DICOMOrient(SimpleITK.ReadImage(str(path)), "LPS")


def _centre(labels: SimpleITK.Image, values: tuple[int, ...]) -> tuple[int, int, int]:
    """The voxel x, y, z in the middle of what has some labels."""
    z, y, x = (round(found.mean()) for found in np.nonzero(np.isin(SimpleITK.GetArrayViewFromImage(labels), values)))
    return x, y, z


def _slice(image: SimpleITK.Image, middle: tuple[int, int, int], plane: str) -> Array:
    """Rows to the back on an axial slice, upwards on the others, which `_upright` then turns over."""
    axis = PLANES[plane]
    return np.take(SimpleITK.GetArrayFromImage(image), middle[axis], axis=2 - axis)


def _upright(axes: Axes, plane: str) -> None:
    low, high = sorted(axes.get_ylim())
    axes.set_ylim((high, low) if plane == "axial" else (low, high))


def _show(axes: Axes, values: Array, **how: Any) -> None:
    axes.imshow(values, **how)
    axes.set_axis_off()


def _outline(axes: Axes, labels: Array, colour: str | None = None) -> None:
    for name, values in LABELS.items():
        inside = np.isin(labels, values)
        if inside.any():
            axes.contour(inside, [0.5], colors=[colour or COLOURS[name]], linewidths=2.0)


def _fill(axes: Axes, labels: Array, opacity: float) -> None:
    _show(axes, np.ones_like(labels), cmap=ListedColormap([COLOURS["surroundings"]]), alpha=opacity)
    for name, values in LABELS.items():
        inside = np.isin(labels, values)
        colour = ListedColormap([COLOURS[name]])
        _show(axes, np.ma.masked_where(~inside, inside), cmap=colour, alpha=opacity, interpolation="nearest")


def _names(figure: Any, names: tuple[str, ...], place: tuple[float, float]) -> None:
    handles = [Patch(color=COLOURS[name], label=name) for name in names]
    figure.legend(handles=handles, loc="center", bbox_to_anchor=place, ncols=len(names), **LEGEND)
