"""Every format of `palpate export` says the same of a body: volumes by tissue, groups, names, moduli, motion."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
import runpy
import types
from collections import Counter
from xml.etree import ElementTree as ET

import highdicom
import meshio
import nibabel
import numpy as np
import pydicom
import pytest
import SimpleITK
from scipy.spatial.transform import Rotation

import palpate
from bodies import with_first_pair
from dicom_files import PLANTED, TILTED, ct_slices, save_series
from palpate.body.loads import loads_on
from palpate.case.case import CaseLoad
from palpate.errors import ConfigurationError, InputDataError
from palpate.export import abaqus, febio
from palpate.export.fitted_model import fitted_model
from palpate.export.formats import format_named
from palpate.export.groups import OFF, element_faces, face_groups, plain_names
from palpate.images.alignment import RigidMotion
from palpate.images.label_image import VoxelGrid
from palpate.images.registration import Registration
from palpate.mechanics.laws.contract import energy
from palpate.mechanics.laws.registry import LAWS
from palpate.mesh.space import lagrange_space
from palpate.mesh.surface import triangle_normals
from palpate.mesh.tet_mesh import FACES
from palpate.report.collect import collect
from palpate.report.scales import modulus_scale, shown_moduli

VOLUME = 1e-4  # relative
LPS = np.array([-1.0, -1.0, 1.0])
PLACES = {"axial": (-40.3, -41.2, -1.0), "sagittal": (-0.3, -41.2, 42.2)}  # first voxel of a series, LPS mm
MESHED = ("prostate", "bladder", "surroundings")
GROUPS = {
    "prostate surface",
    "prostate observed",
    "bladder surface",
    "bladder observed",
    "rectum wall",
    "surroundings surface",
    "outer boundary",
}


@pytest.fixture(scope="module")
def model(case_result):
    return fitted_model(case_result, seal="")


@pytest.fixture(scope="module")
def exported(case_result, tmp_path_factory):
    """The folder of each format, written once when it is asked for."""
    made = {}

    def export(name, **options):
        key = (name, *sorted(options))
        if key not in made:
            made[key] = tmp_path_factory.mktemp(name) / "out"
            palpate.export(case_result, made[key], format=name, **options)
        return made[key]

    return export


def volumes(points, tets):
    corner = points[tets[:, :4]]
    return np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6.0


def volume_of(model, name):
    mesh = model.bodies[0].mesh
    return mesh.volumes[mesh.region == mesh.tissue_index(name)].sum()


def test_a_face_is_that_of_the_tetrahedron_whose_outside_it_shows(model):
    mesh = model.bodies[0].mesh
    for group in face_groups(mesh):
        cells, faces = element_faces(mesh, group.triangles)
        found = mesh.tets[cells[:, None], FACES[faces]]
        assert np.array_equal(np.sort(found, axis=1), np.sort(group.triangles, axis=1))
        away = mesh.nodes[group.triangles].mean(axis=1) - mesh.nodes[mesh.tets[cells]].mean(axis=1)
        assert (np.einsum("ni,ni->n", away, triangle_normals(mesh.nodes, group.triangles)) > 0).all()


def test_plain_names_stay_apart():
    names = ["left hip", "left-hip", "Blase (ü)", "9", "x" * 200, "x" * 201]
    plain = plain_names(names)
    assert len(set(plain.values())) == len(names)
    assert all(re.fullmatch("[A-Z][A-Z0-9_]{0,79}", name) for name in plain.values())


@pytest.mark.parametrize("linear", [False, True])
def test_abaqus_has_each_tissue_with_its_volume_moduli_and_moved_wall(exported, model, linear):
    folder = exported("abaqus", linear=True) if linear else exported("abaqus")
    assert (folder / "palpate_hybrid.inp").exists() == (not linear)
    text = (folder / "palpate.inp").read_text()
    mesh = meshio.read(folder / "palpate.inp")
    tets = np.concatenate([block.data for block in mesh.cells])
    assert tets.shape[1] == (4 if linear else 10)
    plain = plain_names([*MESHED, *GROUPS])
    for name in MESHED:
        own = [block.data[ids] for block, ids in zip(mesh.cells, mesh.cell_sets[plain[name]], strict=True)]
        assert volumes(mesh.points, np.concatenate(own)).sum() == pytest.approx(volume_of(model, name), rel=VOLUME)
    assert {plain[group] for group in GROUPS} <= set(mesh.point_sets)
    constants = re.search(r"\*MATERIAL, NAME=PROSTATE\n\*HYPERELASTIC, NEO HOOKE\n(.*), (.*)\n", text)
    modulus, ratio = 58.9, 0.45
    shear, bulk = modulus / (2 * (1 + ratio)), modulus / (3 * (1 - 2 * ratio))
    assert [float(c) for c in constants.groups()] == pytest.approx([shear / 2, 2 / bulk], rel=1e-9)
    conditions = re.findall(r"^(\d+), ([123]), \2, (\S+)$", text.split("*BOUNDARY\n")[1], re.MULTILINE)
    motion = model.bodies[0].displacements[0]
    wall = mesh.point_sets[plain["rectum wall"]]
    moved = {(int(node), int(axis)): float(value) for node, axis, value in conditions}
    for node in wall[::7]:
        assert [moved[node + 1, axis] for axis in (1, 2, 3)] == pytest.approx(motion[node], abs=1e-9)


def test_the_elements_of_abaqus_are_ours_edge_by_edge(exported):
    """Quadratic nodes lie in the middle of the edges 12, 23, 13, 14, 24, 34 of C3D10."""
    mesh = meshio.read(exported("abaqus") / "palpate.inp")
    tets = mesh.cells[0].data
    for place, (a, b) in enumerate([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)], start=4):
        np.testing.assert_allclose(mesh.points[tets[:, place]], mesh.points[tets[:, [a, b]]].mean(axis=1), atol=1e-9)


def sliding(result, turn):
    """The result with a cut that slides, turned in space, image and mesh, by a matrix (3, 3)."""
    domain = dataclasses.replace(result.case.domain, outer_boundary="sliding")
    case = dataclasses.replace(result.case, domain=domain)
    grid, mesh = result.before.grid, dataclasses.replace(result.space.mesh, nodes=result.space.mesh.nodes @ turn.T)
    turned = np.eye(4)
    turned[:3, :3] = turn
    before = dataclasses.replace(result.before, grid=dataclasses.replace(grid, affine=turned @ grid.affine))
    return dataclasses.replace(with_first_pair(result, space=lagrange_space(mesh, "P2"), before=before), case=case)


OBLIQUE = Rotation.from_rotvec(np.radians(37.0) * np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)).as_matrix()


@pytest.mark.parametrize("mirror", [[0, 1, 2], [1, 0, 2]])  # the axes of an image may be left-handed
def test_loads_on_what_slides_askew_are_stated_along_its_axes(case_result, tmp_path, mirror):
    """Abaqus and CalculiX take *CLOAD along the axes of *TRANSFORM: a, (a x b) x a and a x b of the two given."""
    loads = (
        CaseLoad("gravity", acceleration_m_s2=(0.0, -9.81, 0.0)),
        CaseLoad("traction", surface="outer", traction_kpa=(0.2, 0.5, -0.3)),
        CaseLoad("pressure", surface="outer", pressure_kpa=2.0, following=False),
        CaseLoad("pressure", surface="outer", pressure_kpa=1.0),
        CaseLoad("pressure", surface="outer", pressure_kpa=0.5),
    )
    result = with_mechanics(sliding(case_result, OBLIQUE), "neo-hookean", loads)
    grid = result.before.grid
    swapped = VoxelGrid(tuple(np.array(grid.shape)[mirror].tolist()), grid.affine[:, [*mirror, 3]])
    before = dataclasses.replace(result.before, grid=swapped, index=result.before.index.transpose(mirror))
    palpate.export(with_first_pair(result, before=before), tmp_path, format="abaqus")
    text = (tmp_path / "palpate.inp").read_text()
    first, second = np.array([float(x) for x in text.split("TYPE=R\n")[1].splitlines()[0].split(",")]).reshape(2, 3)
    along = np.array([first, np.cross(np.cross(first, second), first), np.cross(first, second)])
    found = np.zeros_like(result.space.points)
    for row in text.split("*CLOAD\n")[1].split("*")[0].splitlines():
        node, axis, force = row.split(",")
        found[int(node) - 1, int(axis) - 1] += float(force)
    nodes = text.split("NSET=SLIDING\n")[1].split("*")[0].replace(",", " ").split()
    turned = np.array([int(node) - 1 for node in nodes])
    assert len(turned) > 1000
    found[turned] = found[turned] @ along
    acting = loads_on(result.space, loads, densities=np.full(4, 1000.0))
    expected = sum(load.forces(np.zeros_like(found)) for load in acting[:3]).reshape(-1, 3)
    np.testing.assert_allclose(found, expected, atol=1e-8)
    assert set(re.findall(r"^\d+, P\d, (\S+)$", text, re.MULTILINE)) == {"1.5"}  # each face once
    assert "GLOBAL=YES\nU, RF\n*NODE FILE, GLOBAL=YES" in text


def test_sliding_faces_are_held_along_their_normals(case_result, tmp_path):
    """In Abaqus along the image's own axes; where these are askew, FEBio and SOFA say that they cannot."""
    result = sliding(case_result, np.eye(3))
    palpate.export(result, tmp_path / "straight", format="abaqus", linear=True)
    text = (tmp_path / "straight" / "palpate.inp").read_text()
    held = re.findall(r"^(\d+), ([123]), \2$", text, re.MULTILINE)
    mesh = result.space.mesh
    low = {(int(node) - 1, int(axis) - 1) for node, axis in held}
    for node, axis in list(low)[::20]:
        assert mesh.nodes[node, axis] in (0.0, 40.0)
    assert "*TRANSFORM" not in text
    askew = sliding(case_result, OBLIQUE)
    palpate.export(askew, tmp_path / "askew", format="abaqus", linear=True)
    lines = (tmp_path / "askew" / "palpate.inp").read_text().split("TYPE=R\n")[1].splitlines()
    axes = np.array([float(x) for x in lines[0].split(",")]).reshape(2, 3)
    np.testing.assert_allclose(np.abs(axes @ OBLIQUE), np.eye(3)[:2], atol=1e-9)
    for name in ("febio", "sofa"):
        with pytest.raises(ConfigurationError, match=r"oblique(ly)? to the world"):
            palpate.export(askew, tmp_path / name, format=name)


