"""Poisson's ratio of a tissue as an unknown: its derivative, its chain, and its place beside the log-moduli."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from palpate.approximation import exact_approximation, reduced_basis
from palpate.errors import ConfigurationError
from palpate.inversion import InverseProblem, LaterState, Objective, invert, posterior_sd
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.finite_strain import finite_strain_model
from palpate.mechanics.laws.registry import law_named
from palpate.mechanics.linear_model import LinearModel, linear_model
from palpate.observation.noise_model import NoiseModel
from palpate.unknowns import ParameterMap, parameter_map, unit_blocks

NOISE = NoiseModel(np.array([0.03**2]), np.array([3.0]))
KINDS = [("P1", Dilatation.POINTWISE), ("P2", Dilatation.MEAN), ("P2", Dilatation.BLENDED)]
RATIOS = [0.2, 0.45, 0.499]


def eta_of(ratio):
    """ln(lambda / mu)."""
    return np.log(2.0 * ratio / (1.0 - 2.0 * ratio))


@dataclass(frozen=True)
class Open:
    """A twin whose gland's Poisson's ratio is open, with the map of its unknowns: two log-moduli, eta, coefficients."""

    model: LinearModel
    parameters: ParameterMap

    def unknowns(self, ratio, theta=(0.9, 0.5), q=None):
        return np.concatenate([theta, [eta_of(ratio)], np.full(self.model.n_modes, 0.3) if q is None else q])


def opened(twin, dilatation):
    space, own = twin.model.space, {"open_poisson": ("gland",), "dilatation": dilatation}
    model = linear_model(space, twin.model.constraint, **own)
    return Open(model, parameter_map(space.mesh.tissues, model.regions, unit_blocks(model.n_modes), **own))


@pytest.fixture(scope="module", params=KINDS, ids=lambda kind: f"{kind[0]}-{kind[1]}")
def kind(request, twins):
    element, dilatation = request.param
    twin = twins.make_twin(element=element, edge_length_mm=8.0)
    return twin, dilatation, opened(twin, dilatation)


@pytest.mark.parametrize("ratio", RATIOS)
def test_the_parts_are_the_tissue_with_that_ratio(kind, ratio):
    """The displacement is that of a model assembled with it, near incompressibility as elsewhere."""
    twin, dilatation, made = kind
    mesh = twin.model.space.mesh
    tissues = tuple(replace(t, poisson_ratio=ratio) if t.name == "gland" else t for t in mesh.tissues)
    fixed = replace(twin.model.space, mesh=replace(mesh, tissues=tissues))
    x = made.unknowns(ratio)
    expected = linear_model(fixed, twin.model.constraint, dilatation=dilatation).solve(
        10.0 * np.exp([0.9, 0.5, 0.0]), x[3:]
    )
    found = made.model.solve(made.parameters.moduli(x), x[3:])
    assert found.values == pytest.approx(expected.values, abs=1e-8 * np.abs(expected.values).max())


@pytest.mark.parametrize("ratio", RATIOS)
def test_the_derivative_of_the_displacement_leaves_a_remainder_of_second_order(kind, ratio, rng):
    """Taylor's test along eta and the log-moduli at once; the adjoint is the tangent's transpose."""
    _, _, made = kind
    x = made.unknowns(ratio)
    step = np.append(rng.normal(size=3), np.zeros(made.model.n_modes))

    def at(unknowns):
        return made.model.solve(made.parameters.moduli(unknowns), unknowns[3:])

    here = at(x)
    tangent = made.parameters.by_unknowns(here.tangent(), x)
    lengths = 2.0 ** -np.arange(3.0, 7.0)
    rest = [np.linalg.norm(at(x + h * step).values - here.values - h * tangent @ step) for h in lengths]
    orders = np.log2(np.array(rest[:-1]) / rest[1:])
    assert np.all(np.abs(orders - 2.0) < 0.2)
    pull = rng.normal(size=len(here.values))
    assert made.parameters.by_unknowns(here.adjoint(pull)[None], x)[0] == pytest.approx(tangent.T @ pull, rel=1e-6)


@pytest.mark.parametrize("approximate", ["exact", "reduced"])
def test_the_score_of_the_objective_has_that_by_poissons_ratio(twin, point_motion, approximate):
    """Each approximation made at the place, against differences of its own values; by points, which do not slide."""
    made, points, motion = opened(twin, Dilatation.POINTWISE), twin.model.space.points, twin.scene.displacement
    seen = (point_motion.point_motion(n, points[n], motion[n], sd_mm=0.01) for n in range(0, len(points), 7))
    state = LaterState(made.model, tuple(seen))
    x = made.unknowns(0.4, q=0.8 * twin.coefficients)
    (at,) = Objective((state,), made.parameters).linearisation_points(x)
    basis = reduced_basis(made.model, at.moduli).with_modulus_series(at.coefficients, made.parameters.derivatives(x))
    stands_in = {"exact": exact_approximation(made.model, None, at), "reduced": basis.update(at)}[approximate]
    objective = Objective((state.with_approximation(stands_in),), made.parameters).rematched(x)
    step = np.append([0.3, -0.2, 1.0], np.zeros(made.model.n_modes))
    h = 1e-4
    slope = (objective(x + h * step).value - objective(x - h * step).value) / (2.0 * h)
    assert objective(x).score @ step == pytest.approx(slope, rel=1e-5)
    assert abs(objective(x).score[2]) > max(1.0, 0.01 * abs(slope))


def test_the_reduced_basis_keeps_its_bound_over_poissons_ratio(twin):
    made = opened(twin, Dilatation.POINTWISE)
    x = made.unknowns(0.4)
    (at, there) = (Objective((), made.parameters).linearisation_points(of)[0] for of in (x, made.unknowns(0.48)))
    basis = reduced_basis(made.model, at.moduli)
    truth, stated = (m.solve(there.moduli, there.coefficients).values for m in (made.model, basis.model))
    energies = [v @ made.model.forces(there.moduli, v[:, None])[:, 0] for v in (stated - truth, truth)]
    assert 1e-4 < np.sqrt(energies[0] / energies[1]) <= basis.error(there).relative
    assert basis.update(there).error(there).relative < 1e-4


@pytest.mark.parametrize("unknowns", [0.0, 0.7])
def test_the_chain_is_the_derivative_of_the_moduli(twin, unknowns):
    mapping = opened(twin, Dilatation.BLENDED).parameters
    x = np.full(mapping.n_unknowns, unknowns)
    steps = 1e-5 * np.eye(mapping.n_unknowns)[:3]
    slopes = [np.log(mapping.moduli(x + s) / mapping.moduli(x - s)) / 2e-5 for s in steps]
    assert mapping.derivatives(x) == pytest.approx(np.stack(slopes, axis=1), abs=1e-8)


def test_poissons_ratio_is_found_with_the_moduli(twins, twin):
    """The phantom has 0.45 everywhere; the search begins at 0.33 and 0.48."""
    made, exact = opened(twin, Dilatation.POINTWISE), twins.exact_problem(twin, noise=NOISE)
    problem = InverseProblem((LaterState(made.model, exact.states[0].observations),), made.parameters)
    settings = twins.settings(2.0, 24.0, n=3)
    inversion = invert(problem, settings, progress=twins.silent)
    assert inversion.minimum.converged
    off = inversion.minimum.unknowns[:3] - np.append(twins.TRUTH, eta_of(0.45))
    assert np.all(np.abs(off) < 0.05 * posterior_sd(inversion.minimum, 3))
    assert made.parameters.poisson[0].ratio(inversion.minimum.unknowns) == pytest.approx(0.45, abs=2e-3)


def test_a_model_without_the_parts_is_refused(twin):
    model = twin.model
    with pytest.raises(ConfigurationError, match="open_poisson"):
        parameter_map(model.space.mesh.tissues, model.regions, unit_blocks(model.n_modes), open_poisson=("gland",))


def test_under_another_law_no_poissons_ratio_is_sought(twins, twin):
    made, exact = opened(twin, Dilatation.POINTWISE), twins.exact_problem(twin, noise=NOISE)
    law = finite_strain_model(twin.model.space, twin.model.constraint, law_named("neo-hookean"))
    state = LaterState(made.model, exact.states[0].observations, finite_strain=law)
    with pytest.raises(ConfigurationError, match="linear law only"):
        invert(InverseProblem((state,), made.parameters), twins.settings(1.0, n=3), progress=twins.silent)
