"""Stiffness: what holds for every elastic body, and agreement with an independent assembly."""

from __future__ import annotations

import numpy as np
import pytest
import skfem
from skfem.models.elasticity import linear_elasticity

from palpate.errors import ConfigurationError, GeometryError
from palpate.mechanics.rigid import rigid_modes
from palpate.mechanics.stiffness import lame_parameters, tissue_stiffness
from palpate.mesh.space import lagrange_space
from palpate.mesh.tet_mesh import TetMesh

ELEMENTS = ("P1", "P2")


@pytest.fixture(params=ELEMENTS)
def space(request, meshes):
    return lagrange_space(meshes.box_mesh(2, size=30.0, distortion=0.2), request.param)


def test_stiffness_is_symmetric(space):
    stiffness = tissue_stiffness(space, 0, 0.45)
    assert abs(stiffness - stiffness.T).max() < 1e-13 * abs(stiffness).max()


def test_rigid_motions_and_only_they_cost_no_energy(space):
    values, vectors = np.linalg.eigh(tissue_stiffness(space, 0, 0.45).toarray())
    assert np.all(np.abs(values[:6]) < 1e-12 * values[-1])
    assert values[6] > 1e-6 * values[-1]
    modes = rigid_modes(space.points)
    assert np.allclose(vectors[:, :6] @ (vectors[:, :6].T @ modes), modes, atol=1e-9)


def test_uniform_dilatation_stores_three_halves_of_the_bulk_modulus_times_strain_squared(space):
    nu, strain, volume = 0.3, 1e-2, 30.0**3
    u = strain * space.points.ravel()
    energy = 0.5 * u @ (tissue_stiffness(space, 0, nu) @ u)
    bulk = 1.0 / (3.0 * (1.0 - 2.0 * nu))
    assert energy == pytest.approx(4.5 * bulk * strain**2 * volume, rel=1e-12)


def test_the_tissues_stiffnesses_touch_only_their_own_points(meshes):
    mesh = meshes.box_mesh(
        2, tissues=[meshes.known("left"), meshes.unknown("right")], region=lambda c: (c[:, 0] > 0.5).astype(int)
    )
    space = lagrange_space(mesh, "P2")
    used = np.flatnonzero(tissue_stiffness(space, 1, 0.3).diagonal()) // 3
    assert np.array_equal(np.unique(used), np.unique(space.cells[mesh.region == 1]))


@pytest.mark.parametrize("element", ELEMENTS)
def test_agrees_with_scikit_fem(element, meshes):
    mesh = meshes.box_mesh(3, size=30.0, distortion=0.2)
    space = lagrange_space(mesh, element)
    vector = skfem.ElementVector(skfem.ElementTetP1() if element == "P1" else skfem.ElementTetP2())
    basis = skfem.Basis(skfem.MeshTet(mesh.nodes.T.copy(), mesh.tets.T.copy()), vector)
    theirs = linear_elasticity(*lame_parameters(1.0, 0.45)).assemble(basis)
    # Their unknowns are numbered by entity; match them to ours by place and axis.
    key = np.round(np.column_stack([basis.doflocs.T, basis_axis(basis)]), 6)
    ours = np.round(np.column_stack([np.repeat(space.points, 3, axis=0), np.tile(np.arange(3), len(space.points))]), 6)
    order = np.lexsort(key.T)[np.argsort(np.lexsort(ours.T))]
    assert np.array_equal(key[order], ours)
    difference = theirs[order][:, order] - tissue_stiffness(space, 0, 0.45)
    assert abs(difference).max() < 1e-12 * abs(theirs).max()


def basis_axis(basis):
    """The axis (n_dof,) of each of scikit-fem's unknowns."""
    axis = np.zeros(basis.N)
    for number in range(3):
        for dofs in (basis.nodal_dofs, basis.edge_dofs):
            axis[dofs[number : number + 1]] = number
    return axis


def test_stiffness_at_impossible_poisson_ratio_is_refused(space):
    with pytest.raises(ConfigurationError, match=r"0\.5"):
        tissue_stiffness(space, 0, 0.5)


def test_a_flat_tetrahedron_is_refused_with_its_number(meshes):
    mesh = meshes.box_mesh(1)
    nodes = mesh.nodes.copy()
    nodes[:, 2] = 0.0
    flat = TetMesh(nodes, mesh.tets, mesh.region, mesh.boundary, mesh.beyond, mesh.tissues)
    with pytest.raises(GeometryError, match="6 tetrahedra have no positive volume, the first is number 0"):
        tissue_stiffness(lagrange_space(flat, "P1"), 0, 0.3)
