"""Cases that no estimate can start from (no motion; organs too small, thin or lost); the range of the linear law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.body.cost import image_memory_gb, machine_memory_gb
from palpate.case.case import Case
from palpate.errors import ConfigurationError, GeometryError, InputDataError, ResourceError
from palpate.findings import Finding
from palpate.images.alignment import Motion
from palpate.images.checks import SMALL_VOXELS, VOLUME_IMPLAUSIBLE
from palpate.images.distance import window_around
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.mechanics.element import largest_strains
from palpate.mechanics.laws.contract import Law
from palpate.mesh.space import LagrangeSpace

ORGANS, MESHED = (Role.ESTIMATE, Role.DRIVER), (Role.ESTIMATE, Role.KNOWN)
LINEAR_RANGE = 0.10  # principal strain beyond which the neglected squares are over a tenth of it
MOST_BEYOND = 0.01  # largest share of the meshed volume with larger strains
NOTHING_MOVES = (
    "nothing moves this body: no tissue has the role driver, no rigid tissue moves, and no load or force is known, so"
    " no modulus can be estimated. Give the role driver to the hollow organ whose wall deforms the others, give a"
    ' surface of a mesh the boundary "moving" or "prescribed", or state a load'
)
MOVES_MM = 1e-6  # less is rounding


def refuse_what_cannot_be_estimated(case: Case) -> None:
    """Raise `ConfigurationError`, before any image is read, for a case that no image can make right.

    There is no later state, nothing can move, or a load or force acts on a surface that does not exist.
    """
    if case.images is not None and not case.images.after:
        raise ConfigurationError(
            "the key 'after' is missing in [images]; an estimate needs one or more later states of the body"
        )
    if case.estimate.method != "gauss-newton":
        raise ConfigurationError(
            f"[estimate] method = '{case.estimate.method}' is unknown: write 'gauss-newton', or remove the key"
        )
    movers = [tissue for tissue in case.tissues if tissue.role in (Role.DRIVER, Role.RIGID)]
    if case.tissues and case.images is not None and not movers and not case.loads and not case.data:
        raise ConfigurationError(NOTHING_MOVES)
    surfaces = [t.name for t in case.tissues if t.role not in MESHED] + [surface.name for surface in case.surfaces]
    named = [load.surface for load in case.loads if load.surface] + [of.surface for of in case.data if of.surface]
    lost = [name for name in named if name not in (*surfaces, "outer", "outside")]
    if lost and case.phantom is None:
        raise ConfigurationError(
            f"no surface of the mesh is called '{lost[0]}'; those that can be loaded are {sorted(surfaces)} and 'outer'"
        )


def require_samples(case: Case) -> None:
    """Raise `ResourceError` where the case asks for samples and a library for their file is not installed."""
    if not case.estimate.samples:
        return
    try:
        for name in ("h5py", "h5netcdf"):
            import_module(name)
    except ImportError as error:
        raise ResourceError(
            "posterior.nc is written by h5netcdf, which is not installed: pip install 'palpate[samples]'; the estimate"
            " itself works without --samples ([estimate] samples = 0)"
        ) from error


def refuse_still(case: Case, *pairs: tuple[Segmentation, Sequence[Mapping[int, Motion]]]) -> None:
    """Raise `ConfigurationError` where no force, no driver and no moving bone can move the body of any pair.

    pairs: each one's reference image, and the motions of bones in each later state, by tissue index.
    """
    if case.known_force:
        return
    for before, bones in pairs:
        ends = before.grid.world(np.array(list(product(*((0.0, n - 1.0) for n in before.grid.shape)))))
        moved = [np.abs(motion.apply(ends) - ends).max() for motions in bones for motion in motions.values()]
        if any(tissue.role is Role.DRIVER for tissue in before.tissues) or max(moved, default=0.0) > MOVES_MM:
            return
    raise ConfigurationError(NOTHING_MOVES)


def refuse_unmeshable(segmentation: Segmentation, name: str) -> None:
    """Raise `GeometryError` when an organ or driver in the image called `name` has no usable surface.

    That is one of under 50 voxels, or one that is nowhere two voxels thick. An absent organ is not this one's to name.
    """
    for i, tissue in enumerate(segmentation.tissues):
        mask = segmentation.mask(i)
        if tissue.role not in ORGANS or not mask.any():
            continue
        count = int(np.count_nonzero(mask))
        if count < SMALL_VOXELS:
            raise GeometryError(
                f"'{tissue.name}' has only {count} voxels in '{name}', and a surface needs at least {SMALL_VOXELS}: use"
                " finer images, or join it to its neighbour"
            )
        box = window_around(mask, segmentation.grid)
        if not ndimage.binary_erosion(mask[box], np.ones((2, 2, 2), dtype=bool)).any():
            raise GeometryError(
                f"'{tissue.name}' is nowhere two voxels thick in '{name}' ({count} voxels), too thin to be meshed: use"
                " finer images, or join it to its neighbour"
            )


def refuse_large(segmentation: Segmentation, path: Path) -> None:
    """Raise `ResourceError` when this machine has not the memory for two images as large as that of the file `path`."""
    needed, has = image_memory_gb(segmentation, n_images=2), machine_memory_gb()
    if has is not None and needed > has:
        raise ResourceError(
            f"'{path}' has {' x '.join(map(str, segmentation.grid.shape))} voxels: a pair of such images and its"
            f" distance maps needs about {needed:.1f} GB of memory, and this machine has {has:.1f} GB; crop the images"
            " to the organs, or resample the labels to larger voxels"
        )


def refuse_lost(before: Segmentation, after: Segmentation, name: str) -> None:
    """Raise `InputDataError` when an `estimate` tissue cannot be the same organ in the image called `name`.

    Its volume changes by more than 30 %, uncut by the images' borders, or its middle moves by more than its size.
    """
    for i, tissue in enumerate(before.tissues):
        one, other = before.mask(i), after.mask(i)
        if tissue.role is not Role.ESTIMATE or not one.any() or not other.any():
            continue
        change = after.volume(i) / before.volume(i) - 1.0
        if abs(change) > VOLUME_IMPLAUSIBLE and not (_cut(before, i) or _cut(after, i)):
            raise InputDataError(
                f"the volume of '{tissue.name}' changes by {change:+.1%} from 'before' ({before.volume(i) / 1e3:.4g}"
                f" mL) to '{name}' ({after.volume(i) / 1e3:.4g} mL), too much for a deformation of one organ: check"
                " that the label means the same in both images, or give a hollow organ the role driver"
            )
        shift = float(np.linalg.norm(after.middle(i) - before.middle(i)))
        size = float((6.0 * before.volume(i) / np.pi) ** (1.0 / 3.0))
        if shift > size:
            raise InputDataError(
                f"'{tissue.name}' moves by {shift:.1f} mm from 'before' to '{name}', more than its size of {size:.1f}"
                " mm, so its surfaces cannot be matched: check that its label means the same organ, and that the images"
                " are aligned (images.align)"
            )


def _cut(segmentation: Segmentation, tissue: int) -> bool:
    """Whether the tissue reaches the border of its image."""
    mask = segmentation.mask(tissue)
    return any(bool(np.take(mask, end, axis).any()) for axis in range(3) for end in (0, -1))


def linear_strain_warnings(
    law: Law, *moved: tuple[LagrangeSpace, Sequence[NDArray[np.float64]]], images: Sequence[str]
) -> tuple[Finding, ...]:
    """A warning when the linear `law` was used where more than 1 % of the meshed volume strains by more than 10 %.

    moved: each body's space with its displacements (n_points, 3) mm, one a later image; images: a name of each later
    image, body after body. The strain is that of `largest_strains`. The image with the largest share is told of.
    """
    if law.finite:
        return ()
    strained = []
    for space, displacement in ((space, motion) for space, motions in moved for motion in motions):
        strains, volumes = largest_strains(space, displacement), space.mesh.volumes
        order = np.argsort(strains)
        reached = np.cumsum(volumes[order]) / volumes.sum()
        # the 99th percentile by volume
        tail = strains[order[min(int(np.searchsorted(reached, 0.99)), len(order) - 1)]]
        strained.append((float(volumes[strains > LINEAR_RANGE].sum() / volumes.sum()), float(tail)))
    names = [*images, *["a later image"] * len(strained)]  # states that come from no file may have none
    share, tail, image = max(((*s, name) for s, name in zip(strained, names, strict=False)), default=(0.0, 0.0, ""))
    if share <= MOST_BEYOND:
        return ()
    return (
        Finding(
            "linear-strains",
            f"In '{image}' {100 * share:.1f} % of the meshed volume strains by more than {100 * LINEAR_RANGE:.0f} %"
            f" (99th percentile {100 * tail:.0f} %), so moduli by the linear law can be wrong by tens of per cent. Set"
            " mechanics.law = \"neo-hookean\", with the state that is free of stress, the emptier one, as 'before'.",
        ),
    )
