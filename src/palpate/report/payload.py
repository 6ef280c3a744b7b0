"""The geometry and the images of a report as the page's scripts read them: JSON and one deflated block of bytes.

The JSON has the names of the dataclasses' fields. In the place of many numbers it says where these are in the block.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from palpate.report.cut_mesh import element_moduli
from palpate.report.preview_data import ROLE_COLOURS, PreviewImage
from palpate.report.report_data import GREY_STEPS, MOST_ARROWS, LaterImage, MeshPicture, ReportData
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
LEVELS = 65_535  # of a coordinate
STRAIN_STEP = 0.2  # per cent
UNUSED = ("area",)  # by the scripts


@dataclass(frozen=True, slots=True)
class Payload:
    """facts: JSON that can stand in a script element; block: base64 of the deflated arrays."""

    facts: Markup
    block: Markup


@dataclass(frozen=True, slots=True)
class _Packer:
    """Collects arrays one behind the other, equal ones once."""

    chunks: dict[bytes, int] = field(default_factory=dict)  # -> where each begins

    def packed(self, value: Any) -> Any:
        """`value` in JSON's types."""
        if isinstance(value, Scale):
            own = {name: getattr(value, name) for name in ("low", "high", "logarithmic")}
            return own | {"table": value.table.tobytes().hex()}
        if isinstance(value, np.ndarray):
            return value.tolist() if value.dtype == np.float64 else self._array(value)
        if dataclasses.is_dataclass(value):
            names = [of.name for of in dataclasses.fields(value) if of.name not in UNUSED]
            return {name: self.packed(getattr(value, name)) for name in names}
        if isinstance(value, Mapping):
            return {key: self.packed(item) for key, item in value.items()}
        return [self.packed(item) for item in value] if isinstance(value, list | tuple) else value

    def _array(self, array: NDArray[Any]) -> dict[str, Any]:
        """Where and what an array is: whole numbers in as few bits as hold them, many points in 16 a coordinate."""
        told: dict[str, Any] = {"shape": array.shape}
        if array.dtype == np.float32 and array.shape[1:] == (3,) and len(array) > MOST_ARROWS:
            low, high = array.min(axis=0).astype(np.float64), array.max(axis=0).astype(np.float64)
            step = max(float((high - low).max()) / LEVELS, 1e-9)
            told |= {"low": low.tolist(), "step": step}
            array = np.rint((array - low) / step).astype(np.uint16)
        elif array.dtype.kind in "iu":
            array = array.astype(np.min_scalar_type(int(array.max(initial=0))))
        raw = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
        chunk = raw + bytes(-len(raw) % 4)  # the next one begins at a multiple of four bytes
        return told | {"type": array.dtype.name, "offset": self.chunks.setdefault(chunk, sum(map(len, self.chunks)))}


def payload(data: ReportData, preview: Sequence[PreviewImage] = ()) -> Payload:
    """Pack what the page draws itself; preview: what it draws of each later image where nothing is fitted yet."""
    packer, mesh = _Packer(), data.mesh
    has_moduli = any(tissue.modulus for tissue in data.tissues)
    moduli = shown_moduli(data) if has_moduli else np.full(len(data.tissues), np.nan)
    facts = {
        "preview": preview,
        "roles": ROLE_COLOURS,
        "unit": data.unit,
        "tissues": [
            {"name": t.name, "role": t.role, "colour": t.colour, "modulus": None if np.isnan(modulus) else modulus}
            for t, modulus in zip(data.tissues, moduli.tolist(), strict=True)
        ],
        "views": VIEWS,
        "grey_steps": GREY_STEPS,
        "references": data.references,
        "later": [_later(data, later) for later in data.later],
        "measured": data.measured,
        "mesh": None if mesh is None or len(mesh.tets) > MOST_TETS else _mesh(data, mesh, has_moduli),
        "angles": angle_scale(),
        "strains": strain_scale(),
        "moduli": modulus_scale(data) if has_moduli else None,
    }
    told = script_json(packer.packed(facts))
    block = zlib.compress(b"".join(packer.chunks), 9)
    return Payload(told, Markup(base64.b64encode(block).decode()))  # noqa: S704 - base64's own letters


def _later(data: ReportData, later: LaterImage) -> dict[str, Any]:
    """A later image with the scales of its distances and of its motion, and how much longer arrows are drawn."""
    shown = {of.name: getattr(later, of.name) for of in dataclasses.fields(later)}
    shown["scale"], motion = distance_scale(data.references[later.reference].voxel_mm), later.motion
    moved = (
        {"values": motion, "scale": displacement_scale(later), "factor": arrow_factor(later)} if len(motion) else None
    )
    return shown | {"motion": moved}


def _mesh(data: ReportData, mesh: MeshPicture, has_moduli: bool) -> dict[str, Any]:
    """Nodes and tetrahedra; worst: smallest angle, degrees; strain, per cent; moduli in the unit that is shown."""
    return {
        "nodes": mesh.nodes,
        "tets": mesh.tets,
        "region": mesh.region,
        "worst": mesh.angles.min(axis=1).astype(np.int64),
        "strain": np.float32(STRAIN_STEP) * np.rint(100.0 * mesh.strains / STRAIN_STEP),
        "modulus": element_moduli(data).astype(np.float32) if has_moduli else np.zeros(0, np.float32),
    }


def script_json(value: Any) -> Markup:
    """JSON in which nothing can end a script element or open a comment."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False)
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup(text)  # noqa: S704 - markup's letters are escaped in the line above
