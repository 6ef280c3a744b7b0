"""One case: what it says, what came out of it."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from palpate.study.body import Body, ImagedStates, aligned, inverse_problem, make_body
    from palpate.study.case import Case, Discrepancy, Domain, DriverMotion, Mechanics, MeshSettings, Phantom
    from palpate.study.case_file import read_case
    from palpate.study.cost import ExpectedCost, expected_cost
    from palpate.study.earlier import strange_files
    from palpate.study.edge_length import EdgeLength, edge_length_of
    from palpate.study.estimation import (
        Observed,
        conclude,
        estimates_of,
        intervals_of,
        released_of,
        stated_posteriors,
        verdict,
    )
    from palpate.study.lock import held_folder, own_file
    from palpate.study.outputs import make_folder, read_json, recover, staged, write_json, write_text
    from palpate.study.provenance import software_versions
    from palpate.study.read import read_states
    from palpate.study.result import CaseResult, failure_document
    from palpate.study.run import estimate, estimate_states, fitted_states, inversion_settings, mesh
    from palpate.study.simulate import filled

__all__ = [
    "Body",
    "Case",
    "CaseResult",
    "Discrepancy",
    "Domain",
    "DriverMotion",
    "EdgeLength",
    "ExpectedCost",
    "ImagedStates",
    "Mechanics",
    "MeshSettings",
    "Observed",
    "OutputFolder",
    "Phantom",
    "aligned",
    "conclude",
    "edge_length_of",
    "estimate",
    "estimate_states",
    "estimates_of",
    "expected_cost",
    "failure_document",
    "filled",
    "fitted_states",
    "held_folder",
    "intervals_of",
    "inverse_problem",
    "inversion_settings",
    "make_body",
    "make_folder",
    "mesh",
    "own_file",
    "read_case",
    "read_json",
    "read_states",
    "recover",
    "released_of",
    "software_versions",
    "staged",
    "stated_posteriors",
    "strange_files",
    "verdict",
    "write_json",
    "write_text",
]

_HOMES = {
    "Body": "palpate.study.body",
    "Case": "palpate.study.case",
    "CaseResult": "palpate.study.result",
    "Discrepancy": "palpate.study.case",
    "Domain": "palpate.study.case",
    "DriverMotion": "palpate.study.case",
    "EdgeLength": "palpate.study.edge_length",
    "ExpectedCost": "palpate.study.cost",
    "ImagedStates": "palpate.study.body",
    "Mechanics": "palpate.study.case",
    "MeshSettings": "palpate.study.case",
    "Observed": "palpate.study.estimation",
    "OutputFolder": "palpate.study.outputs",
    "Phantom": "palpate.study.case",
    "aligned": "palpate.study.body",
    "conclude": "palpate.study.estimation",
    "edge_length_of": "palpate.study.edge_length",
    "estimate": "palpate.study.run",
    "estimate_states": "palpate.study.run",
    "estimates_of": "palpate.study.estimation",
    "expected_cost": "palpate.study.cost",
    "failure_document": "palpate.study.result",
    "filled": "palpate.study.simulate",
    "fitted_states": "palpate.study.run",
    "held_folder": "palpate.study.lock",
    "intervals_of": "palpate.study.estimation",
    "inverse_problem": "palpate.study.body",
    "inversion_settings": "palpate.study.run",
    "make_body": "palpate.study.body",
    "make_folder": "palpate.study.outputs",
    "mesh": "palpate.study.run",
    "own_file": "palpate.study.lock",
    "read_case": "palpate.study.case_file",
    "read_json": "palpate.study.outputs",
    "read_states": "palpate.study.read",
    "recover": "palpate.study.outputs",
    "released_of": "palpate.study.estimation",
    "software_versions": "palpate.study.provenance",
    "staged": "palpate.study.outputs",
    "stated_posteriors": "palpate.study.estimation",
    "strange_files": "palpate.study.earlier",
    "verdict": "palpate.study.estimation",
    "write_json": "palpate.study.outputs",
    "write_text": "palpate.study.outputs",
}


def __getattr__(name: str) -> Any:
    """Import a name when it is first used: a part of this layer is often wanted alone, and quickly."""
    if name not in _HOMES:
        raise AttributeError(f"module 'palpate.study' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)
