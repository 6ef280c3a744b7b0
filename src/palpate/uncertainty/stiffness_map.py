"""Maps of stiffness: the posterior of ln E in tissues whose modulus is a field, and whether a part of one differs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.special import ndtr

from palpate.inversion import Inversion
from palpate.mechanics.material import field_modes
from palpate.mesh.tet_mesh import FACES, TetMesh
from palpate.uncertainty.covariance import covariance_among
from palpate.uncertainty.intervals import NORMAL_95, Interval
from palpate.unknowns import Acts

CONTRAST = 1.5  # least ratio for a part to have another stiffness than its tissue
CERTAIN, LIKELY = 0.95, 0.5  # posterior probability of that: somewhere in a region that is reported, all over it
MM3_PER_ML = 1000.0
SMOOTH = 1e-6  # of the prior's precision, added for modes that elements do not separate


@dataclass(frozen=True, slots=True)
class DifferentRegion:
    """The largest connected part of a tissue that is likely stiffer, or softer, than the tissue by `CONTRAST`.

    elements (n,): its tetrahedra; volume_ml; centre_mm (3,), RAS; contrast: geometric mean of E where that is certain,
    in its core, over that outside of the whole region, with its 95 % interval, as if nothing had been believed of how
    much it differs (what is believed draws the map to the tissue's mean); probability: the largest posterior
    probability, of an element in it.
    """

    elements: NDArray[np.int64]
    volume_ml: float
    centre_mm: NDArray[np.float64]
    contrast: float
    interval95: Interval
    probability: float


@dataclass(frozen=True, slots=True)
class StiffnessMap:
    """Posterior of ln E in the tetrahedra of one tissue of a reference state.

    tissue: its name; state: number of a later state of that reference; elements (n,): numbers of its tetrahedra in the
    mesh; log_ratio (n,): posterior mean of ln E over that of the tissue's geometric mean; sd (n,): posterior standard
    deviation of ln E; resolution (n,): share of the prior's variance that the data removed, 0 to 1; prior_sd: of ln E,
    learned; resolved: mean of the resolution over the tissue's volume; region: where it differs, if anywhere.
    """

    tissue: str
    state: int
    elements: NDArray[np.int64]
    log_ratio: NDArray[np.float64]
    sd: NDArray[np.float64]
    resolution: NDArray[np.float64]
    prior_sd: float
    resolved: float
    region: DifferentRegion | None = None


@dataclass(frozen=True, slots=True)
class _Field:
    """Posterior of a field at its elements: F x, and its covariance F C F^T + R R^T - F P^-1 F^T + r.

    seen (n, k): F, the modes that the data tell, with coefficients x (k,) of covariance C (k, k), and of a covariance
    P^-1 (k, k) before them; every (n, m): R, all modes of the prior times its standard deviation; left (n,): r, the
    variance that none of them holds.
    """

    coefficients: NDArray[np.float64]
    seen: NDArray[np.float64]
    posterior: NDArray[np.float64]
    prior: NDArray[np.float64]
    every: NDArray[np.float64]
    left: NDArray[np.float64]

    @property
    def mean(self) -> NDArray[np.float64]:
        """(n,) of ln E."""
        return np.asarray(self.seen @ self.coefficients)

    @property
    def prior_variance(self) -> NDArray[np.float64]:
        """(n,) before the data."""
        return np.asarray((self.every**2).sum(axis=1) + self.left)

    @property
    def variance(self) -> NDArray[np.float64]:
        """(n,) after them."""
        change = np.einsum("ek,kl,el->e", self.seen, self.posterior - self.prior, self.seen)
        return np.asarray(np.maximum(self.prior_variance + change, 0.0))

    def free_along(self, shape: NDArray[np.float64], volumes: NDArray[np.float64]) -> _Field:
        """The posterior with a flat prior along a `shape` (n,) of the field.

        With h the shape's coefficients, by volumes (n,), and P h = p: the prior's precision is P - p p^T / h^T p then,
        so that x gains C p p^T x / d, and C gains C p p^T C / d, d = p^T (h - C p) (Sherman and Morrison 1950).
        """
        weighted = volumes[:, None] * self.seen
        precision = np.asarray(np.linalg.inv(self.prior), dtype=np.float64)
        gram = weighted.T @ self.seen
        h = np.linalg.solve(gram + SMOOTH * np.trace(gram) / np.trace(precision) * precision, weighted.T @ shape)
        p = precision @ h
        back = self.posterior @ p
        share = max(float(p @ (h - back)), np.finfo(float).tiny)
        x = self.coefficients + back * float(p @ self.coefficients) / share
        return replace(self, coefficients=x, posterior=self.posterior + np.outer(back, back) / share)

    def variance_of(self, weights: NDArray[np.float64]) -> float:
        """Of the sum of the field times weights (n,)."""
        seen, every = weights @ self.seen, weights @ self.every
        return max(float(every @ every + seen @ (self.posterior - self.prior) @ seen), 0.0)


def stiffness_maps(inversion: Inversion, variances: NDArray[np.float64]) -> tuple[StiffnessMap, ...]:
    """The map of every tissue whose modulus is a field, at a converged estimate.

    variances (n_parameters,): of the log-moduli, with all their causes. The covariance of a field's coefficients is the
    sandwich with what is considered, that of what the images do not see the prior's (Spantini et al. 2015, SIAM J. Sci.
    Comput. 37, A2451, Theorem 2.3).
    """
    objective, minimum, maps = inversion.objective, inversion.minimum, list[StiffnessMap]()
    parameters = objective.parameters
    for number, block in enumerate(parameters.blocks):
        if not block.mapped:
            continue
        state, own = block.states[0], parameters.columns(number)
        model = objective.states[state].model
        mesh = model.space.mesh
        tissue = next(i for i, t in enumerate(mesh.tissues) if t.name == block.of and t.field)
        elements = np.flatnonzero(mesh.region == tissue)
        first = int(np.searchsorted(parameters.acting(Acts.MATERIAL, state), own[0]))
        seen = model.material.fields[elements][:, first : first + block.size].toarray()
        theta = parameters.tissues.index(block.of)
        covariance = covariance_among(objective, minimum.evaluation, np.array([theta, *own]))
        learned = parameters.priors[number].covariance
        stated = mesh.tissues[tissue].field
        assert stated is not None
        sd = stated.sd * float(np.sqrt(np.trace(learned) / np.trace(block.alternatives[0].covariance)))
        modes, volumes = field_modes(mesh, tissue, length_mm=stated.length_mm), mesh.volumes[elements]
        left = sd**2 * np.maximum(1.0 - (modes**2).sum(axis=1), 0.0)
        every = sd * (modes - (volumes @ modes) / volumes.sum())
        field = _Field(minimum.unknowns[own], seen, covariance[1:, 1:], learned, every, left)
        whole = field.variance + variances[theta] + 2.0 * seen @ covariance[1:, 0]
        resolution = np.clip(1.0 - field.variance / field.prior_variance, 0.0, 1.0)
        maps.append(
            StiffnessMap(
                block.of,
                state,
                elements,
                field.mean,
                np.sqrt(np.maximum(whole, 0.0)),
                resolution,
                sd,
                float(np.average(resolution, weights=volumes)),
                _region(mesh, elements, field),
            )
        )
    return tuple(maps)


def _region(mesh: TetMesh, elements: NDArray[np.int64], field: _Field) -> DifferentRegion | None:
    """The largest connected part that probably has another stiffness, somewhere with near certainty; or None."""
    sd, volumes = np.sqrt(np.maximum(field.variance, 1e-300)), mesh.volumes[elements]
    parts = list[tuple[float, NDArray[np.int64], NDArray[np.float64]]]()
    for sign in (1.0, -1.0):
        probability = ndtr((sign * field.mean - np.log(CONTRAST)) / sd)
        likely = np.flatnonzero(probability > LIKELY)
        faces = np.sort(mesh.tets[elements[likely]][:, FACES].reshape(-1, 3), axis=1)
        _, face = np.unique(faces, axis=0, return_inverse=True)
        owner = np.repeat(np.arange(len(likely)), len(FACES))
        of_face = sparse.csr_matrix((np.ones(len(owner)), (owner, face.ravel())), shape=(len(likely), len(faces)))
        _, part = connected_components(of_face @ of_face.T)  # joined through faces
        for label in np.unique(part[probability[likely] > CERTAIN]):
            inside = likely[part == label]
            parts.append((float(volumes[inside].sum()) / MM3_PER_ML, inside, probability))
    if not parts:
        return None
    volume_ml, inside, probability = max(parts, key=lambda found: found[0])
    outside = ~np.isin(np.arange(len(elements)), inside)
    # The map is smooth, so only the core lies wholly in the part.
    core = ~outside & (probability > CERTAIN)
    weights = core * volumes / volumes[core].sum() - outside * volumes / max(float(volumes[outside].sum()), 1e-300)
    free = field.free_along(core - np.average(core, weights=volumes), volumes)
    contrast, half = float(weights @ free.mean), NORMAL_95 * float(np.sqrt(free.variance_of(weights)))
    centres = mesh.nodes[mesh.tets[elements[inside]]].mean(axis=1)
    return DifferentRegion(
        elements[inside],
        volume_ml,
        np.average(centres, axis=0, weights=volumes[inside]),
        float(np.exp(contrast)),
        (float(np.exp(contrast - half)), float(np.exp(contrast + half))),
        float(probability[inside].max()),
    )
