"""A map of stiffness by Palpate and by torch-fem's adjoint with L-BFGS, from the same mesh, data and prior.

Simulated: a cavity that grows moves a shell of 20 mm radius in surroundings of 10 kPa; ln E of the shell is drawn from
the prior. The wall's motion is known, a displacement field is measured on a lattice. The truth is on a finer mesh.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, sparse
from speed_peers import torch_fem_modules

from palpate.images import FieldPrior, Role, Tissue
from palpate.inversion import Bounds, InverseProblem, InversionSettings, LaterState, invert
from palpate.mechanics import law_named, linear_model, material_modes, outer_constraint
from palpate.mesh import Anatomy, LagrangeSpace, lagrange_space, located, point_interpolation, tetrahedralise
from palpate.observation import DataFile, DisplacementField, PointDisplacement, PointTable
from palpate.phantoms import AffineMotion, BoundaryMotion, ball, centred_grid, displacements, grid_box
from palpate.uncertainty import sandwich_covariance, stiffness_maps
from palpate.unknowns import material_blocks, parameter_map, unit_blocks
from palpate_validation.mismatch import patched

__all__ = ["beside_a_peer"]

Array = NDArray[np.float64]

ORGAN, WALL = "shell", "cavity"
RADII_MM, BOX_MM = (8.0, 20.0), 56.0
GROWTH = np.diag([0.35, 0.15, -0.1])  # of the cavity, along each axis
PRIOR_SD, PRIOR_MM = 0.5, 8.0
LEVELS = 48  # of the modulus, in which a draw of it is solved
ORGAN_KPA, AROUND_KPA = 20.0, 10.0
TRUTH_EDGE = 0.7  # of the estimate's
LATTICE_MM, ROUND_MM = 4.0, 6.0
SD_MM = 0.05
START = 2.0  # times the surroundings' modulus
MAX_STEPS = 150  # of L-BFGS
ENDS = 1e-5  # relative reduction of the objective
Say = Callable[[str], None]


@dataclass(frozen=True)
class _Task:
    """An estimate's space and what was measured; ln E of its organ's elements (n,) kPa in truth, their volumes (n,)."""

    space: LagrangeSpace
    wall: NDArray[np.bool_]
    offset: Array
    seen: PointDisplacement
    elements: NDArray[np.int64]
    known: Array
    volumes: Array

    def rms(self, log_moduli: Array) -> float:
        """Root mean square over the organ's volume of ln E (n,) less the true one."""
        return float(np.sqrt(np.average((log_moduli - self.known) ** 2, weights=self.volumes)))


