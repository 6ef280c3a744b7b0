"""Whether a body gives the same moduli from each kind of label file: the demo's labels, written in four ways.

    python benchmarks/inputs.py [--inputs masks,dicom-seg,rtstruct] [--json]

The demo's two label images are written as folders of masks under TotalSegmentator's names, as DICOM-SEG and as RTSTRUCT
beside a CT series of their grid (the extra `dicom`; contours traced around the voxels, slice by slice). Each goes
through `palpate init` and `palpate estimate` with the demo's edge length and known modulus, the demo by its own case.
Volumes and centroids are those of all organs in both states, against the demo's images. The exit code is 1 where
volumes differ by more than 0.1 % (RTSTRUCT: 1 %) or centroids by 0.1 mm, where a modulus is not in the other's
interval, or where one from masks differs by over 0.1 %. Simulated data.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rows import table_of

from palpate.demo import DATA
from palpate.images import LabelImage, read_label_image, write_label_image

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from dicom_files import ct_slices, save_contours, save_segmentation, save_series, traced

STATES = ("before", "after")
ORGANS = {"prostate": 1, "urinary_bladder": 2, "rectum": 3, "sacrum": 6}
ORGANS |= {"hip_right": 7, "hip_left": 8, "femur_right": 9, "femur_left": 10}
COLOUR = "#c08040"
AS_THE_DEMO = ("mesh.edge_length_mm=10", "tissues.surroundings.youngs_modulus_kpa=10")
VOLUMES = {"masks": 1e-3, "dicom-seg": 1e-3, "rtstruct": 1e-2}
CENTROIDS_MM = 0.1
SAME = 1e-3  # moduli of masks, whose voxels are the demo's

Masks = dict[str, NDArray[np.bool_]]


def main() -> int:
    """Write the labels, estimate from each of them, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", default=",".join(WRITERS))
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        images = {state: read_label_image(DATA / f"simulated_{state}.nii.gz") for state in STATES}
        demo = _estimates(DATA / "demo.toml", folder / "demo")
        rows = []
        for kind in asked.inputs.split(","):
            found = _estimated(kind, folder / kind, images)
            rows.append({"input": kind, **found, **_judged(kind, found, demo)})
    for row in ({"input": "demo", "estimates": demo}, *rows):
        print(row, file=sys.stderr)
    print(json.dumps({"demo": demo, "inputs": rows}, indent=1) if asked.json else _table(rows))
    return 0 if all(row["as_wanted"] for row in rows) else 1


def _estimated(kind: str, folder: Path, images: Mapping[str, LabelImage]) -> dict[str, Any]:
    """Largest relative difference of a volume, largest shift of a centroid (mm), estimates by tissue."""
    paths = []
    volumes, shifts = [], []
    for state, image in images.items():
        masks = {name: image.labels == n for name, n in ORGANS.items() if (image.labels == n).any()}
        paths.append(WRITERS[kind](folder / state, image, masks | {"body": image.labels > 0}))
        again = read_label_image(paths[-1])
        for name, mask in masks.items():
            label = next(number for number, called in again.names.items() if called == name)
            found = again.labels == label
            volume = np.count_nonzero(found) * again.grid.voxel_volume
            volumes.append(volume / (np.count_nonzero(mask) * image.grid.voxel_volume) - 1.0)
            shifts.append(np.linalg.norm(_centroid(again, found) - _centroid(image, mask)))
    case = folder / "case"
    _palpate("init", *map(str, paths), "--output", str(case))
    settings = [flag for setting in AS_THE_DEMO for flag in ("--set", setting)]
    return {
        "volume": float(np.abs(volumes).max()),
        "centroid_mm": float(max(shifts)),
        "estimates": _estimates(case / "case.toml", folder / "out", *settings),
    }


