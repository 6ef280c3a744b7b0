"""The geometry and the images of a report as the page's scripts read them: JSON and one deflated block of bytes."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from palpate.report.cut_mesh import element_moduli
from palpate.report.preview_data import ROLE_COLOURS, PreviewImage
from palpate.report.report_data import (
    GREY_STEPS,
    LaterImage,
    MeasuredState,
    Reference,
    ReportData,
    SliceBox,
    TriangleSurface,
    Volume,
)
from palpate.report.scales import (
    Scale,
    angle_scale,
    displacement_scale,
    distance_scale,
    modulus_scale,
    shown_moduli,
    strain_scale,
)
from palpate.report.section import VIEWS
from palpate.report.slices import arrow_factor

MOST_TETS = 120_000  # of a mesh that a page can turn
LEVELS = 65_535
STRAIN_STEP = 0.2  # per cent, in a byte: up to 51 %


@dataclass(frozen=True, slots=True)
class Payload:
    """facts: JSON that can stand in a script element; block: base64 of the deflated arrays."""

    facts: Markup
    block: Markup


@dataclass(frozen=True, slots=True)
class _Packer:
    """Collects arrays one behind the other, equal ones once; points are multiples of `step` mm from `low` (3,) mm."""

    low: NDArray[np.float64]
    step: float
    chunks: dict[bytes, int] = field(default_factory=dict)  # -> where each begins

    def add(self, array: NDArray[Any]) -> dict[str, Any]:
        """Where and what the array, as (n, 3) mm or (n,), is in the block; it begins at a multiple of four bytes."""
        raw = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
        chunk = raw + bytes(-len(raw) % 4)
        offset = self.chunks.setdefault(chunk, sum(map(len, self.chunks)))
        return {"type": array.dtype.name, "offset": offset, "length": array.size}

    def points(self, points: NDArray[np.float32]) -> dict[str, Any]:
        """Points (n, 3) mm in 16 bits a coordinate."""
        steps = np.rint((points.astype(np.float64) - self.low) / self.step)
        return self.add(np.clip(steps, 0, LEVELS).astype(np.uint16))

    def indices(self, indices: NDArray[np.int32]) -> dict[str, Any]:
        """Where the numbers of points, (n, 3) or (n,), are in the block; in 16 bits where they fit."""
        small = int(indices.max(initial=0)) <= LEVELS
        return self.add(indices.astype(np.uint16 if small else np.uint32))


def payload(data: ReportData, preview: Sequence[PreviewImage] = ()) -> Payload:
    """Pack what the page draws itself; preview: what it draws of each later image where nothing is fitted yet."""
    low, step = _quantum(data)
    packer, mesh = _Packer(low, step), data.mesh
    facts = {
        "preview": [
            {
                "organs": [_volume(volume, packer) for volume in image.organs],
                "whole": [_volume(volume, packer) for volume in image.whole],
                "greys": [_volume(volume, packer) for volume in image.greys],
                "arrows": [
                    {"tissue": tissue, "start": start.tolist(), "end": end.tolist()}
                    for tissue, start, end in image.arrows
                ],
                "factor": image.factor,
                "view": _box(image.view),
                "frame": image.frame.ravel().tolist(),
                "field": image.field.ravel().tolist(),
                "motion": None if image.motion is None else image.motion.tolist(),
            }
            for image in preview
        ],
        "roles": dict(ROLE_COLOURS),
        "low": low.tolist(),
        "step": step,
        "unit": data.unit,
        "tissues": [
            {"name": tissue.name, "role": tissue.role, "colour": tissue.colour, "modulus": modulus}
            for tissue, modulus in zip(data.tissues, _shown(data), strict=True)
        ],
        "views": [
            {"name": v.name, "normal": v.normal, "across": v.across, "up": v.up, "letters": v.letters} for v in VIEWS
        ],
        "references": [
            {
                "name": reference.name,
                "box": _box(reference.slices),
                "whole": _box(reference.whole),
                "background": _volume(reference.background, packer),
                "surfaces": [_surface(surface, packer) for surface in reference.surfaces],
            }
            for reference in data.references
        ],
        "later": [_later(data, later, packer) for later in data.later],
        "measured": [_measured(state, packer) for state in data.measured],
        "mesh": None
        if mesh is None or len(mesh.tets) > MOST_TETS
        else {
            "nodes": packer.points(mesh.nodes),
            "tets": packer.indices(mesh.tets),
            "region": packer.add(mesh.region.astype(np.uint8)),
            "worst": packer.add(np.clip(mesh.angles.min(axis=1), 0.0, 255.0).astype(np.uint8)),
            "strain": packer.add(np.clip(np.rint(100.0 * mesh.strains / STRAIN_STEP), 0.0, 255.0).astype(np.uint8)),
            "strainStep": STRAIN_STEP,
            "modulus": packer.add(_element_moduli(data)),
        },
        "angles": _scale(angle_scale()),
        "strains": _scale(strain_scale()),
        "moduli": _scale(modulus_scale(data)) if _has_moduli(data) else None,
    }
    block = zlib.compress(b"".join(packer.chunks), 9)
    return Payload(script_json(facts), Markup(base64.b64encode(block).decode()))  # noqa: S704 - base64's own letters


def _has_moduli(data: ReportData) -> bool:
    return any(tissue.modulus for tissue in data.tissues)


def _shown(data: ReportData) -> list[float | None]:
    """The tissues' moduli in the unit that is shown, None where there is none."""
    if not _has_moduli(data):
        return [None] * len(data.tissues)
    return [float(modulus) if np.isfinite(modulus) else None for modulus in shown_moduli(data)]


