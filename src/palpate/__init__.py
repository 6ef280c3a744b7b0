"""Palpate: how stiff each organ is, from segmented images of one body."""

from __future__ import annotations

from importlib import import_module

from palpate.front_door import front_door

TYPE_CHECKING = False  # the module typing takes longer to import than all that is needed here
if TYPE_CHECKING:
    from typing import Any

    from palpate.case.case import Case as Case
    from palpate.case.file import read_case as read_case
    from palpate.export.folder import export as export
    from palpate.steps.commands import check as check
    from palpate.steps.commands import estimate as estimate
    from palpate.steps.commands import init as init
    from palpate.steps.commands import make_mesh as make_mesh
    from palpate.steps.commands import noise as noise
    from palpate.steps.commands import read_result as read_result
    from palpate.steps.commands import sensitivity as sensitivity
    from palpate.steps.commands import simulate as simulate
    from palpate.steps.commands import voxelise as voxelise
    from palpate.steps.figures import figures as figures
    from palpate.steps.results import CaseResult as CaseResult
    from palpate.steps.results import SavedResult as SavedResult

_named, _names = front_door(__name__)


def __getattr__(name: str) -> Any:
    """A public name, or the version: the command line answers before numpy is loaded."""
    return import_module("importlib.metadata").version("palpate") if name == "__version__" else _named(name)


def __dir__() -> list[str]:
    """The public names, before any of them is used."""
    return [*_names(), "__version__"]
