"""What an estimate will cost, from volumes and edge length alone: tetrahedra, unknowns, memory, time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from palpate.body.edge_length import EdgeLength, case_domain, edge_length_of
from palpate.case.case import Case
from palpate.errors import ResourceError
from palpate.images.distance import REACH_MM, window_around
from palpate.images.segmentation import Segmentation
from palpate.images.surface_alignment import shown_tissues
from palpate.images.tissue import Role
from palpate.mechanics.solvers.registry import expected_of_size
from palpate.mesh import SizeField, TetMesh
from palpate.parallel import processors
from palpate.processes import available_memory, total_memory
from palpate.progress import STAGES, Stage, about, counted

MEMORY_FACTOR = 1.5  # factor by which the predicted memory may be wrong

LATTICE = 64  # points of the lattice along the longest side, on which edge lengths are summed
# Fitted to stages of the demo on a machine of two cores that takes 80 s for it; slow machines take twice as long.
TETS_A_CUBE = 19.4  # tetrahedra in a cube of the wanted edge length, before the mesh is made
TETS_BETWEEN = (17.0, 31.0)  # the same of smooth phantoms and of a real pelvis: what a guess allows for
UNKNOWNS_A_TET = {"P1": 0.62, "P2": 4.4}
FIXED_S: Mapping[Stage, float] = {"read": 5.0, "assemble": 1.0, "search": 3.0, "intervals": 13.0}
SECONDS_AN_UNKNOWN = 2.4e-4  # beside the solver, with 90 modes a driver, for each later image
ASSEMBLING = 0.23  # of that: distances to the surfaces and stiffness matrices
FINITE_STRAIN_S = 3.6e-4  # the same of equilibria and their derivatives at finite strain
INTERVALS_S = 2.2e-4  # the same of intervals, and of what would change the answer
FROM_REST = 2  # further passes, each with a linear one, where the state without loads is found with the moduli
SECONDS_A_CUT = 1.0e-4  # of meshing, for each tetrahedron and each tissue that is cut out
PARALLEL_SHARE = 0.3  # share of the time that more processors shorten
FIXED_GB = 0.48
GB_AN_UNKNOWN = 1.7e-5  # beside the factor, with 90 modes
BYTES_A_VOXEL = 6.0  # of each image: the tissue of each voxel, and masks
BYTES_A_DISTANCE = 81.0  # for each voxel around a tissue, while its distance map is made
LESS_MEMORY = 'make mesh.edge_length_mm larger, or domain.extent = "margin" with a smaller margin_mm'
USUAL_MODES = 90
OVERHEAD_MODES = 10  # cost of an unknown without any mode, in modes
SERIES = 30  # further right-hand sides beside those of the modes


@dataclass(frozen=True, slots=True)
class ExpectedCost:
    """Size of the mesh and of the linear systems, peak memory (GB), time (s), and what they were predicted for.

    stages: of the time, what each stage takes (s), in their order; the last one with the report; between: the costs of
    the smallest and of the largest mesh that the images may lead to, None where the mesh is known.
    """

    tets: int
    unknowns: int
    memory_gb: float
    seconds: float
    solver: str
    processors: int
    stages: Mapping[Stage, float] = field(default_factory=dict)
    between: tuple[ExpectedCost, ExpectedCost] | None = None

    @property
    def time_words(self) -> str:
        """The time in words: "about 2 minutes", before the mesh is known a range."""
        least, most = (about(each.seconds) for each in self.between or (self, self))
        if least == most:
            return f"about {least}"
        number, _, unit = least.partition(" ")
        return f"{number if most.endswith(f' {unit}') and unit else least} to {most}"

    @property
    def memory_words(self) -> str:
        """The peak memory in words: "2.2 GB", before the mesh is known a range."""
        least, most = (f"{each.memory_gb:.1f}" for each in self.between or (self, self))
        return f"{least} GB" if least == most else f"{least} to {most} GB"

    @property
    def sentence(self) -> str:
        """Time and memory as every command says them while it works."""
        words = f"{self.time_words} on {counted(self.processors, 'processor')}"
        return f"an estimate takes {words}, and {self.memory_words} of memory"

    @property
    def in_words(self) -> str:
        """Time, memory and size, as the report of a check has them."""
        least, most = (str(each.unknowns) for each in self.between or (self, self))
        unknowns = f"{self.tets} tetrahedra, {most} unknowns" if least == most else f"{least} to {most} unknowns"
        on = counted(self.processors, "processor")
        return f"{self.time_words}, {self.memory_words} of memory ({unknowns}, {self.solver} on {on})"


def expected_cost(
    case: Case, before: Segmentation, after: tuple[Segmentation, ...], *, n_pairs: int, mesh: TetMesh | None = None
) -> ExpectedCost:
    """The cost of estimating a case on this machine, from its first pair of images; further pairs cost the same each.

    Nothing is meshed: tetrahedra from the sum of 1 / h^3 over the meshed volume, h the mesher's own edge length there,
    or those of the case's own `mesh`. Every command that predicts a cost before it meshes has it from here.
    """

    def of(tets: float) -> ExpectedCost:
        """On a mesh of so many tetrahedra a pair."""
        sizes = [expected_size(case, int(tets))] * n_pairs
        return cost_of_meshes(case, before, sizes, n_after=len(after) or case.n_states)

    if mesh is not None:
        return of(len(mesh.tets))
    tets = expected_tets(case, before, after)
    least, most = (of(tets * each / TETS_A_CUBE) for each in TETS_BETWEEN)
    return replace(of(tets), between=(least, most))


def expected_size(case: Case, tets: int) -> tuple[int, int]:
    """So many tetrahedra, and the unknowns that they bring."""
    return tets, int(tets * UNKNOWNS_A_TET.get(case.mechanics.element, UNKNOWNS_A_TET["P2"]))


def cost_of_meshes(
    case: Case, before: Segmentation, meshes: Sequence[tuple[int, int]], *, n_after: int
) -> ExpectedCost:
    """The same of known meshes: tetrahedra and unknowns of each pair, of which each has `n_after` later images.

    Memory and time from unknowns, modes, images and solver, with measured constants. The report is included, other
    programs are not.
    """
    drivers = max(sum(tissue.role is Role.DRIVER for tissue in before.tissues), 1)
    modes = (drivers * case.driver.modes + OVERHEAD_MODES) / (USUAL_MODES + OVERHEAD_MODES)
    finite = case.mechanics.material_law.finite
    largest = max(unknowns for _, unknowns in meshes)
    solver, _ = expected_of_size(largest, case.driver.modes + SERIES, solver=case.mechanics.solver)
    count = processors()
    shorter = 1.0 - PARALLEL_SHARE + PARALLEL_SHARE / count
    took, gigabytes = {stage: FIXED_S.get(stage, 0.0) * shorter for stage in STAGES}, FIXED_GB
    gigabytes += image_memory_gb(before, n_images=(1 + n_after) * len(meshes))
    for tets, unknowns in meshes:
        _, solving = expected_of_size(unknowns, case.driver.modes + SERIES, solver=solver)
        work = unknowns * modes * max(n_after, 1)
        took["mesh"] += (case.body is None) * SECONDS_A_CUT * tets * (len(before.tissues) - 1) * shorter
        took["assemble"] += ASSEMBLING * SECONDS_AN_UNKNOWN * work * shorter
        took["search"] += (1.0 - ASSEMBLING) * SECONDS_AN_UNKNOWN * work * shorter + solving.seconds
        took["check the law"] += finite * FINITE_STRAIN_S * work * shorter
        if case.strained_reference:
            took["check the law"] += FROM_REST * (SECONDS_AN_UNKNOWN + FINITE_STRAIN_S) * work * shorter
        took["intervals"] += INTERVALS_S * work * shorter
        gigabytes += GB_AN_UNKNOWN * work + solving.bytes / 1e9
    return ExpectedCost(
        tets=sum(tets for tets, _ in meshes),
        unknowns=sum(unknowns for _, unknowns in meshes),
        memory_gb=gigabytes,
        seconds=sum(took.values()),
        solver=solver,
        processors=count,
        stages=took,
    )


def image_memory_gb(image: Segmentation, *, n_images: int) -> float:
    """Memory (GB) that the voxels of so many images like this one take, with the distance maps of one at a time."""
    tissues = [i for i in shown_tissues(image) if image.mask(i).any()]
    windows = [window_around(image.mask(i), image.grid, reach_mm=REACH_MM) for i in tissues]
    sizes = sorted(math.prod(part.stop - part.start for part in window) for window in windows)
    maps = float(sum(sizes[-processors() :]))  # as many as are made side by side
    return (BYTES_A_VOXEL * n_images * math.prod(image.grid.shape) + BYTES_A_DISTANCE * maps) / 1e9


def expected_tets(case: Case, before: Segmentation, after: tuple[Segmentation, ...]) -> int:
    """Number of tetrahedra in the mesh of a reference state."""
    return tets_by_edge_length(case, before)(edge_length_of(case, before, after))


def tets_by_edge_length(case: Case, before: Segmentation) -> Callable[[EdgeLength], int]:
    """The same as a function of the edge lengths: distances to the organs are computed once."""
    box = case_domain(before, case)
    # the tissue at the middles of cells that fill the box, -1 outside the image
    counts = np.maximum(np.ceil(box.lengths / box.lengths.max() * LATTICE), 4).astype(int)
    cell = box.lengths / counts
    ticks = [(np.arange(n) + 0.5) * size for n, size in zip(counts, cell, strict=True)]
    local = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    voxels = np.rint(before.grid.index(box.world(local))).astype(np.int64)
    inside = ((voxels >= 0) & (voxels < before.grid.shape)).all(axis=1)
    index = np.full(len(voxels), -1, dtype=np.int64)
    index[inside] = before.index[tuple(voxels[inside].T)]
    index = index.reshape(tuple(counts))
    tissues = [i for i, tissue in enumerate(before.tissues) if tissue.meshed]
    # the mesher's filler: the remaining tissue if it is meshed, else the largest
    filler = max(tissues, key=lambda i: (not before.tissues[i].labels, before.volume(i)), default=-1)
    meshed = np.array([*(tissue.meshed for tissue in before.tissues), False])[index] & (index >= 0)
    seen = [i for i in range(len(before.tissues)) if i != filler and (index == i).any()]
    distances = np.empty((len(seen), np.count_nonzero(meshed)))  # mm of cells to each surface, on either side of it
    for row, i in enumerate(seen):
        mask = index == i
        away = ndimage.distance_transform_edt(~mask, sampling=cell)
        # inside, the nearest cell outside is no further than the first beside the tissue's box
        box_of = tuple(slice(max(p.min() - 1, 0), p.max() + 2) for p in np.nonzero(mask))
        away[box_of] += ndimage.distance_transform_edt(mask[box_of], sampling=cell) if not mask.all() else np.inf
        distances[row] = np.maximum(away - 0.5 * float(cell.min()), 0.0)[meshed]

    def tets(lengths: EdgeLength) -> int:
        """With edges of that length at the organs."""
        sizes = SizeField.of([before.tissues[i] for i in seen], lengths.mm, lengths.longer_mm).at(distances)
        return max(int(TETS_A_CUBE * np.prod(cell) * float((sizes**-3.0).sum())), 100)

    return tets


def machine_memory_gb() -> float | None:
    """Memory that this machine has, GB; None where the system does not tell."""
    total = total_memory()
    return None if total is None else total / 1e9


def free_memory_gb() -> float | None:
    """Memory that is free on this machine at the moment, GB; None where the system does not tell."""
    free = available_memory()
    return None if free is None else free / 1e9


def lack_of_memory(cost: ExpectedCost) -> str:
    """What a run lacks that this machine cannot hold even if the prediction is `MEMORY_FACTOR` too high; else empty.

    What to do is `LESS_MEMORY`.
    """
    has = machine_memory_gb()
    if has is None or cost.memory_gb <= MEMORY_FACTOR * has:
        return ""
    return f"about {cost.memory_gb:.1f} GB of memory would be needed and this machine has {has:.1f} GB"


def refuse_lack(cost: ExpectedCost) -> None:
    """Raise `ResourceError` for what `lack_of_memory` tells, with what to do."""
    if lack := lack_of_memory(cost):
        raise ResourceError(f"{lack}; {LESS_MEMORY}")
