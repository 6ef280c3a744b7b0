"""Meshes of reference states: shorter edges where a mesh is not fit, which `check` finds as an estimate does."""

from __future__ import annotations

import dataclasses

import pytest

from palpate.body import meshing
from palpate.body.body import make_body
from palpate.body.edge_length import EdgeLength
from palpate.body.imaged import ImagedStates
from palpate.body.meshing import mesh_reference
from palpate.case.file import case_text
from palpate.errors import GeometryError, MeshQualityError
from palpate.images.label_image import LabelImage
from palpate.images.readers import write_label_image
from palpate.progress import silent
from palpate.study.check import check_case


@pytest.fixture
def tried(case_result, monkeypatch):
    """The edge lengths that are tried where only those under 2.5 mm are fit."""
    edges = []

    def fit(*arguments):
        edge_length_mm = arguments[2].mm
        edges.append(edge_length_mm)
        if edge_length_mm > 2.5:
            raise MeshQualityError(f"a dihedral angle at {edge_length_mm:g} mm")
        return case_result.space.mesh, Quality()

    monkeypatch.setattr(meshing, "_fit_mesh", fit)
    return edges


@dataclasses.dataclass
class Quality:
    tets: int = 5000
    min_dihedral_deg: float = 20.0


def with_edge(case, edge):
    return dataclasses.replace(case, mesh=dataclasses.replace(case.mesh, edge_length_mm=edge))


def mesh_of(result, edge, progress=silent):
    return mesh_reference(result.before, result.after, with_edge(result.case, edge), progress=progress)


def test_a_mesh_that_is_fit_is_made_once_and_nothing_is_said(case_result, tried):
    found = mesh_of(case_result, 2.0)
    assert (tried, found.edge_length.mm, found.findings) == ([2.0], 2.0, ())


def test_a_mesh_that_is_not_fit_is_followed_by_finer_ones_which_the_result_tells(case_result, tried):
    told = []
    found = mesh_of(case_result, 4.0, told.append)
    assert tried == [4.0, 3.0, 2.25]
    assert found.edge_length == EdgeLength(2.25, "a mesh of 4 mm failed its quality check")
    (finding,) = found.findings
    assert finding.code == "finer-mesh"
    assert "edges of 4 mm failed its quality check, so one with edges of 2.25 mm is used" in finding.message
    assert any("failed: a dihedral angle at 4 mm" in line for line in told)


def test_after_two_finer_meshes_the_last_refusal_stands_with_all_that_was_tried(case_result, tried):
    with pytest.raises(
        MeshQualityError, match=r"= 5 nor with 3.75 and 2.812 mm. With the last one, a dihedral angle at 2.812 mm"
    ):
        mesh_of(case_result, 5.0)
    assert len(tried) == 3


def test_no_finer_mesh_is_tried_that_the_machine_has_no_memory_for(case_result, tried, environment):
    environment(PALPATE_MEMORY_GB="0.01")
    with pytest.raises(GeometryError, match=r"at 4 mm; a mesh of 3 mm was not tried: about .* GB of memory would be"):
        mesh_of(case_result, 4.0)
    assert tried == [4.0]


@pytest.fixture
def on_disk(case_result, tmp_path):
    """The case with its images, without anything meshed."""
    for name, image in (("before", case_result.before), ("after", case_result.after[0])):
        labels = LabelImage(image.index.astype("int32") + 1, image.grid)
        write_label_image(tmp_path / f"{name}.nii.gz", labels)
    images = dataclasses.replace(
        case_result.case.images, before=tmp_path / "before.nii.gz", after=(tmp_path / "after.nii.gz",)
    )
    case = dataclasses.replace(case_result.case, images=images)
    (tmp_path / "case.toml").write_text(case_text(case, tmp_path))
    return tmp_path / "case.toml"


@pytest.mark.parametrize(("edge", "code"), [(4.0, 0), (6.0, 4)])
def test_check_makes_the_mesh_of_the_estimate_and_predicts_its_cost(case_result, on_disk, tried, edge, code):
    found = check_case(on_disk, [f"mesh.edge_length_mm={edge}"], progress=silent)
    assert found.exit_code == code
    assert len(tried) == 3
    states = ImagedStates(case_result.before, case_result.pairs[0].later)
    if code:
        assert [problem.code for problem in found.problems if problem.exit_code] == ["MeshQualityError"]
        assert found.cost.tets != Quality.tets  # that of a mesh of the wanted size, roughly
    else:
        body = make_body(states, with_edge(case_result.case, edge), progress=silent)
        assert (found.cost.tets, found.cost.unknowns) == (Quality.tets, 3 * len(body.space.points))
        assert "finer-mesh" in [problem.code for problem in found.problems]


@pytest.mark.usefixtures("tried")
def test_check_says_the_same_twice(on_disk):
    first, second = (check_case(on_disk, [], progress=silent).to_dict() for _ in range(2))
    assert first == second


def test_a_domain_may_end_within_voxels(case_result):
    """Voxels that it cuts count by their share: else layers of what is around organs are wrong."""
    case = with_edge(case_result.case, 4.0)
    box = dataclasses.replace(case.domain, extent="margin", margin_mm=3.45)
    found = mesh_reference(
        case_result.before, case_result.after, dataclasses.replace(case, domain=box), progress=silent
    )
    assert abs(found.quality.voxel_volume_error["surroundings"]) < 0.01