@pytest.mark.parametrize("linear", [False, True])
def test_gmsh_has_volumes_and_surfaces_as_physical_groups(exported, model, linear):
    folder = exported("gmsh", linear=True) if linear else exported("gmsh")
    mesh = meshio.read(folder / "palpate.msh")
    assert GROUPS | set(MESHED) == {re.sub(r"\W+$", "", name) for name in mesh.field_data}
    for name in MESHED:
        tag = mesh.field_data[name][0]
        own = [
            block.data[data == tag]
            for block, data in zip(mesh.cells, mesh.cell_data["gmsh:physical"], strict=True)
            if block.type.startswith("tetra")
        ]
        assert volumes(mesh.points, np.concatenate(own)).sum() == pytest.approx(volume_of(model, name), rel=VOLUME)
    np.testing.assert_allclose(mesh.point_data["displacement_mm"], fitted_motion(model, linear=linear), atol=1e-8)


def fitted_motion(model, *, linear=False):
    body = model.bodies[0].with_linear_tetrahedra() if linear else model.bodies[0]
    return body.displacements[0]


@pytest.mark.parametrize("linear", [False, True])
def test_febio_has_domains_sets_and_maps_that_refer_to_each_other(exported, model, linear):
    root = ET.parse((exported("febio", linear=True) if linear else exported("febio")) / "palpate.feb").getroot()
    order = ["Module", "Material", "Mesh", "MeshDomains", "MeshData", "LoadData", "Step", "Output"]
    assert [child.tag for child in root] == order
    nodes = np.array([[float(x) for x in node.text.split(",")] for node in root.find("Mesh/Nodes")])
    sizes = {}
    for elements in root.iter("Elements"):
        assert elements.get("type") == ("tet4" if linear else "tet10")
        cells = np.array([[int(x) for x in e.text.split(",")] for e in elements]) - 1
        sizes[elements.get("name")] = volumes(nodes, cells).sum()
    assert sizes == {name: pytest.approx(volume_of(model, name), rel=VOLUME) for name in MESHED}
    assert {surface.get("name") for surface in root.iter("Surface")} == GROUPS
    assert {d.get("mat") for d in root.iter("SolidDomain")} == {m.get("name") for m in root.iter("material")}
    sets = {s.get("name"): [int(n) for n in s.text.split(",")] for s in root.iter("NodeSet")}
    maps = {data.get("name"): data for data in root.iter("NodeData")}
    motion = fitted_motion(model, linear=linear)
    conditions = [bc for bc in root.iter("bc") if bc.get("type") == "prescribed displacement"]
    assert [bc.find("dof").text for bc in conditions] == ["x", "y", "z"]
    for axis, condition in enumerate(conditions):
        values = [float(node.text) for node in maps[condition.find("value").text]]
        points = np.array(sets[condition.get("node_set")]) - 1
        np.testing.assert_allclose(values, motion[points, axis], atol=1e-9)
    prostate = next(m for m in root.iter("material") if m.get("name") == "prostate")
    assert prostate.get("type") == "neo-Hookean"
    assert [float(prostate.find(key).text) for key in ("E", "v")] == [58.9, 0.45]


