"""Total variation as a prior: its derivatives, the normal laws that touch it, and that reweighting goes downhill."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from palpate.images.tissue import FieldPrior
from palpate.unknowns import Acts, Block
from palpate.unknowns.total_variation import ROUNDING, total_variation

PRIOR = FieldPrior(0.5, 6.0, total_variation=True)


@pytest.fixture(scope="module")
def gland(twin):
    """The twin's mesh, the elements of its gland, and a mode for each of them."""
    mesh = twin.model.space.mesh
    own = np.flatnonzero(mesh.region == 0)
    shape = (len(mesh.tets), len(own))
    return mesh, own, sparse.csr_matrix((np.ones(len(own)), (own, np.arange(len(own)))), shape=shape)


@pytest.fixture(scope="module")
def variation(gland):
    mesh, _, each = gland
    return total_variation(mesh, each, PRIOR)


@pytest.fixture
def data(variation, rng):
    """What data say of the elements: information (n, n) and pull (n,)."""
    n = variation.jumps.shape[1]
    seen = rng.normal(size=(n // 2, n))
    return seen.T @ seen, seen.T @ (seen @ np.where(np.arange(n) < n // 3, 1.1, 0.0) + rng.normal(size=n // 2))


def test_derivatives_are_those_of_the_value(variation, rng):
    x, along = rng.normal(size=(2, variation.jumps.shape[1]))
    remainders = []
    for step in (1e-2, 5e-3):
        to_second = step * variation.gradient(x) @ along + 0.5 * step**2 * along @ variation.curvature(x) @ along
        remainders.append(abs(variation.value(x + step * along) - variation.value(x) - to_second))
    assert np.log2(remainders[0] / remainders[1]) > 2.7


def test_the_touching_law_is_nowhere_above(variation, rng):
    at = rng.normal(size=variation.jumps.shape[1])
    precision = variation.lagged(at)

    def touching(x):
        return variation.value(at) + 0.5 * (x @ precision @ x - at @ precision @ at)

    assert touching(at) == pytest.approx(variation.value(at))
    for x in at + rng.normal(size=(20, len(at))):
        assert touching(x) > variation.value(x)
    assert np.linalg.eigvalsh(precision - variation.curvature(at)).min() > -1e-9


def test_every_reweighting_lowers_the_objective_and_they_end_where_its_gradient_is_zero(variation, data):
    information, pull = data
    x = np.zeros(len(pull))
    values = []
    for _ in range(12):
        x = variation.reweighted(information, pull, x)
        values.append(0.5 * x @ information @ x - pull @ x + variation.value(x))
    assert np.all(np.diff(values) < 0.0)
    least = variation.least(information, pull, np.zeros(len(pull)))
    slope = information @ least - pull + variation.gradient(least)
    assert np.abs(slope).max() < 1e-3 * np.abs(pull).max()
    at_least = 0.5 * least @ information @ least - pull @ least + variation.value(least)
    assert at_least <= values[-1] + 1e-3


def test_a_constant_costs_nothing_but_the_weak_law(variation):
    flat = np.full(variation.jumps.shape[1], 0.7)
    cost = variation.value(flat) - variation.value(np.zeros_like(flat))
    assert cost == pytest.approx(0.5 * flat @ variation.weak @ flat)


def test_an_inclusion_costs_its_surface_times_its_jump(gland, variation):
    mesh, own, _ = gland
    centres = mesh.nodes[mesh.tets[own]].mean(axis=1)
    half = centres[:, 2] > np.median(centres[:, 2])
    border = [face for face in variation.jumps if face @ half]
    for jump in (2.0, 4.0):
        x = jump * half
        cost = variation.weights @ np.abs(variation.jumps @ x)
        walls = variation.weights[np.abs(variation.jumps @ x) > 0.0].sum()
        assert cost == pytest.approx(jump * walls)
        rounded = variation.value(x) - 0.5 * x @ variation.weak @ x - variation.weights.sum() * variation.rounding
        assert rounded == pytest.approx(cost, abs=variation.rounding * walls)
    area = walls * PRIOR.sd * PRIOR.length_mm**2
    assert len(border) > 10
    assert np.pi * 7.0**2 < area < 3.0 * np.pi * 8.0**2  # the ball's cut, of 8 mm radius, along faces that zigzag
    assert variation.rounding == ROUNDING * PRIOR.sd


def test_combinations_of_a_block_keep_its_variation(variation, rng):
    n = variation.jumps.shape[1]
    block = Block("gland", "field", Acts.MATERIAL, (0,), np.eye(n) / PRIOR.sd**2, variation=variation)
    basis = np.linalg.qr(rng.normal(size=(n, n // 2)))[0]
    combined = block.combined(basis.T)
    z = rng.normal(size=n // 2)
    assert combined.variation is not None
    assert combined.variation.value(z) == pytest.approx(variation.value(basis @ z))
    assert replace(block, variation=None).combined(basis.T).variation is None


def test_its_normal_law_at_the_least_is_the_posterior_to_a_quarter_of_its_width(gland, variation, rng):
    mesh, own, _ = gland
    truth = 1.1 * (mesh.nodes[mesh.tets[own]].mean(axis=1)[:, 2] > 0.0)
    information = np.eye(len(own)) / 0.4**2
    pull = information @ (truth + 0.4 * rng.normal(size=len(own)))
    least = variation.least(information, pull, np.zeros(len(own)))
    curvature = information + variation.curvature(least)
    whiten = np.linalg.inv(np.linalg.cholesky(curvature))
    drawn = np.array(sampled(lambda x: information @ x - pull + variation.gradient(x), least, whiten, rng))
    ratio = np.sqrt(np.diag(np.linalg.inv(curvature))) / drawn.std(axis=0)
    assert 0.75 < np.median(ratio) < 1.02


def sampled(slope, start, whiten, rng, draws=1200, leaps=8, step=0.3):
    """Draws of the density with this slope of minus its logarithm, by Hamiltonian paths too short to need a refusal."""
    x, found = start, []
    for _ in range(draws):
        push = rng.normal(size=len(x)) - 0.5 * step * whiten @ slope(x)
        for _ in range(leaps):
            x = x + step * (whiten.T @ push)
            push = push - step * (whiten @ slope(x))
        found.append(x)
    return found
