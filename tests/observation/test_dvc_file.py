"""Displacements by digital volume correlation: what a subset measures, and results of pyALDVC as they are written."""

from __future__ import annotations

import base64
import json
import struct

import numpy as np
import pytest

from palpate.errors import ConfigurationError, InputDataError
from palpate.mesh.locate import located
from palpate.mesh.space import lagrange_space
from palpate.observation.contract import DataFile
from palpate.observation.displacement_field import read_displacement_field
from palpate.observation.dvc_file import FLOOR_VOXELS, UNDERSTATED
from palpate.observation.point_table import COLUMNS
from palpate.observation.subset_mean import subset_mean
from palpate_validation.structured_meshes import box_mesh

SHAPE, STEP, SUBSET, VOXEL = (4, 5, 6), 8, 16, np.array([0.5, 0.5, 1.0])  # n_z, n_y, n_x; voxels; mm
SD = 0.02  # voxels
INVALID = {"masked": 3, "not converged": 7, "an outlier": 50, "without a sd": 90}


@pytest.fixture(scope="module")
def space():
    return lagrange_space(box_mesh(4, size=24.0), "P2")


def means(space, points, edges, field):
    matrix = subset_mean(space, points, located(space.mesh, points), np.array(edges))
    return matrix @ field(space.points)


def test_a_whole_subset_has_the_mean_of_a_quadratic_motion(space):
    """The mean of x^2 over an edge e about x_0 is x_0^2 + e^2 / 12, and that of x y is x_0 y_0."""
    points, edges = np.random.default_rng(1).uniform(6.0, 18.0, (20, 3)), [4.0, 6.0, 8.0]
    found = means(space, points, edges, lambda x: np.stack([x[:, 0] ** 2, x[:, 1] ** 2, x[:, 0] * x[:, 2]], axis=1))
    x, y, z = points.T
    np.testing.assert_allclose(found, np.stack([x**2 + 16.0 / 12.0, y**2 + 36.0 / 12.0, x * z], axis=1), rtol=1e-9)


@pytest.mark.parametrize("point", [(0.5, 12.0, 12.0), (23.9, 0.1, 12.0), (0.0, 0.0, 24.0)])
def test_a_subset_that_the_border_cuts_has_the_motion_of_its_node_where_motion_is_linear(space, point):
    slopes = np.array([[0.1, 0.0, 0.2], [0.0, -0.1, 0.0], [0.3, 0.0, 0.1]])
    found = means(space, np.array([point]), [6.0, 6.0, 6.0], lambda x: x @ slopes + 1.0)
    np.testing.assert_allclose(found, np.array([point]) @ slopes + 1.0, atol=1e-9)


def test_a_subset_much_thicker_than_the_body_has_the_motion_of_its_node(space):
    """Its places lie outside, all but those in one plane or line, which tell no slope across it."""
    slopes = np.diag([0.1, 0.2, -0.1])
    point = np.array([[1.0, 12.0, 23.0]])
    found = means(space, point, [400.0, 400.0, 400.0], lambda x: x @ slopes)
    np.testing.assert_allclose(found, point @ slopes, atol=1e-9)


@pytest.fixture
def result():
    """What pyALDVC finds of two frames, the second compared with the first; voxels, nodes with x fastest."""
    rng = np.random.default_rng(2)
    z, y, x = (a.ravel() for a in np.meshgrid(*(20 + STEP * np.arange(n) for n in SHAPE), indexing="ij"))
    places = np.stack([x, y, z], axis=1).astype(np.float64)
    n = len(places)
    moved = 0.01 * places @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.2], [0.0, -0.2, 0.0]]) + 0.3
    arrays = {
        "coordinates": places,
        "grid_shape": np.array(SHAPE),
        "spacing": np.full(3, float(STEP)),
        "node_valid": np.arange(n) != INVALID["masked"],
        "voxel_size": VOXEL,
        "ref_indices": np.array([0, 1]),
        "para_json": np.array(json.dumps({"winsize": [SUBSET] * 3, "units": "mm"})),
    }
    for k in (1, 2):
        arrays[f"U_{k}"] = moved
        arrays[f"U_accum_{k}"] = k * moved
        arrays[f"U_std_{k}"] = SD * rng.uniform(0.5, 2.0, (n, 3))
        arrays[f"U_std_{k}"][INVALID["without a sd"]] = np.nan
        arrays[f"status_{k}"] = np.where(np.arange(n) == INVALID["not converged"], 1, 0).astype(np.int8)
        arrays[f"outlier_{k}"] = np.arange(n) == INVALID["an outlier"]
    return arrays