@pytest.mark.parametrize("name", ["stl", "obj", "ply"])
def test_surfaces_are_closed_outward_and_hold_their_tissues_volume(exported, model, name):
    for tissue in (*MESHED, "rectum"):
        for state in ("before", "after"):
            (path,) = exported(name).glob(f"*_{tissue}_{state}.{name}")
            mesh = meshio.read(path)
            points, triangles = merged(mesh.points, mesh.cells_dict["triangle"])
            edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
            ways = Counter(map(tuple, edges.tolist()))  # where a body touches itself, an edge has four triangles
            assert ways == Counter({(b, a): count for (a, b), count in ways.items()})
            size = np.linalg.det(points[triangles]).sum() / 6.0
            assert size > 0.0
            if state == "before" and tissue != "rectum":
                assert size == pytest.approx(volume_of(model, tissue), rel=VOLUME)
    if name != "obj":  # whose comments meshio passes over
        assert b"SPACE=RAS" in path.read_bytes()[:200]


def merged(points, triangles):
    """Points that lie on each other as one, as in the triangles of STL."""
    _, first, inverse = np.unique(np.round(points, 4), axis=0, return_index=True, return_inverse=True)
    return points[first].astype(float), inverse.ravel()[triangles]


def test_vtk_has_each_state_and_each_group(exported, model):
    folder = exported("vtu")
    mesh = meshio.read(folder / "mesh_1.vtu")
    np.testing.assert_allclose(mesh.point_data["displacement_mm"], fitted_motion(model), atol=1e-12)
    assert not meshio.read(folder / "mesh_0.vtu").point_data["displacement_mm"].any()
    label = mesh.cell_data["label"][0]
    sizes = volumes(mesh.points, mesh.cells[0].data)
    for number, name in ((1, "prostate"), (2, "bladder"), (4, "surroundings")):
        assert sizes[label == number].sum() == pytest.approx(volume_of(model, name), rel=VOLUME)
    blocks = ET.parse(folder / "groups.vtm").getroot().iter("DataSet")
    files = {block.get("name"): folder / block.get("file") for block in blocks}
    assert set(files) == GROUPS | {"mesh"}
    assert all(path.is_file() for path in files.values())


