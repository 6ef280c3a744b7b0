"""What the images say of frame, drawing and tissues, in numbers and in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.inversion import InverseProblem, LaterState, invert
from palpate.observation.surface_distance import surface_distance
from palpate.observation.target import surface_target
from palpate.statement.discrepancy import FoundDiscrepancy, OffsetFound, discrepancy_findings, discrepancy_of
from palpate.uncertainty import FittedState
from palpate.unknowns import Choice, offset_block, parameter_map, unit_blocks

DRAWN_MM = 0.6


@pytest.fixture(scope="module")
def inversion(twins, twin):
    """Of a twin whose gland is drawn larger in the later image, and whose walls' blocks are called the frame's."""
    targets = [twins.voxel_target(twin, surface) for surface in twin.surfaces]
    before, after = targets[0].voxels
    targets[0] = surface_target(twin.surfaces[0], before, after.shifted(-DRAWN_MM))
    seen, model = tuple(surface_distance(target) for target in targets), twin.model
    blocks = [replace(block, cause="frame", choice=Choice.FRAME, unit_mm=2.0) for block in unit_blocks(model.n_modes)]
    blocks += [offset_block(o, 0, sd=0.5) for o in seen if not o.of_driver]
    mapping = parameter_map(twin.scene.tissues, model.regions, blocks)
    problem = InverseProblem((LaterState(model, seen),), mapping)
    return invert(problem, twins.settings(2.0), progress=twins.silent)


@pytest.fixture(scope="module")
def found(inversion, twin):
    grid = twin.scene.before.grid
    uniform = np.tile([3.0, 0.0, -4.0], (len(twin.model.space.points), 1))
    return discrepancy_of(inversion, (FittedState(twin.model.space, uniform, grid, grid),))


def test_an_offset_has_its_size_and_an_interval_that_holds_what_was_drawn(found):
    gland, sac = found.offsets
    assert (gland.tissue, gland.state, sac.tissue) == ("gland", 0, "sac")
    assert gland.mm == pytest.approx(DRAWN_MM, abs=0.1)
    assert gland.interval95[0] < DRAWN_MM < gland.interval95[1]
    assert (gland.told, sac.told) == (True, False)


def test_the_frame_moves_as_the_faces_on_the_cut_do(found):
    (frame,) = found.frame
    assert (frame.rms_mm, frame.largest_mm) == pytest.approx((5.0, 5.0))
    assert frame.prior_mm == pytest.approx(2.0)


def test_a_drawing_that_differs_is_said_in_words(found):
    (finding,) = discrepancy_findings(found)
    assert finding.code == "drawn-otherwise"
    assert f"'gland' in 'after' lies {found.offsets[0].mm:.2g} mm further out than" in finding.message


@pytest.mark.parametrize(
    ("mm", "half", "words"),
    [(-1.2, 0.4, "1.2 mm further in"), (-1.2, 1.3, None), (0.09, 0.01, None), (0.3, 0.1, "0.3 mm further out")],
)
def test_only_what_is_larger_than_two_standard_deviations_and_a_tenth_of_a_millimetre_is_told(mm, half, words):
    offset = OffsetFound("rectum", 1, mm, (mm - half, mm + half))
    told = discrepancy_findings(FoundDiscrepancy(offsets=(offset,)))
    assert [words in finding.message for finding in told] == ([] if words is None else [True])
    assert all("'after[2]'" in finding.message for finding in told)
