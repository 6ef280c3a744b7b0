"""B7 on coarse meshes, with each element."""

from __future__ import annotations

import pytest

from palpate.mechanics.dilatation import choose_element
from palpate_validation.problems.cook import INCOMPRESSIBLE, deflection


@pytest.mark.parametrize("element", ["P2", "auto"])
def test_compressible_panel(element):
    assert deflection(10, 1.0 / 3.0, choose_element(element)) == pytest.approx(32.25, rel=1.2e-2)


def test_the_automatic_element_does_not_lock_where_linear_tetrahedra_do():
    assert deflection(10, 0.4999, choose_element("auto")) == pytest.approx(INCOMPRESSIBLE, rel=2.5e-2)
    assert deflection(10, 0.4999, choose_element("P1")) < 0.7 * INCOMPRESSIBLE
