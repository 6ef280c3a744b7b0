import re
from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import MeshQualityError
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.mesh.anatomy import Anatomy, Box
from palpate.mesh.cutting import graded_grid
from palpate.mesh.quality import check_mesh, dihedral_angles, level_set_volumes, mesh_quality
from palpate.mesh.tet_mesh import OUTER, TetMesh
from palpate.mesh.tetrahedralise import boundary_of

BOX = Box(np.zeros(3), np.eye(3), np.full(3, 20.0))
REST = Tissue("rest", Role.KNOWN, youngs_modulus_kpa=1.0)
ORGAN = Tissue("organ", Role.ESTIMATE, (1,))


class Below:
    """The half space below a height; `slope`: that of its level set."""

    def __init__(self, height, slope=1.0):
        self.height, self.slope = height, slope

    def at(self, points):
        return self.slope * (points[:, 2] - self.height)

    def gradient_at(self, points):
        return np.tile([0.0, 0.0, self.slope], (len(points), 1))


def _anatomy(height=10.0, slope=1.0):
    return Anatomy((ORGAN, REST), (Below(height, slope), None), BOX)


def _mesh(nodes=None, tets=None, keep=slice(None)):
    grid = graded_grid(BOX, lambda p: np.full(len(p), 9.0), coarsest_mm=5.0, region=1)
    nodes = grid.nodes if nodes is None else nodes
    tets = (grid.tets if tets is None else tets)[keep]
    region = np.where(grid.nodes[tets].mean(axis=1)[:, 2] < 10.0, 0, 1)
    boundary = boundary_of(tets)
    return TetMesh(nodes, tets, region, boundary, np.full(len(boundary), OUTER), (ORGAN, REST))


def test_the_regular_tetrahedron_has_its_known_angle():
    nodes = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    tets = np.array([[0, 1, 2, 3]])
    mesh = TetMesh(nodes, tets, np.zeros(1), np.zeros((0, 3)), np.zeros(0), (REST,))
    assert np.allclose(dihedral_angles(mesh), np.degrees(np.arccos(1 / 3)))


@pytest.mark.parametrize("slope", [1.0, 0.6])
def test_volumes_of_level_sets_are_exact_for_planes_whatever_their_slope(slope):
    volumes = level_set_volumes(_anatomy(7.3, slope))
    assert volumes["organ"] == pytest.approx(7.3 * 400.0, rel=1e-6)
    assert sum(volumes.values()) == pytest.approx(8000.0)


def test_a_sound_mesh_passes():
    quality = check_mesh(_mesh(), _anatomy(), voxel_volumes={"organ": 4020.0})
    assert quality.min_dihedral_deg == pytest.approx(45.0)
    assert quality.components == 1
    assert quality.voxel_volume_error["organ"] == pytest.approx(4000.0 / 4020.0 - 1.0)


def test_a_wrong_volume_names_the_region():
    with pytest.raises(MeshQualityError, match=r"'organ'.*level set"):
        check_mesh(_mesh(), _anatomy(10.2))
    with pytest.raises(MeshQualityError, match=r"'organ'.*voxels"):
        check_mesh(_mesh(), _anatomy(), voxel_volumes={"organ": 4500.0})
    assert check_mesh(_mesh(), _anatomy(), voxel_volumes={"organ": 4500.0}, thin=("organ",)).tets


def _image(height, spacing=(1.0, 2.0, 0.5)):
    """The half space in voxels that fill the box."""
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = 0.5 * np.array(spacing)
    grid = VoxelGrid(tuple(int(20 / edge) for edge in spacing), affine)
    index = np.zeros(grid.shape, dtype=np.int16)
    index[:, :, int(height / spacing[2]) :] = 1
    return Segmentation(index, grid, (ORGAN, REST))


def test_where_mesh_and_image_differ_is_named_in_millimetres_voxels_and_slices():
    image = _image(10.0)
    index = image.index.copy()
    index[15:, :3, 20:30] = 0  # the organ of the image has a bump that the mesh lacks
    with pytest.raises(MeshQualityError) as refused:
        check_mesh(_mesh(), _anatomy(), voxel_volumes={"organ": 4150.0}, image=replace(image, index=index))
    found = re.search(
        r"'organ'.*near RAS \[(.*?)\] mm \(voxel \[(.*?)\], .*; axial slice (\d+) of 40", str(refused.value)
    )
    place, voxel, number = found[1].split(","), found[2].split(","), int(found[3])
    place, voxel = np.array(place, dtype=float), np.array(voxel, dtype=int)
    assert np.abs(place - image.grid.world(voxel[None].astype(float))[0]).max() < 0.06
    assert index[tuple(voxel)] == 0
    assert image.index[tuple(voxel)] == 1
    assert number == voxel[2] + 1


def test_an_inverted_tetrahedron_is_found_where_it_is():
    mesh = _mesh()
    tets = mesh.tets.copy()
    tets[5] = tets[5][[1, 0, 2, 3]]
    with pytest.raises(MeshQualityError, match="inverted"):
        check_mesh(_mesh(tets=tets), _anatomy())


def test_a_sliver_is_found_where_it_is():
    mesh = _mesh()
    nodes = mesh.nodes.copy()
    inner = int(np.argmin(np.linalg.norm(nodes - 10.0, axis=1)))
    around = mesh.tets[(mesh.tets == inner).any(axis=1)][0]
    others = around[around != inner]
    nodes[inner] += 0.99 * (nodes[others].mean(axis=0) - nodes[inner])
    with pytest.raises(MeshQualityError, match=r"dihedral angle.*near RAS"):
        check_mesh(_mesh(nodes=nodes), _anatomy())


def test_a_mesh_in_two_pieces_is_refused():
    centre = _mesh().nodes[_mesh().tets].mean(axis=1)[:, 0]
    mesh = _mesh(keep=(centre < 5.0) | (centre > 10.0))
    assert mesh_quality(mesh, _anatomy()).components == 2
    with pytest.raises(MeshQualityError, match="2 pieces"):
        check_mesh(mesh, _anatomy())
