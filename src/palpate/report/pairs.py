"""The pairs of images of a result, each as if it were of that alone; their voxels, and how well their bones lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import igl
import numpy as np

from palpate.body.provenance import pair_names
from palpate.case.sources import Images
from palpate.images.alignment import within_border
from palpate.images.tissue import Role
from palpate.report.report_data import BoneDistance, InputImage, TriangleSurface
from palpate.statement.result import CaseResult


@dataclass(frozen=True, slots=True)
class ImagePair:
    """A reference state with its later images: `result` shows it as the first and only pair; names of its images."""

    result: CaseResult
    before: str
    after: tuple[str, ...]


def image_pairs(result: CaseResult) -> tuple[ImagePair, ...]:
    """The first pair of the result, then its further ones."""
    results = list[CaseResult]()
    for number, pair in enumerate(result.pairs):
        case = result.case
        if number:  # of which only labels are known
            source = case.pairs[number - 1]
            case = replace(case, images=Images(source.before, source.after), pairs=())
        own = replace(result.estimation, displacements=result.displacements_of(number))
        results.append(replace(result, case=case, estimation=own, pairs=(pair,)))
    return tuple(
        ImagePair(one, before, tuple(after[k] if k < len(after) else f"after {k + 1}" for k in range(len(one.after))))
        for one, (before, after) in zip(results, pair_names(result.case), strict=False)
    )


def drawn_images(counts: Sequence[int], most: int) -> tuple[tuple[int, int], ...]:
    """(pair, later image) of those to be drawn, at the most `most`, of pairs with so many later images.

    The first of every pair comes before the second of any.
    """
    every = [(pair, after) for pair, count in enumerate(counts) for after in range(count)]
    return tuple(sorted(sorted(every, key=lambda item: item[1])[:most]))


def input_images(pairs: tuple[ImagePair, ...]) -> tuple[InputImage, ...]:
    """Every label image of the pairs with its voxels and its organs' volumes."""
    found = []
    for number, pair in enumerate(pairs):
        key = "" if number == 0 else f"pairs[{number - 1}]."
        keys = (f"{key}before", *(f"{key}after[{i}]" for i in range(len(pair.after))))
        images = (pair.result.before, *pair.result.after)
        digests = [pair.result.provenance.inputs.get(name, "") for name in keys]
        for later, (name, image, sha256) in enumerate(zip((pair.before, *pair.after), images, digests, strict=True)):
            x, y, z = (float(edge) for edge in image.grid.spacing)
            volume = np.asarray(
                image.grid.voxel_volume * np.bincount(image.index.ravel(), minlength=len(image.tissues))
            )
            if pair.result.case.body is not None:  # its voxels only show the mesh
                mesh = pair.result.space.mesh
                volume = np.asarray(np.bincount(mesh.region, mesh.volumes, minlength=len(image.tissues)))
            volumes = tuple((volume / 1000.0).tolist())
            found.append(InputImage(name, number, later > 0, image.grid.shape, (x, y, z), volumes, sha256))
    return tuple(found)


def bone_distances(
    result: CaseResult, after: int, earlier: tuple[TriangleSurface, ...], later: tuple[TriangleSurface, ...]
) -> tuple[BoneDistance, ...]:
    """Distances (mm) of the rigid tissues' surfaces from those of the aligned later image, where that shows them."""
    grid, target = result.after[after].grid, {surface.tissue: surface for surface in later}
    found = []
    for surface in earlier:
        if result.tissues[surface.tissue].role is not Role.RIGID or surface.tissue not in target:
            continue
        points = surface.points.astype(np.float64)
        points = points[within_border(grid, points)]  # nearer to the later image's border its surface is cut
        if len(points):
            other = target[surface.tissue]
            squared = igl.point_mesh_squared_distance(
                points, other.points.astype(np.float64), other.triangles.astype(np.int64)
            )[0]
            distance = np.sqrt(squared)
            found.append(BoneDistance(surface.tissue, float(distance.mean()), float(np.percentile(distance, 95.0))))
    return tuple(found)