def _element_moduli(data: ReportData) -> NDArray[np.float32]:
    """Young's modulus (n_tets,) of each element in the unit that is shown; NaN where none was found."""
    if data.mesh is None or not _has_moduli(data):
        return np.zeros(0, np.float32)
    return element_moduli(data).astype(np.float32)


def script_json(value: Any) -> Markup:
    """JSON in which nothing can end a script element or open a comment."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False)
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup(text)  # noqa: S704 - markup's letters are escaped in the line above


def _quantum(data: ReportData) -> tuple[NDArray[np.float64], float]:
    """Corner (3,) mm and step (mm) of a lattice that holds every point."""
    images: list[Reference | LaterImage] = [*data.references, *data.later]
    clouds = [surface.points for image in images for surface in image.surfaces]
    clouds += [surface.points for later in data.later for surface in later.outlines]
    clouds += [surface.points for state in data.measured for surface in state.outlines]
    clouds += [p for later in data.later for m in later.model for p in (m.rest, m.fitted)]
    clouds += [data.mesh.nodes] if data.mesh else []
    clouds = [cloud for cloud in clouds if len(cloud)]
    if not clouds:
        return np.zeros(3), 1.0
    low = np.min([cloud.min(axis=0) for cloud in clouds], axis=0).astype(np.float64)
    high = np.max([cloud.max(axis=0) for cloud in clouds], axis=0).astype(np.float64)
    return low, max(float((high - low).max()) / LEVELS, 1e-9)


def _box(box: SliceBox | None) -> dict[str, list[float]] | None:
    return None if box is None else {name: getattr(box, name).tolist() for name in ("low", "high", "position")}


def _volume(volume: Volume | None, packer: _Packer) -> dict[str, Any] | None:
    if volume is None:
        return None
    values = volume.values if volume.kind == "grey" else volume.values.astype(np.uint8)
    return {
        "kind": volume.kind,
        "shape": volume.values.shape,
        "origin": volume.origin.tolist(),
        "step": volume.step.tolist(),
        "values": packer.add(values),
        "span": volume.span,
        "steps": GREY_STEPS,
        "window": volume.window,
        "unit": volume.unit,
    }


def _surface(surface: TriangleSurface, packer: _Packer) -> dict[str, Any]:
    return {
        "tissue": surface.tissue,
        "points": packer.points(surface.points),
        "triangles": packer.indices(surface.triangles),
    }


def _later(data: ReportData, later: LaterImage, packer: _Packer) -> dict[str, Any]:
    return {
        "name": later.name,
        "reference": later.reference,
        "background": _volume(later.background, packer),
        "surfaces": [_surface(surface, packer) for surface in later.surfaces],
        "outlines": [_surface(surface, packer) for surface in later.outlines],
        "both": [_volume(volume, packer) for volume in later.both],
        "model": [
            {
                "tissue": model.tissue,
                "triangles": packer.indices(model.triangles),
                "rest": packer.points(model.rest),
                "fitted": packer.points(model.fitted),
                "distanceRest": packer.add(model.distance_rest),
                "distanceFitted": packer.add(model.distance_fitted),
            }
            for model in later.model
        ],
        "scale": _scale(distance_scale(data.references[later.reference].voxel_mm)),
        "motion": _motion(later, packer) if len(later.motion) else None,
    }


def _motion(later: LaterImage, packer: _Packer) -> dict[str, Any]:
    """The fitted motion of the mesh's nodes in steps of 16 bits, its scale, and how much longer arrows are drawn."""
    step = max(float(np.abs(later.motion).max()) / 32_767, 1e-9)
    return {
        "values": packer.add(np.rint(later.motion / step).astype(np.int16)),
        "step": step,
        "scale": _scale(displacement_scale(later)),
        "factor": arrow_factor(later),
    }


def _measured(state: MeasuredState, packer: _Packer) -> dict[str, Any]:
    return {
        "name": state.name,
        "reference": state.reference,
        "box": _box(state.box),
        "outlines": [_surface(surface, packer) for surface in state.outlines],
        "motionFactor": state.motion_factor,
        "leftFactor": state.left_factor,
        "points": [
            {
                "near": of.near_mm,
                "rest": packer.add(of.rest),
                "observed": packer.add(of.observed),
                "fitted": packer.add(of.fitted),
            }
            for of in state.points
        ],
    }


def _scale(scale: Scale) -> dict[str, Any]:
    return {
        "low": scale.low,
        "high": scale.high,
        "logarithmic": scale.logarithmic,
        "table": scale.table.tobytes().hex(),
    }