def test_the_warp_takes_points_to_where_the_model_has_them(case_result, tmp_path, model):
    """Before's surfaces come to lie on after's, in the worlds of both images; the inverse takes them back."""
    shift = RigidMotion([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], [5.0, -3.0, 2.0])
    lay = dataclasses.replace(
        case_result.pairs[0].later[0], alignment=Registration("surfaces", shift, np.zeros(3), 0.0)
    )
    result = with_first_pair(case_result, later=(lay,))
    palpate.export(result, tmp_path, format="warp")
    body = model.bodies[0]
    surface = np.unique(np.concatenate([body.space.facets(g.triangles) for g in face_groups(body.mesh)]))
    before = body.space.points[surface]
    after = shift.apply(before + fitted_motion(model)[surface])
    grid = case_result.before.grid
    there = VoxelGrid(grid.shape, shift.matrix @ grid.affine)
    for name, start, goal, box in (("warp", before, after, grid), ("inverse_warp", after, before, there)):
        image = SimpleITK.ReadImage(str(tmp_path / f"{name}.nii.gz"), SimpleITK.sitkVectorFloat64)
        transform = SimpleITK.DisplacementFieldTransform(image)
        near = (np.abs(box.index(start) / (np.array(grid.shape) - 1.0) - 0.5) < 0.5).all(axis=1)  # where the field is
        assert near.sum() > 1000
        found = np.array([transform.TransformPoint(p) for p in (start[near] * LPS).tolist()]) * LPS
        assert np.sqrt(((found - goal[near]) ** 2).sum(axis=1).mean()) < 0.05


@pytest.mark.parametrize("axes", ["RAS", "PIR"])
def test_the_jacobian_of_a_warp_is_the_models_however_the_axes_of_the_image_lead(case_result, tmp_path, model, axes):
    """SimpleITK takes derivatives along the grid for those along LPS; most images lead RAS. Here: change of volume."""
    before = case_result.before
    turn = nibabel.orientations.axcodes2ornt(axes)
    index = nibabel.orientations.apply_orientation(before.index, turn)
    affine = before.grid.affine @ nibabel.orientations.inv_ornt_aff(turn, before.grid.shape)
    turned = dataclasses.replace(before, index=index, grid=VoxelGrid(index.shape, affine))
    palpate.export(with_first_pair(case_result, before=turned), tmp_path, format="warp")
    field = SimpleITK.ReadImage(str(tmp_path / "warp.nii.gz"), SimpleITK.sitkVectorFloat64)
    found = SimpleITK.DisplacementFieldJacobianDeterminant(field)
    body, name = model.bodies[0], "bladder"
    own = body.mesh.tets[body.mesh.region == body.mesh.tissue_index(name)]
    deep = body.mesh.nodes[own].mean(axis=1)
    values = [found[found.TransformPhysicalPointToIndex(place)] for place in (deep * LPS).tolist()]
    moved = (body.mesh.nodes + fitted_motion(model, linear=True))[own]
    changes = np.linalg.det(moved[:, 1:] - moved[:, :1]) / np.linalg.det(np.diff(body.mesh.nodes[own], axis=1))
    assert np.ptp(changes) > 0.02
    assert np.sqrt(np.mean((np.array(values) - changes) ** 2)) < 0.01


def test_dicom_holds_stiffness_in_kilopascals_and_every_tissue(exported, case_result):
    folder = exported("dicom")
    stiffness = pydicom.dcmread(folder / "stiffness.dcm")
    assert stiffness.ContentQualification == "RESEARCH"
    mapping = stiffness.SharedFunctionalGroupsSequence[0].RealWorldValueMappingSequence[0]
    assert mapping.MeasurementUnitsCodeSequence[0].CodeValue == "kPa"
    assert mapping.MeasurementUnitsCodeSequence[0].CodingSchemeDesignator == "UCUM"
    values = np.unique(np.frombuffer(stiffness.FloatPixelData, dtype="<f4"))
    np.testing.assert_allclose(values, [0.0, 10.0, 31.2, 58.9], rtol=1e-6)
    segmentation = highdicom.seg.segread(folder / "segmentation.dcm")
    names = {str(item.SegmentLabel): int(item.SegmentNumber) for item in segmentation.SegmentSequence}
    assert set(names) == {"prostate", "bladder", "rectum", "surroundings"}
    prostate = segmentation.get_volume(segment_numbers=[names["prostate"]], combine_segments=True)
    count = np.count_nonzero(case_result.before.index == 0)
    assert np.count_nonzero(prostate.array) == count
    world = prostate.affine
    middle = np.argwhere(prostate.array).mean(axis=0) @ world[:3, :3].T + world[:3, 3]
    expected = case_result.before.grid.world(np.argwhere(case_result.before.index == 0).mean(axis=0)[None])[0]
    np.testing.assert_allclose(middle * [-1, -1, 1], expected, atol=1e-3)


