"""Landmarks and displacement fields: read as written, refused where they cannot be what they are taken for."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import SimpleITK
from scipy.spatial import cKDTree

from palpate.errors import InputDataError
from palpate.images.alignment import RigidMotion
from palpate.images.label_image import VoxelGrid
from palpate.images.readers.nifti import write_displacement_field
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.mesh.space import lagrange_space
from palpate.observation.contract import DataFile, seen_by
from palpate.observation.displacement_field import read_displacement_field
from palpate.observation.landmarks import read_landmarks
from palpate_validation.structured_meshes import box_mesh

LPS = np.array([-1.0, -1.0, 1.0])
MOTION = np.array([[0.0, 0.1, 0.0], [-0.1, 0.0, 0.02], [0.0, -0.02, 0.0]])


def away(mesh, by):
    return replace(mesh, nodes=mesh.nodes + by)


@pytest.fixture(scope="module")
def space():
    """A box of two tissues."""
    return lagrange_space(away(box_mesh(2, size=30.0), 7.0), "P2")


@pytest.fixture
def points(space):
    low, high = space.points.min(axis=0), space.points.max(axis=0)
    return np.random.default_rng(1).uniform(low + 0.05 * (high - low), high - 0.05 * (high - low), (25, 3))


def moved(points):
    return points + points @ MOTION.T + 0.01


def no_force(_name, _direction):
    raise AssertionError("points need no force")


def markups(points, labels, *, system="LPS"):
    sign = LPS if system == "LPS" else np.ones(3)
    controls = [{"label": n, "position": (sign * p).tolist()} for n, p in zip(labels, points, strict=True)]
    return {"markups": [{"type": "Fiducial", "coordinateSystem": system, "controlPoints": controls}]}


def write_lists(folder, *lists):
    """Files a.mrk.json and b.mrk.json of (labels, points, indices of those that were not placed)."""
    paths = []
    for name, (labels, points, unplaced) in zip("ab", lists, strict=True):
        content = markups(points, labels)
        for n, status in zip(unplaced, ("undefined", "missing", "preview") * len(unplaced), strict=False):
            control = content["markups"][0]["controlPoints"][n]
            control |= {"positionStatus": status, "position": [0.0, 0.0, 0.0]}
            if status == "missing":
                del control["position"]
        paths.append(folder / f"{name}.mrk.json")
        paths[-1].write_text(json.dumps(content))
    return paths


def csv_of(path, before, after, *, columns="before_x,before_y,before_z,after_x,after_y,after_z"):
    rows = [",".join(f"{x:.9g}" for x in row) for row in np.concatenate([before, after], axis=1)]
    path.write_text("\n".join([columns, *rows]) + "\n")
    return path


def read(path, *others, kind="landmarks", **more):
    file = DataFile(kind, kind, (path, *others), 1, 0.3, **more)
    return read_landmarks(file) if kind == "landmarks" else read_displacement_field(file)


@pytest.mark.parametrize("system", ["LPS", "RAS"])
@pytest.mark.parametrize("order", ["labels", "order"])
def test_two_markups_are_paired_by_label_or_else_by_order(tmp_path, points, system, order):
    labels = [f"F-{i}" for i in range(len(points))] if order == "labels" else [""] * len(points)
    shuffled = np.random.default_rng(2).permutation(len(points)) if order == "labels" else np.arange(len(points))
    (tmp_path / "a.mrk.json").write_text(json.dumps(markups(points, labels, system=system)))
    later = markups(moved(points)[shuffled], [labels[i] for i in shuffled], system=system)
    (tmp_path / "b.mrk.json").write_text(json.dumps(later))
    table = read(tmp_path / "a.mrk.json", tmp_path / "b.mrk.json").table
    np.testing.assert_allclose(table.before, points, atol=1e-9)
    np.testing.assert_allclose(table.after, moved(points), atol=1e-9)


@pytest.mark.parametrize("system", ["LPS", "RAS", "0", "1"])
def test_fcsv_says_its_coordinate_system(tmp_path, points, system):
    sign = LPS if system in ("LPS", "1") else np.ones(3)
    for name, places in (("a", points), ("b", moved(points))):
        rows = [f"{i},{','.join(map(repr, map(float, sign * p)))},0,0,0,1,1,1,0,F-{i},," for i, p in enumerate(places)]
        head = ["# Markups fiducial file version = 4.11", f"# CoordinateSystem = {system}"]
        head += ["# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"]
        (tmp_path / f"{name}.fcsv").write_text("\n".join([*head, *rows]) + "\n")
    table = read(tmp_path / "a.fcsv", tmp_path / "b.fcsv").table
    np.testing.assert_allclose(table.before, points, atol=1e-9)
    np.testing.assert_allclose(table.after, moved(points), atol=1e-9)


def numbered(name, numbers):
    return [f"{name}-{n}" for n in numbers]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (numbered("F", range(25)), numbered("F", range(25))),
        (numbered("before", range(25)), numbered("after", range(25))),  # of 3D Slicer: the list's name and a number
        ([""] * 25, [""] * 25),
        (["bead"] * 25, ["bead"] * 25),
        (numbered("F", range(25)), numbered("F", range(25, 50))),  # numbered on: only the order tells
    ],
)
def test_points_that_were_not_placed_are_left_out_and_named_however_pairs_are_found(tmp_path, points, first, second):
    paths = write_lists(tmp_path, (first, points, [2, 7]), (second, moved(points), [20]))
    source = read(*paths)
    kept = np.delete(np.arange(25), [2, 7, 20])
    np.testing.assert_allclose(source.table.before, points[kept], atol=1e-9)
    np.testing.assert_allclose(source.table.after, moved(points)[kept], atol=1e-9)
    (finding,) = source.table.pairing
    assert finding.code == "points-unpaired"
    assert all(f"{name or 'number 3'}" in finding.message for name in (first[2], first[7], second[20]) if name)


def test_points_that_one_list_lacks_are_left_out_and_the_others_are_paired_by_label(tmp_path, space, points):
    """Also where both lists are equally long, and where a label stands twice."""
    labels = [*numbered("F", range(23)), "twice", "twice"]
    first, second = np.delete(np.arange(25), [3, 11]), np.delete(np.arange(25), [5, 17])[::-1]
    own = [[labels[n] for n in each] for each in (first, second)]
    source = read(*write_lists(tmp_path, (own[0], points[first], []), (own[1], moved(points)[second], [])))
    kept = [n for n in range(23) if n not in {3, 5, 11, 17}]
    np.testing.assert_allclose(source.table.before, points[kept], atol=1e-9)
    np.testing.assert_allclose(source.table.after, moved(points)[kept], atol=1e-9)
    _, (finding,) = source.on(space, no_force)
    assert all(name in finding.message for name in ("F-3", "F-5", "F-11", "F-17", "twice"))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (numbered("F", range(25)), numbered("F", range(20, 44))),
        (numbered("F", range(25)), numbered("F", range(20, 45))),
        ([""] * 25, [""] * 24),
    ],
)
def test_lists_whose_labels_hardly_agree_or_tell_nothing_of_another_length_are_refused(tmp_path, points, first, second):
    later = moved(points)[: len(second)]
    with pytest.raises(InputDataError, match="the same label"):
        read(*write_lists(tmp_path, (first, points, []), (second, later, [])))


def test_positions_for_displacements_and_pairs_of_many_other_points_are_recognised(tmp_path):
    rng = np.random.default_rng(5)
    points = rng.uniform(-20.0, 30.0, (400, 3))
    for after in (rng.permutation(moved(points)), moved(points) - points, 1e-3 * moved(points), 2.0 * points):
        with pytest.raises(InputDataError, match="may be positions"):
            read(csv_of(tmp_path / "m.csv", points, after))
    half_turned = np.diag([-1.0, -1.0, 1.0])
    assert len(read(csv_of(tmp_path / "m.csv", points, points @ half_turned)).table.before) == len(points)


def test_fcsv_of_slicer_3_and_5(tmp_path, points):
    """The old one begins with the label; the new one has the status of each point behind the columns that it names."""
    rows = [f"F-{i},{p[0]!r},{p[1]!r},{p[2]!r},1,1" for i, p in enumerate(points.tolist())]
    (tmp_path / "a.fcsv").write_text("\n".join(["# columns = label,x,y,z,sel,vis", *rows]) + "\n")
    status = ["0" if i == 4 else "2" for i in range(len(points))]
    rows = [
        f"{i},{-p[0]!r},{-p[1]!r},{p[2]!r},0,0,0,1,1,1,0,F-{i},,,{status[i]},0"
        for i, p in enumerate(moved(points).tolist())
    ]
    head = ["# Markups fiducial file version = 5.6", "# CoordinateSystem = LPS"]
    head += ["# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"]
    (tmp_path / "b.fcsv").write_text("\n".join([*head, *reversed(rows)]) + "\n")
    table = read(tmp_path / "a.fcsv", tmp_path / "b.fcsv").table
    kept = np.delete(np.arange(len(points)), 4)
    np.testing.assert_allclose(table.before, points[kept], atol=1e-9)
    np.testing.assert_allclose(table.after, moved(points)[kept], atol=1e-9)


@pytest.mark.parametrize("units", ["um", ["m", "UCUM", "meter"]])
def test_markups_in_another_unit_are_refused(tmp_path, points, units):
    content = markups(points, [""] * len(points))
    content["markups"][0]["coordinateUnits"] = units
    (tmp_path / "a.mrk.json").write_text(json.dumps(content))
    with pytest.raises(InputDataError, match="in mm"):
        read(tmp_path / "a.mrk.json", tmp_path / "a.mrk.json")


def test_the_term_is_zero_where_the_body_moves_as_measured(tmp_path, space, points):
    source = read(csv_of(tmp_path / "m.csv", points, moved(points)))
    term, findings = source.on(space, no_force)
    motion = seen_by(term, (moved(space.points) - space.points).ravel())
    assert findings == ()
    assert np.abs(term.residuals(motion).values).max() < 1e-7
    assert term.fit(term.residuals(0.0 * motion)).rms_mm == pytest.approx(
        float(np.sqrt(np.mean(np.sum((moved(points) - points) ** 2, axis=1)))), rel=1e-6
    )


def test_points_move_with_the_alignment(tmp_path, points):
    """What the whole body moved by before it was brought back is no displacement."""
    rigid = RigidMotion(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([3.0, -2.0, 5.0]))
    source = read(csv_of(tmp_path / "m.csv", points, rigid.apply(moved(points)))).brought(rigid)
    np.testing.assert_allclose(source.table.after, moved(points), atol=1e-7)


def test_points_outside_are_named_and_left_out(tmp_path, space, points):
    far = np.concatenate([points, points[:1] + 500.0])
    term, (finding,) = read(csv_of(tmp_path / "m.csv", far, moved(far))).on(space, no_force)
    assert len(term.measured) == 3 * len(points)
    assert finding.code == "points-outside"
    assert "number 26" in finding.message


@pytest.mark.parametrize(("scale", "words"), [(1e-3, "metres"), (1e3, "micrometres")])
def test_another_unit_is_recognised(tmp_path, space, points, scale, words):
    source = read(csv_of(tmp_path / "m.csv", scale * points, scale * moved(points)))
    with pytest.raises(InputDataError, match=words):
        source.on(space, no_force)


def test_a_field_that_reaches_far_beyond_a_body_at_the_origin_is_in_no_other_unit(tmp_path):
    body = lagrange_space(away(box_mesh(2, size=30.0), -15.0), "P1")
    grid = np.stack(np.meshgrid(*[np.arange(-50.0, 51.0, 10.0)] * 3), axis=-1).reshape(-1, 3)
    field = read(csv_of(tmp_path / "field.csv", grid, moved(grid)), kind="displacement-field")
    term, _ = field.on(body, no_force)
    motion = seen_by(term, (moved(body.points) - body.points).ravel())
    assert np.abs(term.residuals(motion).values).max() < 1e-9


def test_lps_read_as_ras_is_recognised(tmp_path, space, points):
    with pytest.raises(InputDataError, match="LPS"):
        read(csv_of(tmp_path / "m.csv", LPS * points, LPS * moved(points))).on(space, no_force)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x,y,z\n1,2,3\n", "lacks the column"),
        ("before_x,before_y,before_z,after_x,after_y,after_z\n", "no pair of points"),
        ("before_x,before_y,before_z,after_x,after_y,after_z\n1,2,nan,1,2,3\n", "no number"),
        ("before_x,before_y,before_z,after_x,after_y,after_z\n1,2,1e308,1,2,-1e308\n", "beyond any body"),
        ("before_x,before_y,before_z,after_x,after_y,after_z\n1,2,three,1,2,3\n", "line 2"),
        ("before_x,before_y,before_z,after_x,after_y,after_z\n1,2,3,1,2,3\n", "did not move at all"),
        ("before_x,before_y,before_z,after_x,after_y,after_z\n1,2\n", "no number"),
    ],
)
def test_a_table_that_is_none_is_refused(tmp_path, text, words):
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(InputDataError, match=words):
        read(tmp_path / "m.csv")


@pytest.mark.parametrize("n", [1, 3])
def test_a_field_of_a_row_or_two_is_no_field_but_a_marker_is_one(tmp_path, points, n):
    path = csv_of(tmp_path / "m.csv", points[:n], moved(points[:n]))
    with pytest.raises(InputDataError, match=f"holds {n} points, and a field needs at least 4"):
        read(path, kind="displacement-field")
    assert f"{n} pair{'s' * (n > 1)} of points" in read(path).in_words


@pytest.mark.parametrize(
    "content",
    [
        "{}",
        "[",
        '{"markups": 3}',
        '{"markups": [{"controlPoints": [{"position": [1]}]}]}',
        '{"markups": [{"coordinateUnits": [], "controlPoints": []}]}',
    ],
)
def test_a_markups_file_that_is_none_is_refused(tmp_path, content):
    (tmp_path / "m.mrk.json").write_text(content)
    with pytest.raises(InputDataError):
        read(tmp_path / "m.mrk.json", tmp_path / "m.mrk.json")


def grid_and_field(space):
    low, high = space.points.min(axis=0), space.points.max(axis=0)
    affine = np.diag([*((high - low) / 11.0), 1.0])
    affine[:3, 3] = low
    grid = VoxelGrid((12, 12, 12), affine)
    centres = grid.world(np.indices(grid.shape).reshape(3, -1).T.astype(float))
    return grid, (moved(centres) - centres).reshape(*grid.shape, 3)


@pytest.mark.parametrize("ending", [".nii.gz", ".nrrd", ".mha", ".h5"])
def test_a_field_is_read_from_what_itk_writes(tmp_path, space, ending):
    grid, field = grid_and_field(space)
    field[:3] = 0.0  # says nothing there
    path = tmp_path / f"field{ending}"
    write_displacement_field(tmp_path / "own.nii.gz", field, grid)
    if ending == ".nii.gz":
        path = tmp_path / "own.nii.gz"
    else:
        image = SimpleITK.ReadImage(str(tmp_path / "own.nii.gz"), SimpleITK.sitkVectorFloat64)
        if ending == ".h5":
            whole = SimpleITK.CompositeTransform([SimpleITK.DisplacementFieldTransform(image)])
            SimpleITK.WriteTransform(whole, str(path))
        else:
            SimpleITK.WriteImage(image, str(path))
    source = read(path, kind="displacement-field", correlation_mm=2.0)
    assert len(source.table.before) == 9 * 12 * 12
    np.testing.assert_allclose(source.table.after, moved(source.table.before), atol=1e-4)
    term, _ = source.on(space, no_force)
    motion = seen_by(term, (moved(space.points) - space.points).ravel())
    assert np.abs(term.residuals(motion).values).max() < 1e-3


def round_an_organ(folder, scale):
    """A field on a lattice, which has nodes of an organ in the middle of a box, and its term; all lengths scaled."""
    mesh = box_mesh(8, size=160.0 * scale)
    inside = np.linalg.norm(mesh.nodes[mesh.tets].mean(axis=1) / scale - 80.0, axis=1) < 25.0
    tissues = tuple(replace(mesh.tissues[0], name=role.value, role=role) for role in (Role.KNOWN, Role.ESTIMATE))
    space = lagrange_space(replace(mesh, tissues=tissues, region=inside.astype(mesh.region.dtype)), "P1")
    points = scale * np.stack(np.meshgrid(*[np.arange(4.0, 160.0, 4.0)] * 3), axis=-1).reshape(-1, 3)
    table = csv_of(folder / f"{scale}.csv", points, moved(points))
    source = read(table, kind="displacement-field", correlation_mm=2.0 * scale)
    return source.on(space, no_force)[0], space, cKDTree(space.mesh.nodes[np.unique(space.mesh.tets[inside])])


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    return round_an_organ(tmp_path_factory.mktemp("large"), 1.0)


def test_means_are_of_more_points_the_further_an_organ_is(large):
    """Near the organ they are as narrow as its elements, far away wider, but not as wide as the way there."""
    term, space, organ = large
    assert np.abs(term.residuals(seen_by(term, (moved(space.points) - space.points).ravel())).values).max() < 1e-6
    means = term.material[::3]
    away, apart = organ.query(means)[0], cKDTree(means).query(means, k=2)[0][:, 1]
    size = 0.6 * space.mesh.usual_edge_mm
    near, far = apart[away < 0.5 * size], apart[away > 4.0 * size]
    assert np.median(near) < size
    assert 1.5 * np.median(near) < np.median(far) < 4.0 * size


def test_means_of_a_body_a_fiftieth_as_large_are_the_same(tmp_path, large):
    small, *_ = round_an_organ(tmp_path, 0.02)
    assert small.material / 0.02 == pytest.approx(large[0].material, abs=1e-5)


def itk_field(low, high, spacing, slope, shift):
    """The field x -> slope x + shift, LPS mm, on a grid from low to high, as a transform; a slope per axis."""
    sizes = [int(n) for n in np.rint((np.array(high) - low) / spacing) + 1]
    index = np.stack(np.indices(sizes), axis=-1)
    values = (np.array(low) + spacing * index) * slope + shift
    image = SimpleITK.GetImageFromArray(np.swapaxes(values, 0, 2), isVector=True)
    image.SetOrigin([float(x) for x in low])
    image.SetSpacing([float(spacing)] * 3)
    return SimpleITK.DisplacementFieldTransform(image)


def test_a_composite_of_fields_on_several_grids_is_what_one_after_the_other_does(tmp_path):
    """Only where a point's way keeps to all grids: beyond one ITK takes its displacement for none."""
    first = itk_field([-20.0, -20.0, -20.0], [20.0, 20.0, 20.0], 2.0, 0.05, 1.0)  # the last is applied first
    second = itk_field([-10.0, -30.0, -30.0], [30.0, 30.0, 30.0], 5.0, -0.1, 2.0)
    turn = SimpleITK.AffineTransform(3)
    turn.SetTranslation([3.0, 0.0, 0.0])
    SimpleITK.WriteTransform(SimpleITK.CompositeTransform([second, turn, first]), str(tmp_path / "all.h5"))
    source = read(tmp_path / "all.h5", kind="displacement-field")
    lps = source.table.before * LPS
    way = lps * 1.05 + 1.0 + np.array([3.0, 0.0, 0.0])
    assert source.table.after * LPS == pytest.approx(way * 0.9 + 2.0, abs=1e-9)
    grid = np.stack(np.meshgrid(*[np.arange(-20.0, 21.0, 2.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    kept = grid[:, 0] * 1.05 + 4.0 >= -10.0
    assert 0 < np.count_nonzero(kept) < len(grid)
    assert {tuple(x) for x in lps.round(6)} == {tuple(x) for x in grid[kept].round(6)}


def test_fields_whose_grids_lie_apart_are_refused(tmp_path):
    apart = [itk_field([x, 0.0, 0.0], [x + 10.0, 10.0, 10.0], 2.0, 0.0, 1.0) for x in (0.0, 50.0)]
    SimpleITK.WriteTransform(SimpleITK.CompositeTransform(apart), str(tmp_path / "apart.h5"))
    with pytest.raises(InputDataError, match=r"the 2 fields of .* write the transform as one field"):
        read(tmp_path / "apart.h5", kind="displacement-field")


def images(shift):
    """A ball in a box, and later a ball elsewhere."""
    grid = VoxelGrid((40, 40, 40), np.eye(4))
    centres = np.moveaxis(np.indices(grid.shape), 0, -1)
    tissues = (Tissue("ball", (1,), Role.ESTIMATE), Tissue("rest", (), Role.KNOWN, 0.45, 10.0))
    return [
        Segmentation((np.linalg.norm(centres - c, axis=-1) > 9.0).astype(np.int16), grid, tissues)
        for c in (np.full(3, 19.5), 19.5 + shift)
    ]


@pytest.mark.parametrize(
    ("signs", "words"), [(np.ones(3), None), (-np.ones(3), "from the later state"), (LPS, "LPS where RAS")]
)
def test_a_field_that_leads_the_other_way_is_refused(tmp_path, signs, words):
    shift = np.array([4.0, 2.0, 1.0])
    rng = np.random.default_rng(3)
    points = rng.uniform(5.0, 35.0, (4000, 3))
    near = np.linalg.norm(points - 19.5, axis=1) < 12.0
    points = points[near]
    source = read(csv_of(tmp_path / "m.csv", points, points + signs * shift), kind="displacement-field")
    if words is None:
        source.against(*images(shift))
        return
    with pytest.raises(InputDataError, match=words):
        source.against(*images(shift))
