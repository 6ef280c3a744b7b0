"""A case as a file: case.toml read, with overrides from the command line, and written with every setting."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from palpate.case.case import Case
from palpate.case.schema import Rule, read_table, shortened
from palpate.case.tissue import POISSON_RATIO, CaseTissue
from palpate.errors import ConfigurationError
from palpate.images.input_file import read_input
from palpate.images.named_labels import printable

LARGEST_FILE = 100_000  # bytes; a case is a page of text, and one of a hundred tissues has 40 000
MOST_DOTS = 100  # in a line: keys of thousands of parts would take the parser minutes
HEADING = (
    "# The case of the result beside it, as it was run: every setting is written out. Files outside of this folder are"
    "\n# named by their whole paths, so that the folder may be moved."
)


def read_case(
    path: str | os.PathLike[str],
    overrides: Sequence[str] = (),
    *,
    change: Callable[[dict[str, Any]], dict[str, Any]] = dict,
) -> Case:
    """The case that the TOML file at `path` describes; paths in it are relative to the file.

    Each of `overrides` is `key.path=value` with a TOML value (text may go without quotes); it replaces the file's.
    change: makes another table of the file's before that, as a cohort does with its template.
    Raises `ConfigurationError` when the file cannot be read or says something unknown or impossible.
    """
    path = Path(path)
    try:
        content, _ = read_input(path, LARGEST_FILE)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigurationError(f"cannot read the case file {path}: {reason}; check its path") from error
    if len(content) > LARGEST_FILE:
        raise ConfigurationError(f"{path} has over {LARGEST_FILE} bytes, so it is not a case file; give a case.toml")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigurationError(
            f"{path} is not UTF-8 text (byte {error.start}), so it is not a case.toml; to estimate from images, name at"
            " least two, before and after"
        ) from error
    table = change(_parse(text, str(path)))
    for override in overrides:
        table = _merged(table, _parse_override(override))
    table.setdefault("id", path.stem)
    tissues = table.get("tissues")
    if "phantom" in table and isinstance(tissues, dict):  # a phantom's tissues are known by name
        table["tissues"] = {
            name: {"label": name, **tissue} if isinstance(tissue, dict) else tissue for name, tissue in tissues.items()
        }
    case = read_table(Case, table, where=path.name, folder=path.absolute().parent)
    return replace(case, overrides=tuple(overrides))


def _parse(text: str, where: str) -> dict[str, Any]:
    if max(line.count(".") for line in text.split("\n")) > MOST_DOTS:
        raise ConfigurationError(
            f"{where} has a line with over {MOST_DOTS} dots, too many for a key; break a long list into several lines"
        )
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise ConfigurationError(f"{where} is not valid TOML: its brackets are nested too deep") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{where} is not valid TOML: {shortened(str(error))}") from error
    except ValueError as error:  # Python's own, on whole numbers of over 4300 digits
        raise ConfigurationError(f"{where} is not valid TOML: a number in it is too long") from error


def _parse_override(override: str) -> dict[str, Any]:
    key, equals, value = override.partition("=")
    shown = f"--set {shortened(override)}"
    if not equals or not key.strip():
        raise ConfigurationError(f"{shown}: write key.path=value, as in --set mesh.edge_length_mm=3")
    if len(override) > LARGEST_FILE:
        raise ConfigurationError(f"{shown} is longer than a case file may be; shorten it")
    try:
        return _parse(f"{key} = {value}", shown)
    except ConfigurationError as error:
        if not isinstance(error.__cause__, tomllib.TOMLDecodeError):
            raise
        return _parse(f"{key} = {json.dumps(value.strip())}", shown)  # text may go without quotes


def _merged(table: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(table)
    for key, value in changes.items():
        below = merged.get(key)
        merged[key] = _merged(below, value) if isinstance(value, dict) and isinstance(below, dict) else value
    return merged


def case_tables(case: Case, place: Callable[[Path], str]) -> dict[str, Any]:
    """The tables of a case.toml that says what `case` says, defaults written out; `place`: how a file is named.

    What follows from the whole case is stated, too: alignment, Poisson's ratios, the parameters of the material law.
    Only a phantom's own constants stay out, which its seed draws.
    """
    law = case.mechanics.material_law
    own = {parameter.name: getattr(law, parameter.name) for parameter in law.parameters}
    case = replace(case, mechanics=replace(case.mechanics, law_parameters={**case.mechanics.law_parameters, **own}))
    if case.images is not None:
        ratios = [POISSON_RATIO if t.poisson_ratio is None else t.poisson_ratio for t in case.tissues]
        tissues = tuple(replace(t, poisson_ratio=nu) for t, nu in zip(case.tissues, ratios, strict=True))
        case = replace(case, images=replace(case.images, align=case.align), tissues=tissues)
    return _table(case, place)


def case_text(case: Case, folder: Path) -> str:
    """The case.toml of `case` for a file in `folder`, from which `read_case` reads the same case.

    Raises `ConfigurationError` for a path that is not UTF-8.
    """
    lines = [HEADING]
    lines += [f"# --set {printable(override)}" for override in case.overrides]
    lines += ["", *_lines(case_tables(case, lambda path: lasting_path(path, folder)), ())]
    return "\n".join(lines).rstrip() + "\n"


def _table(value: Any, place: Callable[[Path], str]) -> dict[str, Any]:
    """The fields of a dataclass of the schema as `read_table` takes them; those that are None or empty are left out."""
    table: dict[str, Any] = {}
    for field in fields(value):
        bounds, item = field.metadata.get("rule", Rule()), getattr(value, field.name)
        if bounds.collects:
            table |= item
        elif item is None and bounds.chosen:
            table[field.name] = bounds.chosen
        elif item is not None and not bounds.unwritten and (plain := _plain(item, place)) not in ([], {}):
            table[field.name] = plain
            table.pop(bounds.instead_of, None)  # which stands before it
    return table


def _plain(item: Any, place: Callable[[Path], str]) -> Any:
    if isinstance(item, tuple) and item and isinstance(item[0], CaseTissue):  # a table's own name is the tissue's
        tables = [_table(tissue, place) for tissue in item]
        return {table.pop("name"): table for table in tables}
    if isinstance(item, tuple):
        return [_plain(part, place) for part in item]
    if is_dataclass(item):
        return _table(item, place)
    if isinstance(item, Path):
        return place(item)
    return str(item) if isinstance(item, StrEnum) else item


def _lines(table: Mapping[str, Any], above: tuple[str, ...]) -> Iterator[str]:
    """The lines of a table, its values before the tables in it; `above`: the keys that lead to it."""
    inner = {key: value for key, value in table.items() if _is_tables(value)}
    for key, value in table.items():
        if key not in inner:
            yield f"{toml_key(key)} = {toml_value(value)}"
    for key, value in inner.items():
        path = (*above, key)
        name = ".".join(map(toml_key, path))
        for part in value if isinstance(value, list) else ():
            yield from ("", f"[[{name}]]", *_lines(part, path))
        if isinstance(value, dict):
            heading = () if value and all(map(_is_tables, value.values())) else ("", f"[{name}]")
            yield from (*heading, *_lines(value, path))


def _is_tables(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and bool(value) and isinstance(value[0], dict))


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