def test_dicom_belongs_to_the_series_that_is_named(case_result, tmp_path):
    slices = ct_slices((28, 27, 26), (1.6, 1.6, 1.6), (-40.3, -41.2, -1.0))
    save_series(tmp_path / "series", slices)
    palpate.export(case_result, tmp_path / "out", format="dicom", source=tmp_path / "series")
    for name in ("stiffness.dcm", "segmentation.dcm"):
        found = pydicom.dcmread(tmp_path / "out" / name)
        assert found.StudyInstanceUID == slices[0].StudyInstanceUID
        assert found.FrameOfReferenceUID == slices[0].FrameOfReferenceUID
        assert found.PatientName == PLANTED
        assert found.ReferencedSeriesSequence[0].SeriesInstanceUID == slices[0].SeriesInstanceUID
    save_series(tmp_path / "far", ct_slices((5, 27, 26), (1.6, 1.6, 1.6), (-40.3, -41.2, 500.0)))
    with pytest.raises(InputDataError, match="lies elsewhere than"):
        palpate.export(case_result, tmp_path / "no", format="dicom", source=tmp_path / "far")
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize("plane", [None, "axial", "sagittal"])
def test_frames_of_dicom_lie_as_the_slices_of_the_series_and_without_one_axial(case_result, tmp_path, plane):
    """Viewers show frames as they are stored, whichever way the axes of the first image's file lead."""
    source = None if plane is None else tmp_path / "series"
    if plane is not None:
        save_series(source, ct_slices((28, 27, 26), (1.6, 1.6, 1.6), PLACES[plane], plane))
    palpate.export(case_result, tmp_path / "out", format="dicom", source=source)
    grid, index = case_result.before.grid, case_result.before.index
    expected = grid.world(np.argwhere(index == 0).mean(axis=0)[None])[0] * LPS
    for name, least in (("stiffness.dcm", 58.0), ("segmentation.dcm", 0.5)):
        found = highdicom.imread(tmp_path / "out" / name)
        groups = found.SharedFunctionalGroupsSequence[0]
        if name == "stiffness.dcm":  # from the lowest slice up, as dcmqi takes them to lie
            assert groups.FrameAnatomySequence[0].FrameLaterality == "U"
            frames = found.PerFrameFunctionalGroupsSequence
            normal = np.cross(*np.reshape(groups.PlaneOrientationSequence[0].ImageOrientationPatient, (2, 3)))
            assert (np.diff([f.PlanePositionSequence[0].ImagePositionPatient @ normal for f in frames]) > 0.0).all()
            places = [int(f.FrameContentSequence[0].DimensionIndexValues) for f in frames]
            assert places == list(range(1, len(frames) + 1))
        rows_and_columns = groups.PlaneOrientationSequence[0].ImageOrientationPatient
        np.testing.assert_allclose(rows_and_columns, np.ravel(TILTED[plane or "axial"]), atol=1e-6)
        volume = (
            highdicom.seg.segread(tmp_path / "out" / name).get_volume(segment_numbers=[1], combine_segments=True)
            if name == "segmentation.dcm"
            else found.get_volume()
        )
        middle = volume.map_indices_to_reference(np.argwhere(volume.array > least).astype(float)).mean(axis=0)
        np.testing.assert_allclose(middle, expected, atol=0.5)


