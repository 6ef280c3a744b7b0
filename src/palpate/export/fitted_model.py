"""The model that an estimate has fitted, as other programs get it: meshes, moduli, motions; no name of an input."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from palpate.case.data import CaseLoad
from palpate.errors import ConfigurationError, EstimationError, InputDataError
from palpate.images.label_image import VoxelGrid
from palpate.images.tissue import Tissue
from palpate.mechanics.laws.contract import Law
from palpate.mechanics.laws.registry import law_from
from palpate.mesh.space import LagrangeSpace, lagrange_space
from palpate.mesh.tet_mesh import TetMesh
from palpate.statement.estimation import ModulusEstimate
from palpate.statement.result import CaseResult
from palpate.statement.samples import ModulusSamples

HIGHEST_RATIO = 0.4999  # Poisson's, that a case may have


@dataclass(frozen=True, slots=True)
class FittedBody:
    """One reference state with the motion fitted to each of its later images.

    order: 1 or 2, of the displacements (n_points, 3) mm on the points of `space`, one a later image; alignments: one
    (4, 4) a later image, which takes points from the world of the first image, RAS mm, to where the later one has them;
    index (n_x, n_y, n_z): the tissue of each voxel of the first image, on `grid`; loads: the known ones in each later
    image; log_ratio (n_tets,): ln E of each element over that of its tissue, None: tissues are homogeneous.
    """

    mesh: TetMesh
    order: int
    displacements: tuple[NDArray[np.float64], ...]
    alignments: tuple[NDArray[np.float64], ...]
    index: NDArray[np.int16]
    grid: VoxelGrid
    loads: tuple[tuple[CaseLoad, ...], ...]
    log_ratio: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        index, n = self.index, len(self.mesh.tissues)
        if self.log_ratio is not None and self.log_ratio.shape != self.mesh.region.shape:
            raise InputDataError("the elements of a fitted model do not all have a modulus")
        if index.shape != self.grid.shape or (index.size and not 0 <= int(index.min()) <= int(index.max()) < n):
            raise InputDataError(f"the voxels of a fitted model do not all belong to one of its {n} tissues")

    @property
    def tissues(self) -> tuple[Tissue, ...]:
        """The case's tissues, in the mesh's order."""
        return self.mesh.tissues

    @property
    def space(self) -> LagrangeSpace:
        """The displacements' points on the mesh."""
        return lagrange_space(self.mesh, f"P{self.order}")

    def element_moduli(self, of_tissues: NDArray[np.float64]) -> NDArray[np.float64]:
        """Young's modulus (n_tets,) of each element, in the unit of those of its tissues (n_tissues,)."""
        factor = 1.0 if self.log_ratio is None else np.exp(self.log_ratio)
        return np.asarray(of_tissues[self.mesh.region] * factor)

    def with_linear_tetrahedra(self) -> FittedBody:
        """The same with the displacements of the corners alone."""
        n = len(self.mesh.nodes)  # which come first among the points
        return replace(self, order=1, displacements=tuple(motion[:n] for motion in self.displacements))


