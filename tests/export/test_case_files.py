"""The files beside result.json: each voxel and each tetrahedron has the stiffness of its tissue."""

from __future__ import annotations

import dataclasses

import meshio
import nibabel
import numpy as np
import pytest

from bodies import with_first_pair
from palpate.export.case_files import file_name, write_estimate_files, write_mesh_files, write_simulation_files
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.label_table import read_label_table
from palpate.images.tissue import Role
from palpate.mesh.locate import region_image
from palpate.statement.result import MeshResult, Simulation


def test_a_voxel_has_the_region_of_its_tetrahedron(case_result):
    mesh = case_result.space.mesh
    turned = np.array([[0.9, -0.4, 0.1, 3.137], [0.4, 0.9, 0, -7.318], [0, 0.1, 1.3, 4.249], [0, 0, 0, 1]])
    grid = VoxelGrid((30, 31, 32), turned)
    image = region_image(mesh, grid)
    rng = np.random.default_rng(3)
    for voxel in rng.integers(0, [30, 31, 32], size=(60, 3)):
        point = grid.world(voxel[None].astype(float))[0]
        corners = mesh.nodes[mesh.tets]
        b = np.linalg.solve((corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1), (point - corners[:, 0])[..., None])
        inside = (b[..., 0].min(axis=1) >= 0) & (b.sum(axis=(1, 2)) <= 1)
        expected = mesh.region[inside][0] if inside.any() else -1
        assert image[tuple(voxel)] == expected


def test_the_volume_of_each_region_is_found_again(case_result):
    mesh = case_result.space.mesh
    grid = VoxelGrid((90, 90, 90), np.diag([0.5, 0.5, 0.5, 1.0]) + np.array([[0, 0, 0, -2.2]] * 3 + [[0] * 4]))
    image = region_image(mesh, grid)
    for region in (0, 1, 3):
        volume = mesh.volumes[mesh.region == region].sum()
        assert np.count_nonzero(image == region) * grid.voxel_volume == pytest.approx(volume, rel=0.02)


def test_the_stiffness_map_lies_on_the_image(tmp_path, case_result):
    write_estimate_files(case_result, tmp_path)
    image = nibabel.load(tmp_path / "stiffness.nii.gz")
    values = np.asarray(image.dataobj)
    np.testing.assert_allclose(image.affine, case_result.before.grid.affine, atol=1e-6)
    assert values.shape == case_result.before.grid.shape
    found = np.unique(values[np.isfinite(values)])
    np.testing.assert_allclose(found, [10.0, 31.2, 58.9], rtol=1e-6)
    hollow = case_result.before.index == 2
    assert np.isnan(values[hollow]).mean() > 0.6  # the tube's voxels, but for the stairs of the coarse mesh
    assert np.isnan(values[0]).mean() < 0.2


def test_the_mesh_carries_label_modulus_and_poissons_ratio(tmp_path, case_result):
    write_estimate_files(case_result, tmp_path)
    mesh = meshio.read(tmp_path / "mesh.vtu")
    region = case_result.space.mesh.region
    np.testing.assert_array_equal(mesh.cell_data["label"][0], np.array([1, 2, 3, 4])[region])
    np.testing.assert_array_equal(mesh.cell_data["youngs_modulus_kpa"][0], np.array([58.9, 31.2, 0, 10.0])[region])
    assert set(mesh.cell_data["poisson_ratio"][0]) == {0.45}
    np.testing.assert_array_equal(mesh.point_data["displacement_mm"], case_result.estimation.displacements[0])


def test_the_table_and_the_cells_name_the_voxels_of_the_label_image(tmp_path, case_result):
    write_estimate_files(case_result, tmp_path)
    table = read_label_table(tmp_path / "labels.csv")
    image = nibabel.load(tmp_path / "labels.nii.gz")
    np.testing.assert_allclose(image.affine, case_result.before.grid.affine, atol=1e-6)
    for number, name in table.items():
        tissue = [t.name for t in case_result.tissues].index(name)
        np.testing.assert_array_equal(np.asarray(image.dataobj) == number, case_result.before.index == tissue)
    assert set(meshio.read(tmp_path / "mesh.vtu").cell_data["label"][0]) <= set(table)