def read(path, **stated):
    return read_displacement_field(DataFile("displacement-field", "field", (path,), **({"state": 1} | stated)))


def npz(path, arrays):
    np.savez_compressed(path, **arrays)
    return path


def test_valid_nodes_have_their_motion_their_errors_and_their_subset_in_mm(tmp_path, result):
    source = read(npz(tmp_path / "a.npz", result))
    kept = np.delete(np.arange(len(result["coordinates"])), list(INVALID.values()))
    np.testing.assert_allclose(source.table.before, VOXEL * result["coordinates"][kept])
    np.testing.assert_allclose(source.table.moved, VOXEL * result["U_1"][kept])
    errors = np.hypot(UNDERSTATED * result["U_std_1"][kept], FLOOR_VOXELS)
    np.testing.assert_allclose(source.table.sd, VOXEL * errors)
    assert source.file.subset_mm == pytest.approx((8.5, 8.5, 17.0))
    assert source.file.correlation_mm == pytest.approx(34.0 / 6.0)
    assert "4 of 120 nodes are not valid" in source.in_words


def test_the_frame_is_that_of_the_state_and_its_errors_are_those_of_all_frames_between(tmp_path, result):
    path = npz(tmp_path / "a.npz", result)
    second = read(path, state=2).table
    np.testing.assert_array_equal(second.after, read(path, frame=2).table.after)
    kept = np.delete(np.arange(len(result["coordinates"])), list(INVALID.values()))
    np.testing.assert_allclose(second.moved, VOXEL * 2.0 * result["U_1"][kept])
    both = result["U_std_1"][kept] ** 2 + result["U_std_2"][kept] ** 2
    np.testing.assert_allclose(second.sd, VOXEL * np.sqrt(UNDERSTATED**2 * both + 2.0 * FLOOR_VOXELS**2))
    with pytest.raises(InputDataError, match="frames 1 to 2, not 3"):
        read(path, state=3)


def test_what_the_case_states_goes_before_what_the_file_says(tmp_path, result):
    own = {"sd_mm": 0.3, "correlation_mm": 0.0, "subset_mm": (1.0, 1.0, 1.0)}
    source = read(npz(tmp_path / "a.npz", result), **own)
    assert (source.file.correlation_mm, source.file.subset_mm) == (0.0, (1.0, 1.0, 1.0))
    assert np.unique(source.table.sd).tolist() == [0.3]


@pytest.mark.parametrize(("unit", "millimetres"), [("um", 1e-3), ("µm", 1e-3), ("m", 1e3)])
def test_other_units_of_length_are_turned_to_mm(tmp_path, result, unit, millimetres):
    plain = read(npz(tmp_path / "a.npz", result)).table
    result["para_json"] = np.array(json.dumps({"winsize": [SUBSET] * 3, "units": unit}))
    result["voxel_size"] = VOXEL / millimetres
    other = read(npz(tmp_path / "b.npz", result)).table
    np.testing.assert_allclose([other.before, other.after, other.sd], [plain.before, plain.after, plain.sd])


def test_axes_that_a_case_states_are_refused(tmp_path, result):
    """The file has its own, which another word of the case would not turn."""
    with pytest.raises(InputDataError, match="remove the key axes"):
        read(npz(tmp_path / "a.npz", result), axes="LPS")


def spoilt(result, name, value):
    return {key: array for key, array in (result | {name: value}).items() if array is not None}


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("para_json", np.array(json.dumps({"winsize": [16] * 3, "units": "voxel"})), "set voxel_size and units"),
        ("para_json", np.array("{"), "no result of pyALDVC"),
        ("status_1", None, "no result of pyALDVC"),
        ("U_1", np.zeros((5, 3)), "no result of pyALDVC"),
        ("ref_indices", np.array([1, 1]), "no result of pyALDVC"),
        ("U_std_1", np.full((120, 3), np.nan), "none of the 120 nodes"),
        ("coordinates", np.array([None] * 120), "no result of pyALDVC"),
    ],
)
def test_what_is_no_result_is_refused(tmp_path, result, name, value, words):
    result.pop("U_accum_1")
    with pytest.raises(InputDataError, match=words):
        read(npz(tmp_path / "a.npz", spoilt(result, name, value)))


