"""Pictures of triangles in space without a display: matplotlib paints them from the farthest to the nearest."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.image as mpimg
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection, TriMesh
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation
from numpy.typing import NDArray

FINE = 2  # samples a pixel edge; the picture is averaged down by it
EDGE_WIDTH = 1.1  # of drawn edges, in pixels of the finished picture
EDGE_SHADE = 0.45  # of the face that they bound


@dataclass(frozen=True, slots=True)
class Camera:
    """Parallel projection: `right`, `up`, `back` (3,) unit vectors of the picture, `back` towards the viewer."""

    right: NDArray[np.float64]
    up: NDArray[np.float64]
    back: NDArray[np.float64]

    @classmethod
    def looking(cls, back: tuple[float, float, float]) -> Camera:
        """The camera that stands in the direction `back`, of any length, and holds the head upright."""
        towards = np.array(back) / np.linalg.norm(back)
        right = np.cross([0.0, 0.0, 1.0], towards)
        right /= np.linalg.norm(right)
        return cls(right, np.cross(towards, right), towards)

    @property
    def axes(self) -> NDArray[np.float64]:
        """World to picture, (3, 3), dimensionless: rows across, up and towards the viewer."""
        return np.stack([self.right, self.up, self.back])


@dataclass(frozen=True, slots=True)
class Triangles:
    """Triangles of closed surfaces, drawn with their edges if `edges` is set.

    Seen from outside their corners run counter-clockwise; those that face away are hidden by others, and are not drawn.
    corners (n, 3, 3) mm; colours (n, 3, 3), 0 to 1, and normals (n, 3, 3), dimensionless, one a corner.
    """

    corners: NDArray[np.float64]
    colours: NDArray[np.float64]
    normals: NDArray[np.float64]
    edges: bool = False


@dataclass(frozen=True, slots=True)
class Arrows:
    """Arrows from `feet` (n, 3) mm along `ways` (n, 3) mm, of one colour, so thick (pixels); before all triangles."""

    feet: NDArray[np.float64]
    ways: NDArray[np.float64]
    colour: str
    thick: float


def render_png(
    triangles: Triangles,
    camera: Camera,
    *,
    width: int,
    height: int,
    fill: float = 0.94,
    arrows: Sequence[Arrows] = (),
) -> bytes:
    """A PNG of `width` x `height` pixels, transparent where nothing is; what is drawn takes up `fill` of it."""
    ends = [end for of in arrows for end in (of.feet, of.feet + of.ways)]
    every = np.concatenate([triangles.corners.reshape(-1, 3), *ends]) @ camera.axes.T
    low, high = every.min(axis=0), every.max(axis=0)
    scale = fill * min(width / max(high[0] - low[0], 1e-9), height / max(high[1] - low[1], 1e-9))

    def projected(points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels across and up from the picture's middle, and depth, of points (..., 3) mm."""
        return np.asarray((points @ camera.axes.T - 0.5 * (low + high)) * scale)

    flat = projected(triangles.corners)
    # a lamp beside the viewer, normals to either side
    lamp = camera.back + 0.35 * camera.up - 0.3 * camera.right
    cosine = np.abs(triangles.normals @ (lamp / np.linalg.norm(lamp)))
    shades = np.clip(triangles.colours * (0.5 + 0.55 * cosine)[..., None], 0.0, 1.0)
    ahead = flat[:, 1:, :2] - flat[:, :1, :2]
    facing = np.flatnonzero(ahead[:, 0, 0] * ahead[:, 1, 1] > ahead[:, 0, 1] * ahead[:, 1, 0])
    drawn = facing[np.argsort(flat[facing, :, 2].mean(axis=1), kind="stable")]
    figure = Figure(figsize=(width / 72.0, height / 72.0), dpi=72.0 * FINE, facecolor="none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(-0.5 * width, 0.5 * width), ylim=(-0.5 * height, 0.5 * height))
    axes.set_axis_off()
    if triangles.edges:
        faces = shades[drawn].mean(axis=1)
        style = {"facecolors": faces, "edgecolors": EDGE_SHADE * faces, "linewidths": EDGE_WIDTH}
        outlines: Any = flat[drawn, :, :2]  # an array is drawn faster than the sequence that matplotlib's types ask for
        axes.add_collection(PolyCollection(outlines, joinstyle="round", **style), autolim=False)
    elif len(drawn):
        places, corners = flat[drawn, :, :2].reshape(-1, 2), np.arange(3 * len(drawn)).reshape(-1, 3)
        mesh = TriMesh(Triangulation(*places.T, corners), facecolors=shades[drawn].reshape(-1, 3))
        axes.add_collection(mesh, autolim=False)
    for of in arrows:
        feet, tips = projected(of.feet), projected(of.feet + of.ways)
        way = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "units": "dots", "minlength": 0.5}
        axes.quiver(*feet.T[:2], *(tips - feet).T[:2], color=of.colour, width=FINE * of.thick, zorder=3.0, **way)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    # the mean over FINE x FINE samples, with straight alpha
    fine = np.asarray(canvas.buffer_rgba()).astype(np.float64)
    fine[..., :3] *= fine[..., 3:] / 255.0
    mean = fine.reshape(height, FINE, width, FINE, 4).mean(axis=(1, 3))
    mean[..., :3] /= np.maximum(mean[..., 3:] / 255.0, 1e-9)
    memory = io.BytesIO()
    mpimg.imsave(memory, np.rint(mean).astype(np.uint8), format="png")
    return memory.getvalue()
