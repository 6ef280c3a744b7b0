import numpy as np

from palpate.images.tissue import Role, Tissue
from palpate.mesh.anatomy import Anatomy, Box
from palpate.mesh.cutting import cut, graded_grid, signed_volumes
from palpate.mesh.snapping import contacts_of, debiased, snapped


class Sphere:
    def at(self, points):
        return np.linalg.norm(points, axis=1) - 11.0

    def gradient_at(self, points):
        return points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9)


ANATOMY = Anatomy(
    (Tissue("organ", Role.ESTIMATE, (1,)), Tissue("rest", Role.KNOWN, youngs_modulus_kpa=1.0)),
    (Sphere(), None),
    Box(np.full(3, -20.0), np.eye(3), np.array([40.0, 40.0, 27.0])),
)


def _cut_sphere():
    grid = graded_grid(ANATOMY.box, lambda p: np.full(len(p), 7.0), coarsest_mm=7.0, region=1)
    touch = np.full(len(grid.nodes), 0.8)
    return cut(grid, Sphere(), inside=0, splittable=grid.region == 1, touch_mm=touch, box=ANATOMY.box)


def test_snapped_nodes_lie_on_the_surface_and_stay_on_the_box():
    grid = _cut_sphere()
    contacts = contacts_of(grid, ANATOMY)
    moved = snapped(grid, contacts, limit_mm=2.0)
    assert np.abs(Sphere().at(moved.nodes[contacts.on[:, 0]])).max() < 0.02
    assert np.array_equal(ANATOMY.box.faces_at(moved.nodes), ANATOMY.box.faces_at(grid.nodes))
    assert signed_volumes(moved.nodes, moved.tets).min() > 0.0


def test_debiasing_takes_the_sag_of_the_facets_out_of_the_volume():
    grid = _cut_sphere()
    contacts = contacts_of(grid, ANATOMY)
    exact = np.pi * (2 / 3 * 11.0**3 + 11.0**2 * 7.0 - 7.0**3 / 3)  # the box cuts the ball 7 mm above its centre
    on_surface = snapped(grid, contacts, limit_mm=2.0)
    meshes = (on_surface, debiased(on_surface, contacts)[0])
    errors = [signed_volumes(m.nodes, m.tets)[m.region == 0].sum() / exact - 1.0 for m in meshes]
    assert errors[0] < -0.02
    assert abs(errors[1]) < 0.006
