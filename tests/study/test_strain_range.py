"""The linear law is warned of where strains leave its range, and nowhere else."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from palpate.body.body import Body
from palpate.body.imaged import ImagedStates
from palpate.body.refusals import linear_strain_warnings
from palpate.case.case import Mechanics
from palpate.mechanics.laws.registry import LAWS
from palpate.study.run import strain_warnings


@pytest.fixture
def space(case_result):
    return case_result.space


def stretched(space, amount, share=1.0):
    """The part of the box below `share` of its height in z is stretched along z by `amount`, the rest is carried."""
    z = space.points[:, 2]
    top = z.min() + share * np.ptp(z)
    along = amount * (np.minimum(z, top) - z.min())
    return np.column_stack([np.zeros_like(z), np.zeros_like(z), along])


def test_large_strains_under_the_linear_law_are_warned_of(space):
    (remark,) = linear_strain_warnings(LAWS["linear"], (space, [stretched(space, 0.2)]), images=["late.nii"])
    assert remark.code == "linear-strains"
    for words in ("In 'late.nii' 100.0 %", "99th percentile 22 %", 'law = "neo-hookean"'):  # (1.2^2 - 1) / 2 = 0.22
        assert words in remark.message
    assert "free of stress, the emptier one, as 'before'" in remark.message


def test_small_strains_pass(space):
    assert linear_strain_warnings(LAWS["linear"], (space, [stretched(space, 0.09)]), images=["a"]) == ()


@pytest.mark.parametrize("law", ["neo-hookean", "mooney-rivlin"])
def test_finite_strain_laws_pass(space, law):
    assert linear_strain_warnings(LAWS[law], (space, [stretched(space, 0.5)]), images=["a"]) == ()


def test_the_share_is_that_of_the_volume(space):
    (remark,) = linear_strain_warnings(LAWS["linear"], (space, [stretched(space, 0.3, share=0.3)]), images=["a"])
    volumes, height = space.mesh.volumes, space.mesh.nodes[:, 2]
    below = height[space.mesh.tets].max(axis=1) <= height.min() + 0.3 * np.ptp(height) + 1e-9
    assert f"In 'a' {100 * volumes[below].sum() / volumes.sum():.1f} %" in remark.message


def test_the_image_that_strains_most_is_named(space):
    motions = [stretched(space, amount, share) for amount, share in ((0.2, 0.5), (0.2, 1.0), (0.0, 1.0))]
    (remark,) = linear_strain_warnings(
        LAWS["linear"], (space, motions[:1]), (space, motions[1:]), images=["one", "two", "three"]
    )
    assert remark.message.startswith("In 'two'")


def test_nothing_fitted_is_nothing_strained(space):
    assert linear_strain_warnings(LAWS["linear"], (space, []), images=["a"]) == ()


def test_every_pair_of_images_meets_its_own_mesh_and_displacements(case_result):
    r = case_result
    case = dataclasses.replace(r.case, mechanics=Mechanics(law="linear"))
    body = Body(ImagedStates(r.before, r.pairs[0].later), r.space, None, 1.0)
    small = dataclasses.replace(r.space, mesh=dataclasses.replace(r.space.mesh, nodes=0.5 * r.space.mesh.nodes))
    half = dataclasses.replace(body, space=small)
    motion = stretched(r.space, 0.08)  # on the mesh of half the size it strains twice as much
    estimation = dataclasses.replace(r.estimation, displacements=(motion, motion))
    (remark,) = strain_warnings(case, (body, half), estimation)
    assert "100.0 %" in remark.message
    assert "99th percentile 17 %" in remark.message  # (1.16^2 - 1) / 2
    finite = dataclasses.replace(r.case, mechanics=Mechanics(law="neo-hookean"))
    assert strain_warnings(finite, (body, half), estimation) == ()
