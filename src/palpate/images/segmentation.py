"""A segmentation: every voxel belongs to one tissue of the case."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError, InputDataError
from palpate.findings import Finding
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.tissue import Role, Tissue


@dataclass(frozen=True, slots=True)
class Segmentation:
    """`index` (n_x, n_y, n_z) int16: which of `tissues` a voxel of `grid` belongs to.

    `digests`, `findings`: as of `LabelImage`; `middles`: the middle (3,) mm of each named label's voxels, of which one
    tissue may have several.
    """

    index: NDArray[np.int16]
    grid: VoxelGrid
    tissues: tuple[Tissue, ...]
    digests: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    middles: Mapping[str, NDArray[np.float64]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        index = np.array(self.index, dtype=np.int16)
        index.setflags(write=False)
        object.__setattr__(self, "index", index)

    def mask(self, tissue: int) -> NDArray[np.bool_]:
        """Which voxels (n_x, n_y, n_z) belong to the tissue of that index."""
        return np.asarray(self.index == tissue)

    def voxels(self, tissue: int) -> Iterator[NDArray[np.int64]]:
        """Indices (n, 3) of the tissue's voxels in their order, those of one layer of the first axis at a time.

        All at once they take up to twelve times the memory of the image.
        """
        for i, layer in enumerate(self.index):
            found = np.argwhere(layer == tissue)
            yield np.column_stack([np.full(len(found), i), found])

    def middle(self, tissue: int) -> NDArray[np.float64]:
        """Mean (3,) mm of the centres of the tissue's voxels, of which there is one at least."""
        mask = self.mask(tissue)
        along = [mask.sum(axis=tuple({0, 1, 2} - {axis})) for axis in range(3)]
        place = [float(counts @ np.arange(len(counts)) / counts.sum()) for counts in along]
        return np.asarray(self.grid.world(np.array([place]))[0])

    def volume(self, tissue: int) -> float:
        """Volume of the tissue by counting voxels, mm^3."""
        return float(np.count_nonzero(self.index == tissue)) * self.grid.voxel_volume


def first_labels(tissues: tuple[Tissue, ...]) -> NDArray[np.int32]:
    """Number of each tissue (n_tissues,), by which our files know it: its smallest label other than 0.

    A tissue without such a label gets the smallest number from 1 on that no other claims: 0 is what programs take for
    the background. So it is left to the first `void` tissue that has no label other than 0.
    """
    claimed = {label for tissue in tissues for label in tissue.labels}
    free = (number for number in count(1) if number not in claimed)
    background = next((i for i, t in enumerate(tissues) if t.role is Role.VOID and not any(t.labels)), None)
    numbers = [
        0 if i == background else min((label for label in tissue.labels if label), default=0) or next(free)
        for i, tissue in enumerate(tissues)
    ]
    return np.array(numbers, dtype=np.int32)


def segment(image: LabelImage, tissues: tuple[Tissue, ...]) -> Segmentation:
    """Give every voxel of `image` to its tissue, which takes the names of its labels, and a colour if it has none.

    Raises `ConfigurationError` when two tissues claim one label or two are "remaining", `InputDataError` when a
    voxel's label belongs to no tissue or a tissue has no voxel.
    """
    owner: dict[int, int] = {}
    for i, tissue in enumerate(tissues):
        for label in tissue.labels:
            if label in owner:
                raise ConfigurationError(
                    f"label {label} is claimed by '{tissues[owner[label]].name}' and by '{tissue.name}';"
                    " a voxel can belong to one tissue only"
                )
            owner[label] = i
    rest = [i for i, tissue in enumerate(tissues) if not tissue.labels]
    if len(rest) > 1:
        raise ConfigurationError(f"tissues {[tissues[i].name for i in rest]} are both 'remaining'; only one can be")
    labels = np.unique(np.concatenate([np.unique(layer) for layer in image.labels]))
    orphans = [int(label) for label in labels if int(label) not in owner]
    if orphans and not rest:
        scaled = "".join(f". {each.message}" for each in image.findings if each.code == "scaled-labels")
        raise InputDataError(
            f"labels {orphans[:10]} belong to no tissue; name them in a tissue, or give one tissue label = 'remaining'"
            f"{scaled}"
        )
    table = np.array([owner.get(int(label), rest[0] if rest else -1) for label in labels], dtype=np.int16)
    described = []
    for tissue in tissues:
        called = tuple(image.names[label] for label in tissue.labels if label in image.names)
        colour = next((image.colours[label] for label in tissue.labels if label in image.colours), None)
        described.append(replace(tissue, called=called or tissue.called, colour=tissue.colour or colour))
    index = np.empty(image.labels.shape, dtype=np.int16)
    sums, rows = np.zeros((len(labels), 3)), np.indices(index.shape[1:]).reshape(2, -1)
    counts = np.zeros(len(labels))
    for i, layer in enumerate(image.labels):  # all at once these numbers would take eight times the labels' memory
        numbers = np.searchsorted(labels, layer)
        index[i] = table[numbers]
        here, *sides = (np.bincount(numbers.ravel(), weights, len(labels)) for weights in (None, *rows))
        counts += here
        sums += np.stack([i * here, *sides], axis=1)
    world = image.grid.world(sums / counts[:, None])
    middles = {image.names[int(n)]: place for n, place in zip(labels, world, strict=True) if int(n) in image.names}
    return Segmentation(index, image.grid, tuple(described), image.digests, image.findings, middles)
