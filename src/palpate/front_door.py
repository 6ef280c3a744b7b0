"""Front doors of packages whose parts are often wanted alone, and quickly: a name is imported when it is first used."""

from __future__ import annotations

import ast
import sys
from functools import cache
from importlib import import_module

TYPE_CHECKING = False  # the module typing takes longer to import than all that is needed here
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any


def front_door(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package: of the names that it imports `if TYPE_CHECKING`, each `as` itself.

    So they stand there once, and mypy and an editor know their types.
    """

    @cache
    def homes() -> dict[str, str]:
        """Name -> module, by the package's own source."""
        loader: Any = getattr(sys.modules[package].__spec__, "loader", None)
        block = next(node for node in ast.parse(loader.get_source(package)).body if isinstance(node, ast.If))
        imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
        return {alias.asname: str(node.module) for node in imports for alias in node.names if alias.asname}

    def named(name: str) -> Any:
        """What a name stands for, or the list of all of them."""
        if name == "__all__":
            return sorted(homes())
        if name not in homes():
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(import_module(homes()[name]), name)

    return named, lambda: sorted(homes())
