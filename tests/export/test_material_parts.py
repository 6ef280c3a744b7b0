"""The parts of a tissue that is not homogeneous: whoever solves them finds the displacement that was fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from palpate.export.groups import OFF, material_parts
from palpate.mechanics import equilibrium
from palpate.mechanics.dilatation import Dilatation
from palpate.mechanics.laws.linear import Linear
from palpate.mechanics.linear_model import linear_model
from palpate.mechanics.material import material_modes
from palpate.mesh.space import Constraint


@pytest.fixture(scope="module")
def fitted(twin):
    """A twin whose tissues differ inside: its space, ln E over the tissue's by element, and its displacement."""
    space = twin.model.space
    modes = material_modes(space.mesh, (0, 1, 3), length_mm=9.0)
    model = linear_model(space, twin.model.constraint, material=modes)
    inside = 0.3 * np.random.default_rng(4).standard_normal(modes.fields.shape[1])
    displacement = model.solve(twin.moduli, np.concatenate([twin.coefficients, inside])).displacement
    return space, np.log(modes.scale(inside)), displacement


def solved(fitted, moduli, log_ratio):
    """Displacement (n_points, 3) mm of the parts' moduli (kPa), the outer faces and the wall as they were fitted."""
    space, _, displacement = fitted
    parts, mesh = material_parts(space.mesh, log_ratio), space.mesh
    region = np.empty_like(mesh.region)
    for number, part in enumerate(parts):
        region[part.cells] = number
    meshed = [tissue for tissue in mesh.tissues if tissue.meshed]
    tissues = tuple(replace(meshed[0], name=f"{part.name} {n}") for n, part in enumerate(parts))
    of = dict(zip([i for i, t in enumerate(mesh.tissues) if t.meshed], moduli, strict=True))
    own = np.array([of[part.tissue] * np.exp(part.log_ratio) for part in parts])
    points, n = np.unique(space.facets(mesh.boundary)), 3 * len(space.points)
    dofs, free, offset = (3 * points[:, None] + np.arange(3)).ravel(), np.ones(n, dtype=bool), np.zeros(n)
    free[dofs], offset[dofs] = False, displacement.ravel()[dofs]
    chosen = sparse.csr_matrix(sparse.identity(n, format="csc")[:, free])
    bare = replace(space, mesh=replace(mesh, region=region, tissues=tissues, beyond=np.full_like(mesh.beyond, -1)))
    constraint = Constraint(chosen, np.zeros((n, 0)), offset)
    return equilibrium(bare, constraint, own, law=Linear(), dilatation=Dilatation.POINTWISE).displacement


def test_every_element_is_in_one_part_whose_modulus_is_nearly_its_own(fitted):
    space, log_ratio, _ = fitted
    parts = material_parts(space.mesh, log_ratio)
    cells = np.concatenate([part.cells for part in parts])
    assert np.array_equal(np.sort(cells), np.arange(len(space.mesh.region)))
    assert len({part.name for part in parts}) == len(parts)
    for part in parts:
        assert set(space.mesh.region[part.cells]) == {part.tissue}
        assert np.abs(np.expm1(log_ratio[part.cells] - part.log_ratio)).max() <= OFF + 1e-12


def test_a_homogeneous_body_has_its_tissues_for_parts(fitted):
    mesh = fitted[0].mesh
    assert [part.name for part in material_parts(mesh, None)] == [t.name for t in mesh.tissues if t.meshed]
    assert len(material_parts(mesh, np.zeros(len(mesh.region)))) == 3


def test_whoever_solves_the_parts_finds_the_fitted_displacement(fitted, twin):
    """To second order in what differs, which is what a first-order model of the material leaves out."""
    _, log_ratio, displacement = fitted

    def off(of):
        """RMS distance to the fitted displacement over the largest motion."""
        distance = np.linalg.norm(solved(fitted, twin.moduli, of) - displacement, axis=1)
        return np.sqrt((distance**2).mean()) / np.linalg.norm(displacement, axis=1).max()

    assert off(log_ratio) < 0.2 * off(None)
    assert off(log_ratio) < 5e-3
