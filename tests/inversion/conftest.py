"""Fixtures of the inversion's tests; its twin problems stand in the conftest of all tests."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def rng():
    return np.random.default_rng(20240511)


@pytest.fixture(scope="session")
def patients():
    """The module `patients`: problems without a mesh, whose posteriors are known."""
    path = Path(__file__).parent / "patients.py"
    spec = importlib.util.spec_from_file_location("inversion_patients", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module
