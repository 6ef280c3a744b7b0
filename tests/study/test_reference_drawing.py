"""How a reference image is drawn is unknown where several later images are compared with it, of every organ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from palpate.body.body import joint_problem, make_body
from palpate.body.imaged import aligned
from palpate.case.case import Case, CaseTissue, Discrepancy, Domain, DriverMotion, Images, Mechanics, MeshSettings
from palpate.images.segmentation import segment
from palpate.progress import silent
from palpate.unknowns import Acts

DRIVER, ORGANS = "tube", ["gland", "sac"]


@pytest.fixture(scope="module")
def bodies(twins, twin):
    """Bodies of a reference image with one, two and three later ones, and their case."""
    tissues = twin.scene.tissues
    before = segment(twin.scene.before, tissues)
    later = [segment(of.scene.after, tissues) for of in (twin, *(twins.deformed(twin.model, seed=s) for s in (6, 7)))]
    case = Case(
        "twin",
        images=Images(Path("before.nii.gz"), tuple(Path(f"{i}.nii.gz") for i in range(3))),
        tissues=tuple(CaseTissue(t.name, t.labels, t.role, youngs_modulus_kpa=t.youngs_modulus_kpa) for t in tissues),
        mesh=MeshSettings(7.0),
        mechanics=Mechanics("linear", "P1"),
        driver=DriverMotion(modes=8),
        domain=Domain(outer_boundary="fixed"),
        discrepancy=Discrepancy(0.0, 25.0, 0.0),
    )
    made = [make_body(aligned(before, tuple(later[:n]), method="none"), case, progress=silent) for n in (1, 2, 3)]
    return dict(zip((1, 2, 3), made, strict=True)), case


def drawn(problem):
    """The surfaces with modes at rest, by name with the later states that share them."""
    return [(b.of, b.states) for b in problem.parameters.blocks if b.acts is Acts.REFERENCE]


def test_one_later_image_has_none_for_the_noise_says_as_much(bodies):
    of, case = bodies
    problem = joint_problem((of[1],), case, progress=silent)
    assert drawn(problem) == []
    assert all(not state.at_rest for state in problem.states)


@pytest.mark.parametrize("n", [2, 3])
def test_several_share_one_of_each_organ_and_none_of_a_driver(bodies, n):
    of, case = bodies
    problem = joint_problem((of[n],), case, progress=silent)
    assert {o.name for o in problem.states[0].observations} == {*ORGANS, DRIVER}
    assert drawn(problem) == [(name, tuple(range(n))) for name in ORGANS]
    sizes = {b.of: b.size for b in problem.parameters.blocks if b.acts is Acts.REFERENCE}
    for state in problem.states:
        assert {name: modes.shape[1] for name, modes in state.at_rest.items()} == sizes
        for o in state.observations:
            assert o.of_driver or len(state.at_rest[o.name]) == len(o.dofs)


def test_each_reference_image_has_its_own_and_one_that_is_seen_once_has_none(bodies):
    of, case = bodies
    problem = joint_problem((of[2], of[1], of[2]), case, progress=silent)
    assert drawn(problem) == [(name, states) for states in ((0, 1), (3, 4)) for name in ORGANS]
    assert [sorted(state.at_rest) for state in problem.states] == [ORGANS, ORGANS, [], ORGANS, ORGANS]
    own = [problem.parameters.acting(Acts.REFERENCE, s) for s in range(5)]
    assert np.array_equal(own[0], own[1])
    assert len(own[2]) == 0
    assert not set(own[0]) & set(own[3])
    for s in range(5):
        moved = set(problem.parameters.unknowns_of(s))
        assert moved >= set(own[s])
        assert not moved & (set(own[0] if s > 1 else own[3]))
