"""The JSON Schemas that are shipped: made from the code, and met by every document that it writes."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import jsonschema
import pytest
import referencing

from palpate.case.json_schema import SCHEMAS, case_schema
from palpate.demo import DATA
from palpate.errors import NotConverged
from palpate.statement.result import failure_document

DOCS = Path(__file__).parents[2] / "docs"
CASE = json.loads((SCHEMAS / "case.schema.json").read_text(encoding="utf-8"))
RESULT = json.loads((SCHEMAS / "result.schema.json").read_text(encoding="utf-8"))
REGISTRY = referencing.Registry().with_contents([(schema["$id"], schema) for schema in (CASE, RESULT)])
LEAST = {"images": {"before": "b", "after": ["a"]}, "tissues": {"organ": {"label": 1, "role": "estimate"}}}
REFUSED = [
    {"mesh": {"edge_lenght_mm": 4.0}},
    {"mesh": {"edge_length_mm": 0.0}},
    {"mechanics": {"law": "neo-hooke"}},
    {"mechanics": {"c01_over_c10": -1}},
    {"tissues": {"organ": {"role": "estimate"}}},
    {"tissues": {"organ": {"label": [1, -1], "role": "estimate"}}},
    {"tissues": {"organ": {"label": 1, "role": "organ"}}},
    {"images": {"before": "b", "after": []}},
    {"estimate": {"bounds_ratio": [1.0]}},
    {"estimate": {"starts_kpa": [1.0], "start_ratios": [1.0]}},
    {"loads": [{"surface": "outer"}]},
    {"overrides": []},
    {"patient": ""},
    {"seed": 1.5},
]


def errors(schema, document) -> list[str]:
    validator = jsonschema.Draft202012Validator(schema, registry=REGISTRY)
    return [f"{error.json_path}: {error.message}" for error in validator.iter_errors(document)]


def test_the_schema_of_a_case_is_that_of_the_code():
    assert case_schema() == CASE, "run: make schemas"


@pytest.mark.parametrize("schema", [CASE, RESULT], ids=["case", "result"])
def test_a_schema_is_one(schema):
    jsonschema.Draft202012Validator.check_schema(schema)


def test_cases_of_the_docs_and_the_demo_are_met():
    block = (DOCS / "case-file.md").read_text().split("```toml\n")[1].split("```")[0]
    assert errors(CASE, tomllib.loads(block)) == []
    assert errors(CASE, tomllib.loads((DATA / "demo.toml").read_text())) == []
    assert errors(CASE, {"phantom": {"kind": "spheres"}, "tissues": {"core": {"role": "estimate"}}}) == []
    assert errors(CASE, LEAST) == []


@pytest.mark.parametrize("change", REFUSED, ids=str)
def test_what_the_reader_refuses_at_sight_the_schema_refuses(change):
    assert errors(CASE, LEAST | change)


def test_results_and_failures_meet_their_schema_key_by_key(case_result, sampled_result):
    document = case_result.to_dict()
    assert errors(RESULT, sampled_result.to_dict()) == []
    assert sampled_result.to_dict()["samples"]["moduli"][1]["interval95"] == [19.0, None]
    assert errors(RESULT, document) == []
    assert set(RESULT["properties"]) - set(document) == {"pairs", "files"}
    assert errors(RESULT, failure_document(case_result.case, NotConverged("it stopped"))) == []
    assert [image["shows"] for image in document["explanations"][0]["images"]] == [[]]
    assert document["explanations"][1] == {
        "probability": 0.2,
        "scenario": ["nearly homogeneous", "layers", "frame still"],
        "images": [{"after": document["fit"][0]["after"], "shows": ["bladder drawn otherwise"]}],
        "moduli": {"prostate": 64.0, "bladder": 29.0},
    }
    stopped = replace(case_result, estimation=replace(case_result.estimation, status="not converged"))
    assert stopped.to_dict()["explanations"] == []
    assert errors(RESULT, document | {"explanations": [{"probability": 0.5}]})
    assert errors(RESULT, document | {"status": "fine"})
    assert errors(RESULT, document | {"case": {"mesh": {}}, "news": 1})
