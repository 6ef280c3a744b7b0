"""Whether the strains of an estimate lie within the range of the linear law."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.findings import Finding
from palpate.mechanics.deformation import largest_strains
from palpate.mechanics.laws.contract import Law
from palpate.mesh.space import LagrangeSpace

__all__ = ["LINEAR_RANGE", "linear_strain_warnings"]

LINEAR_RANGE = 0.10  # principal strain: beyond it the squares that the linear law leaves out are tenths of it
MOST_BEYOND = 0.01  # share of the meshed volume


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
            f"{image}: {100 * share:.1f} % of the meshed volume strains by more than {100 * LINEAR_RANGE:.0f} % (99th"
            f" percentile {100 * tail:.0f} %), beyond the range of the linear law, whose moduli can then be wrong by"
            " tens of per cent and others when the images are exchanged, whatever their intervals; set [mechanics] law"
            ' = "neo-hookean", with the state that is free of stress (the emptier one) as images.before',
        ),
    )
