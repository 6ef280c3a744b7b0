"""How the material of a body may differ from that of homogeneous tissues: modes of ln E, and of Poisson's ratios."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from palpate.mechanics.hyperelastic import Elements, Moduli
from palpate.mesh.gaussian_process import karhunen_loeve, matern
from palpate.mesh.tet_mesh import TetMesh
from palpate.parallel import mapped, processors

SHARE, SHARE_OF_MAP = 0.95, 0.9995  # share of the variance of ln E in the modes of a tissue, and of a mapped tissue
MOST = 120  # largest number of modes of a tissue that is not mapped


@dataclass(frozen=True, slots=True)
class MaterialModes:
    """Element e of a tissue t has ln E_e = ln E_t + sum_k fields[e, k] c_k, and Poisson's ratio nu_t + c_t.

    fields (n_tets, n_fields) dimensionless; poisson: groups of tissues, by number, whose ratios may differ, one
    coefficient each, after those of the fields; sizes: tissue and number of the fields of each tissue that has any.
    """

    fields: sparse.csr_matrix[np.float64]
    poisson: tuple[tuple[int, ...], ...] = ()
    sizes: tuple[tuple[int, int], ...] = ()

    @property
    def n_modes(self) -> int:
        """Number of coefficients."""
        return int(self.fields.shape[1]) + len(self.poisson)

    def combined(self, basis: NDArray[np.float64]) -> MaterialModes:
        """The modes on combinations c = basis z of the fields' coefficients, basis (n_fields, k).

        Poisson's ratios stay as they are; which combination is of which tissue is not kept.
        """
        return replace(self, fields=sparse.csr_matrix(self.fields @ sparse.csr_matrix(basis)), sizes=())

    def scale(self, coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
        """E_e / E_t (n_tets,), dimensionless, at coefficients (n_modes,)."""
        logarithms = np.asarray(self.fields @ coefficients[: self.fields.shape[1]], dtype=np.float64)
        return np.asarray(np.exp(logarithms))

    def poisson_shifts(self, coefficients: NDArray[np.float64]) -> dict[int, float]:
        """By how much the Poisson's ratio of each tissue differs, dimensionless, at coefficients (n_modes,)."""
        groups = zip(self.poisson, coefficients[self.fields.shape[1] :].tolist(), strict=True)
        return {tissue: shift for tissues, shift in groups for tissue in tissues}


HOMOGENEOUS = MaterialModes(sparse.csr_matrix((0, 0)))


def material_modes(
    mesh: TetMesh, tissues: Sequence[int], *, length_mm: float, poisson: Sequence[tuple[int, ...]] = ()
) -> MaterialModes:
    """Modes of ln E in each of the meshed `tissues` (numbers), and one of the Poisson's ratio of each of `poisson`.

    Fields are those of `field_modes`, less their mean by volume: the modulus of a tissue is the geometric mean over it.
    """
    found, sizes = list[sparse.csr_matrix[np.float64]](), list[tuple[int, int]]()
    for tissue in tissues:
        own = np.flatnonzero(mesh.region == tissue)
        volumes = mesh.volumes[own]
        local = field_modes(mesh, tissue, length_mm=length_mm)
        local = local - (volumes @ local) / volumes.sum()
        rows, columns = np.repeat(own, local.shape[1]), np.tile(np.arange(local.shape[1]), len(own))
        found.append(sparse.csr_matrix((local.ravel(), (rows, columns)), shape=(len(mesh.tets), local.shape[1])))
        sizes.append((tissue, local.shape[1]))
    fields = sparse.csr_matrix(sparse.hstack(found)) if found else sparse.csr_matrix((len(mesh.tets), 0))
    return MaterialModes(fields, tuple(poisson), tuple(sizes))


def field_modes(mesh: TetMesh, tissue: int, *, length_mm: float) -> NDArray[np.float64]:
    """Karhunen-Loeve modes (n, k) of ln E, of standard deviation 1, in the n elements of a tissue (number).

    Of a Gaussian kernel of length_mm; where the tissue's modulus is a field, of Matern's with its own length, which
    allows of what has an edge.
    """
    own = np.flatnonzero(mesh.region == tissue)
    centres, volumes, prior = mesh.nodes[mesh.tets[own]].mean(axis=1), mesh.volumes[own], mesh.tissues[tissue].field
    if prior is None:
        return karhunen_loeve(centres, volumes, kernel_mm=length_mm, share=SHARE, most=MOST)
    return karhunen_loeve(
        centres, volumes, kernel_mm=prior.length_mm, share=SHARE_OF_MAP, most=prior.modes, kernel=matern
    )


