"""The limit of benchmarks/cramer_rao.py: no estimate beats it, and its own weights attain it."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.inversion import Evaluation, LaterState, Objective
from palpate.inversion.objective import Linearisation
from palpate.mesh import lagrange_space, located, point_interpolation
from palpate.observation.contract import DataFile, Residuals, Weighting, seen_by
from palpate.observation.jacobian import Jacobian
from palpate.observation.noise_model import NoiseModel
from palpate.observation.point_displacement import point_displacement
from palpate.observation.point_table import PointTable, stated_sd
from palpate.observation.robust_loss import PowerLaw
from palpate.observation.surface_distance import SurfaceDistance
from palpate.phantoms.motion import smooth_field
from palpate.uncertainty import sandwich_covariance
from palpate.unknowns import Arrowhead, ParameterMap, unit_blocks
from palpate_validation.structured_meshes import box_mesh

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "cramer_rao.py"
NOISE = NoiseModel(np.array([0.3**2]), np.array([5.0]))
PRECISION = 200.0


@pytest.fixture(scope="module")
def limits():
    """The module, loaded by its path."""
    spec = importlib.util.spec_from_file_location("cramer_rao_benchmark", BENCHMARK)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def sphere(n=600, radius=15.0):
    """Places (n, 3) and normals of a Fibonacci lattice on a sphere."""
    k = np.arange(n) + 0.5
    height, turn = 1.0 - 2.0 * k / n, np.pi * (1.0 + np.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - height**2)
    normals = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height])
    return radius * normals, normals


def seen(jacobian):
    """Objective and evaluation of one surface on the sphere: two log-moduli, then modes of unit variance."""
    places, normals = sphere()
    n, weights = len(places), np.full(len(places), 1.0 / len(places))
    target = SimpleNamespace(area=np.ones(n), surface=SimpleNamespace(driver=False))
    surface = SurfaceDistance(target, None, NOISE, Weighting(PRECISION, PowerLaw()), stated_noise=NOISE)
    residuals = Residuals(np.zeros(n), weights, places, normals, places, None)
    line = Linearisation(surface, 0, residuals, np.arange(5), Jacobian.of(jacobian), weights, None, None)
    prior = np.diag([0.0, 0.0, 1.0, 1.0, 1.0])
    matrix = prior + PRECISION * jacobian.T @ (weights[:, None] * jacobian)
    evaluation = Evaluation(0.0, 0.0, np.zeros(5), Arrowhead.of(matrix), (line,), Arrowhead.of(prior), np.zeros(5))
    parameters = ParameterMap(np.ones(2), np.eye(2), ("a", "b"), "c", True, unit_blocks(3))
    return Objective((LaterState(None, (surface,)),), parameters), evaluation


def smooth_jacobian():
    x, y, z = sphere()[1].T
    return np.column_stack([0.3 * x * y, 0.3 * z, 0.4 * z + 0.2 * x, 0.5 * y, 0.3 * (z**2 - x**2)])


@pytest.fixture(scope="module")
def smooth():
    return seen(smooth_jacobian())


def test_no_estimate_beats_the_limit(limits, smooth):
    limit = limits.cramer_rao(smooth[1], NOISE, 2, cell_mm=5.0)
    assert np.linalg.eigvalsh(sandwich_covariance(*smooth) - 0.95 * limit).min() > 0.0
    assert np.linalg.eigvalsh(limit).min() > 0.0


def test_the_weights_of_the_limit_attain_it_under_noise_of_its_model(limits, smooth):
    now, rng = smooth[1], np.random.default_rng(20240511)
    places, normals = sphere()
    rows, *_ = limits.efficient_gain(now, NOISE, 2, cell_mm=5.0)
    kept = (
        np.eye(5)[:2] - rows @ now.linearisations[0].jacobian.dense
    )  # what is not seen of the unknowns comes from their prior
    assert kept[:, :2] == pytest.approx(np.zeros((2, 2)), abs=1e-9)  # no bias in the log-moduli
    fields = (smooth_field(rng, sd_mm=NOISE.sd, correlation_mm=5.0, features=100) for _ in range(400))
    draws = [rows @ np.einsum("na,na->n", field.at(places), normals) for field in fields]
    found = np.cov(np.transpose(draws)) + kept[:, 2:] @ np.linalg.solve(now.prior.dense[2:, 2:], kept[:, 2:].T)
    limit = limits.cramer_rao(now, NOISE, 2, cell_mm=5.0)
    assert np.sqrt(np.diag(found)) == pytest.approx(np.sqrt(np.diag(limit)), rel=0.12)


def test_cells_of_the_noises_length_lose_little(limits, smooth):
    fine, cells = (np.sqrt(np.diag(limits.cramer_rao(smooth[1], NOISE, 2, cell_mm=size))) for size in (2.0, 5.0))
    assert np.all(cells >= fine * (1.0 - 1e-9))
    assert np.all(cells < 1.1 * fine)


def test_roughness_of_single_faces_hardly_lowers_the_limit_of_cells(limits, smooth):
    """A derivative that is rough from face to face seems to tell the moduli from what smooth noise leaves alone.

    Of cells with five faces each the limit falls by 6 %, of single faces to a fifteenth.
    """
    jacobian, rng = smooth_jacobian(), np.random.default_rng(20240511)
    _, rough = seen(jacobian * (1.0 + 0.05 * rng.standard_normal((len(jacobian), 1))))
    single, cells, smooth_limit = (
        np.sqrt(np.diag(limits.cramer_rao(of, NOISE, 2, cell_mm=size)))
        for of, size in ((rough, 0.1), (rough, 5.0), (smooth[1], 5.0))
    )
    assert np.all(cells > 0.8 * smooth_limit)
    assert np.all(single < 0.4 * smooth_limit)


def test_points_tell_what_their_stated_covariance_leaves(limits, smooth):
    """J^T C^-1 J of all points, whatever noise the fit believes; beside surfaces informations add."""
    rng, space = np.random.default_rng(7), lagrange_space(box_mesh(2, size=30.0), "P2")
    points, tangent = rng.uniform(2.0, 28.0, (20, 3)), rng.normal(size=(3 * len(space.points), 5))
    root = rng.normal(size=(3, 3))
    file = DataFile("landmarks", "landmarks", (), 1, 0.4, covariance_mm2=root @ root.T + 0.1 * np.eye(3))
    places = located(space.mesh, points)
    table = PointTable(points, points, stated_sd(file, 20), ("",) * 20, ())
    term = point_displacement(space, table, places, file=file, description="")
    told = Jacobian.of(term.whitening @ seen_by(term, tangent))
    doubtful = term.with_noise(NoiseModel(np.array([4.0]), np.array([1.0])))
    line = Linearisation(doubtful, 0, None, np.arange(5), told, np.full(60, 1.0 / 60.0), None, None)
    evaluation = replace(smooth[1], linearisations=(*smooth[1].linearisations, line))
    whole = np.kron(point_interpolation(space, places).toarray(), np.eye(3)) @ tangent
    expected = whole.T @ np.linalg.solve(np.kron(np.eye(20), file.covariance_mm2), whole)
    alone, together = (limits.fisher_information(of, NOISE, cell_mm=5.0) for of in (smooth[1], evaluation))
    assert together - alone == pytest.approx(expected, rel=1e-9)
