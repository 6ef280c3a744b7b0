"""What the mesh adds to an interval: by the size of its elements beside the tissue, and of that alone."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.inversion import LaterState, Objective
from palpate.mesh import lagrange_space
from palpate.uncertainty import discretisation_sd
from palpate.uncertainty.covariance import mesh_covariance
from palpate.unknowns import parameter_map, unit_blocks
from palpate_validation.structured_meshes import box_mesh, known, unknown

TISSUES = (unknown("gland"), unknown("sac"), known("fat"))


def halves(centroids):
    """The gland below 1/4, the sac up to 1/2 of the box, fat above."""
    height = centroids[:, 2] / centroids[:, 2].max()
    return np.searchsorted([0.25, 0.5], height)


def space(n=8, *, element="P2", size=40.0):
    return lagrange_space(box_mesh(n, size=size, tissues=TISSUES, region=halves), element)


def test_half_the_edges_leave_a_quarter_and_the_unit_of_length_nothing():
    assert discretisation_sd(space(16), [0]) == pytest.approx(discretisation_sd(space(8), [0]) / 4.0)
    assert discretisation_sd(space(size=0.04), [0]) == pytest.approx(discretisation_sd(space(), [0]))


def test_linear_elements_count_as_quadratic_ones_with_the_same_points():
    assert discretisation_sd(space(16, element="P1"), [1]) == pytest.approx(discretisation_sd(space(8), [1]))


def test_a_thin_tissue_is_less_certain_than_a_thick_one_with_the_same_elements():
    assert discretisation_sd(space(), [0]) > 1.5 * discretisation_sd(space(), [2])


def variances(*spaces, references=(), tied=()):
    """Diagonal of the moduli's covariance by the mesh, of later states with these meshes."""
    regions = (0, 1, 2)
    references = references or range(len(spaces))
    states = [
        replace(LaterState(None, ()), model=SimpleNamespace(space=own, regions=regions), reference=reference)
        for own, reference in zip(spaces, references, strict=True)
    ]
    mapping = parameter_map(TISSUES, regions, unit_blocks(*[0] * len(states)), tied=tied)
    covariance = mesh_covariance(Objective(tuple(states), mapping))
    assert np.array_equal(covariance, np.diag(np.diag(covariance)))
    return np.diag(covariance)


def test_meshes_of_different_rest_images_average_and_one_mesh_does_not():
    alone = variances(space())
    assert variances(space(), space()) == pytest.approx(alone / 2.0)
    assert variances(space(), space(), references=(0, 0)) == pytest.approx(alone)
    assert variances(space(), space(4)) == pytest.approx((alone + variances(space(4))) / 4.0)


def test_tied_tissues_share_one_value_and_keep_their_own_thickness():
    both = space()
    assert variances(both, tied=[("gland", "sac")]) == pytest.approx([discretisation_sd(both, [0, 1]) ** 2])
    assert discretisation_sd(both, [0, 1]) == pytest.approx(discretisation_sd(both, [0]))  # two plates alike
