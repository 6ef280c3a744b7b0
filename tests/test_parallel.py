"""Work on several processors gives what one would."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.parallel import mapped, processors


def test_results_come_in_the_order_of_the_items():
    assert mapped(lambda n: n * n, range(100)) == [n * n for n in range(100)]
    assert mapped(str, []) == []


def test_what_a_call_raises_is_raised():
    with pytest.raises(ZeroDivisionError):
        mapped(lambda n: 1 // n, [2, 1, 0])


def test_what_numpy_is_told_to_let_pass_passes_in_every_thread(environment):
    environment(OMP_NUM_THREADS="2")
    with np.errstate(invalid="ignore"):
        assert np.isnan(mapped(np.log, [-1.0, -2.0, -3.0])).all()


def test_the_limit_of_the_linear_algebra_holds(environment):
    environment(OMP_NUM_THREADS="1")
    assert processors() == 1


def test_a_limit_that_is_no_plain_number_is_none(environment):
    environment(MKL_NUM_THREADS="1", OMP_NUM_THREADS="\u00b2")
    assert processors() == 1
