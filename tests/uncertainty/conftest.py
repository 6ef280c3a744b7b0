"""Fixtures of the tests of uncertainty; their twin problems stand in the conftest of all tests."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture
def rng():
    return np.random.default_rng(20240511)
