"""Values as they are written in a TOML file: text, keys, numbers, paths relative to the file."""

from __future__ import annotations

import json
import os
from pathlib import Path

from palpate.errors import ConfigurationError

__all__ = ["lasting_path", "relative_path", "toml_key", "toml_text", "toml_value"]


def toml_text(value: str) -> str:
    """`value` as a basic string of TOML; raises `ConfigurationError` for what UTF-8 cannot hold."""
    try:
        value.encode("utf-8")
    except UnicodeEncodeError as error:
        raise ConfigurationError(
            f"{value!r} is not UTF-8, so no case file can name it; rename the file or give it an ASCII link"
        ) from error
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_key(name: str) -> str:
    """`name` as a key of TOML, in quotes where it needs them; raises as `toml_text` does."""
    plain = name.isascii() and all(letter.isalnum() or letter in "-_" for letter in name)
    return name if plain else toml_text(name)


def relative_path(path: Path, folder: Path) -> str:
    """`path` from `folder`, with slashes, as a case file in the folder names it; whole where it is on another drive.

    Links on the way to both are followed first: `..` leads out of the folder that a link leads to.
    """
    place, real = path.absolute().parent.resolve() / path.name, folder.resolve()
    try:
        relative = os.path.relpath(place, real)
    except ValueError:  # another drive
        relative = str(place)
    if relative.startswith("~"):  # a case's reader takes that for somebody's home
        relative = str(Path("..", real.name, relative))
    return Path(relative).as_posix()


def lasting_path(path: Path, folder: Path) -> str:
    """`path` as a case file in the folder names it that may be moved: whole, but for what lies in the folder itself."""
    place = path.absolute().parent.resolve() / path.name
    return relative_path(path, folder) if place.is_relative_to(folder.resolve()) else place.as_posix()


def toml_value(value: str | bool | float | list[str] | list[float]) -> str:
    """A value as TOML writes it; numbers are read back to the last digit. Raises as `toml_text` does."""
    if isinstance(value, list):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return toml_text(value) if isinstance(value, str) else repr(value)
