"""Fixtures of the problems with known answers."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="session")
def meshes():
    """The module `structured_meshes`, loaded by its path: tests are no package."""
    path = Path(__file__).parents[1] / "mechanics" / "structured_meshes.py"
    spec = importlib.util.spec_from_file_location("structured_meshes", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def rng():
    return np.random.default_rng(20240511)
