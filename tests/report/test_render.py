"""Pictures made without a display: what is near hides what is far, and sizes are true."""

from __future__ import annotations

import io

import matplotlib.image as mpimg
import numpy as np
import pytest

from palpate.report.collect import collect
from palpate.report.pictures import mesh_png, organs_png, section_faces
from palpate.report.render import Camera, Triangles, render_png


def square(size, depth, colour):
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * size / 2 + [0, 0, depth]
    faces = corners[np.array([[0, 1, 2], [0, 2, 3]])]
    return faces, np.tile(np.array(colour, float), (2, 3, 1)), np.tile([0.0, 0.0, 1.0], (2, 3, 1))


def picture(*squares, **options):
    triangles = Triangles(*(np.concatenate(arrays) for arrays in zip(*squares, strict=True)), **options)
    camera = Camera(np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, 1.0]))
    return mpimg.imread(io.BytesIO(render_png(triangles, camera, width=100, height=80, fill=1.0)))


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_hides_the_farther_in_any_order(order):
    both = [square(40.0, 0.0, (1, 0, 0)), square(20.0, 5.0, (0, 0, 1))][::order]
    drawn = picture(*both)
    assert drawn.shape == (80, 100, 4)
    assert drawn[40, 50, 2] > 0.8
    assert drawn[40, 50, 0] < 0.1
    assert drawn[10, 50, 0] > 0.8


def test_a_square_fills_the_height_and_nothing_else():
    drawn = picture(square(40.0, 0.0, (1, 1, 1)))
    assert (drawn[..., 3] > 0.5).sum() == pytest.approx(80 * 80, rel=0.03)
    assert drawn[:, :8, 3].max() == 0.0


def test_what_faces_away_is_not_drawn():
    """Half of a closed surface faces away, and lies behind its front."""
    faces, colours, normals = square(40.0, 0.0, (1, 1, 1))
    drawn = picture(square(50.0, -5.0, (1, 0, 0)), (faces[:, ::-1], colours, normals))
    assert drawn[40, 50, 0] > 0.8
    assert drawn[40, 50, 1] < 0.1


def test_edges_are_darker_than_faces():
    plain, edged = picture(square(40.0, 0.0, (1, 1, 1))), picture(square(40.0, 0.0, (1, 1, 1)), edges=True)
    diagonal = np.arange(15, 65)
    assert edged[79 - diagonal, diagonal + 10, 0].mean() < 0.75 * plain[79 - diagonal, diagonal + 10, 0].mean()
    assert edged[20, 30, 0] == plain[20, 30, 0]


def test_a_camera_sees_the_patients_left_on_its_right_from_the_front():
    camera = Camera.looking((0.0, 1.0, 0.0))
    np.testing.assert_allclose(camera.right, [-1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)


def test_the_cut_mesh_is_bounded_by_closed_faces(case_result):
    data = collect(case_result)
    faces, tets = section_faces(data.mesh, axis=0, position=20.0)
    edges, count = np.unique(
        np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_counts=True
    )
    assert (count % 2 == 0).all()
    assert len(edges)
    assert set(data.mesh.region[tets]) == {0, 1, 3}
    assert all(set(face) <= set(data.mesh.tets[tet]) for face, tet in zip(faces, tets, strict=True))
    assert volume_within(data.mesh.nodes[faces]) > 0.0


def test_surfaces_are_seen_from_outside(case_result):
    """What faces away is not drawn: a surface turned inside out would show its far side."""
    data = collect(case_result)
    for later in data.later:
        assert all(volume_within(model.rest[model.triangles]) > 0.0 for model in later.model)


def volume_within(corners):
    """Volume (mm^3) within triangles (n, 3 corners, 3) that run counter-clockwise seen from outside."""
    a, b, c = (corners[:, k].astype(float) for k in range(3))
    return float(np.einsum("na,na->", a, np.cross(b, c))) / 6.0


def test_the_reports_pictures_are_drawn(case_result):
    data = collect(case_result)
    rest, fitted = (organs_png(data, data.later[0], fitted=fitted) for fitted in (False, True))
    pictures = [rest, fitted, *(mesh_png(data, by=by) for by in ("tissue", "modulus", "strain"))]
    assert len(set(pictures)) == 5
    assert all(content.startswith(b"\x89PNG") for content in pictures)
