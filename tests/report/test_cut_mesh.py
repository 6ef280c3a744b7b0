"""The model on a slice: the same tetrahedra as a search by point finds, and linear fields to the last digit."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from palpate.mesh.locate import located
from palpate.report.collect import collect
from palpate.report.cut_mesh import cut_mesh, element_moduli, motion_of
from palpate.report.section import VIEWS, Plane
from palpate.report.slices import motion_on, stiffness_on

LOW, HIGH = np.array([-2.0, 3.0, 1.0]), np.array([37.0, 42.0, 38.0])  # partly outside the mesh


@pytest.fixture(scope="module")
def data(case_result):
    return collect(case_result)


@pytest.fixture(params=VIEWS, ids=lambda view: view.name)
def plane(request):
    return Plane(request.param, 13.3, LOW, HIGH)


def test_a_pixel_lies_in_the_tetrahedron_that_a_search_finds(data, case_result, plane):
    cut = cut_mesh(data, plane)
    found = located(case_result.space.mesh, plane.points.reshape(-1, 3)).tet.reshape(cut.tet.shape)
    assert (found >= 0).any()
    assert (found < 0).any()
    region = case_result.space.mesh.region
    same = np.where((cut.tet >= 0) & (found >= 0), region[cut.tet] == region[found], (cut.tet < 0) == (found < 0))
    assert same.mean() > 0.99  # but for pixels on a face, which are of either


def test_a_linear_field_is_exact_on_the_slice(data, plane):
    matrix, shift = np.random.default_rng(3).standard_normal((3, 3)), np.array([1.0, -2.0, 3.0])
    cut = cut_mesh(data, plane)
    values = cut.of_nodes(data.mesh.nodes.astype(np.float64) @ matrix.T + shift)
    expected = plane.points @ matrix.T + shift
    assert cut.inside.any()
    np.testing.assert_allclose(values[cut.inside], expected[cut.inside], atol=1e-5)
    assert np.isnan(values[~cut.inside]).all()


def test_a_mesh_that_moved_is_cut_where_it_lies_now(data):
    shift = np.array([0.0, 0.0, 5.0])
    here, there = (Plane(VIEWS[0], position, LOW, HIGH) for position in (13.3, 18.3))
    moved = cut_mesh(data, there, motion=np.tile(shift, (len(data.mesh.nodes), 1)))
    assert np.array_equal(moved.tet, cut_mesh(data, here).tet)


def test_only_what_was_estimated_has_a_modulus(data, plane):
    moduli = stiffness_on(data, plane)
    assert set(np.unique(moduli[np.isfinite(moduli)])) <= {58.9, 31.2}
    of_elements = element_moduli(data)
    assert np.array_equal(np.isnan(of_elements), data.mesh.region == 3)


def test_the_motion_on_a_slice_is_that_of_the_result(data, case_result, plane):
    (later,) = data.later
    np.testing.assert_allclose(
        motion_of(later), case_result.displacements[0][: len(case_result.space.mesh.nodes)], atol=1e-6
    )
    lengths = np.linalg.norm(motion_on(data, plane, later), axis=2)
    assert 0.0 < np.nanmax(lengths) <= np.linalg.norm(case_result.displacements[0], axis=1).max() + 1e-6


def test_data_without_motion_say_what_to_do(data):
    bare = dataclasses.replace(data.later[0], motion=np.zeros((0, 3), dtype=np.float32))
    with pytest.raises(ValueError, match="run the estimate again"):
        motion_of(bare)
    with pytest.raises(ValueError, match="there is no mesh"):
        cut_mesh(dataclasses.replace(data, mesh=None), Plane(VIEWS[0], 13.3, LOW, HIGH))


def test_the_motion_comes_back_from_the_file(data, tmp_path):
    data.save(tmp_path / "data.npz")
    again = type(data).load(tmp_path / "data.npz")
    assert np.array_equal(again.later[0].motion, data.later[0].motion)


def test_the_second_pair_has_no_motion_of_the_first_mesh(two_pairs):
    data = collect(two_pairs)
    assert [len(later.motion) > 0 for later in data.later] == [True, False]
