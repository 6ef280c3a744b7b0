"""VTK files: another reader finds the same mesh, and VTK's numbering of edges is ours."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import meshio
import numpy as np
import pytest

from palpate.errors import InputDataError
from palpate.export.vtk_xml import write_pvd, write_vtp, write_vtu
from palpate.mesh.space import lagrange_space
from palpate.mesh.surface import tissue_surface


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_another_reader_finds_the_same_mesh(tmp_path, case_result, element):
    space = lagrange_space(case_result.space.mesh, element)
    rng = np.random.default_rng(1)
    displacement = rng.normal(size=space.points.shape)
    modulus = rng.random(len(space.cells))
    write_vtu(
        tmp_path / "mesh.vtu",
        space,
        point_data={"displacement_mm": displacement},
        cell_data={"youngs_modulus_kpa": modulus, "label": np.arange(len(space.cells), dtype=np.int32)},
    )
    read = meshio.read(tmp_path / "mesh.vtu")
    np.testing.assert_array_equal(read.points, space.points)
    np.testing.assert_array_equal(read.cells[0].data, space.cells)
    assert read.cells[0].type == {"P1": "tetra", "P2": "tetra10"}[element]
    np.testing.assert_array_equal(read.point_data["displacement_mm"], displacement)
    np.testing.assert_array_equal(read.cell_data["youngs_modulus_kpa"][0], modulus)
    np.testing.assert_array_equal(read.cell_data["label"][0], np.arange(len(space.cells)))


def test_edges_are_numbered_as_vtk_does(case_result):
    # vtkQuadraticTetra: the mid-edge nodes lie between (0,1) (1,2) (2,0) (0,3) (1,3) (2,3)
    points, cells = case_result.space.points, case_result.space.cells
    for place, (a, b) in enumerate([(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)], start=4):
        np.testing.assert_allclose(points[cells[:, place]], 0.5 * (points[cells[:, a]] + points[cells[:, b]]))


def test_large_arrays_survive_the_split_into_blocks(tmp_path, case_result):
    space = case_result.space
    many = np.random.default_rng(2).random((len(space.points), 40))  # beyond one block of 1 MiB
    write_vtu(tmp_path / "mesh.vtu", space, point_data={"many": many}, cell_data={})
    np.testing.assert_array_equal(meshio.read(tmp_path / "mesh.vtu").point_data["many"], many)


def test_names_are_escaped(tmp_path, case_result):
    name = '<a "b" & c>'
    write_vtu(tmp_path / "m.vtu", case_result.space, point_data={name: case_result.space.points}, cell_data={})
    assert ET.parse(tmp_path / "m.vtu").getroot().find(".//PointData/DataArray").get("Name") == name


def test_the_space_is_said(tmp_path, case_result):
    mesh = case_result.space.mesh
    write_vtu(tmp_path / "m.vtu", case_result.space, point_data={}, cell_data={})
    write_vtp(tmp_path / "s.vtp", mesh.nodes, tissue_surface(mesh, 0).triangles)
    assert "SPACE=RAS" in (tmp_path / "m.vtu").read_text()
    field = ET.parse(tmp_path / "s.vtp").getroot().find("PolyData/FieldData/Array")
    assert (field.get("Name"), field.text.split()) == ("SPACE", [str(code) for code in (*b"RAS", 0)])


def test_an_array_of_another_length_is_refused(tmp_path, case_result):
    with pytest.raises(InputDataError, match="'x' has 3 rows"):
        write_vtu(tmp_path / "m.vtu", case_result.space, point_data={"x": np.zeros(3)}, cell_data={})
    assert list(tmp_path.iterdir()) == []


def test_a_surface_keeps_its_own_points_only(tmp_path, case_result):
    mesh = case_result.space.mesh
    surface = tissue_surface(mesh, 0)
    write_vtp(tmp_path / "s.vtp", mesh.nodes, surface.triangles)
    piece = ET.parse(tmp_path / "s.vtp").getroot().find("PolyData/Piece")
    assert int(piece.get("NumberOfPoints")) == len(surface.nodes)
    assert int(piece.get("NumberOfPolys")) == len(surface.triangles)


def test_a_series_names_its_files(tmp_path):
    write_pvd(tmp_path / "m.pvd", [(0.0, "steps/a.vtu"), (0.5, "steps/b & c.vtu")])
    sets = ET.parse(tmp_path / "m.pvd").getroot().findall("Collection/DataSet")
    assert [(s.get("timestep"), s.get("file")) for s in sets] == [("0", "steps/a.vtu"), ("0.5", "steps/b & c.vtu")]
