"""What is compared with an image: the free part of a surface, with its share, in flat triangles."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.errors import GeometryError
from palpate.images.tissue import Role, Tissue
from palpate.mesh.space import lagrange_space
from palpate.mesh.surface import triangle_normals
from palpate.observation.observed_surface import observed_surface

SIZE = 30.0


def scene(meshes, top_role=Role.DRIVER, element="P1", side=-1):
    """An organ in the upper half of a box under a tissue of `top_role`; `side` is behind the other faces."""
    tissues = [meshes.known("fat"), meshes.unknown("organ"), Tissue("top", top_role), Tissue("air", Role.VOID)]
    mesh = meshes.box_mesh(
        4,
        size=SIZE,
        tissues=tissues,
        region=lambda c: (c[:, 2] > 15.0).astype(int),
        beyond=lambda f: np.where(f[:, 2] > SIZE - 1e-9, 2, side),
    )
    return lagrange_space(mesh, element)


def areas(surface):
    return np.linalg.norm(triangle_normals(surface.rest, surface.triangles), axis=1)


@pytest.mark.parametrize("element", ["P1", "P2"])
@pytest.mark.parametrize("top", [Role.DRIVER, Role.RIGID])
def test_faces_on_drivers_bones_and_the_cut_are_not_observed(meshes, top, element):
    surface = observed_surface(scene(meshes, top, element), 1)
    heights = surface.rest[surface.triangles].mean(axis=1)[:, 2]
    assert np.array_equal(surface.observed, np.abs(heights - 15.0) < 1e-9)
    assert areas(surface).sum() == pytest.approx(2 * 900.0 + 4 * 450.0)
    assert surface.share == pytest.approx(900.0 / 3600.0)


def test_faces_in_air_are_observed(meshes):
    space = scene(meshes, Role.VOID, side=3)
    assert observed_surface(space, 1).share == pytest.approx(1.0)
    assert observed_surface(scene(meshes, Role.VOID), 1).share == pytest.approx(0.5)


def test_faces_between_two_unknown_tissues_are_observed(meshes):
    tissues = [meshes.unknown("gland"), meshes.unknown("tumour")]
    mesh = meshes.box_mesh(4, size=SIZE, tissues=tissues, region=lambda c: (c[:, 2] > 15.0).astype(int))
    for tissue in range(2):
        assert observed_surface(lagrange_space(mesh, "P1"), tissue).share == pytest.approx(0.25)


def test_all_of_a_drivers_wall_is_observed(meshes):
    surface = observed_surface(scene(meshes), 2)
    assert surface.observed.all()
    assert surface.share == 1.0
    assert surface.rest[:, 2] == pytest.approx(SIZE)
    assert np.all(triangle_normals(surface.rest, surface.triangles)[:, 2] < 0.0)  # out of the driver, into the body


def test_too_little_to_observe_is_refused_with_its_share(meshes):
    tissues = [meshes.known("fat"), meshes.unknown("organ"), Tissue("rectum", Role.DRIVER)]
    mesh = meshes.box_mesh(
        3,
        size=SIZE,
        tissues=tissues,
        region=lambda c: (~np.all(c < 10.0, axis=1)).astype(int),
        beyond=lambda f: np.full(len(f), 2),
    )
    with pytest.raises(GeometryError, match="'organ': only 6 %"):
        observed_surface(lagrange_space(mesh, "P1"), 1)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_its_points_are_those_of_the_space(meshes, element):
    space = scene(meshes, element=element)
    surface = observed_surface(space, 1)
    assert np.array_equal(space.points[surface.points], surface.rest)
    numbers = np.arange(3 * len(space.points)).reshape(-1, 3)
    assert np.array_equal(surface.dofs, numbers[surface.points].ravel())


def test_a_quadratic_face_becomes_four_triangles(meshes):
    linear, quadratic = (observed_surface(scene(meshes, element=e), 1) for e in ("P1", "P2"))
    assert len(quadratic.triangles) == 4 * len(linear.triangles)
    assert areas(quadratic) == pytest.approx(areas(linear)[0] / 4.0)
    outwards = triangle_normals(quadratic.rest, quadratic.triangles)
    away = quadratic.rest[quadratic.triangles].mean(axis=1) - [15.0, 15.0, 22.5]
    assert np.all(np.einsum("na,na->n", outwards, away) > 0.0)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_the_rim_is_where_the_observed_part_ends(meshes, element):
    surface = observed_surface(scene(meshes, element=element), 1)
    triangle, corner = np.nonzero(surface.rim)
    ends = np.stack([surface.triangles[triangle, (corner + k) % 3] for k in (1, 2)], axis=1)
    at = surface.rest[ends]  # (n, 2, 3)
    on_side = np.any((np.abs(at).max(axis=1) < 1e-9) | (np.abs(at - SIZE).max(axis=1) < 1e-9), axis=1)
    assert on_side.all()
    assert np.abs(at[..., 2] - 15.0).max() < 1e-9
    assert np.linalg.norm(at[:, 0] - at[:, 1], axis=1).sum() == pytest.approx(4 * SIZE)


def test_an_organ_that_the_mesh_has_nothing_of_is_refused(meshes):
    """As one of two voxels across is, which the smoothing of the images takes away."""
    tissues = [meshes.known("fat"), meshes.unknown("organ"), meshes.unknown("sheet")]
    mesh = meshes.box_mesh(4, size=SIZE, tissues=tissues, region=lambda c: (c[:, 2] > 15.0).astype(int))
    with pytest.raises(GeometryError, match="'sheet' is so thin"):
        observed_surface(lagrange_space(mesh, "P1"), 2)
