"""Three balls under a known pull: equilibrium, scale, both methods on their own mesh, both laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.mechanics.linear_model import linear_model
from palpate.observation.observed_surface import observed_surface
from palpate.unknowns import parameter_map, unit_blocks
from palpate_validation.paper.balls import (
    BODIES,
    Balls,
    balls_space,
    balls_tissues,
    floating,
    mean_deformations,
    pulled,
    random_grid,
)
from palpate_validation.paper.columns import paper_estimate, paper_target
from palpate_validation.paper.figure4 import LAW, Figure4Settings, figure4, nominal_stress
from palpate_validation.paper.staging import ORGANS, CohortSettings, estimate_patient, patient_space, true_moduli
from palpate_validation.paper.table1 import Table1Settings, table1
from palpate_validation.scenes import Ledger

TINY = Balls(radii_mm=(8.0, 14.0, 20.0), edge_mm=8.0, truth_edge_mm=6.0)
MODULI = np.array([50.0, 100.0, 150.0])


@pytest.fixture(scope="module")
def model():
    space = balls_space(TINY, TINY.edge_mm, element="P1")
    return linear_model(space, floating(space), loads=(pulled(space, 10.0),))


def test_the_pull_is_in_equilibrium(model):
    forces = model.load.reshape(-1, 3)
    assert abs(forces).max() > 1.0
    assert forces.sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-9)
    assert np.cross(model.space.points, forces).sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-8)


def test_balls_of_one_modulus_are_deformed_alike(model):
    u = model.solve(np.full(3, 100.0), np.zeros(6)).displacement
    assert mean_deformations(model.space, u) == pytest.approx(np.full(3, 0.1), rel=1e-4)
    terms = np.column_stack([model.space.points, np.ones(len(u))])
    affine = np.linalg.lstsq(terms, u, rcond=None)[0]
    assert u == pytest.approx(terms @ affine, abs=1e-7)
    assert 0.5 * (affine[:3] + affine[:3].T) == pytest.approx(np.diag([0.1, -0.045, -0.045]), abs=1e-8)


def test_nothing_resists_where_the_rigid_motion_is_held(model):
    u = model.solve(MODULI, np.zeros(6)).displacement
    forces = model.forces(MODULI, u.ravel()[:, None])[:, 0]
    assert forces == pytest.approx(model.load, abs=1e-7)


def test_the_load_sets_a_scale_and_without_it_there_are_ratios_only(model):
    once, twice = (model.solve(f * MODULI, np.zeros(6)).displacement for f in (1.0, 2.0))
    assert twice == pytest.approx(0.5 * once, abs=1e-9)
    tissues = balls_tissues(tuple(MODULI))
    assert parameter_map(tissues, model.regions, unit_blocks(6), loaded=True).absolute
    assert not parameter_map(tissues, model.regions, unit_blocks(6)).absolute


def test_the_papers_gradient_leads_downhill_to_the_moduli_that_made_its_data(model):
    u = model.solve(MODULI, np.zeros(6)).displacement
    targets = [paper_target(model.space, u, observed_surface(model.space, body)) for body in range(3)]
    fit = paper_estimate(model, targets, moduli=0.5 * MODULI, columns=np.arange(3))
    assert fit.converged
    assert fit.moduli == pytest.approx(MODULI, rel=0.02)
    assert 3 < fit.iterations <= fit.evaluations < 80


def test_random_grids_hold_the_balls(model):
    grids = [random_grid(TINY, np.random.default_rng(seed)) for seed in (1, 2)]
    for grid in grids:
        index = grid.index(1.1 * model.space.points)
        assert index.min() > 0.0
        assert np.all(index < np.array(grid.shape) - 1)
    assert np.abs(grids[0].affine - grids[1].affine).max() > 0.05


def test_same_mesh_gives_the_moduli_back_and_finished_columns_are_kept(tmp_path):
    settings = Table1Settings(balls=TINY, equal_kpa=(), different_kpa=(tuple(MODULI),))
    kept = Ledger(tmp_path / "parts.jsonl", "a")
    others = ("other_mesh", "voxels", "paper_method", "paper_method_other_mesh")
    stand_in = {"kpa": 50.0, "error_percent": 0.0, "interval95": None, "verdict": None, "iterations": 1}
    for column in others:
        kept.keep(f"50/100/150 {column}", dict.fromkeys(BODIES, stand_in))
    document = table1(settings).found(kept, progress=lambda _: None).to_dict()
    assert [row["body"] for row in document["rows"]] == list(BODIES)
    assert document["worst_error_percent"]["same_mesh"] < 0.01
    assert {row["columns"]["same_mesh"]["verdict"] for row in document["rows"]} == {"identified"}
    assert document["rows"][0]["paper_kpa"] is None


def test_small_stretches_obey_hooke_and_large_ones_do_not():
    assert nominal_stress(1.0001) == pytest.approx(1e-4, rel=1e-3)
    assert nominal_stress(1.3) < 0.27


def test_the_law_of_the_truth_is_right_where_the_linear_one_is_not():
    """At 30 % of deformation, too, where a round on first-order models leaves more than the square of its step."""
    settings = Figure4Settings(balls=replace(TINY, edge_mm=11.0), moduli_kpa=(tuple(MODULI),), deformations=(0.2, 0.3))
    found = figure4(settings).found(Ledger(None, ""), progress=lambda _: None)
    errors = {law: [abs(p.error_percent) for p in found.points if p.law == law] for law in ("linear", LAW)}
    assert max(errors["linear"]) > 5.0
    assert max(errors[LAW]) < 0.01
    assert all(5.0 < p.deformation_percent < 30.0 for p in found.points)


def test_a_patients_pairs_share_one_reduced_model():
    settings = CohortSettings(stages=(3,), pairs=(2,), edge_mm=16.0)
    found = estimate_patient(settings, 0, lambda _: None)
    assert found.true_kpa == true_moduli(settings, 0)
    assert found.dofs < 30_000
    assert found.largest_error_bound < 0.01
    for organ in ORGANS:
        assert len(found.kpa[organ]) + found.not_converged == 2
        assert len(set(found.kpa[organ])) == len(found.kpa[organ])  # each pair has its own motion and noise


def test_the_default_cohort_keeps_to_its_limit_of_unknowns():
    settings = CohortSettings()
    assert len(settings.stages) == len(settings.pairs) == 8
    assert sum(settings.pairs) == 180
    space = patient_space(settings, 2)[1]  # the largest of the eight
    assert 3 * len(space.points) <= 30_000
