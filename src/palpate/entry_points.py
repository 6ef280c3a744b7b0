"""What other packages bring: commands, readers and data, which they name as entry points of the groups `palpate.*`."""

from __future__ import annotations

from collections.abc import Container
from importlib import import_module
from typing import TypeVar

from palpate.errors import ConfigurationError

T = TypeVar("T")


def brought(group: str, kind: type[T], *, taken: Container[str] = ()) -> dict[str, T]:
    """What installed packages name in an entry point group, by its name; `taken`: the names that are our own.

    Raises `ConfigurationError` for one that cannot be imported, is of another kind or has a name that is taken.
    """
    found: dict[str, T] = {}
    metadata = import_module("importlib.metadata")  # which a process that reads an image does without
    for point in metadata.entry_points(group=group):
        package = point.dist.name if point.dist else "a package"
        told = f"{package} brings {point.name} ({group}), but {{}}; update that package, or uninstall it"
        try:
            thing = point.load()
        except Exception as error:  # whatever foreign code raises
            flaw = f"{point.value} cannot be imported: {type(error).__name__}: {error}"
            raise ConfigurationError(told.format(flaw)) from error
        if not isinstance(thing, kind):
            raise ConfigurationError(told.format(f"{point.value} is no {kind.__name__}"))
        if point.name in taken:
            raise ConfigurationError(told.format("that name is taken"))
        found[point.name] = thing
    return found