def beside_a_peer(edge_mm: float, n_modes: int, seed: int, say: Say) -> dict[str, Any]:
    """Seconds and error of ln E of both, the peer's None where it is not installed."""
    task = _task(edge_mm, n_modes, np.random.default_rng(seed))
    began, cpu = time.perf_counter(), time.process_time()
    modes = material_modes(task.space.mesh, [_number(task.space, ORGAN)], length_mm=1.0)
    n_dofs, none = 3 * len(task.space.points), np.zeros((task.offset.size, 0))
    constraint = outer_constraint(task.space, outer="fixed", modes=none, offset=task.offset, prescribed=task.wall)
    model = linear_model(task.space, constraint, material=modes)
    tissues = task.space.mesh.tissues
    field = material_blocks(modes, task.space.mesh, (0,), heterogeneity_sd=0.0, poisson_sd=0.0)
    parameters = parameter_map(tissues, model.regions, [*unit_blocks(0), *field])
    problem = InverseProblem((LaterState(model, (task.seen,)),), parameters)
    bounds = Bounds(np.log([0.02]), np.log([200.0]))
    inversion = invert(problem, InversionSettings((np.log([START]),), bounds), progress=lambda _: None)
    estimated, processor = time.perf_counter() - began, time.process_time() - cpu
    variances = np.diag(sandwich_covariance(inversion.objective, inversion.minimum.evaluation))
    (found,) = stiffness_maps(inversion, variances)
    ours = np.log(AROUND_KPA) + inversion.minimum.unknowns[0] + found.log_ratio
    mean = np.full_like(ours, np.average(task.known, weights=task.volumes))
    row: dict[str, Any] = {
        "dofs": n_dofs,
        "elements": len(task.elements),
        "modes": modes.n_modes,
        "residuals": len(task.seen.measured),
        "estimate_s": round(estimated, 1),
        "processor_s": round(processor, 1),
        "with_posterior_s": round(time.perf_counter() - began, 1),
        "evaluations": inversion.evaluations,
        "rms_error": round(task.rms(ours), 3),
        "rms_error_of_one_modulus": round(task.rms(mean), 3),
        "sd": round(float(np.sqrt(np.average(found.sd**2, weights=task.volumes))), 3),
    }
    say(f"{row}")
    peer = _torch_fem(task, modes.fields[task.elements].toarray(), constraint.free.tocoo().row)
    if peer is None:
        return row | {"torch_fem": None}
    theirs = peer.pop("log_moduli")
    apart = float(np.sqrt(np.average((theirs - ours) ** 2, weights=task.volumes)))
    return row | {"torch_fem": peer | {"rms_error": round(task.rms(theirs), 3), "rms_difference": round(apart, 3)}}