def test_the_mesh_carries_the_strain_of_its_displacement(tmp_path, case_result):
    stretch = case_result.space.points * [0.0, 0.0, 0.2]
    estimation = dataclasses.replace(case_result.estimation, displacements=(stretch,))
    write_estimate_files(dataclasses.replace(case_result, estimation=estimation), tmp_path)
    written = meshio.read(tmp_path / "mesh.vtu").cell_data["largest_strain"][0]
    np.testing.assert_allclose(written, (1.2**2 - 1.0) / 2.0, rtol=1e-5)


def test_ratios_are_not_passed_off_as_kilopascals(tmp_path, case_result):
    estimation = case_result.estimation
    ratios = tuple(dataclasses.replace(e, unit="ratio", value=None, interval95=None) for e in estimation.estimates)
    mesh = case_result.space.mesh
    rest = dataclasses.replace(mesh.tissues[3], role=Role.ESTIMATE, youngs_modulus_kpa=None)
    space = dataclasses.replace(case_result.space, mesh=dataclasses.replace(mesh, tissues=(*mesh.tissues[:3], rest)))
    estimation = dataclasses.replace(estimation, estimates=ratios)
    result = dataclasses.replace(with_first_pair(case_result, space=space), estimation=estimation)
    assert result.unit == "ratio"
    write_estimate_files(result, tmp_path)
    written = meshio.read(tmp_path / "mesh.vtu")
    assert np.isnan(written.cell_data["youngs_modulus_kpa"][0]).all()
    assert np.nanmax(written.cell_data["youngs_modulus_ratio"][0]) == 5.89


def test_what_did_not_converge_leaves_no_stiffness(tmp_path, case_result):
    estimation = dataclasses.replace(case_result.estimation, status="not converged")
    write_estimate_files(dataclasses.replace(case_result, estimation=estimation), tmp_path)
    values = np.asarray(nibabel.load(tmp_path / "stiffness.nii.gz").dataobj)
    np.testing.assert_allclose(np.unique(values[np.isfinite(values)]), [10.0])


def test_a_mesh_is_written_with_every_surface(tmp_path, case_result):
    r = case_result
    paths = write_mesh_files(MeshResult(r.case, r.space, r.mesh_summary, r.before, r.provenance), tmp_path)
    assert len([path for path in paths if path.suffix == ".vtp"]) == 4
    assert all(path.stat().st_size > 0 for path in paths)


@pytest.mark.parametrize("steps", [1, 3])
def test_a_simulation_is_written_with_its_steps(tmp_path, case_result, steps):
    r = case_result
    image = LabelImage(r.before.index + 1, r.before.grid)
    last = r.estimation.displacements[0]
    simulation = Simulation(
        case=r.case,
        space=r.space,
        mesh_summary=r.mesh_summary,
        displacements=tuple(last * (k + 1) / steps for k in range(steps)),
        before=image,
        after=image,
        moduli_kpa={"prostate": 60.0, "bladder": 30.0, "surroundings": 10.0},
        provenance=r.provenance,
    )
    paths = write_simulation_files(simulation, tmp_path)
    assert all(path.is_file() for path in paths)
    assert {"before.nii.gz", "after.nii.gz", "mesh.vtu", "surfaces"} <= {path.name for path in tmp_path.iterdir()}
    assert (tmp_path / "mesh.pvd").exists() == (steps > 1)
    written = sorted(tmp_path.glob("steps/*.vtu"))
    assert len(written) == (steps + 1 if steps > 1 else 0)
    strains = [meshio.read(path).cell_data["largest_strain"][0].max() for path in [*written, tmp_path / "mesh.vtu"]]
    assert strains == sorted(strains)  # grows with the motion, from none
    assert strains[-1] > 0.0
    assert steps == 1 or strains[0] == 0.0


@pytest.mark.parametrize("name", ["../../etc/passwd", "a/b", "x" * 300, "CON:", "", "\n"])
def test_a_tissues_name_never_leaves_the_folder(name):
    assert set(file_name(name)) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ_")
    assert 0 < len(file_name(name)) <= 60
