"""E1 to E6, checks of the estimator: recovery, scale, coverage, gradients, information, parameters at a bound."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.inversion import (
    Inversion,
    InversionSettings,
    Objective,
    gauss_newton,
    invert,
    with_first_noise,
)
from palpate.mechanics import ForwardModel, LinearModel
from palpate.mesh import lagrange_space
from palpate.observation import NoiseModel
from palpate.phantoms import smooth_field
from palpate.statement import verdict
from palpate.uncertainty import NORMAL_95, log_interval, sandwich_covariance
from palpate_validation.problems.concentric import SENSITIVITIES, hollow_spheres, radial
from palpate_validation.problems.contract import Check, Problem, checked
from palpate_validation.problems.inflation import NEO, NU, bore_of, inflated_model, youngs
from palpate_validation.problems.twin import TRUTH, noise_of, settings_from, twin_model, twin_problem
from palpate_validation.structured_meshes import known, octant_mesh

__all__ = ["ESTIMATOR_PROBLEMS", "coverage", "gradient_error", "recovered"]

Array = NDArray[np.float64]

REPEATS = 200
PASSES = 4  # of closest points and minimum
NOISE_SD, NOISE_LENGTH = 0.015, 4.0  # mm
SHARP = (1e-3, 3.0)  # law of residuals of images without noise, mm
SOURCE = "truth of the simulated case (B4, closed form)"


def _inverted(model: LinearModel, settings: InversionSettings, noise: NoiseModel) -> Inversion:
    return invert(twin_problem(model, stated_noise=noise), settings, progress=lambda _: None)


def recovered(n_surface: int, start: float) -> Array:
    """Moduli (2,) kPa of core and middle on a mesh with n_surface cells, both started at `start` of the outer one's."""
    found = _inverted(twin_model(n_surface), settings_from(np.full(2, start)), noise_of(*SHARP))
    return np.asarray(TRUTH[2] * np.exp(found.minimum.unknowns))


def coverage(repeats: int, seed: int) -> Array:
    """Share (2,), dimensionless, of noisy repeats whose 95 % interval holds the truth of core and middle.

    Each repeat moves the later surfaces by a smooth random field, minimises anew and makes its own interval.
    """
    model, rng = twin_model(8), np.random.default_rng(seed)
    stated, settings = noise_of(NOISE_SD, NOISE_LENGTH), settings_from(np.ones(2))
    first = _inverted(model, settings, stated)
    approximation, start = first.objective.states[0].approximation, first.minimum.unknowns
    assert approximation is not None
    truth, inside = np.log(TRUTH[:2] / TRUTH[2]), np.zeros(2)
    for _ in range(repeats):
        noise = smooth_field(rng, sd_mm=NOISE_SD, correlation_mm=NOISE_LENGTH, features=200)
        problem = twin_problem(model, noise, stated_noise=stated)
        objective = with_first_noise(Objective(problem.states, problem.parameters).with_approximations([approximation]))
        unknowns = start
        for _ in range(PASSES):
            objective = objective.rematched(unknowns)
            found = gauss_newton(objective, unknowns, bounds=settings.bounds)
            unknowns = found.unknowns
        sd = np.sqrt(np.diag(sandwich_covariance(objective, found.evaluation)))
        inside += np.abs(found.unknowns - truth) < NORMAL_95 * sd
    return np.asarray(inside / repeats)


def gradient_error(model: ForwardModel, moduli: Array, amounts: Array, step: float) -> float:
    """Largest difference of adjoint gradient and central differences of 1/2 |u|^2 by ln E, over the largest slope."""
    here = model.solve(moduli, amounts)
    slope = here.adjoint(here.values)[: len(moduli)]
    differences = np.zeros(len(moduli))
    for i in range(len(moduli)):
        ends = [
            model.solve(moduli * np.exp(sign * step * np.eye(len(moduli))[i]), amounts).values for sign in (1.0, -1.0)
        ]
        differences[i] = (ends[0] @ ends[0] - ends[1] @ ends[1]) / (4.0 * step)
    return float(np.abs(differences - slope).max() / np.abs(slope).max())


