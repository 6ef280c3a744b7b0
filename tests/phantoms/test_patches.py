import numpy as np
import pytest

from palpate.errors import GeometryError
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.phantoms.spheres import SpheresOptions, spheres_anatomy
from palpate_validation.mismatch import patched


@pytest.fixture(scope="module")
def mesh():
    return tetrahedralise(spheres_anatomy(SpheresOptions(seed=1, kind="pushed")), edge_length_mm=7.0)


def of_tissue(mesh, name):
    """The numbers of the regions that a tissue was cut into."""
    return [i for i, t in enumerate(mesh.tissues) if t.name == name or t.name.startswith(f"{name} ")]


def test_the_geometric_mean_of_a_patched_tissue_is_what_the_tissue_states(mesh):
    cut = patched(mesh, mesh.nodes[mesh.tets].mean(axis=1)[:, 0] / 20.0)
    for tissue in mesh.tissues:
        if tissue.meshed:
            here = np.isin(cut.region, of_tissue(cut, tissue.name))
            moduli = np.array([t.youngs_modulus_kpa or np.nan for t in cut.tissues])[cut.region[here]]
            mean = np.exp(np.average(np.log(moduli), weights=cut.volumes[here]))
            assert mean == pytest.approx(tissue.youngs_modulus_kpa)


def test_patches_leave_every_tetrahedron_in_its_tissue_and_follow_the_factors(mesh):
    factors = mesh.nodes[mesh.tets].mean(axis=1)[:, 0] / 20.0
    cut = patched(mesh, factors, levels=40)
    shell = mesh.tissue_index("shell")
    assert np.array_equal(np.isin(cut.region, of_tissue(cut, "shell")), mesh.region == shell)
    here = mesh.region == shell
    logs = np.log([t.youngs_modulus_kpa or np.nan for t in cut.tissues])[cut.region[here]]
    assert np.ptp(logs - factors[here]) < 0.3  # twice what is lost in forty levels, at the ends
    assert np.corrcoef(logs, factors[here])[0, 1] > 0.99


def test_few_values_are_kept_as_they_are_and_one_value_changes_nothing(mesh):
    shell = mesh.region == mesh.tissue_index("shell")
    factors = np.where(shell & (mesh.nodes[mesh.tets].mean(axis=1)[:, 0] > 0.0), np.log(3.0), 0.0)
    cut = patched(mesh, factors)
    soft, stiff = (cut.tissues[i].youngs_modulus_kpa for i in of_tissue(cut, "shell"))
    assert stiff / soft == pytest.approx(3.0)
    assert len(of_tissue(cut, "surroundings")) == 1
    same = patched(mesh, np.full(len(mesh.tets), 0.7))
    assert [t.youngs_modulus_kpa for t in same.tissues] == pytest.approx([t.youngs_modulus_kpa for t in mesh.tissues])
    assert np.array_equal(same.region, mesh.region)


def test_factors_of_another_mesh_are_refused(mesh):
    with pytest.raises(GeometryError, match="one each"):
        patched(mesh, np.zeros(3))
