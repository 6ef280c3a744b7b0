"""Files that other programs read; the package itself can be called: `palpate.export(result, folder, format="stl")`."""

from __future__ import annotations

import sys
from types import ModuleType

from palpate.front_door import front_door

TYPE_CHECKING = False  # the module typing takes longer to import than all that is needed here
if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    from palpate.export.case_files import write_estimate_files as write_estimate_files
    from palpate.export.conditions import prescribed as prescribed
    from palpate.export.fitted_model import fitted_bodies as fitted_bodies
    from palpate.export.groups import face_groups as face_groups
    from palpate.export.groups import material_parts as material_parts


class _Callable(ModuleType):
    """Python makes a package an attribute of the one around it: `palpate.export` is this, so it does what it says."""

    def __call__(self, *arguments: Any, **options: Any) -> tuple[Path, ...]:
        """Do what `palpate.export.folder.export` does."""
        from palpate.export.folder import export  # noqa: PLC0415 - numpy is loaded when it is needed

        return export(*arguments, **options)


__getattr__, __dir__ = front_door(__name__)


sys.modules[__name__].__class__ = _Callable