def _recovery_checks() -> tuple[Check, ...]:
    coarse, fine = recovered(8, 1.0), recovered(16, 1.0)
    order = np.log2(np.abs(coarse / TRUTH[:2] - 1.0) / np.abs(fine / TRUTH[:2] - 1.0))
    return tuple(
        Check(f"E of {name} (kPa)", float(truth), float(value), 1.0, order=float(rate))
        for name, truth, value, rate in zip(("core", "middle"), TRUTH, fine, order, strict=False)
    )


def _scale_checks() -> tuple[Check, ...]:
    """No modulus is known: the derivatives by ln E sum to zero, and the estimate is of ratios."""
    model = twin_model(8, outer_known=False)
    tangent = model.solve(TRUTH, np.zeros(0)).tangent()
    together = float(np.abs(tangent.sum(axis=1)).max() / np.abs(tangent).max())
    mapping = twin_problem(model).parameters
    word, _ = verdict((0.9, 1.1), at_bound=False, absolute=mapping.absolute)
    return (
        Check("du by a common factor of all moduli, over the largest part", 0.0, together, 1e-7, scale=1.0),
        Check("moduli that can be told, of three", 2.0, float(len(mapping.tissues)), 0.0),
        Check("stated as a ratio only (1: yes)", 1.0, float(word == "ratio only"), 0.0),
    )


def _coverage_checks() -> tuple[Check, ...]:
    found = coverage(REPEATS, seed=3)
    return tuple(
        Check(
            f"95 % intervals of {name} that hold the truth, of {REPEATS} (%)",
            94.0,
            100.0 * float(share),
            4.0,
            scale=100.0,
        )
        for name, share in zip(("core", "middle"), found, strict=True)
    )


def _gradient_checks() -> tuple[Check, ...]:
    linear = gradient_error(hollow_spheres(), TRUTH, np.ones(1), 1e-4)
    tissues = [known("inner", nu=NU), known("outer", nu=NU)]
    space = lagrange_space(octant_mesh(np.array([10.0, 15.0, 20.0]), [1, 1], 6, tissues), "P2")
    model = inflated_model(space, bore_of(space.mesh, 10.0), NEO)
    finite = gradient_error(model, youngs(model, [10.0, 30.0]), np.array([0.2]), 1e-3)
    return (
        Check("adjoint against central differences, linear (B4)", 0.0, linear, 1e-4, scale=1.0),
        Check("adjoint against central differences, neo-Hookean (B12)", 0.0, finite, 1e-4, scale=1.0),
    )


def _information_checks() -> tuple[Check, ...]:
    model = hollow_spheres(12)
    tangent = radial(model) @ model.solve(TRUTH, np.array([5.0])).tangent()[:, :3]
    found, expected = (np.linalg.svd(matrix)[1] for matrix in (tangent, SENSITIVITIES))
    names = (f"singular value {i} of the log-sensitivities (mm)" for i in (1, 2))
    return checked(dict(zip(names, map(float, expected), strict=True)), found, 0.5)


def _bound_checks() -> tuple[Check, ...]:
    """The truth of the core (1/3) lies below the lower bound (1/2)."""
    found = _inverted(twin_model(8), settings_from(np.ones(2), lower=0.5), noise_of(*SHARP))
    ratio = float(np.exp(found.minimum.unknowns[0]))
    interval = log_interval(ratio, 0.05, lower=0.5, upper=10.0)
    word, _ = verdict(interval, at_bound=abs(ratio / 0.5 - 1.0) < 1e-6, absolute=True)
    return (
        Check("estimate of the core, over its bound", 1.0, ratio / 0.5, 1e-4),
        Check("called not identified (1: yes)", 1.0, float(word == "not identified"), 0.0),
        Check("interval left open (1: yes)", 1.0, float(interval[0] is None), 0.0),
    )


ESTIMATOR_PROBLEMS = (
    Problem("E1", "Twin recovery without an inverse crime", SOURCE, _recovery_checks, quick=False),
    Problem("E2", "Scale invariance is detected and reported", "exact: K(cE) = c K(E)", _scale_checks),
    Problem("E3", "Coverage of the 95 % intervals", "90 to 98 % of the repeats", _coverage_checks, quick=False),
    Problem("E4", "Gradients against central differences", "exact: adjoint identity", _gradient_checks),
    Problem(
        "E5",
        "Information of the displacements",
        "singular values of B4's closed form",
        _information_checks,
        quick=False,
    ),
    Problem("E6", "A parameter at its bound is refused an interval", SOURCE, _bound_checks),
)
