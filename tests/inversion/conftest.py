"""Fixtures of the inversion's tests: twin problems, made once."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="session")
def twins():
    """The module `twins`, loaded by its path: tests are no package."""
    return loaded("inversion_twins", Path(__file__).with_name("twins.py"))


@pytest.fixture(scope="session")
def toys():
    """The module `toys`: objectives whose minimum is known by hand."""
    return loaded("inversion_toys", Path(__file__).with_name("toys.py"))


@pytest.fixture(scope="session")
def point_motion():
    """The module `point_motion` of the observations' tests: a second kind of observation."""
    return loaded("point_motion", Path(__file__).parents[1] / "observation" / "point_motion.py")


def loaded(name, path):
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def twin(twins):
    """A linear-element twin at known moduli."""
    return twins.make_twin()


@pytest.fixture(scope="session")
def exact(twins, twin):
    """Its inverse problem with exact targets."""
    return twins.exact_problem(twin)


@pytest.fixture(scope="session")
def voxels(twins, twin):
    """Its inverse problem through voxels."""
    return twins.voxel_problem(twin)


@pytest.fixture
def rng():
    return np.random.default_rng(20240511)
