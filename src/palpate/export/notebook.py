"""A result on its image in a notebook: slices and volume by NiiVue, through ipyniivue (extra `notebook`)."""

from __future__ import annotations

import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import ResourceError
from palpate.images.label_image import LabelImage
from palpate.images.readers import write_label_image, write_scalar_image
from palpate.images.tissue import Role, tissue_colours
from palpate.mesh.locate import modulus_image
from palpate.statement.result import CaseResult


def notebook_viewer(result: CaseResult, *, background: Path | None = None, opacity: float = 0.6) -> Any:
    """A widget of the first image: `background` (a grey image) or the tissues, the modulus over it from `stiffness`.

    opacity: of the modulus, 0 to 1. Raises `ResourceError` without the extra `notebook`.
    """
    try:
        ipyniivue = import_module("ipyniivue")
    except ImportError as error:
        raise ResourceError(
            "the viewer for notebooks is ipyniivue, which is not installed: pip install 'palpate[notebook]'"
        ) from error
    grid = result.before.grid
    with tempfile.TemporaryDirectory() as folder:
        labels, stiffness = Path(folder) / "tissues.nii.gz", Path(folder) / "stiffness.nii.gz"
        write_label_image(labels, LabelImage(result.before.index.astype(np.int32), grid))
        write_scalar_image(stiffness, modulus_image(result.space.mesh, grid, result.stiffness), grid)
        known = result.stiffness[result.stiffness > 0.0]
        over = ipyniivue.Volume(
            data=stiffness.read_bytes(),
            name=stiffness.name,
            colormap="viridis",
            cal_min=0.5 * float(known.min()) if len(known) else 0.0,
            cal_max=float(known.max()) if len(known) else 1.0,
            opacity=opacity,
        )
        if background is None:
            colours = [bytes.fromhex(colour[1:]) for colour in tissue_colours(result.tissues)]
            opaque = [0 if tissue.role is Role.VOID else 255 for tissue in result.tissues]
            table = [part for colour, alpha in zip(colours, opaque, strict=True) for part in (*colour, alpha)]
            names = [tissue.name for tissue in result.tissues]
            shades = ipyniivue.LUT(lut=table, min=0.0, max=len(names) - 1.0, labels=names)
            under = ipyniivue.Volume(data=labels.read_bytes(), name=labels.name, colormap_label=shades, opacity=1.0)
        else:
            under = ipyniivue.Volume(path=background, colormap="gray", opacity=1.0)
    under.colorbar_visible = False  # the bar is the modulus's
    viewer = ipyniivue.NiiVue(height=400, is_colorbar=True)
    viewer.load_volumes([under, over])
    return viewer
