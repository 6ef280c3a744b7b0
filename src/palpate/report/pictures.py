"""Pictures in space that stand where the page cannot turn its bodies: on paper, without WebGL, before it has loaded."""

from __future__ import annotations

from typing import Literal

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from palpate.mesh import outer_faces
from palpate.mesh.surface import triangle_normals, vertex_normals
from palpate.report.render import Arrows, Camera, Triangles, render_png
from palpate.report.report_data import LaterImage, MeasuredState, MeshPicture, ReportData
from palpate.report.scales import distance_scale, modulus_scale, shown_moduli, strain_scale

WIDTH, HEIGHT = 620, 460
BESIDE = Camera.looking((-1.0, 0.3, 0.15))  # the patient's left side, a little from the front
AT_THE_SIDE = Camera.looking((-1.0, 0.35, 0.25))  # of the sagittal cut, whose far half is kept
BESIDE_FRONT = Camera.looking((-1.0, 0.6, 0.35))
SEEN, FITTED = ("#c98b00", 4.0), ("#1f6fd6", 2.0)  # colour of arrows, and how many pixels thick


def organs_png(data: ReportData, later: LaterImage, *, fitted: bool, size: tuple[int, int] | None = None) -> bytes:
    """The model's organs, as fitted to `later` or at rest, coloured by their signed distance to that image; PNG.

    size: its width and height in pixels; None: those of the page.
    """
    if not later.model:
        raise ValueError("there is no fitted model")
    scale = distance_scale(data.references[later.reference].voxel_mm)
    corners, colours, normals = [], [], []
    for model in later.model:
        points = (model.fitted if fitted else model.rest).astype(np.float64)
        distance = (model.distance_fitted if fitted else model.distance_rest).astype(np.float64)
        corners.append(points[model.triangles])
        colours.append(scale.colours(distance)[model.triangles])
        normals.append(vertex_normals(points, model.triangles.astype(np.int64))[model.triangles])
    triangles = Triangles(np.concatenate(corners), np.concatenate(colours), np.concatenate(normals))
    width, height = size or (WIDTH, HEIGHT)
    return render_png(triangles, BESIDE, width=width, height=height)


def points_png(data: ReportData, state: MeasuredState) -> bytes:
    """Arrows of the measured and the fitted motion before the far walls of the bodies at rest; PNG."""
    corners, colours = [], []
    rest = np.concatenate([of.rest for of in state.points]).astype(np.float64)
    for surface in data.references[state.reference].surfaces:
        if not len(surface.triangles):
            continue
        wall = surface.points.astype(np.float64)[surface.triangles]
        a, b, c = np.moveaxis(wall - wall.reshape(-1, 3).mean(axis=0), 1, 0)
        outwards = float(np.sum(a * np.cross(b, c))) > 0.0
        corners.append(wall[:, ::-1] if outwards else wall)  # inwards, so that what faces the viewer is not drawn
        colours.append(0.45 + 0.55 * np.array(to_rgb(data.tissues[surface.tissue].colour)))
    arrows = []
    for (colour, thick), motion in ((SEEN, "observed"), (FITTED, "fitted")):  # the thin one over the broad one
        ways = state.motion_factor * np.concatenate([getattr(of, motion) for of in state.points]).astype(np.float64)
        arrows.append(Arrows(rest, ways, colour, thick))
    every = np.concatenate([np.zeros((0, 3, 3)), *corners])
    shades = np.concatenate(
        [every[:0], *(np.broadcast_to(c, of.shape) for c, of in zip(colours, corners, strict=True))]
    )
    triangles = Triangles(every, shades, np.repeat(face_normals(every)[:, None], 3, axis=1))
    return render_png(triangles, BESIDE_FRONT, width=WIDTH, height=HEIGHT, arrows=arrows)


def mesh_png(data: ReportData, *, by: Literal["tissue", "modulus", "strain"]) -> bytes:
    """The mesh cut by the sagittal plane of the slices, coloured by tissue, Young's modulus or strain; PNG."""
    mesh = data.mesh
    if mesh is None:
        raise ValueError("there is no mesh")
    box = data.references[0].slices if data.references else None
    middle = float(np.median(mesh.nodes[:, 0])) if box is None else float(box.position[0])
    faces, tets = section_faces(mesh, axis=0, position=middle)
    if by == "strain":
        shades = strain_scale().colours(100.0 * mesh.strains[tets].astype(np.float64))
    elif by == "modulus":
        shades = modulus_scale(data).colours(shown_moduli(data))[mesh.region[tets]]
    else:
        shades = np.array([to_rgb(tissue.colour) for tissue in data.tissues])[mesh.region[tets]]
    corners = mesh.nodes.astype(np.float64)[faces]
    colours = np.repeat(shades[:, None], 3, axis=1)
    triangles = Triangles(corners, colours, np.repeat(face_normals(corners)[:, None], 3, axis=1), edges=True)
    return render_png(triangles, AT_THE_SIDE, width=WIDTH, height=HEIGHT)


def face_normals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit normals (n, 3) of triangles (n, 3, 3)."""
    normal = triangle_normals(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))


def section_faces(mesh: MeshPicture, *, axis: int, position: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Outer faces (n, 3), and the tetrahedron (n,) of each, of those whose middle lies beyond `position` (mm)."""
    kept = np.flatnonzero(mesh.nodes[mesh.tets, axis].mean(axis=1) > position)
    faces, owner = outer_faces(mesh.tets[kept].astype(np.int64))
    return faces, kept[owner]
