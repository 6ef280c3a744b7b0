"""Palpate: how stiff each organ is, from segmented images of one body."""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # the module typing takes longer to import than all that is needed here
if TYPE_CHECKING:
    from typing import Any

    from palpate.export.folder import export
    from palpate.steps.commands import (
        check,
        estimate,
        init,
        make_mesh,
        noise,
        read_result,
        sensitivity,
        simulate,
        voxelise,
    )
    from palpate.steps.results import CaseResult, SavedResult
    from palpate.study.case import Case
    from palpate.study.case_file import read_case

__all__ = [
    "Case",
    "CaseResult",
    "SavedResult",
    "check",
    "estimate",
    "export",
    "init",
    "make_mesh",
    "noise",
    "read_case",
    "read_result",
    "sensitivity",
    "simulate",
    "voxelise",
]

_HOMES = {
    "Case": "palpate.study.case",
    "CaseResult": "palpate.steps.results",
    "SavedResult": "palpate.steps.results",
    "check": "palpate.steps.commands",
    "estimate": "palpate.steps.commands",
    "export": "palpate.export.folder",
    "init": "palpate.steps.commands",
    "make_mesh": "palpate.steps.commands",
    "noise": "palpate.steps.commands",
    "read_case": "palpate.study.case_file",
    "read_result": "palpate.steps.commands",
    "sensitivity": "palpate.steps.commands",
    "simulate": "palpate.steps.commands",
    "voxelise": "palpate.steps.commands",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: the command line answers before numpy is loaded."""
    if name == "__version__":
        return import_module("importlib.metadata").version("palpate")
    if name not in _HOMES:
        raise AttributeError(f"module 'palpate' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """The public names, before any of them is used."""
    return [*__all__, "__version__"]
