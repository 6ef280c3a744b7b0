"""The real pelvis of table 2: what moves it, and which parts share a mesh."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.mesh.space import LagrangeSpace
from palpate_validation.paper.real_pelvis import ORGANS, RealPelvis, real_pelvis
from palpate_validation.paper.table import COLUMNS
from palpate_validation.paper.table2 import Table2Settings, table2


@pytest.fixture(scope="module")
def pelvis() -> RealPelvis:
    return real_pelvis(50.0)


@pytest.fixture(scope="module")
def space(pelvis) -> LagrangeSpace:
    return pelvis.space(18.0)


def test_the_filling_moves_the_wall_outwards_and_nothing_else(pelvis, space):
    offset, mesh = pelvis.filling(space, 7.5), space.mesh
    wall = np.unique(space.facets(mesh.boundary[mesh.beyond == mesh.tissue_index("rectum")]))
    lengths = np.linalg.norm(offset, axis=1)
    assert lengths[np.setdiff1d(np.arange(len(lengths)), wall)].max() == 0.0
    assert 7.5 < lengths.max() < 15.0  # a wall that is no round tube moves more where it is farther from the middle
    away = space.points[wall] - space.points[wall].mean(axis=0)
    assert np.mean(np.einsum("ij,ij->i", away, offset[wall]) > 0.0) > 0.9


def test_the_filling_is_proportional_to_its_size(pelvis, space):
    assert pelvis.filling(space, 6.0) == pytest.approx(2.0 * pelvis.filling(space, 3.0))


def test_every_part_of_the_table_is_made_once():
    settings = Table2Settings(moduli_kpa=(50.0, 100.0, 150.0), positions=2)
    keys = [key for job in table2(settings).jobs for key in job.keys]
    assert sorted(keys) == sorted(f"{kpa:g} {column}" for kpa in settings.moduli_kpa for column in COLUMNS)
    assert ("50 voxels", "150 voxels") in [job.keys for job in table2(settings).jobs]  # of one grid, and so of one mesh


def test_same_mesh_gives_the_moduli_back_where_the_driver_is_given():
    surfaces, *_ = table2(Table2Settings(edge_mm=18.0, moduli_kpa=(50.0, 150.0))).jobs
    found = surfaces.make("150 same_mesh", lambda _: None)
    assert max(abs(found[organ]["error_percent"]) for organ in ORGANS) < 0.01
    assert {found[organ]["verdict"] for organ in ORGANS} == {"identified"}
