"""Which points of a fitted body are prescribed, along what, and by how much."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.errors import ConfigurationError
from palpate.export.fitted_model import FittedBody
from palpate.mechanics.boundary import outer_constraint
from palpate.mesh.space import LagrangeSpace
from palpate.observation.prescribed_motion import prescribed_motion

IN_FRAME = 1e-6  # by which a held direction may lie off an axis: the image's faces are planes along its own axes


@dataclass(frozen=True, slots=True)
class Prescribed:
    """Points that are held or moved.

    whole (n,): points whose displacement is that of the fit along all axes; sliding (m,): points that keep to a face,
    an edge or a corner of the image, held (m, 3) marks along which rows of `axes` (3, 3), right-handed unit vectors,
    they do not move.
    """

    whole: NDArray[np.int64]
    sliding: NDArray[np.int64]
    held: NDArray[np.bool_]
    axes: NDArray[np.float64]

    @property
    def along_world(self) -> bool:
        """Whether what slides does so along the axes of the world."""
        return not len(self.sliding) or bool(np.array_equal(self.axes, np.eye(3)))


def prescribed(body: FittedBody, space: LagrangeSpace, *, outer: str) -> Prescribed:
    """The points that walls, bones and the image's cut (`outer`: "fixed", "sliding", "free") hold or move.

    Raises `ConfigurationError` where a sliding face is not along the image's axes.
    """
    walls = prescribed_motion(space, {}, n_modes=0, kernel_mm=1.0, prior_mm=1.0)
    n = 3 * len(space.points)
    constraint = outer_constraint(
        space, outer=outer, modes=np.zeros((n, 0)), offset=np.zeros(n), prescribed=walls.prescribed
    )
    axes = (body.grid.affine[:3, :3] / body.grid.spacing).T
    sizes = np.abs(axes)
    if np.all(np.minimum(sizes, 1.0 - sizes) < IN_FRAME):  # the world's axes, maybe reordered
        axes = np.eye(3)
    axes[2] = np.cross(axes[0], axes[1])  # an image may be left-handed
    rows, free = constraint.free.tocsr(), np.empty((len(space.points), 3))
    for place, axis in enumerate(axes):  # the square of what of it lies among each point's free directions, 0 or 1
        blocks = sparse.kron(sparse.eye_array(len(space.points)), axis[None]).tocsr() @ rows
        free[:, place] = np.asarray(blocks.multiply(blocks).sum(axis=1)).ravel()
    counts = np.rint(free.sum(axis=1))
    sliding = np.flatnonzero((counts > 0.0) & (counts < 3.0))
    share = free[sliding]
    if np.any(np.minimum(share, 1.0 - share) > IN_FRAME):
        raise ConfigurationError(
            "the sliding faces do not lie along the image's axes, so no export can describe them; choose vtu"
        )
    return Prescribed(np.flatnonzero(counts == 0.0), sliding, share < 0.5, axes)
