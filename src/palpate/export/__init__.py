"""Files that other programs read; the package itself can be called: `palpate.export(result, folder, format="stl")`."""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType

TYPE_CHECKING = False  # the module typing takes longer to import than all that is needed here
if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    from palpate.export.fitted_model import fitted_bodies
    from palpate.export.groups import material_parts

__all__ = ["fitted_bodies", "material_parts"]

_HOMES = {"fitted_bodies": "palpate.export.fitted_model", "material_parts": "palpate.export.groups"}


class _Callable(ModuleType):
    """Python makes a package an attribute of the one around it: `palpate.export` is this, so it does what it says."""

    def __call__(self, *arguments: Any, **options: Any) -> tuple[Path, ...]:
        """Do what `palpate.export.folder.export` does."""
        from palpate.export.folder import export  # noqa: PLC0415 - numpy is loaded when it is needed

        return export(*arguments, **options)


def __getattr__(name: str) -> Any:
    """Import a name when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module 'palpate.export' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)


sys.modules[__name__].__class__ = _Callable
