"""Small pictures: the reports' tests look at what is drawn, not at how finely; and a result of two pairs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from palpate.body.imaged import LaterImage
from palpate.case.case import Images, Pair
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.mesh.space import lagrange_space
from palpate.report import pictures
from palpate.statement.result import PairResult

AWAY = np.array([0.0, 0.0, 50.0])


@pytest.fixture(autouse=True, scope="session")
def small_pictures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "WIDTH", 124)
        patch.setattr(pictures, "HEIGHT", 92)
        yield


def moved_away(image: Segmentation) -> Segmentation:
    affine = image.grid.affine.copy()
    affine[:3, 3] += AWAY
    return Segmentation(image.index, VoxelGrid(image.grid.shape, affine), image.tissues)


@pytest.fixture(scope="session")
def two_pairs(case_result):
    """The result, with a second pair of images of the same body, which lies 50 mm higher."""
    estimation = case_result.estimation
    images = Images(Path("one/before.nii.gz"), (Path("one/first.nii.gz"),))
    further = Pair(Path("two/before.nii.gz"), (Path("two/second.nii.gz"),))
    mesh = case_result.space.mesh
    pair = PairResult(
        space=lagrange_space(dataclasses.replace(mesh, nodes=mesh.nodes + AWAY), "P2"),
        mesh_summary=case_result.mesh_summary,
        before=moved_away(case_result.before),
        later=(LaterImage(2, moved_away(case_result.after[0])),),
    )
    return dataclasses.replace(
        case_result,
        case=dataclasses.replace(case_result.case, images=images, pairs=(further,)),
        estimation=dataclasses.replace(
            estimation, fits=2 * estimation.fits, displacements=2 * estimation.displacements
        ),
        pairs=(*case_result.pairs, pair),
    )
