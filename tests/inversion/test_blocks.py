"""Unknowns beside the moduli: how surfaces are drawn, how the frame moves, and a kind that nobody has thought of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.images.tissue import Role, Tissue
from palpate.inversion import InverseProblem, LaterState, invert
from palpate.inversion.linear_evidence import EVERY, LinearEvidence
from palpate.inversion.objective import Evaluation
from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.material import material_modes
from palpate.mechanics.rigid import rigid_modes
from palpate.mesh.anatomy import Anatomy, Box
from palpate.mesh.space import lagrange_space
from palpate.mesh.surface import cut_faces
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.observation.prescribed_motion import FrameMotion, prescribed_motion
from palpate.observation.surface_distance import surface_distance
from palpate.observation.target import surface_target
from palpate.phantoms.shapes import ball
from palpate.unknowns import (
    Acts,
    Arrowhead,
    Block,
    ParameterMap,
    material_blocks,
    offset_block,
    parameter_map,
    sought_ratio_blocks,
    unit_blocks,
)
from palpate.unknowns.blocks import frame_blocks, only

DRAWN_MM = 0.3


@pytest.fixture(scope="module")
def gelatine():
    """A ball in a box, without a driver."""
    tissues = (
        Tissue("gland", Role.ESTIMATE, (1,), 0.40),
        Tissue("rest", Role.KNOWN, (2,), 0.43, youngs_modulus_kpa=10.0),
    )
    box = Box(np.full(3, -15.0), np.eye(3), np.full(3, 30.0))
    anatomy = Anatomy(tissues, (ball([0.0, 0.0, 0.0], 7.0), None), box)
    return lagrange_space(tetrahedralise(anatomy, edge_length_mm=7.0), "P1")


@pytest.fixture(scope="module")
def motion(gelatine):
    return prescribed_motion(gelatine, {}, n_modes=3, kernel_mm=10.0, prior_mm=1.0, frame=FrameMotion(1.5, 30.0))


def test_a_frame_that_moves_rigidly_takes_the_body_along(gelatine, motion):
    """Translations to the last digit, and small rotations, for they are linear in the place: no strain, no stress."""
    given = {"modes": motion.modes, "offset": motion.offset, "prescribed": motion.prescribed}
    model = linear_model(gelatine, outer_constraint(gelatine, outer="moving", **given))
    rigid = rigid_modes(gelatine.points)
    for column in range(motion.modes.shape[1] - 6, motion.modes.shape[1]):
        moved = model.solve(np.array([30.0, 10.0]), np.eye(motion.modes.shape[1])[column]).values
        left = moved - rigid @ np.linalg.lstsq(rigid, moved, rcond=None)[0]
        assert np.abs(left).max() < 1e-9 * np.abs(moved).max()


def test_the_frame_is_what_the_image_cuts_and_moves_as_its_kernel_says(gelatine, motion):
    points = np.unique(gelatine.facets(cut_faces(gelatine.mesh)))
    moved = motion.modes.any(axis=1).reshape(-1, 3).any(axis=1)
    assert np.array_equal(np.flatnonzero(moved), points)
    smooth = motion.modes[:, : motion.modes.shape[1] - 6].reshape(-1, 3, motion.modes.shape[1] - 6)[points, 0]
    far = np.sum((gelatine.points[points][:, None] - gelatine.points[points]) ** 2, axis=2)
    expected = 1.5**2 * np.exp(-far / (2.0 * 30.0**2))
    assert np.abs(smooth @ smooth.T - expected).mean() < 0.02 * 1.5**2
    blocks = frame_blocks(motion, 0)
    assert [block.size for block in blocks] == [smooth.shape[1], 6]


@pytest.mark.parametrize(("moved_mm", "low", "high"), [(0.02, 0.015, 0.06), (0.25, 0.15, 0.3), (2.0, 1.5, 3.0)])
def test_a_frame_is_believed_to_stand_still_to_hardly_move_or_to_move(motion, moved_mm, low, high, rng):
    """By a motion of its own kernel, seen to 0.1 mm at every point: as far as that one, of what is stated 1.5 mm."""
    blocks = frame_blocks(motion, 0)
    mapping = ParameterMap(np.ones(1), np.zeros((1, 0)), (), "rest", True, blocks)
    n = blocks[0].size
    smooth, information = motion.modes[:, :n], motion.modes.T @ motion.modes / 0.1**2
    x = np.append(moved_mm / 1.5 * rng.normal(size=n), np.zeros(6))
    prior, nothing = mapping.prior_matrix, np.zeros(len(x))
    matrix = Arrowhead.of(information, mapping.places.images) + prior
    evaluation = Evaluation(0.0, 0.0, -information @ x, matrix, (), prior, nothing)
    likeliest = LinearEvidence.of(mapping, evaluation, nothing).compared(EVERY)[0]
    believed = np.linalg.inv(mapping.choosing(dict(likeliest.chosen)).prior_matrix.dense)[:n, :n]
    moves = smooth.any(axis=1)
    sd = np.sqrt(np.einsum("pm,mk,pk->p", smooth[moves], believed, smooth[moves]).mean())
    assert 0.98 * low < sd < 1.02 * high


def test_blocks_stand_in_the_order_in_which_the_model_takes_them(gelatine, motion):
    modes = material_modes(gelatine.mesh, (0, 1), length_mm=12.0, poisson=((0,), (1,)))
    material = material_blocks(modes, gelatine.mesh, (0, 1), heterogeneity_sd=0.3, poisson_sd=0.02)
    frames = [block for state in (0, 1) for block in frame_blocks(motion, state)]
    mapping = parameter_map(gelatine.mesh.tissues, (0, 1), [*frames, *material])
    n_frame = sum(block.size for block in frame_blocks(motion, 0))
    x = np.arange(float(mapping.n_unknowns))
    first, second = mapping.coefficients(x)
    assert len(first) == len(second) == n_frame + modes.n_modes
    assert np.array_equal(first[n_frame:], second[n_frame:])  # one body, one material
    assert not set(first[:n_frame]) & set(second[:n_frame])
    alone, own = mapping.alone(1)
    assert np.array_equal(alone.coefficients(x[own])[0], second)


def test_a_ratio_that_is_sought_is_one_unknown_of_all_reference_states_and_the_last_of_each_model(gelatine):
    modes = material_modes(gelatine.mesh, (0,), length_mm=12.0, poisson=((1,), (0,)))
    own = {"heterogeneity_sd": 0.3, "poisson_sd": 0.02, "n_sought": 1}
    of_each = [block for s in (0, 1) for block in material_blocks(modes, gelatine.mesh, (s,), **own)]
    sought = sought_ratio_blocks([("gland", 0.01, 0.05)], (0, 1))
    mapping = parameter_map(gelatine.mesh.tissues, (0, 1), [*of_each, *sought])
    first, second = mapping.coefficients(np.arange(float(mapping.n_unknowns)))
    assert len(first) == len(second) == modes.n_modes
    assert first[-1] == second[-1] == mapping.n_unknowns - 1
    assert not set(first[:-1]) & set(second[:-1])
    assert mapping.prior_centre.tolist() == [0.0] * (mapping.n_unknowns - 1) + [0.01]


def drawn_otherwise(twins, twin, blocks_of):
    """The voxel problem of a twin whose gland is drawn larger in the later image."""
    surfaces = twin.surfaces
    targets = [twins.voxel_target(twin, surface) for surface in surfaces]
    before, after = targets[0].voxels
    targets[0] = surface_target(surfaces[0], before, after.shifted(-DRAWN_MM))
    seen = tuple(surface_distance(target) for target in targets)
    model = twin.model
    mapping = parameter_map(twin.scene.tissues, model.regions, [*unit_blocks(model.n_modes), *blocks_of(seen)])
    return InverseProblem((LaterState(model, seen),), mapping)


def test_a_surface_that_is_drawn_larger_is_found_and_no_modulus_pays_for_it(twins, twin):
    settings = twins.settings(2.0)
    known = invert(drawn_otherwise(twins, twin, lambda _: ()), settings, progress=twins.silent)
    problem = drawn_otherwise(twins, twin, lambda seen: [offset_block(o, 0, sd=0.5) for o in seen])
    found = invert(problem, settings, progress=twins.silent)
    offsets = problem.parameters.offsets(found.minimum.unknowns, 0)
    assert offsets[0] == pytest.approx(DRAWN_MM, abs=0.1)
    assert abs(offsets[1]) < 0.1
    assert abs(offsets[2]) < 1e-3  # the driver's is considered
    alike = invert(twins.voxel_problem(twin), settings, progress=twins.silent).minimum.unknowns[:2]
    off = [np.abs(run.minimum.unknowns[:2] - alike).max() for run in (found, known)]
    assert off[0] < 0.1
    assert off[0] < 0.3 * off[1]


def test_an_offset_is_believed_wide_where_a_search_begins_and_by_what_is_likelier_where_it_ends(twins, twin):
    """Held small at first, what is drawn otherwise is taken for motion. That of a driver is held all along."""
    problem = drawn_otherwise(twins, twin, lambda seen: [offset_block(o, 0, sd=0.5) for o in seen])
    begins = 1.0 / np.sqrt(problem.parameters.prior_matrix.diagonal[-3:])
    found = invert(problem, twins.settings(2.0), progress=twins.silent)
    ends = 1.0 / np.sqrt(found.objective.parameters.prior_matrix.diagonal[-3:])
    assert begins == pytest.approx([0.5, 0.5, 0.5e-4])
    assert ends == pytest.approx([0.5, 0.05, 0.5e-4])
    (image,) = found.mixture.explanations[0].images
    assert image == ("gland drawn otherwise",)


def test_another_kind_of_boundary_motion_is_a_block_and_its_modes(twins, twin):
    """A table that presses on the body: one more mode of what is prescribed, one more block, and nothing else."""
    space, old = twin.model.space, twin.model.constraint
    lowest = np.isclose(space.points[:, 2], space.points[:, 2].min())
    table = np.zeros((len(space.points), 3))
    table[lowest, 2] = 1.0
    constraint = replace(old, modes=np.column_stack([old.modes, table.ravel()]))
    model = linear_model(space, constraint)
    pressed = twins.deformed(model, voxel_mm=1.5, seed=5)
    problem = twins.exact_problem(pressed)
    blocks = [*unit_blocks(old.n_modes), Block("table", "table", Acts.BOUNDARY, (0,), only(np.eye(1)))]
    parameters = parameter_map(pressed.scene.tissues, model.regions, blocks)
    found = invert(replace(problem, parameters=parameters), twins.settings(2.0), progress=twins.silent)
    assert found.minimum.unknowns[:2] == pytest.approx(twins.TRUTH, abs=1e-3)
    assert found.minimum.unknowns[-1] == pytest.approx(pressed.coefficients[-1], abs=1e-3)