@dataclass(frozen=True, slots=True)
class FittedModel:
    """All bodies of a case with the moduli that they share.

    moduli (n_tissues,) in `unit`, "kPa" or "ratio" to `relative_to`; NaN of hollow tissues; covariance (n, n) of the
    natural logarithms of the `estimates`; law_parameters, element, outer_boundary, densities (n_tissues,), in
    kg/m^3: as the case has them; seal: SHA-256 of the numbers of the result.json beside it; samples: draws of the
    moduli's posterior, where the case asked for them; strained: whether the reference state is not free of stress.
    """

    bodies: tuple[FittedBody, ...]
    moduli: NDArray[np.float64]
    unit: str
    relative_to: str
    estimates: tuple[ModulusEstimate, ...]
    covariance: NDArray[np.float64]
    law: str
    law_parameters: Mapping[str, float]
    element: str
    outer_boundary: str
    densities: NDArray[np.float64]
    seal: str
    samples: ModulusSamples | None = None
    strained: bool = False

    @property
    def material_law(self) -> Law:
        """The law with its parameters."""
        return law_from(self.law, self.law_parameters)

    def law_among(self, *written: type[Law]) -> Law:
        """The law, where it is one of those that a format can write.

        Raises `ConfigurationError` for another, and where the mesh is not free of stress.
        """
        if self.strained:
            raise ConfigurationError(
                "the reference state is loaded, but another program would take its mesh as free of stress; export to"
                " vtu, whose fields are those of the estimate"
            )
        law = self.material_law
        if not isinstance(law, written):
            names = " and ".join(f"'{kind().name}'" for kind in written)
            raise ConfigurationError(
                f"the law '{self.law}' is not supported by this format, which has {names}; export to vtu, whose fields"
                " are those of the estimate"
            )
        return law

    @property
    def tissues(self) -> tuple[Tissue, ...]:
        """The case's tissues; their order is that of every body's mesh."""
        return self.bodies[0].tissues

    @property
    def modulus_name(self) -> str:
        """What files call Young's modulus, with its unit."""
        return "youngs_modulus_kpa" if self.unit == "kPa" else "youngs_modulus_ratio"

    @property
    def units(self) -> str:
        """The units of all numbers, as a file's heading says them."""
        if self.unit == "kPa":
            return "mm, kPa, mN; RAS coordinates"
        return f"mm, moduli and stresses as ratios to the modulus of '{self.relative_to}'; RAS coordinates"


def fitted_bodies(result: CaseResult) -> tuple[FittedBody, ...]:
    """The reference states of a result, each with the motions fitted to it; raises as `fitted_model` does."""
    return fitted_model(result, seal="").bodies


def fitted_model(result: CaseResult, *, seal: str) -> FittedModel:
    """The model of a result; raises `EstimationError` where the estimate did not converge, for there is none then."""
    estimation, case = result.estimation, result.case
    if estimation.status != "converged":
        raise EstimationError(
            f"the estimate ended with the status '{estimation.status}' ({estimation.reason}), so there is no model to"
            " export; an estimate that did not converge cannot be exported"
        )
    motions = [result.displacements_of(number) for number in range(len(result.pairs))]
    numbers = np.cumsum([1, *map(len, motions)]).tolist()
    loads = [tuple(case.loads_in(n) for n in range(*ends)) for ends in pairwise(numbers)]
    materials = [estimation.materials[n - 1] if estimation.materials else None for n in numbers[:-1]]
    bodies = list[FittedBody]()
    for pair, moved, acting, material in zip(result.pairs, motions, loads, materials, strict=True):
        mesh, shifts = pair.space.mesh, material.poisson_shifts if material else {}
        ratios = [min(tissue.poisson_ratio + shifts.get(tissue.name, 0.0), HIGHEST_RATIO) for tissue in mesh.tissues]
        # the labels' own names are the image's
        own = (replace(t, called=(), poisson_ratio=ratio) for t, ratio in zip(mesh.tissues, ratios, strict=True))
        lay = (later.alignment for later in pair.later)
        alignments = tuple(np.eye(4) if found is None else found.motion.matrix for found in lay)
        fitted = FittedBody(
            replace(mesh, tissues=tuple(own)),
            pair.space.order,
            moved or (np.zeros_like(pair.space.points),),
            alignments or (np.eye(4),),
            pair.before.index,
            pair.before.grid,
            acting or ((),),
            None if material is None else material.log_ratio,
        )
        bodies.append(fitted)
    density = {tissue.name: tissue.density_kg_m3 for tissue in case.tissues}
    law = case.mechanics.material_law
    return FittedModel(
        tuple(bodies),
        result.stiffness,
        result.unit,
        next((item.relative_to for item in estimation.estimates), ""),
        estimation.estimates,
        estimation.covariance.total,
        law.name,
        {parameter.name: getattr(law, parameter.name) for parameter in law.parameters},
        case.mechanics.element,
        case.domain.outer_boundary,
        np.array([density.get(tissue.name, 1000.0) for tissue in result.tissues]),
        seal,
        estimation.samples,
        case.strained_reference,
    )