def _judged(kind: str, found: Mapping[str, Any], demo: Mapping[str, Any]) -> dict[str, Any]:
    """Largest relative difference of a modulus from the demo's, and whether all is as it should be."""
    pairs = [(found["estimates"][name], demo[name]) for name in demo]
    inside = all(
        a["interval"][0] <= b["value"] <= a["interval"][1] and b["interval"][0] <= a["value"] <= b["interval"][1]
        for a, b in pairs
    )
    differs = max(abs(a["value"] / b["value"] - 1.0) for a, b in pairs)
    placed = found["volume"] <= VOLUMES[kind] and found["centroid_mm"] <= CENTROIDS_MM
    return {"modulus": differs, "as_wanted": placed and inside and (kind != "masks" or differs <= SAME)}


def _write_masks(folder: Path, image: LabelImage, masks: Masks) -> Path:
    folder.mkdir(parents=True)
    for name, mask in masks.items():
        write_label_image(folder / f"{name}.nii.gz", LabelImage(mask.astype(np.int32), image.grid))
    return folder


def _write_segments(folder: Path, image: LabelImage, masks: Masks) -> Path:
    return Path(save_segmentation(folder / "segments.dcm", *_in_dicom(folder, image, masks)))


def _write_contours(folder: Path, image: LabelImage, masks: Masks) -> Path:
    slices, _, named, organs = _in_dicom(folder, image, masks)
    contours = {number: traced(mask, 0.5) for number, mask in organs.items()}
    return Path(save_contours(folder / "contours.dcm", slices, named, contours))


WRITERS: Mapping[str, Callable[[Path, LabelImage, Masks], Path]] = {
    "masks": _write_masks,
    "dicom-seg": _write_segments,
    "rtstruct": _write_contours,
}


def _in_dicom(
    folder: Path, image: LabelImage, masks: Masks
) -> tuple[Any, str, dict[int, tuple[str, str]], dict[int, NDArray[np.bool_]]]:
    """A saved series of axial slices on the image's grid; how segments are stored; names and masks by number."""
    affine = image.grid.affine
    spacing = np.diag(affine)[:3]
    if not np.allclose(affine[:3, :3], np.diag(spacing)) or spacing.min() <= 0.0:
        raise SystemExit(f"the demo's axes are expected along x, y and z, not {affine[:3, :3].tolist()}")
    shape = np.array(image.labels.shape)
    first = image.grid.world(np.array([[shape[0] - 1.0, shape[1] - 1.0, 0.0]]))[0] * [-1, -1, 1]  # LPS
    slices = ct_slices(tuple(shape[::-1].tolist()), tuple(spacing[::-1].tolist()), tuple(first.tolist()))
    folder.mkdir(parents=True)
    save_series(folder / "ct", slices)
    named = {number: (name, COLOUR) for number, name in enumerate(masks, start=1)}
    turned = {number: mask[::-1, ::-1].transpose(2, 1, 0) for number, mask in enumerate(masks.values(), start=1)}
    return slices, "BINARY", named, turned


def _centroid(image: LabelImage, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    return np.asarray(image.grid.world(np.argwhere(mask).mean(axis=0)[None])[0])


def _estimates(case: Path, output: Path, *flags: str) -> dict[str, Any]:
    """Value and interval of each tissue, kPa; names as the demo has them."""
    _palpate("estimate", str(case), "--output", str(output), *flags)
    document = json.loads((output / "result.json").read_text())
    return {
        item["tissue"].removeprefix("urinary_"): {"value": item["value"], "interval": item["interval95"]}
        for item in document["estimates"]
    }


def _palpate(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "palpate", *arguments, "--quiet"], check=True)


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    head = ["input", "volumes differ by", "centroids by", "moduli by", "as wanted"]
    numbers = (("volume", "{:.3%}"), ("centroid_mm", "{:.3f} mm"), ("modulus", "{:.2%}"), ("as_wanted", "{}"))
    return table_of(head, [[row["input"], *(form.format(row[key]) for key, form in numbers)] for row in rows])


if __name__ == "__main__":
    raise SystemExit(main())
