"""result.json: the fixed schema, strict JSON, and no number that did not converge."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from palpate.body.provenance import input_digests
from palpate.errors import InputDataError, NotConverged, SolverError
from palpate.images.tissue import Role
from palpate.report.collect import collect_failure
from palpate.statement.result import MeshResult, Simulation, failure_document
from palpate.uncertainty import Covariance


def with_estimation(result, **changes):
    return dataclasses.replace(result, estimation=dataclasses.replace(result.estimation, **changes))


def test_the_document_says_what_was_found(case_result):
    document = case_result.to_dict()
    assert document["schema"] == "palpate.result/1"
    assert document["estimates"][0]["interval95"] == pytest.approx([47.12, 73.625])
    assert set(document["fit"][0]) == {"after", "prostate", "bladder"}
    assert document["fit"][0]["after"] == "after.nii.gz"
    assert document["fit"][0]["prostate"]["end"]["hd95_mm"] == 0.22
    assert document["starts"][0]["reason"] == "ok"
    assert document["observations"] == {"surface distance": "the distance between surfaces"}
    assert document["inputs"]["before"] == {"sha256": "ab" * 32}
    assert document["warnings"] == [{"code": "example", "message": "a warning to be shown"}]
    assert document["correlation"][0][1] == pytest.approx(-0.003 / np.sqrt(0.01 * 0.06))


def test_the_document_is_strict_json(case_result):
    broken = with_estimation(case_result, covariance=Covariance(*np.full((5, 2, 2), np.nan)))
    document = broken.to_dict()
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["correlation"] == [[None, None], [None, None]]


@pytest.mark.parametrize("status", ["not converged", "failed"])
def test_what_did_not_converge_has_no_value(case_result, status):
    result = with_estimation(case_result, status=status)
    for estimate in result.to_dict()["estimates"]:
        assert {estimate[key] for key in ("value", "ratio")} == {None}
        assert estimate["interval95"] is None
        assert estimate["ratio_interval95"] is None
        assert estimate["verdict"] == "not identified"
    assert np.isnan(result.stiffness[:2]).all()


@pytest.mark.parametrize(("error", "status"), [(NotConverged("x"), "not converged"), (SolverError("y"), "failed")])
def test_an_error_still_makes_a_whole_document(case_result, error, status):
    document = failure_document(case_result.case, error)
    assert (document["status"], document["reason"]) == (status, str(error))
    assert [(e["tissue"], e["value"]) for e in document["estimates"]] == [("prostate", None), ("bladder", None)]


def test_a_failed_estimate_without_anything_known_speaks_of_ratios(case_result):
    case = case_result.case
    assert {e["unit"] for e in failure_document(case, SolverError("x"))["estimates"]} == {"kPa"}
    free = dataclasses.replace(case, tissues=tuple(t for t in case.tissues if t.role is not Role.KNOWN))
    assert {e["unit"] for e in failure_document(free, SolverError("x"))["estimates"]} == {"ratio"}
    assert collect_failure(free, SolverError("x")).unit == "ratio"


def test_stiffness_takes_known_and_estimated_moduli_and_leaves_hollows_out(case_result):
    assert case_result.unit == "kPa"
    np.testing.assert_array_equal(case_result.stiffness, [58.9, 31.2, np.nan, 10.0])


def test_mesh_and_simulation_documents_are_strict_json(case_result):
    r = case_result
    mesh = MeshResult(r.case, r.space, r.mesh_summary, r.before, r.provenance)
    json.dumps(mesh.to_dict(), allow_nan=False)
    simulation = Simulation(
        case=r.case, space=r.space, mesh_summary=r.mesh_summary, displacements=r.estimation.displacements,
        before=None, after=None, moduli_kpa={"prostate": 60.0}, provenance=r.provenance,
    )  # fmt: skip
    largest = np.linalg.norm(r.estimation.displacements[0], axis=1).max()
    assert simulation.to_dict()["largest_displacement_mm"] == pytest.approx(largest)


def test_digests_name_every_input_and_a_file_that_changed_between_two_readings_is_refused(tmp_path, case_result):
    (tmp_path / "b").write_bytes(b"abc")
    images = dataclasses.replace(case_result.case.images, intensities_before=tmp_path / "b")
    case = dataclasses.replace(case_result.case, images=images)
    digests = input_digests(case, {"before": "1", "names": "2"}, {"pairs[0].before": "3", "names": "2"})
    abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-2, appendix B.1
    assert digests == {"before": "1", "names": "2", "pairs[0].before": "3", "intensities_before": abc}
    with pytest.raises(InputDataError, match="'names' was changed"):
        input_digests(case, {"names": "1"}, {"names": "2"})