def _task(edge_mm: float, n_modes: int, rng: np.random.Generator) -> _Task:
    """A body that was moved on a finer mesh, seen on a lattice in and round its organ, meshed for the estimate."""
    prior = FieldPrior(PRIOR_SD, PRIOR_MM, modes=n_modes)
    tissues = (
        Tissue(WALL, Role.DRIVER, (1,)),
        Tissue(ORGAN, Role.ESTIMATE, (2,), youngs_modulus_kpa=ORGAN_KPA, field=prior),
        Tissue("surroundings", Role.KNOWN, (3,), youngs_modulus_kpa=AROUND_KPA),
    )
    parts = (ball(np.zeros(3), RADII_MM[0]), ball(np.zeros(3), RADII_MM[1]), None)
    anatomy = Anatomy(tissues, parts, grid_box(centred_grid((BOX_MM,) * 3, (1.0, 1.0, 1.0))))
    motion = BoundaryMotion({WALL: AffineMotion(GROWTH, np.zeros(3), np.zeros(3))})
    fine = lagrange_space(tetrahedralise(anatomy, edge_length_mm=TRUTH_EDGE * edge_mm), "P2")
    modes = material_modes(fine.mesh, [_number(fine, ORGAN)], length_mm=PRIOR_MM).fields
    drawn = PRIOR_SD * np.asarray(modes @ rng.normal(size=modes.shape[1]))
    stiff = patched(fine.mesh, drawn, levels=LEVELS)
    (moved,) = displacements(replace(fine, mesh=stiff), [motion], law=law_named("linear"))

    space = lagrange_space(tetrahedralise(anatomy, edge_length_mm=edge_mm), "P2")
    reach = RADII_MM[1] + ROUND_MM
    lattice = np.stack(np.meshgrid(*[np.arange(-reach, reach, LATTICE_MM)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    lattice = lattice[located(space.mesh, lattice).inside & located(fine.mesh, lattice).inside]
    after = lattice + point_interpolation(fine, located(fine.mesh, lattice)) @ moved
    after = after + SD_MM * rng.normal(size=after.shape)
    file = DataFile("field", "displacement-field", (Path("simulated.csv"),), 1, SD_MM)
    seen, _ = DisplacementField(file, PointTable(lattice, after, ("",) * len(lattice), ())).on(space, _no_force)

    mesh, points = space.mesh, np.unique(space.facets(space.mesh.boundary[space.mesh.beyond == _number(space, WALL)]))
    wall, offset = np.zeros(len(space.points), dtype=bool), np.zeros_like(space.points)
    wall[points], offset[points] = True, motion.walls[WALL].at(space.points[points])
    elements = np.flatnonzero(mesh.region == _number(space, ORGAN))
    known = np.log(ORGAN_KPA) + drawn[located(fine.mesh, mesh.nodes[mesh.tets[elements]].mean(axis=1)).tet]
    assert isinstance(seen, PointDisplacement)
    return _Task(space, wall, offset.ravel(), seen, elements, known, mesh.volumes[elements])


def _number(space: LagrangeSpace, name: str) -> int:
    return next(i for i, tissue in enumerate(space.mesh.tissues) if tissue.name == name)


def _no_force(name: str, direction: Array) -> NoReturn:
    raise AssertionError(f"a field needs no force on {name} along {direction}")


def _torch_fem(task: _Task, fields: Array, free: NDArray[np.int32]) -> dict[str, Any] | None:
    """torch-fem's displacement and its backward pass in SciPy's L-BFGS-B over ln E of the organ and the field's modes.

    fields (n, n_modes): of the elements, times the prior's standard deviation the modes of independent unknowns of
    variance 1; free (n_free,): numbers of the displacement's free unknowns.
    """
    if (modules := torch_fem_modules()) is None:
        return None
    torch, solid, elastic = modules
    torch.sparse.check_sparse_tensor_invariants.disable()
    space, seen, mesh = task.space, task.seen, task.space.mesh
    prior = mesh.tissues[_number(space, ORGAN)].field
    assert prior is not None
    modes, elements = torch.tensor(prior.sd * fields), torch.tensor(task.elements)
    nodes, cells = torch.tensor(space.points), torch.tensor(space.cells)
    poisson = torch.tensor([tissue.poisson_ratio for tissue in mesh.tissues])[torch.tensor(mesh.region)]
    held = torch.ones(3 * len(space.points), dtype=torch.bool)
    held[torch.tensor(np.unique(free))] = False
    offset = torch.tensor(task.offset).reshape(-1, 3)
    design, dofs = sparse.csr_matrix(seen.whitening @ seen.interpolation), torch.tensor(seen.dofs)
    operator = torch.sparse_csr_tensor(design.indptr, design.indices, design.data, design.shape)
    data, sd = torch.tensor(seen.whitening @ seen.measured), float(seen.noise_model.sd)
    evaluations = 0

    def value_and_gradient(unknowns: Array) -> tuple[float, Array]:
        """Minus the log-posterior at [ln E, coefficients] (1 + n_modes,)."""
        nonlocal evaluations
        evaluations += 1
        x = torch.tensor(unknowns, requires_grad=True)
        moduli = torch.full((len(mesh.tets),), AROUND_KPA).index_put((elements,), torch.exp(x[0] + modes @ x[1:]))
        body = solid.Solid(nodes, cells, elastic.IsotropicElasticity3D(moduli, poisson))
        body.constraints, body.displacements = held.reshape(-1, 3), offset
        moved = body.solve(differentiable_parameters=(x,), method="direct")[0].ravel()
        residual = (operator @ moved[dofs] - data) / sd
        value = 0.5 * residual @ residual + 0.5 * x[1:] @ x[1:]
        value.backward()
        return float(value.detach()), np.asarray(x.grad.numpy())

    start = np.append(np.log(START * AROUND_KPA), np.zeros(fields.shape[1]))
    began, cpu = time.perf_counter(), time.process_time()
    found = optimize.minimize(
        value_and_gradient, start, jac=True, method="L-BFGS-B", options={"maxiter": MAX_STEPS, "ftol": ENDS}
    )
    return {
        "estimate_s": round(time.perf_counter() - began, 1),
        "processor_s": round(time.process_time() - cpu, 1),
        "gradients": evaluations,
        "ended": str(found.message),
        "log_moduli": found.x[0] + prior.sd * fields @ found.x[1:],
    }
