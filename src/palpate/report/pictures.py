"""Pictures in space that stand where the page cannot turn its bodies: on paper, without WebGL, before it has loaded."""

from __future__ import annotations

from typing import Literal

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from palpate.report.render import Camera, Triangles, render_png
from palpate.report.report_data import LaterImage, MeasuredState, MeshPicture, ReportData
from palpate.report.scales import Scale, distance_scale, modulus_scale, strain_scale

WIDTH, HEIGHT = 620, 460
BESIDE = Camera.looking((-1.0, 0.3, 0.15))  # the patient's left side, a little from the front
AT_THE_SIDE = Camera.looking((-1.0, 0.35, 0.25))  # of the sagittal cut, whose far half is kept
BESIDE_FRONT = Camera.looking((-1.0, 0.6, 0.35))
SEEN, FITTED = ("#c98b00", 1.7), ("#1f6fd6", 0.9)  # colour of arrows on white and on black, and how thick
HEAD, SHAFT, BRIM, SIDES = 0.05, 0.18, 0.42, 6  # head over the body's radius, shaft and brim over the head
FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])


def organs_png(data: ReportData, later: LaterImage, *, fitted: bool) -> bytes:
    """The model's organs, as fitted to `later` or at rest, coloured by their signed distance to that image; PNG."""
    if not later.model:
        raise ValueError("there is no fitted model")
    scale = distance_scale(data.references[later.reference].voxel_mm)
    corners, colours, normals = [], [], []
    for model in later.model:
        points = (model.fitted if fitted else model.rest).astype(np.float64)
        distance = (model.distance_fitted if fitted else model.distance_rest).astype(np.float64)
        corners.append(points[model.triangles])
        colours.append(scale.colours(distance)[model.triangles])
        # unit normals of points, the mean of those of their triangles by area
        corner = points[model.triangles]
        face = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        total = np.zeros_like(points)
        for side in range(3):
            np.add.at(total, model.triangles[:, side], face)
        total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
        normals.append(total[model.triangles])
    triangles = Triangles(np.concatenate(corners), np.concatenate(colours), np.concatenate(normals))
    return render_png(triangles, BESIDE, width=WIDTH, height=HEIGHT)


def points_png(data: ReportData, state: MeasuredState) -> bytes:
    """Arrows of the measured and the fitted motion before the far walls of the bodies at rest; PNG."""
    corners, colours = [], []
    rest = np.concatenate([of.rest for of in state.points]).astype(np.float64)
    walls = [surface for surface in data.references[state.reference].surfaces if len(surface.triangles)]
    clouds = np.concatenate([rest, *(surface.points.astype(np.float64) for surface in walls)])
    radius = 0.5 * float(np.linalg.norm(np.ptp(clouds, axis=0)))
    for surface in walls:
        wall = surface.points.astype(np.float64)[surface.triangles]
        a, b, c = np.moveaxis(wall - wall.reshape(-1, 3).mean(axis=0), 1, 0)
        outwards = float(np.sum(a * np.cross(b, c))) > 0.0
        corners.append(wall[:, ::-1] if outwards else wall)  # inwards, so that what faces the viewer is not drawn
        colours.append(0.45 + 0.55 * np.array(to_rgb(data.tissues[surface.tissue].colour)))
    for (colour, wide), motion, ahead in ((SEEN, "observed", 0.0), (FITTED, "fitted", radius)):
        ways = state.motion_factor * np.concatenate([getattr(of, motion) for of in state.points]).astype(np.float64)
        arrows = arrow_triangles(rest, ways, radius=radius, wide=wide)
        corners.append(arrows + ahead * BESIDE_FRONT.back)  # so that the thin one is seen before the broad one
        colours.append(np.array(to_rgb(colour)))
    every = np.concatenate(corners)
    shades = np.concatenate([np.broadcast_to(c, of.shape) for c, of in zip(colours, corners, strict=True)])
    triangles = Triangles(every, shades, np.repeat(face_normals(every)[:, None], 3, axis=1))
    return render_png(triangles, BESIDE_FRONT, width=WIDTH, height=HEIGHT)


def arrow_triangles(
    rest: NDArray[np.float64], ways: NDArray[np.float64], *, radius: float, wide: float
) -> NDArray[np.float64]:
    """Corners (k, 3, 3) mm of arrows from points (n, 3) mm along (n, 3) mm, as thick as suits a body of that radius.

    wide: how many times as thick; what is too short to be seen has none.
    """
    length = np.linalg.norm(ways, axis=1)
    seen = length > 0.004 * radius
    foot, along, length = rest[seen], ways[seen] / length[seen, None], length[seen]
    aside = np.where(np.abs(along[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    u = np.cross(along, aside)
    u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-12)
    head = np.minimum(HEAD * radius, 0.6 * length)
    turn = 2.0 * np.pi * np.arange(SIDES + 1) / SIDES
    round_ = np.cos(turn)[:, None, None] * u + np.sin(turn)[:, None, None] * np.cross(along, u)  # (SIDES + 1, n, 3)
    neck = foot + (length - head)[:, None] * along
    low, high = foot + SHAFT * wide * head[:, None] * round_, neck + SHAFT * wide * head[:, None] * round_
    brim, tip = neck + BRIM * wide * head[:, None] * round_, np.broadcast_to(foot + length[:, None] * along, neck.shape)
    found = []
    for i in range(SIDES):
        j = i + 1
        found += [[low[i], low[j], high[j]], [low[i], high[j], high[i]], [brim[i], brim[j], tip]]
        found += [[high[i], brim[j], brim[i]], [high[i], high[j], brim[j]]]
    return np.asarray(np.moveaxis(np.array(found), 2, 1)).reshape(-1, 3, 3)


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
    else:
        shades = tissue_shades(data, modulus_scale(data) if by == "modulus" else None)[mesh.region[tets]]
    corners = mesh.nodes.astype(np.float64)[faces]
    colours = np.repeat(shades[:, None], 3, axis=1)
    triangles = Triangles(corners, colours, np.repeat(face_normals(corners)[:, None], 3, axis=1), edges=True)
    return render_png(triangles, AT_THE_SIDE, width=WIDTH, height=HEIGHT)


def face_normals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit normals (n, 3) of triangles (n, 3, 3)."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))


def tissue_shades(data: ReportData, scale: Scale | None) -> NDArray[np.float64]:
    """Colours (n_tissues, 3), dimensionless, 0 to 1: the tissues' own, or those of their moduli on `scale`."""
    if scale is None:
        return np.array([to_rgb(tissue.colour) for tissue in data.tissues])
    moduli = [np.nan if tissue.modulus is None else tissue.modulus for tissue in data.tissues]
    return scale.colours(np.array(moduli, dtype=np.float64))


def section_faces(mesh: MeshPicture, *, axis: int, position: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Outer faces (n, 3), and the tetrahedron (n,) of each, of those whose middle lies beyond `position` (mm)."""
    kept = np.flatnonzero(mesh.nodes[mesh.tets, axis].mean(axis=1) > position)
    faces = mesh.tets[kept].astype(np.int64)[:, FACES].reshape(-1, 3)
    owner = np.repeat(kept, 4)
    ordered = np.sort(faces, axis=1)
    n = len(mesh.nodes)
    keys = (ordered[:, 0] * n + ordered[:, 1]) * n + ordered[:, 2]
    _, first, count = np.unique(keys, return_index=True, return_counts=True)
    outside = first[count == 1]
    return faces[outside], owner[outside]
