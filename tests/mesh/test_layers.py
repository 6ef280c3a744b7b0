"""Layers round organs: the elements of known tissues that touch them, and no other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import Delaunay

from palpate.images.tissue import Role, Tissue
from palpate.mesh.layers import Layer, layer_thickness_mm, layered_space, layers_round_organs
from palpate.mesh.space import lagrange_space
from palpate.mesh.tet_mesh import TetMesh

ORGAN, FAT, MUSCLE = (
    Tissue("organ", Role.ESTIMATE),
    Tissue("fat", Role.KNOWN, youngs_modulus_kpa=3.0),
    Tissue("muscle", Role.KNOWN, youngs_modulus_kpa=30.0),
)


@pytest.fixture
def space():
    """An organ in the middle of a cube of fat, of which one end, far from the organ, is muscle."""
    rng, axis = np.random.default_rng(0), np.arange(-4.0, 5.0)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = nodes + rng.uniform(-0.1, 0.1, nodes.shape)
    tets = Delaunay(nodes).simplices.astype(np.int64)
    volumes = np.linalg.det(nodes[tets[:, 1:]] - nodes[tets[:, :1]])
    tets = np.where(volumes[:, None] < 0.0, tets[:, [1, 0, 2, 3]], tets)[np.abs(volumes) > 1e-3]
    centres = nodes[tets].mean(axis=1)
    region = np.where(np.linalg.norm(centres, axis=1) < 1.6, 0, np.where(centres[:, 0] > 3.0, 2, 1))
    none = np.zeros((0, 3), dtype=np.int64)
    return lagrange_space(TetMesh(nodes, tets, region, none, none[:, 0], (ORGAN, FAT, MUSCLE)), "P1")


def test_a_layer_is_what_touches_the_organ(space):
    assert layers_round_organs(space.mesh) == (Layer(0, 1),)
    mesh, before = layered_space(space, layers_round_organs(space.mesh)).mesh, space.mesh
    layer = mesh.region == len(before.tissues)
    at_organ = np.isin(before.tets, before.tets[before.region == 0]).any(axis=1)
    assert np.array_equal(layer, at_organ & (before.region == 1))
    assert np.array_equal(mesh.region[~layer], before.region[~layer])
    assert mesh.tissues == (ORGAN, FAT, MUSCLE, FAT)


def test_without_layers_a_space_is_itself(space):
    assert layered_space(space, ()) is space


def test_a_layer_is_as_thick_as_its_elements(space):
    """Elements that touch a ball in a lattice of unit cubes: about the cube that a face belongs to, or two."""
    layers = layers_round_organs(space.mesh)
    thickness = layer_thickness_mm(space.mesh, layers, 0)
    assert 0.8 < thickness < 2.5
    wide = replace(space.mesh, nodes=3.0 * space.mesh.nodes)
    assert layer_thickness_mm(wide, layers, 0) == pytest.approx(3.0 * thickness)


def test_an_organ_whose_layer_another_has_taken_is_still_so_far_from_the_next(space):
    """Of two halves of one ball the second keeps what touches it alone; its layer is as thick as that of the first."""
    mesh = space.mesh
    halves = np.where((mesh.region == 0) & (mesh.nodes[mesh.tets].mean(axis=1)[:, 0] > 0.0), 3, mesh.region)
    two = replace(mesh, region=halves, tissues=(*mesh.tissues, replace(ORGAN, name="other half")))
    layers = layers_round_organs(two)
    assert layers == (Layer(0, 1), Layer(3, 1))
    first, second = (layer_thickness_mm(two, layers, organ) for organ in (0, 3))
    assert second == pytest.approx(first, rel=0.5)


def test_organs_that_meet_a_tissue_in_a_point_have_no_layer_there():
    """Two tetrahedra that share a corner."""
    nodes = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], dtype=float)
    tets = np.array([[0, 1, 2, 3], [0, 5, 4, 6]])
    none = np.zeros((0, 3), dtype=np.int64)
    assert layers_round_organs(TetMesh(nodes, tets, np.array([0, 1]), none, none[:, 0], (ORGAN, FAT))) == ()
