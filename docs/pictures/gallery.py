"""The pictures of docs/gallery.md: five of a demo's output folder, and one of the notebook 4_map, which is run.

    make demo && python docs/pictures/gallery.py demo-output

Writes `gallery-*.jpg` and `.svg` beside this file, in about two minutes.
"""

from __future__ import annotations

import argparse
import io
import json
import tempfile
from contextlib import chdir, redirect_stdout
from pathlib import Path
from typing import Any

from PIL import Image

import palpate

HERE = Path(__file__).parent
NOTEBOOK = HERE.parents[1] / "examples" / "notebooks" / "4_map.ipynb"
OF_DEMO = ("stiffness-slices", "displacement-1", "before-after-1", "residuals-1")
MOST_BYTES, QUALITIES = 150_000, (88, 80, 70, 60)
DPI = 160


def main(folder: Path, pictures: Path = HERE) -> None:
    """Draw all six: `folder` is the output of `palpate demo`, `pictures` takes them."""
    result = palpate.read_result(folder)
    result.plot(unit="kPa").savefig(pictures / "gallery-moduli.svg")
    with tempfile.TemporaryDirectory() as room:
        palpate.figures(folder, room, formats=["png"], dpi=DPI)
        for name in OF_DEMO:
            small_jpeg(Path(room) / f"{name}.png", pictures / f"gallery-{name.removesuffix('-1')}.jpg")
    with tempfile.TemporaryDirectory() as room:
        palpate.figures(mapped(), room, formats=["png"], dpi=DPI)
        small_jpeg(Path(room) / "map-1.png", pictures / "gallery-map.jpg")


def mapped() -> palpate.CaseResult:
    """What the notebook 4_map finds."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as room, chdir(room), redirect_stdout(io.StringIO()):
        for cell in cells:
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), NOTEBOOK.name, "exec"), names)  # noqa: S102 - our own notebook
        return names["result"]


def small_jpeg(source: Path, target: Path) -> None:
    """The picture as a JPEG that a page loads quickly."""
    with Image.open(source) as picture:
        for quality in QUALITIES:
            picture.convert("RGB").save(target, quality=quality, optimize=True)
            if target.stat().st_size < MOST_BYTES:
                return


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="the output folder of palpate demo")
    main(parser.parse_args().folder)
