import dataclasses
import functools

import numpy as np
import pytest

from palpate.errors import ConfigurationError
from palpate.images.tissue import Role
from palpate.phantoms.motion import smooth_field
from palpate.phantoms.pelvis import PelvisOptions, pelvis, pelvis_anatomy, pelvis_motions
from palpate.phantoms.pelvis_shapes import draw_pelvis
from palpate.phantoms.scene import centred_grid, grid_box
from palpate.phantoms.shapes import Union

BOX = grid_box(centred_grid((110.0, 120.0, 120.0), (1.0, 1.0, 1.0)))


def directions(n=1500):
    vectors = np.random.default_rng(0).normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@functools.cache
def scene():
    return pelvis(
        PelvisOptions(
            seed=3,
            filling_mm=3.0,
            truth_edge_mm=10.0,
            tumour=True,
            bones=True,
            bone_motion_mm=1.0,
            spacing_mm=(2.5, 2.5, 3),
        )
    )


@pytest.mark.parametrize("seed", range(6))
def test_drawn_organs_lie_as_in_a_pelvis(seed):
    body = draw_pelvis(np.random.default_rng(seed), BOX, bones=True)
    organs = Union([body.prostate, body.bladder])
    assert -7.0 < body.bladder.at(body.prostate.surface(directions())).min() < -3.0  # pressed into the bladder
    assert 7.5 < organs.at(body.rectum.surface(directions())).min() < 10.5
    assert body.prostate.at(body.tumour.surface(directions())).max() < -1.0
    assert 4.0 / 3.0 * np.pi * np.prod(body.tumour.semi_axes) >= 5000.0
    for bone in body.bones:
        assert Union([organs, body.rectum]).at(bone.surface(directions())).min() > 2.5
    for shape in (body.prostate, body.bladder, body.rectum, *body.bones):
        local = BOX.local(shape.surface(directions()))
        assert (local > 2.0).all()
        assert (BOX.lengths - local > 2.0).all()


def test_a_pelvis_is_refused_a_field_that_is_too_small():
    with pytest.raises(ConfigurationError, match="fits into a field"):
        pelvis(PelvisOptions(seed=1, field_mm=(80.0, 80.0, 80.0)))


def test_every_tissue_has_its_role_its_label_and_its_modulus():
    truth = scene()
    roles = {tissue.name: tissue.role for tissue in truth.tissues}
    assert roles == {
        "tumour": Role.ESTIMATE,
        "prostate": Role.ESTIMATE,
        "bladder": Role.ESTIMATE,
        "rectum": Role.DRIVER,
        "left bone": Role.RIGID,
        "right bone": Role.RIGID,
        "surroundings": Role.KNOWN,
    }
    assert set(np.unique(truth.before.labels)) == set(range(1, 8))
    assert 2.0 <= truth.moduli_kpa["tumour"] / truth.moduli_kpa["prostate"] <= 3.0
    assert 15.0 <= truth.moduli_kpa["bladder"] <= 60.0
    assert truth.moduli_kpa["surroundings"] == 10.0


def test_rectum_fills_and_pushes_the_prostate():
    truth = scene()
    rectum = truth.mesh.tissue_index("rectum") + 1
    filled = np.count_nonzero(truth.after.labels == rectum) / np.count_nonzero(truth.before.labels == rectum)
    assert 1.1 < filled < 1.6
    prostate = np.unique(truth.space.cells[truth.mesh.region == truth.mesh.tissue_index("prostate")])
    assert np.linalg.norm(truth.displacement[prostate], axis=1).mean() > 0.2


def test_bones_move_as_rigid_bodies():
    truth = scene()
    bone = truth.mesh.tissue_index("left bone")
    wall = np.unique(truth.space.facets(truth.mesh.boundary[truth.mesh.beyond == bone]))
    rest = truth.space.points[wall]
    moved = rest + truth.displacement[wall]
    assert np.linalg.norm(moved - moved[0], axis=1) == pytest.approx(np.linalg.norm(rest - rest[0], axis=1), abs=1e-9)
    assert np.linalg.norm(moved - rest, axis=1).max() > 0.7


def test_outer_border_is_held():
    truth = scene()
    outer = np.unique(truth.space.facets(truth.mesh.boundary[truth.mesh.beyond == -1]))
    assert np.abs(truth.displacement[outer]).max() == 0.0
    assert np.abs(np.abs(truth.space.points[outer]).max(axis=0) - [55.0, 60.0, 60.0]).max() < 1e-6


PLAIN = PelvisOptions(seed=3, filling_mm=3.0, spacing_mm=(2.5, 2.5, 3))


def test_wall_motion_does_not_depend_on_what_else_is_asked_for():
    field = smooth_field(np.random.default_rng(0), sd_mm=1.0, correlation_mm=20.0)
    points = 30.0 * field.at(directions(20))
    assert pelvis_motions(PLAIN)["rectum"].at(points) == pytest.approx(scene().motions["rectum"].at(points))
    assert moduli(PLAIN)["prostate"] == scene().moduli_kpa["prostate"]


def test_another_motion_moves_the_same_body():
    options = dataclasses.replace(PLAIN, motion_seed=1)
    assert moduli(options) == moduli(PLAIN)
    points = 30.0 * directions(100)
    for ours, theirs in zip(*(pelvis_anatomy(of).level_sets[:3] for of in (options, PLAIN)), strict=True):
        assert np.array_equal(ours.at(points), theirs.at(points))
    space = scene().space
    wall = space.mesh.boundary[space.mesh.beyond == space.mesh.tissue_index("rectum")]
    points = space.points[np.unique(space.facets(wall))]
    moved, before = pelvis_motions(options)["rectum"].at(points), scene().motions["rectum"].at(points)
    assert np.linalg.norm(moved - before, axis=1).max() > 0.5
    assert np.linalg.norm(moved, axis=1).max() == pytest.approx(3.0, rel=0.3)


def moduli(options):
    """True modulus (kPa) of every meshed tissue, by name."""
    return {tissue.name: tissue.youngs_modulus_kpa for tissue in pelvis_anatomy(options).tissues if tissue.meshed}
