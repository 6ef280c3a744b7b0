"""B16 at finite strain, on meshes coarser than those of `palpate verify`, and with the automatic element."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mechanics.dilatation import Dilatation
from palpate_validation.problems.manufactured import neo_hookean_errors, observed_orders


@pytest.mark.parametrize(("element", "sizes", "orders"), [("P1", (6, 12), (2, 1)), ("P2", (4, 8), (3, 2))])
def test_errors_fall_with_the_orders_of_theory(element, sizes, orders):
    observed = observed_orders(*(neo_hookean_errors(element, Dilatation.POINTWISE, n) for n in sizes))
    assert np.all(np.abs(observed - orders) < 0.25), observed


def test_the_automatic_element_is_at_least_as_good_as_its_mixed_theory():
    """P2/P0: second order in u, first in grad u (Boffi, Brezzi & Fortin, 2013, section 8.4); the blend's are better."""
    observed = observed_orders(*(neo_hookean_errors("P2", Dilatation.BLENDED, n) for n in (4, 8)))
    assert np.all(observed > [2.0, 1.0]), observed
