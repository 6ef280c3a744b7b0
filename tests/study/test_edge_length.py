"""The edge length that a case leaves to its organs: it follows their size, and how well their surfaces are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from palpate.body.edge_length import EdgeLength, edge_length_of
from palpate.case.case import Case, Mechanics, MeshSettings, Noise, Phantom
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue

TISSUES = (
    Tissue("gland", Role.ESTIMATE, (1,)),
    Tissue("bowel", Role.DRIVER, (2,)),
    Tissue("rest", Role.KNOWN, (), 0.45, 10.0),
)
CASE = Case("balls", phantom=Phantom("spheres", 1))


def image(radius_mm=15.0, *, bowel_mm=16.0, inner_mm=0.0, scale=1.0):
    """A ball, or a shell around `inner_mm`, above a round bowel, on voxels of `scale` mm; lengths grow with them."""
    places = np.stack(np.meshgrid(*[np.arange(80.0)] * 3, indexing="ij"), axis=-1) - 39.5
    far = np.linalg.norm(places - np.array([0, 0, 8]), axis=-1)
    index = np.full(far.shape, 2)
    index[(far < radius_mm) & (far >= inner_mm)] = 0
    index[np.linalg.norm(places + np.array([0, 0, 22]), axis=-1) < bowel_mm] = 1
    return Segmentation(index, VoxelGrid((80, 80, 80), np.diag([scale, scale, scale, 1.0])), TISSUES)


def chosen(picture, case=CASE):
    return edge_length_of(case, picture, (picture,))


def test_a_stated_edge_length_holds_whatever_the_organs_are():
    stated = dataclasses.replace(CASE, mesh=MeshSettings(2.6))
    assert chosen(image(), stated) == EdgeLength(2.6, "stated by the case")


@pytest.mark.parametrize(("radius_mm", "expected"), [(10.0, 4.0), (15.0, 6.0), (18.0, 7.25)])
def test_five_edges_cross_an_organ_on_voxels_of_one_millimetre(radius_mm, expected):
    found = chosen(image(radius_mm))
    assert found.mm == pytest.approx(expected, abs=0.25)
    assert found.reason == f"5.0 edges across 'gland', as large as a ball of {2 * radius_mm:.0f} mm"


def test_an_edge_is_no_longer_than_shows_a_surface_and_no_shorter_than_pays():
    assert chosen(image(25.0, bowel_mm=17.0, scale=1.2)).mm == 8.0
    speck = chosen(image(4.0))
    assert speck.mm == 3.0
    assert (
        "shortest that is chosen automatically; 5.0 edges across 'gland', as large as a ball of 8 mm would be 1.6"
        in speck.reason
    )


def test_a_thin_shell_and_a_narrow_bowel_ask_for_shorter_edges_than_balls_of_their_volume():
    shell = chosen(image(18.0, inner_mm=8.0))
    assert shell.mm == pytest.approx(4.0, abs=0.5)
    assert "2.5 edges across 'gland', 10 mm thick" in shell.reason
    assert "'bowel'" in chosen(image(18.0, bowel_mm=9.0)).reason


def test_the_edge_grows_with_the_root_of_the_surfaces_error_within_its_bounds():
    """Of organs of the same size: on larger voxels, and under a noise that the case states."""
    length = chosen(image(10.0)).mm
    for error, factor in ((2.0, np.sqrt(2.0)), (4.0, 1.5)):  # times that of the voxels alone
        noisy = dataclasses.replace(CASE, noise=Noise(surface_sd_mm=np.sqrt((error**2 - 1.0) / 12.0)))
        assert chosen(image(10.0), noisy).mm == pytest.approx(factor * length, abs=0.25)
    finer = image(20.0, bowel_mm=17.0, scale=0.5)
    assert chosen(finer).mm == pytest.approx(0.75 * length, abs=0.25)


def test_a_large_organ_is_measured_on_every_second_voxel():
    """A shell on voxels of a quarter of its own, 144 across: it is as thick as before."""
    around = image(18.0, inner_mm=8.0, bowel_mm=1.0).index[18:62, 18:62, 26:70]
    index = around.repeat(4, axis=0).repeat(4, axis=1).repeat(4, axis=2)
    fine = Segmentation(index, VoxelGrid(index.shape, np.diag([0.25, 0.25, 0.25, 1.0])), TISSUES)
    assert ", 10 mm thick" in chosen(image(18.0, inner_mm=8.0)).reason
    assert ", 10 mm thick" in chosen(fine).reason


@pytest.mark.parametrize(("radius_mm", "own"), [(8.0, {"bowel": 8.0}), (15.0, {})])
def test_organs_whose_edges_would_differ_by_half_have_their_own(radius_mm, own):
    """In the same ratio where the case states the shortest, up to the longest that shows a surface."""
    found = chosen(image(radius_mm))
    assert found.longer_mm == own
    assert found.in_words == found.reason + "".join(f"; {h:g} mm at '{name}'" for name, h in own.items())
    for share in (0.5, 1.3, 2.0):
        stated = chosen(image(radius_mm), dataclasses.replace(CASE, mesh=MeshSettings(share * found.mm)))
        assert stated.longer_mm == {name: min(share * h, 8.0) for name, h in own.items()}


def test_a_longer_edge_makes_no_organs_edges_shorter():
    """Or a mesh that is to be coarser, for want of memory, would be finer."""
    stated = [dataclasses.replace(CASE, mesh=MeshSettings(mm)) for mm in np.arange(2.0, 12.0, 0.5)]
    lengths = [chosen(image(8.0), case) for case in stated]
    bowel = [length.longer_mm.get("bowel", length.mm) for length in lengths]
    assert np.all(np.diff(bowel) >= 0.0)
    assert max(bowel[:10]) == 8.0


def test_linear_elements_get_half_the_edge_length_and_so_the_same_points():
    linear = dataclasses.replace(CASE, mechanics=Mechanics("linear", "P1"))
    assert chosen(image(18.0), linear).mm == pytest.approx(0.5 * chosen(image(18.0)).mm, abs=0.25)
    assert chosen(image(25.0, bowel_mm=17.0, scale=1.2), linear).mm == 4.0


def test_the_shortest_edge_is_not_rounded_below_two_voxels():
    coarse = chosen(image(3.0, bowel_mm=17.0, scale=2.05))
    assert coarse.mm == 4.25
