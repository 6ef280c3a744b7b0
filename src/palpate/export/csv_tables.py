"""Tidy tables, a row an observation: tissues with moduli and volumes, groups of faces with areas, samples."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.groups import face_groups
from palpate.export.netcdf import moduli_samples
from palpate.images.segmentation import first_labels
from palpate.mechanics.element import volumes_after
from palpate.mesh.surface import triangle_normals
from palpate.study.outputs import write_text

TISSUES = (
    "tissue",
    "role",
    "label",
    "unit",
    "youngs_modulus",
    "interval95_low",
    "interval95_high",
    "ratio",
    "ratio_interval95_low",
    "ratio_interval95_high",
    "relative_to",
    "verdict",
    "poisson_ratio",
    "volume_before_mm3",
    "volume_after_mm3",
)


def write(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write tissues.csv, groups.csv and samples.csv (draw, tissue, youngs_modulus); no value: empty."""
    areas = []
    for group in face_groups(body.mesh):
        area = float(np.linalg.norm(triangle_normals(body.mesh.nodes, group.triangles), axis=1).sum())
        areas.append((group.name, len(group.triangles), _number(area)))
    tissues, estimates = list[Sequence[object]](), {item.tissue: item for item in model.estimates}
    before, after = body.mesh.volumes, volumes_after(body.space, body.displacements[-1])
    for number, label in enumerate(first_labels(body.tissues).tolist()):
        tissue = body.tissues[number]
        own, region = estimates.get(tissue.name), body.mesh.region == number
        low, high = (own.interval95 if own else None) or (None, None)
        least, most = (own.ratio_interval95 if own else None) or (None, None)
        row = [tissue.name, str(tissue.role), label, model.unit, _number(model.moduli[number])]
        row += [_number(low), _number(high), _number(own.ratio if own else None), _number(least), _number(most)]
        row += [own.relative_to, own.verdict] if own else ["", ""]
        row.append(_number(tissue.poisson_ratio) if tissue.meshed else "")
        row += [_number(volumes[region].sum()) if tissue.meshed else "" for volumes in (before, after)]
        tissues.append(row)
    _table(folder / "tissues.csv", TISSUES, tissues)
    _table(folder / "groups.csv", ("group", "faces", "area_before_mm2"), areas)
    samples = moduli_samples(model)
    rows = ((place[0], samples.tissues[place[1]], _number(value)) for place, value in np.ndenumerate(samples.moduli))
    _table(folder / "samples.csv", ("draw", "tissue", "youngs_modulus"), rows)


def _number(value: float | None) -> str:
    return "" if value is None or not np.isfinite(value) else f"{float(value):.10g}"


def _table(path: Path, heading: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(heading)
    table.writerows(rows)
    write_text(path, text.getvalue())