def test_netcdf_and_csv_hold_the_posterior_of_the_intervals(exported, case_result):
    h5netcdf = pytest.importorskip("h5netcdf")
    with h5netcdf.File(exported("netcdf") / "posterior.nc") as file:
        values = np.array(file["posterior/youngs_modulus"][...])
        assert file["posterior/youngs_modulus"].dimensions == ("chain", "draw", "tissue")
        names = [str(name, "utf-8") if isinstance(name, bytes) else name for name in file["posterior/tissue"][...]]
    assert names == ["prostate", "bladder"]
    logarithms = np.log(values).reshape(-1, 2)
    np.testing.assert_allclose(logarithms.mean(axis=0), np.log([58.9, 31.2]), atol=0.02)
    np.testing.assert_allclose(np.cov(logarithms.T), case_result.estimation.covariance.total, rtol=0.1, atol=2e-3)
    with (exported("csv") / "samples.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert [float(row["youngs_modulus"]) for row in rows] == pytest.approx(values.ravel(), rel=1e-9)
    with (exported("csv") / "tissues.csv").open() as table:
        tissues = {row["tissue"]: row for row in csv.DictReader(table)}
    assert float(tissues["prostate"]["interval95_low"]) == pytest.approx(0.8 * 58.9)
    assert tissues["rectum"]["youngs_modulus"] == tissues["surroundings"]["verdict"] == ""


def test_netcdf_and_csv_of_a_result_with_samples_hold_these(sampled_result, exported, tmp_path):
    """Names, dims and units are ArviZ's; what they are, and the share of their intervals, is written beside them."""
    h5netcdf = pytest.importorskip("h5netcdf")
    samples = sampled_result.estimation.samples
    (path,) = palpate.export(sampled_result, tmp_path / "nc", format="netcdf")
    with h5netcdf.File(path) as file, h5netcdf.File(exported("netcdf") / "posterior.nc") as linearised:
        posterior, constant = (file[name] for name in ("posterior", "constant_data"))
        moduli = posterior["youngs_modulus"]
        assert moduli.dimensions == ("chain", "draw", "tissue")
        assert moduli.attrs["units"] == "kPa"
        assert moduli.attrs["kind"].startswith("sampled")
        assert linearised["posterior/youngs_modulus"].attrs["kind"].startswith("linearised")
        np.testing.assert_array_equal(moduli[...], samples.moduli[None])
        assert [len(posterior.dimensions[axis]) for axis in ("chain", "draw", "tissue")] == [1, 150, 2]
        assert np.array_equal(posterior["draw"][...], np.arange(150))
        assert "samples_interval95_high" not in linearised["constant_data"].variables
        np.testing.assert_array_equal(constant["samples_interval95_high"][...], [71.0, np.nan])
        np.testing.assert_allclose(constant["interval95_low"][...], [0.8 * 58.9, 0.8 * 31.2])
        ends = [name for name in constant.variables if "interval95" in name]
        assert len(ends) == 4
        assert {(constant[name].attrs["units"], constant[name].attrs["interval_probability"]) for name in ends} == {
            ("kPa", 0.95)
        }
    palpate.export(sampled_result, tmp_path / "csv", format="csv")
    with (tmp_path / "csv" / "samples.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert [float(row["youngs_modulus"]) for row in rows] == pytest.approx(samples.moduli.ravel(), rel=1e-9)
    assert (rows[-1]["draw"], rows[-1]["tissue"]) == ("149", "bladder")


class Node:
    """Records what a scene adds to it, in place of SOFA's own."""

    def __init__(self):
        self.objects, self.children = [], {}

    def addChild(self, name):
        return self.children.setdefault(name, Node())

    def addObject(self, kind, **options):
        self.objects.append((kind, options))
        return options


def test_the_sofa_scene_builds_every_tissue(exported, model):
    scene = runpy.run_path(str(exported("sofa") / "scene.py"))
    root = scene["createScene"](Node())
    body = root.children["body"]
    nodes = np.array(dict(body.objects)["MechanicalObject"]["position"])
    for name in MESHED:
        parts = dict(body.children[name.upper()].objects)
        tets = np.array(parts["TetrahedronSetTopologyContainer"]["tetrahedra"])
        assert volumes(nodes, tets).sum() == pytest.approx(volume_of(model, name), rel=VOLUME)
    shear, lame = map(float, body.children["PROSTATE"].objects[2][1]["ParameterSet"].split())
    assert shear * (3 * lame + 2 * shear) / (lame + shear) == pytest.approx(58.9)
    held = dict(body.objects)["FixedProjectiveConstraint"]["indices"]
    np.testing.assert_allclose(scene["positions"](1.0), (nodes + fitted_motion(model, linear=True))[held], atol=1e-12)


class Recorder(types.ModuleType):
    """Takes every call of a viewer's script; `files`: paths that it was given."""

    def __init__(self, name):
        super().__init__(name)
        self.files = []

    def __getattr__(self, name):
        return self

    def __call__(self, *arguments, **options):
        self.files += [a for a in (*arguments, *options.values()) if isinstance(a, str) and "/" in a]
        return self


@pytest.mark.parametrize(("name", "module"), [("slicer", "slicer"), ("paraview", "paraview")])
def test_the_scripts_of_viewers_load_files_that_are_there(exported, put_library, name, module):
    folder, viewer = exported(name), Recorder(module)
    put_library(module, viewer)
    runpy.run_path(str(folder / f"load_in_{name}.py"))
    loaded = [path for path in viewer.files if path.startswith(str(folder))]
    assert len(loaded) >= (12 if name == "slicer" else 1)
    assert all((folder / path).is_file() for path in loaded)
    assert json.loads((folder / "scene.json").read_text())["schema"] == f"palpate.{name}/1"


@pytest.mark.parametrize("verdict", ["identified", "ratio only"])
def test_slicer_shares_unit_limits_and_colours_with_the_report(case_result, tmp_path, verdict):
    estimation = case_result.estimation
    items = tuple(dataclasses.replace(item, verdict=verdict) for item in estimation.estimates)
    result = dataclasses.replace(case_result, estimation=dataclasses.replace(estimation, estimates=items))
    palpate.export(result, tmp_path, format="slicer")
    scene = json.loads((tmp_path / "scene.json").read_text())["stiffness"]
    scale = modulus_scale(collect(result))
    assert scene["name"] == scale.label
    assert ("kPa" in scene["name"]) == (verdict == "identified")
    assert scene["range"] == pytest.approx([scale.low, scale.high])
    values = np.unique(np.asarray(nibabel.load(tmp_path / "stiffness.nii.gz").dataobj))
    moduli = shown_moduli(collect(result))
    shown = np.unique(moduli[np.isfinite(moduli)])
    np.testing.assert_allclose(values[values > 0], shown, rtol=1e-5)
    assert scale.low <= shown.min() < shown.max() <= scale.high
    places = np.rint(255 * (shown - scale.low) / (scale.high - scale.low)).astype(int)
    np.testing.assert_allclose(np.array(scene["colours"])[places], scale.colours(shown), atol=0.02)


@pytest.mark.parametrize("name", ["abaqus", "febio"])
def test_a_model_whose_moduli_are_ratios_speaks_of_no_kilopascal(model, tmp_path, name):
    """Stresses of such a model have the unit of its reference tissue's modulus."""
    for unit in ("kPa", "ratio"):
        known = dataclasses.replace(model, unit=unit)
        folder = tmp_path / unit
        folder.mkdir()
        format_named(name).write(known, known.bodies[0], folder)
        text = "".join(path.read_text() for path in folder.iterdir())
        assert ("kPa" in text) == (unit == "kPa")


def with_mechanics(result, law, loads=()):
    mechanics = dataclasses.replace(result.case.mechanics, law=law)
    return dataclasses.replace(result, case=dataclasses.replace(result.case, mechanics=mechanics, loads=loads))


def test_febio_and_sofa_have_our_energies(case_result, tmp_path):
    """The formulae of their manuals, with the constants of the files, give the energy that we compute."""
    F = np.eye(3) + 0.15 * np.random.default_rng(2).standard_normal((4, 3, 3))
    C = np.einsum("nki,nkj->nij", F, F)
    first, log = np.einsum("nii->n", C), np.log(np.linalg.det(F))
    second = 0.5 * (first**2 - np.einsum("nij,nij->n", C, C))
    shear, lame = 58.9 / 2.9, 58.9 * 0.45 / (1.45 * 0.1)
    result = with_mechanics(case_result, "mooney-rivlin")
    palpate.export(result, tmp_path, format="febio", linear=True)
    material = ET.parse(tmp_path / "palpate.feb").find("Material/material")
    assert material.get("type") == "coupled Mooney-Rivlin"
    c1, c2, k = (float(material.find(key).text) for key in ("c1", "c2", "k"))
    theirs = c1 * (first - 3) + c2 * (second - 3) - 2 * (c1 + 2 * c2) * log + k / 2 * log**2
    ours = energy(result.case.mechanics.material_law, F, mu=shear, lame=lame)
    np.testing.assert_allclose(theirs, ours, rtol=1e-9)
    palpate.export(case_result, tmp_path / "sofa", format="sofa")
    tissue = json.loads((tmp_path / "sofa" / "model.json").read_text())["tissues"][0]
    mu, lame_there = map(float, tissue["parameters"]["ParameterSet"].split())
    theirs = mu / 2 * (first - 3) - mu * log + lame_there / 2 * log**2
    np.testing.assert_allclose(
        theirs, energy(case_result.case.mechanics.material_law, F, mu=shear, lame=lame), rtol=1e-9
    )


def test_each_later_image_bears_its_own_loads(model, tmp_path):
    """A weight in the first later image alone: FEBio's curve goes back to 0, and Abaqus' next step begins anew."""
    weight = CaseLoad("gravity", acceleration_m_s2=(0.0, -9.81, 0.0))
    pressed = CaseLoad("pressure", surface="outer", pressure_kpa=2.0)
    linear = model.bodies[0].with_linear_tetrahedra()
    body = dataclasses.replace(linear, displacements=2 * linear.displacements, loads=((weight, pressed), (pressed,)))
    febio.write(model, body, tmp_path)
    root = ET.parse(tmp_path / "palpate.feb").getroot()
    curves = {c.get("id"): [pt.text for pt in c.find("points")] for c in root.find("LoadData")}
    of_load = [[node.get("lc") for node in load.iter() if node.get("lc")] for load in root.find("Loads")]
    assert [curves[of[0]] for of in of_load] == [["0,0", "1,1", "2,0"], ["0,0", "1,1", "2,1"]]
    abaqus.write(model, body, tmp_path)
    first, second = (tmp_path / "palpate.inp").read_text().split("*STEP")[1:]
    assert "*CLOAD\n" in first
    assert "*DLOAD\n" in first
    assert "*CLOAD, OP=NEW\n*DLOAD, OP=NEW\n" in second
    assert second.count(", P") == first.count(", P") > 0


@pytest.mark.parametrize("name", ["abaqus", "febio", "sofa"])
def test_a_law_that_a_format_has_not_is_refused(case_result, tmp_path, registered, name):
    """Another program would else compute with a neo-Hookean solid, and nobody would know."""

    class Plain:
        """No relative of a law that the formats have."""

        name = "plain"
        parameters = ()
        finite = True

    registered(LAWS, "plain", Plain())
    result = with_mechanics(case_result, "plain")
    with pytest.raises(ConfigurationError, match="'plain' is not supported by this format"):
        palpate.export(result, tmp_path, format=name, linear=True)


def test_the_linear_law_is_a_linear_step(case_result, tmp_path):
    palpate.export(with_mechanics(case_result, "linear"), tmp_path, format="abaqus", linear=True)
    text = (tmp_path / "palpate.inp").read_text()
    assert "*MATERIAL, NAME=PROSTATE\n*ELASTIC\n58.9, 0.45\n" in text
    assert "NLGEOM" not in text


def test_known_loads_keep_their_sum(case_result, tmp_path, model):
    """Weight as forces on nodes, a pressure on the faces of the outer boundary; SOFA's scene says that it has none."""
    weight = CaseLoad("gravity", acceleration_m_s2=(0.0, -9.81, 0.0))
    pressed = CaseLoad("pressure", surface="outer", pressure_kpa=2.0)
    result = with_mechanics(case_result, "neo-hookean", (weight, pressed))
    palpate.export(result, tmp_path / "abaqus", format="abaqus", linear=True)
    text = (tmp_path / "abaqus" / "palpate.inp").read_text()
    rows = text.split("*CLOAD\n")[1].split("*")[0].split("\n")[:-1]
    forces = np.array([[float(x) for x in row.split(",")] for row in rows])
    assert set(forces[:, 1]) == {2.0}
    mass_kg = 1e-6 * model.bodies[0].mesh.volumes.sum()
    assert forces[:, 2].sum() == pytest.approx(-9.81e3 * mass_kg, rel=1e-6)  # mN
    faces = text.split("*DLOAD\n")[1].split("*")[0].split("\n")[:-1]
    (outer,) = [group for group in face_groups(model.bodies[0].mesh) if group.name == "outer boundary"]
    assert len(faces) == len(outer.triangles)
    assert all(row.endswith(", 2") for row in faces)
    palpate.export(result, tmp_path / "febio", format="febio", linear=True)
    root = ET.parse(tmp_path / "febio" / "palpate.feb").getroot()
    assert [load.get("type") for load in root.find("Loads")] == ["nodal_force", "pressure"]
    with pytest.raises(ConfigurationError, match="neither known loads"):
        palpate.export(result, tmp_path / "sofa", format="sofa")


def parts_of(path):
    """Cells (numbers from 0) and constant of every section of an Abaqus file."""
    sets, sections, moduli, kind, now = {}, [], {}, "", ""
    for line in path.read_text().splitlines():
        if line.startswith("*"):
            kind, options = line.split(",")[0], dict(o.strip().split("=") for o in line.split(",")[1:] if "=" in o)
            now = options.get("ELSET") or options.get("NAME", now)
            if kind == "*SOLID SECTION":
                sections.append((options["ELSET"], options["MATERIAL"]))
        elif kind == "*ELEMENT":
            sets.setdefault(now, []).append(int(line.split(",")[0]) - 1)
        elif kind == "*ELSET":
            sets.setdefault(now, []).extend(int(n) - 1 for n in line.split(",") if n.strip())
        elif kind == "*HYPERELASTIC":
            moduli[now] = float(line.split(",")[0])
    return [(np.array(sets[cells]), moduli[material]) for cells, material in sections]


def test_elements_of_a_tissue_that_is_not_homogeneous_have_their_own_moduli_in_every_simulator(model, tmp_path):
    mesh = model.bodies[0].mesh
    own = np.flatnonzero(mesh.region == mesh.tissue_index("prostate"))
    logs = np.zeros(len(mesh.region))
    logs[own] = 0.4 * np.sin(mesh.nodes[mesh.tets[own]].mean(axis=1)[:, 0] / 5.0)
    body = dataclasses.replace(model.bodies[0], log_ratio=logs)
    wanted = 58.9 * np.exp(logs[own])
    np.testing.assert_allclose(body.element_moduli(model.moduli)[own], wanted)
    for name in ("abaqus", "febio", "gmsh", "sofa"):
        format_named(name).write(model, body, tmp_path)

    parts = parts_of(tmp_path / "palpate.inp")
    assert sorted(np.concatenate([cells for cells, _ in parts]).tolist()) == list(range(len(mesh.region)))
    found = np.zeros(len(mesh.region))
    for cells, constant in parts:
        found[cells] = 4.0 * constant * (1.0 + 0.45)  # E of C10 = mu / 2
    off = found[own] / wanted - 1.0
    assert np.abs(off).max() <= OFF + 1e-9
    assert np.abs(off).max() > 0.2 * OFF

    root = ET.parse(tmp_path / "palpate.feb").getroot()
    (values,) = root.iter("ElementData")
    (cells,) = (s for s in root.iter("ElementSet") if s.get("name") == values.get("elem_set"))
    assert cells.text.split(",") == [str(cell + 1) for cell in own]
    np.testing.assert_allclose([float(value.text) for value in values], wanted, rtol=1e-9)
    prostate = next(m for m in root.iter("material") if m.get("name") == "prostate")
    assert (prostate.find("E").get("type"), prostate.find("E").text) == ("map", values.get("name"))
    bladder = next(m for m in root.iter("material") if m.get("name") == "bladder")
    assert float(bladder.find("E").text) == 31.2

    gmsh = meshio.read(tmp_path / "palpate.msh")
    ordered = np.sort(gmsh.cells_dict["tetra10"][:, :4], axis=1)
    places = {tuple(corners): number for number, corners in enumerate(ordered.tolist())}
    rows = [places[tuple(sorted(corners))] for corners in mesh.tets[own].tolist()]
    read = np.concatenate(
        [
            data
            for block, data in zip(gmsh.cells, gmsh.cell_data["youngs_modulus_kpa"], strict=True)
            if block.type == "tetra10"
        ]
    )
    np.testing.assert_allclose(np.asarray(read).ravel()[rows], wanted, rtol=1e-6)

    document = json.loads((tmp_path / "model.json").read_text())
    with np.load(tmp_path / "model.npz") as arrays:
        part = arrays["part"]
    shear = {of["part"]: float(str(of["parameters"]["ParameterSet"]).split()[0]) for of in document["tissues"]}
    theirs = np.array([2.0 * (1.0 + 0.45) * shear[number] for number in part[own].tolist()])
    np.testing.assert_allclose(theirs, found[own], rtol=1e-9)
