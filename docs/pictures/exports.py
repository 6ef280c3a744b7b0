"""The picture of docs/export: what was exported for ParaView, drawn by VTK through PyVista, which is none of ours.

    palpate export out --format paraview --output paraview && pip install pyvista
    python docs/pictures/exports.py paraview

Writes `export.jpg` beside this file: the reference state and the later one, cut open, by Young's modulus; the walls.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pyvista

SIZE = (1500, 620)  # pixels


def main() -> None:
    """Draw it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="what `palpate export --format paraview` wrote")
    folder = parser.parse_args().folder
    scene = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    plotter = pyvista.Plotter(off_screen=True, shape=(1, 3), window_size=SIZE, border=False)
    for column, (name, title) in enumerate((("mesh_0.vtu", "before"), ("mesh_1.vtu", "after, as fitted"))):
        plotter.subplot(0, column)
        mesh = pyvista.read(folder / name).warp_by_vector("displacement_mm")
        opened = mesh.clip(normal="x", origin=scene["middle"], crinkle=True)
        bar = {"title": "Young's modulus (kPa)", "color": "black"}
        shown = {"scalars": scene["modulus"], "clim": scene["range"], "log_scale": True, "cmap": "viridis"}
        plotter.add_mesh(opened, show_edges=True, edge_color="#404040", scalar_bar_args=bar, **shown)
        plotter.add_text(title, font_size=12, color="black")
        plotter.view_vector((1.0, 0.35, 0.25), viewup=(0.0, 0.0, 1.0))
    plotter.subplot(0, 2)
    colours = iter(("#e69f00", "#56b4e9", "#cc79a7", "#cfc8b8"))
    for path in sorted((folder / "groups").glob("*.vtp")):
        if any(word in path.name for word in ("observed", "rectum_wall", "bones_wall")):
            moved = pyvista.read(path).warp_by_vector("displacement_mm")
            plotter.add_mesh(moved, color=next(colours), smooth_shading=True)
    plotter.add_text("groups: observed surfaces, walls", font_size=12, color="black")
    plotter.view_vector((1.0, 0.35, 0.25), viewup=(0.0, 0.0, 1.0))
    plotter.set_background("white", all_renderers=True)
    plotter.screenshot(Path(__file__).parent / "export.jpg")


if __name__ == "__main__":
    main()
