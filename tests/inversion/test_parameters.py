"""From log-ratios to moduli: the scale is a known tissue's, and without one only ratios exist."""

from __future__ import annotations

import numpy as np
import pytest
from palpate.inversion.modulus_map import modulus_map

from palpate.errors import ConfigurationError
from palpate.images.tissue import Role, Tissue

GLAND, SAC = Tissue("gland", Role.ESTIMATE), Tissue("sac", Role.ESTIMATE)
TUBE = Tissue("tube", Role.DRIVER)
FAT = Tissue("fat", Role.KNOWN, youngs_modulus_kpa=10.0)
MUSCLE = Tissue("muscle", Role.KNOWN, youngs_modulus_kpa=40.0)


def test_moduli_are_ratios_times_the_first_known_modulus():
    mapping = modulus_map((GLAND, TUBE, MUSCLE, SAC, FAT), (0, 2, 3, 4))
    assert mapping.tissues == ("gland", "sac")
    assert (mapping.relative_to, mapping.scale_kpa, mapping.absolute) == ("muscle", 40.0, True)
    assert mapping.moduli(np.log([3.0, 0.5])) == pytest.approx([120.0, 40.0, 20.0, 10.0])


def test_without_a_known_modulus_the_first_estimate_is_the_scale():
    mapping = modulus_map((TUBE, GLAND, SAC), (1, 2))
    assert not mapping.absolute
    assert (mapping.relative_to, mapping.tissues, mapping.scale_kpa) == ("gland", ("sac",), 1.0)
    assert mapping.moduli(np.log([4.0])) == pytest.approx([1.0, 4.0])


def test_the_pullback_is_the_derivative_of_the_map(rng):
    mapping = modulus_map((GLAND, FAT, SAC), (0, 1, 2))
    theta, by_log_modulus, h = rng.normal(size=2), rng.normal(size=3), 1e-6
    steps = h * np.eye(2)
    slopes = [np.log(mapping.moduli(theta + s)) - np.log(mapping.moduli(theta - s)) for s in steps]
    assert mapping.pullback(by_log_modulus) == pytest.approx(np.array(slopes) @ by_log_modulus / (2 * h), rel=1e-8)


def test_the_base_is_not_written_into():
    mapping = modulus_map((GLAND, FAT), (0, 1))
    mapping.moduli(np.ones(1))
    assert np.array_equal(mapping.base, [10.0, 10.0])


@pytest.mark.parametrize("tissues", [(FAT, TUBE), (GLAND, TUBE)])
def test_a_case_without_a_ratio_is_refused(tissues):
    with pytest.raises(ConfigurationError, match="only"):
        modulus_map(tissues, (0,))
