"""The pairs of images of a result, each as if the result were of it alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from palpate.study.case import Images
from palpate.study.result import CaseResult, pair_names


@dataclass(frozen=True, slots=True)
class ImagePair:
    """A reference state with its later images: `result` shows it as the first and only pair; names of its images."""

    result: CaseResult
    before: str
    after: tuple[str, ...]


def image_pairs(result: CaseResult) -> tuple[ImagePair, ...]:
    """The first pair of the result, then its further ones."""
    images = result.case.images
    sources = result.case.pairs if images else ()
    results = [result]
    for pair, source in zip(result.further, sources, strict=False):
        alone = replace(
            result,
            case=replace(result.case, images=Images(source.before, source.after), pairs=()),  # only labels are known
            estimation=replace(result.estimation, displacements=pair.displacements),
            space=pair.space,
            mesh_summary=pair.mesh_summary,
            before=pair.before,
            after=pair.after,
            further=(),
        )
        results.append(alone)
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
