"""Pictures of triangles in space without a display: every triangle sampled into a depth buffer."""

from __future__ import annotations

import io
from dataclasses import dataclass

import matplotlib.image as mpimg
import numpy as np
from numpy.typing import NDArray

FINE = 2  # samples a pixel edge; the picture is averaged down by it
DENSITIES = np.array([2, 3, 4, 6, 8, 11, 15, 20, 28, 40, 56, 80, 112, 160, 224, 320, 448, 640, 1280])
DEPTHS, SAMPLES = 2**24 - 1, 2**38  # a depth and a sample's number share an integer, whose largest is the nearest
EDGE_WIDTH = 1.1  # of drawn edges, in pixels of the finished picture
MOST_SAMPLES = 60_000_000


@dataclass(frozen=True, slots=True)
class Camera:
    """Parallel projection: `right`, `up`, `back` (3,) unit vectors of the picture, `back` towards the viewer."""

    right: NDArray[np.float64]
    up: NDArray[np.float64]
    back: NDArray[np.float64]

    @classmethod
    def looking(cls, back: tuple[float, float, float], up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Camera:
        """The camera that stands in the direction `back` and holds `up` upright; neither needs unit length."""
        towards = np.array(back) / np.linalg.norm(back)
        right = np.cross(np.array(up), towards)
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


def render_png(triangles: Triangles, camera: Camera, *, width: int, height: int, fill: float = 0.94) -> bytes:
    """A PNG of `width` x `height` pixels, transparent where nothing is; the triangles take up `fill` of it."""
    flat = triangles.corners @ camera.axes.T  # (n, 3 corners, 3): across, up, depth
    low, high = flat.reshape(-1, 3).min(axis=0), flat.reshape(-1, 3).max(axis=0)
    scale = fill * FINE * min(width / max(high[0] - low[0], 1e-9), height / max(high[1] - low[1], 1e-9))
    shape = (FINE * height, FINE * width)
    flat = (flat - 0.5 * (low + high)) * scale + [0.5 * shape[1], 0.5 * shape[0], 0.0]
    # a lamp beside the viewer, normals to either side
    lamp = camera.back + 0.35 * camera.up - 0.3 * camera.right
    cosine = np.abs(triangles.normals @ (lamp / np.linalg.norm(lamp)))
    light = (0.5 + 0.55 * cosine)[..., None]
    depth = flat[..., 2]
    flat[..., 2] = (depth - depth.min()) / max(float(np.ptp(depth)), 1e-9)
    ahead = flat[:, 1:, :2] - flat[:, :1, :2]
    facing = ahead[:, 0, 0] * ahead[:, 1, 1] > ahead[:, 0, 1] * ahead[:, 1, 0]
    flat, shades = flat[facing], (triangles.colours * light)[facing]
    # by the number of samples along an edge, so that samples lie within a pixel
    edge = np.linalg.norm(flat[:, :, :2] - np.roll(flat[:, :, :2], 1, axis=1), axis=2).max(axis=1)
    wanted = DENSITIES[np.minimum(np.searchsorted(DENSITIES, 1.2 * edge), len(DENSITIES) - 1)]
    if float((wanted.astype(float) ** 2).sum()) > 2.0 * MOST_SAMPLES:
        raise ValueError("the picture has too many triangles to be drawn")
    buffer = np.full(shape[0] * shape[1], -1, dtype=np.int64)
    fine, first, groups = np.zeros((len(buffer), 4)), 0, []
    for density in np.unique(wanted):
        group, weights = np.flatnonzero(wanted == density), _samples(int(density))
        _keep_nearest(flat[group], weights, first, shape, buffer)
        groups.append((first, group, weights))
        first += len(group) * len(weights)
    seen = np.flatnonzero(buffer >= 0)
    number = buffer[seen] & (SAMPLES - 1)
    for first, group, weights in groups:  # colours of the nearest samples alone
        own = (number >= first) & (number < first + len(group) * len(weights))
        triangle, sample = np.divmod(number[own] - first, len(weights))
        shade = np.clip(np.einsum("ns,nsc->nc", weights[sample], shades[group[triangle]]), 0.0, 1.0)
        if triangles.edges:
            shade *= _edge_shade(flat[group], triangle, weights[sample])[:, None]
        fine[seen[own], :3] = shade
    fine[seen, 3] = 1.0
    # the mean over FINE x FINE samples, with straight alpha
    mean = fine.reshape(height, FINE, width, FINE, 4).mean(axis=(1, 3))
    mean[..., :3] /= np.maximum(mean[..., 3:], 1e-9)
    memory = io.BytesIO()
    mpimg.imsave(memory, np.rint(255.0 * mean).astype(np.uint8), format="png")
    return memory.getvalue()


def _samples(density: int) -> NDArray[np.float64]:
    """Barycentric coordinates (n_samples, 3) of samples, `density` along each edge of a triangle."""
    i, j = np.meshgrid(np.arange(density + 1), np.arange(density + 1))
    inside = i + j <= density
    return np.asarray(np.stack([i[inside], j[inside], (density - i - j)[inside]], axis=1) / density)


def _keep_nearest(
    flat: NDArray[np.float64],
    weights: NDArray[np.float64],
    first: int,
    shape: tuple[int, int],
    buffer: NDArray[np.int64],
) -> None:
    """Put the samples of triangles (n, 3, 3), pixels and depth from 0 to 1, into the buffer of depths and numbers.

    weights (n_samples, 3): where in each triangle; first: number of the first sample; shape: rows and columns.
    """
    rows, columns = shape
    corners, narrow = flat.astype(np.float32), weights.astype(np.float32)
    batch = max(1_000_000 // len(weights), 1)
    for start in range(0, len(flat), batch):
        x, y, depth = (narrow @ corners[start : start + batch]).reshape(-1, 3).T
        down, across = np.maximum(rows - 1 - y.astype(np.int64), 0), np.minimum(x.astype(np.int64), columns - 1)
        near = (depth * np.float32(DEPTHS)).astype(np.int64) * SAMPLES
        number = first + start * len(weights)
        np.maximum.at(buffer, down * columns + across, near + np.arange(number, number + len(near)))


def _edge_shade(
    flat: NDArray[np.float64], triangle: NDArray[np.int64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Darkness (n,) of samples at barycentric weights (n, 3) of triangles (n,) that lie on an edge."""
    a, b = flat[:, 1, :2] - flat[:, 0, :2], flat[:, 2, :2] - flat[:, 0, :2]
    double_area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    opposite = np.linalg.norm(flat[:, [2, 0, 1], :2] - flat[:, [1, 2, 0], :2], axis=2)
    heights = double_area[:, None] / np.maximum(opposite, 1e-9)  # (n_triangles, 3)
    distance = (weights * heights[triangle]).min(axis=1)
    return np.asarray(np.where(distance < 0.5 * EDGE_WIDTH * FINE, 0.45, 1.0))