@dataclass(frozen=True, slots=True)
class MaterialForces:
    """Derivatives G = sum_p S_p A_p (n_dof, n_modes), mN, of internal forces by a material's coefficients; not formed.

    parts: of fields and of Poisson's ratios, in the order of the coefficients, S (n_dof, n_cells) mN, an element's
    nodal forces in each column, and A (n_cells, n), how much of them a coefficient is. A matrix of all unknowns by all
    modes would be the largest thing there is.
    """

    n_dof: int
    parts: tuple[tuple[sparse.csc_matrix[np.float64], sparse.csr_matrix[np.float64]], ...]

    def along(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """G d (n_dof, k) for directions d (n_modes, k)."""

        def some(part: NDArray[np.float64]) -> NDArray[np.float64]:
            """Along some of them."""
            total, start = np.zeros((self.n_dof, part.shape[1])), 0
            for scatter, amounts in self.parts:
                end = start + amounts.shape[1]
                total += scatter @ np.asarray(amounts @ part[start:end])
                start = end
            return total

        return np.concatenate(mapped(some, np.array_split(directions, processors(), axis=1)), axis=1)

    def work(self, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        """G^T p (n_modes,) or (n_modes, k), mN mm, of the forces along p (n_dof,) or (n_dof, k) mm."""
        parts = [np.asarray(amounts.T @ (scatter.T @ displacement)) for scatter, amounts in self.parts]
        return np.concatenate([np.zeros((0, *displacement.shape[1:])), *parts])

    def of_cells(self, cells: NDArray[np.int64]) -> MaterialForces:
        """Those of some elements (n,), by number."""
        return replace(self, parts=tuple((scatter[:, cells], amounts[cells]) for scatter, amounts in self.parts))


def material_forces(
    elements: Elements,
    modes: MaterialModes,
    displacement: NDArray[np.float64],
    moduli: Moduli,
    *,
    by_poisson: Moduli,
    tissue: NDArray[np.int64],
) -> MaterialForces:
    """Derivatives of the internal forces at u (n_dof,) mm by the coefficients of the modes.

    moduli: Lame's constants of the elements there; by_poisson: their derivatives by Poisson's ratio; tissue (n_tets,):
    of which tissue each element is.
    """
    nodal, n_dof = displacement.reshape(-1, 3), len(displacement)

    def scatter(forces: NDArray[np.float64]) -> sparse.csc_matrix[np.float64]:
        """Element forces (n_cells, n_a, 3) at the unknowns they act on (n_dof, n_cells)."""
        rows = _unknowns_of(elements)
        ends = rows.shape[1] * np.arange(len(rows) + 1)
        return sparse.csc_matrix((forces.ravel(), rows.ravel(), ends), shape=(n_dof, len(rows)))

    every = ((modes.fields, moduli), (_of_poisson(modes, tissue), by_poisson))
    found = [(scatter(elements.forces(nodal, of)), amounts) for amounts, of in every if amounts.shape[1]]
    return MaterialForces(n_dof, tuple(found))


def material_force_along(
    elements: Elements,
    modes: MaterialModes,
    displacement: NDArray[np.float64],
    moduli: Moduli,
    direction: NDArray[np.float64],
    *,
    by_poisson: Moduli,
    tissue: NDArray[np.int64],
) -> NDArray[np.float64]:
    """G d (n_dof,), mN, of the derivatives G of `material_forces` and one direction d (n_modes,).

    The internal forces at u (n_dof,) mm of Lame's constants that change as d says, for they are linear in these: one
    sum over the elements. moduli, by_poisson, tissue: as there.
    """
    n_fields = modes.fields.shape[1]
    amount = np.asarray(modes.fields @ direction[:n_fields])
    shift = np.asarray(_of_poisson(modes, tissue) @ direction[n_fields:])
    pairs = ((moduli.mu, by_poisson.mu), (moduli.pointwise, by_poisson.pointwise), (moduli.mean, by_poisson.mean))
    changed = Moduli(*(amount * own + shift * slope for own, slope in pairs))
    forces, rows = elements.forces(displacement.reshape(-1, 3), changed), _unknowns_of(elements)
    return np.asarray(np.bincount(rows.ravel(), weights=forces.ravel(), minlength=len(displacement)), dtype=np.float64)


def _unknowns_of(elements: Elements) -> NDArray[np.int64]:
    """Numbers (n_cells, 3 n_a) of the unknowns that each element's forces act on."""
    return np.asarray((3 * elements.cells[:, :, None] + np.arange(3)).reshape(len(elements.cells), -1))


def _of_poisson(modes: MaterialModes, tissue: NDArray[np.int64]) -> sparse.csr_matrix[np.float64]:
    """Which elements (n_tets, n_groups) each coefficient of a Poisson's ratio acts on."""
    own = np.array([np.isin(tissue, group) for group in modes.poisson], dtype=np.float64).reshape(-1, len(tissue))
    return sparse.csr_matrix(own.T)