def vti(path, arrays, *, frame=1, encoding="binary"):
    """As pyALDVC writes it: inline base64 of float32, in the unit of the voxels."""
    point_data = {
        "displacement": arrays[f"U_{frame}"] * VOXEL,
        "node_valid": arrays["node_valid"],
        "displacement_std": arrays[f"U_std_{frame}"] * VOXEL,
    }
    rows = []
    for name, values in point_data.items():
        content = np.ascontiguousarray(values, dtype=np.float32).tobytes()
        text = base64.b64encode(struct.pack("<I", len(content)) + content).decode()
        width = 1 if values.ndim == 1 else 3
        head = f'<DataArray type="Float32" Name="{name}" NumberOfComponents="{width}" format="{encoding}">'
        rows.append(f"{head}\n  {text}\n</DataArray>")
    low, gap = VOXEL * arrays["coordinates"][0], VOXEL * STEP
    path.write_text(
        '<?xml version="1.0"?>\n<VTKFile type="ImageData" byte_order="LittleEndian" header_type="UInt32">\n'
        f'<ImageData WholeExtent="0 {SHAPE[2] - 1} 0 {SHAPE[1] - 1} 0 {SHAPE[0] - 1}"'
        f' Origin="{low[0]} {low[1]} {low[2]}" Spacing="{gap[0]} {gap[1]} {gap[2]}">'
        f"<Piece><PointData>\n{''.join(rows)}\n</PointData></Piece></ImageData></VTKFile>\n"
    )
    return path


def test_an_image_of_nodes_says_what_the_archive_says(tmp_path, result):
    """It does not know of states and outliers; its subsets are taken for twice the distance of nodes."""
    result["status_1"][:], result["outlier_1"][:] = 0, False
    del result["U_accum_1"]
    own, other = read(npz(tmp_path / "a.npz", result)), read(vti(tmp_path / "a.vti", result))
    for name in ("before", "after", "sd"):
        np.testing.assert_allclose(getattr(other.table, name), getattr(own.table, name), rtol=1e-5, atol=1e-6)
    assert other.file.subset_mm == pytest.approx(tuple(2.0 * STEP * VOXEL))


def test_an_image_with_other_arrays_or_encodings_is_refused(tmp_path, result):
    with pytest.raises(InputDataError, match="does not stand inline"):
        read(vti(tmp_path / "a.vti", result, encoding="appended"))
    (tmp_path / "b.vti").write_text("<VTKFile><ImageData></ImageData></VTKFile>")
    with pytest.raises(InputDataError, match="no result of pyALDVC"):
        read(tmp_path / "b.vti")


def table(path, rows, columns="before_x,before_y,before_z,after_x,after_y,after_z,sd_x,sd_y,sd_z"):
    path.write_text("\n".join([columns, *(",".join(f"{x:.9g}" for x in row) for row in rows)]) + "\n")
    return path


def test_a_table_may_have_an_error_for_each_component(tmp_path):
    rng = np.random.default_rng(3)
    before, sd = rng.uniform(0.0, 20.0, (30, 3)), rng.uniform(0.1, 0.5, (30, 3))
    path = table(tmp_path / "a.csv", np.hstack([before, before + 0.5, sd]))
    np.testing.assert_allclose(read(path).table.sd, sd, rtol=1e-8)
    assert np.unique(read(path, sd_mm=1.0).table.sd).tolist() == [1.0]
    with pytest.raises(InputDataError, match="not positive"):
        read(table(tmp_path / "b.csv", np.hstack([before, before + 0.5, -sd])))
    with pytest.raises(ConfigurationError, match="no stated error"):
        read(table(tmp_path / "d.csv", np.hstack([before, before + 0.5]), ",".join(COLUMNS)))
