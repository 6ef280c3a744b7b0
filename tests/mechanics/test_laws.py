"""What every elastic law must obey, and what each is at small strain."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from dataclasses import replace

import numpy as np
import pytest

import palpate.mechanics.laws
from palpate.errors import ConfigurationError
from palpate.mechanics.laws.contract import Law, energy, stress, tangent
from palpate.mechanics.laws.mooney_rivlin import MooneyRivlin
from palpate.mechanics.laws.registry import LAWS, law_named
from palpate.mechanics.stiffness import lame_parameters

LAME, MU = lame_parameters(7.0, 0.45)
CONSTANTS = {"mu": MU, "lame": LAME}
FINITE = sorted(name for name, law in LAWS.items() if law.finite)


@pytest.fixture(params=sorted(LAWS))
def law(request):
    return LAWS[request.param]


@pytest.fixture
def gradients(rng):
    """Deformation gradients (n, 3, 3) with large strains and rotations and J between 0.5 and 2."""
    F = np.eye(3) + 0.4 * rng.standard_normal((200, 3, 3))
    J = np.linalg.det(F)
    F = F[(J > 0.5) & (J < 2.0)]
    assert len(F) > 20
    return F


def rotations(rng, n):
    q, _ = np.linalg.qr(rng.standard_normal((n, 3, 3)))
    return q * np.linalg.det(q)[:, None, None]


def differences(function, F, step=1e-6):
    """Central differences (n, ..., 3, 3) of a function of F."""
    columns = []
    for k in range(3):
        for m in range(3):
            shift = np.zeros((3, 3))
            shift[k, m] = step
            columns.append((function(F + shift) - function(F - shift)) / (2.0 * step))
    return np.stack(columns, axis=-1).reshape(*columns[0].shape, 3, 3)


def test_every_law_that_there_is_has_a_name_in_the_registry():
    members = [name for name in vars(Law) if not name.startswith("_")]
    found = set()
    for module in pkgutil.walk_packages(palpate.mechanics.laws.__path__, "palpate.mechanics.laws."):
        for _, kind in inspect.getmembers(importlib.import_module(module.name), inspect.isclass):
            if kind is not Law and all(hasattr(kind, member) for member in members):
                found.add(kind)
    assert found == {type(law) for law in LAWS.values()}


def test_stress_is_the_derivative_of_the_energy(law, gradients):
    expected = differences(lambda F: energy(law, F, **CONSTANTS), gradients)
    assert np.allclose(stress(law, gradients, **CONSTANTS), expected, atol=1e-7 * abs(expected).max())


def test_tangent_is_the_derivative_of_the_stress(law, gradients):
    expected = differences(lambda F: stress(law, F, **CONSTANTS), gradients)
    assert np.allclose(tangent(law, gradients, **CONSTANTS), expected, atol=1e-7 * abs(expected).max())


def test_tangent_has_the_symmetry_of_a_second_derivative(law, gradients):
    A = tangent(law, gradients, **CONSTANTS)
    assert np.allclose(A, A.transpose(0, 3, 4, 1, 2), atol=1e-12 * abs(A).max())


def test_the_rest_state_is_free_of_energy_and_stress(law):
    rest = np.eye(3)[None]
    assert abs(energy(law, rest, **CONSTANTS)).max() < 1e-14
    assert abs(stress(law, rest, **CONSTANTS)).max() < 1e-13


def test_every_law_has_lames_constants_at_small_strain(law):
    identity = np.eye(3)
    A = tangent(law, identity[None], **CONSTANTS)[0]
    expected = LAME * np.einsum("ij,kl->ijkl", identity, identity)
    expected += MU * (np.einsum("ik,jl->ijkl", identity, identity) + np.einsum("il,jk->ijkl", identity, identity))
    assert np.allclose(A, expected, atol=1e-12 * LAME)


@pytest.mark.parametrize("name", FINITE)
def test_finite_laws_do_not_feel_a_superposed_rotation(name, gradients, rng):
    law, Q = LAWS[name], rotations(rng, len(gradients))
    assert np.allclose(energy(law, Q @ gradients, **CONSTANTS), energy(law, gradients, **CONSTANTS), rtol=1e-11)
    turned, P = stress(law, Q @ gradients, **CONSTANTS), stress(law, gradients, **CONSTANTS)
    assert np.allclose(turned, Q @ P, atol=1e-11 * abs(P).max())


@pytest.mark.parametrize("name", FINITE)
def test_finite_laws_are_isotropic(name, gradients, rng):
    law, Q = LAWS[name], rotations(rng, len(gradients))
    assert np.allclose(energy(law, gradients @ Q, **CONSTANTS), energy(law, gradients, **CONSTANTS), rtol=1e-11)


def test_the_linear_law_takes_a_large_rotation_for_strain(rng):
    turn = rotations(rng, 1)
    assert energy(LAWS["linear"], turn, **CONSTANTS)[0] > 0.1


def test_finite_laws_become_the_linear_law_as_strains_vanish(rng):
    H = rng.standard_normal((20, 3, 3))
    for name in FINITE:
        gaps = []
        for size in (1e-3, 1e-4):
            F = np.eye(3) + size * H
            small = stress(LAWS["linear"], F, **CONSTANTS)
            gaps.append(abs(stress(LAWS[name], F, **CONSTANTS) - small).max() / abs(small).max())
        assert gaps[1] < 0.11 * gaps[0] < 0.01


def test_neo_hookean_stress_is_the_closed_form(gradients):
    """P = mu (F - F^-T) + lambda ln J F^-T."""
    inverse = np.swapaxes(np.linalg.inv(gradients), 1, 2)
    log = np.log(np.linalg.det(gradients))[:, None, None]
    expected = MU * (gradients - inverse) + LAME * log * inverse
    assert np.allclose(stress(LAWS["neo-hookean"], gradients, **CONSTANTS), expected, atol=1e-12 * abs(expected).max())


def test_mooney_rivlin_energy_is_the_closed_form(gradients):
    """W = c10 (I1 - 3) + c01 (I2 - 3) - 2 (c10 + 2 c01) ln J + (lambda/2 - 2 c01) (ln J)^2, mu = 2 (c10 + c01)."""
    ratio = 0.4
    c10 = 0.5 * MU / (1.0 + ratio)
    c01 = ratio * c10
    C = np.swapaxes(gradients, 1, 2) @ gradients
    first = np.trace(C, axis1=1, axis2=2)
    second = 0.5 * (first**2 - np.trace(C @ C, axis1=1, axis2=2))
    log = np.log(np.linalg.det(gradients))
    expected = c10 * (first - 3) + c01 * (second - 3) - 2 * (c10 + 2 * c01) * log + (LAME / 2 - 2 * c01) * log**2
    found = energy(law_named("mooney-rivlin", c01_over_c10=ratio), gradients, **CONSTANTS)
    assert np.allclose(found, expected, rtol=1e-12)


def test_mooney_rivlin_without_its_second_term_is_neo_hookean(gradients):
    plain = replace(MooneyRivlin(), c01_over_c10=0.0)
    assert np.allclose(
        stress(plain, gradients, **CONSTANTS), stress(LAWS["neo-hookean"], gradients, **CONSTANTS), atol=1e-12
    )


def test_an_unknown_law_is_refused_with_the_names_of_all():
    with pytest.raises(ConfigurationError, match=r"mooney-rivlin.*neo-hookean"):
        law_named("ogden")


@pytest.mark.parametrize("ratio", [-0.1, np.nan, np.inf])
def test_an_impossible_mooney_ratio_is_refused(ratio):
    with pytest.raises(ConfigurationError, match="c01_over_c10"):
        law_named("mooney-rivlin", c01_over_c10=ratio)


def test_fung_energy_is_the_closed_form(gradients):
    """W = mu/(2 b) (exp(b (I1 - 3 - 2 ln J)) - 1) + lambda/2 (ln J)^2."""
    b = 1.5
    log = np.log(np.linalg.det(gradients))
    first = np.einsum("nij,nij->n", gradients, gradients)
    expected = MU / (2.0 * b) * (np.exp(b * (first - 3.0 - 2.0 * log)) - 1.0) + LAME / 2.0 * log**2
    assert np.allclose(energy(law_named("fung", fung_exponent=b), gradients, **CONSTANTS), expected, rtol=1e-12)


def test_fung_with_a_small_exponent_is_neo_hookean(gradients):
    found = stress(law_named("fung", fung_exponent=1e-9), gradients, **CONSTANTS)
    assert np.allclose(found, stress(LAWS["neo-hookean"], gradients, **CONSTANTS), rtol=1e-7)


@pytest.mark.parametrize("b", [5.0, 44.0])
def test_a_pull_that_keeps_volume_stiffens_fung_by_one_and_nine_times_b_times_the_squared_strain(b):
    """To second order in the strain, along the axis of the pull: the true stress over that of small strains."""

    def pulled(law, strain):
        stretch = 1.0 + strain
        F = np.diag([stretch, stretch**-0.5, stretch**-0.5])[None]
        P = stress(law, F, **CONSTANTS)[0]
        return P[0, 0] * stretch - P[1, 1] * stretch**-0.5  # the pressure falls out

    strain, step = 0.1 / np.sqrt(9.0 * b), 1e-6
    laws = law_named("fung", fung_exponent=b), LAWS["neo-hookean"]
    found, plain = (pulled(law, strain + step) - pulled(law, strain - step) for law in laws)
    assert found / plain == pytest.approx(1.01, abs=2e-3)


@pytest.mark.parametrize("b", [0.0, -1.0, np.inf, np.nan])
def test_an_exponent_that_makes_no_law_is_refused(b):
    with pytest.raises(ConfigurationError, match="fung_exponent"):
        law_named("fung", fung_exponent=b)
