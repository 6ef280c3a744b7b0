"""Tables of a TOML file read into frozen dataclasses: types, allowed values and defaults stand in the classes."""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

from palpate.errors import ConfigurationError

__all__ = ["Rule", "nearest", "read_table", "rule"]

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Rule:
    """What a key's value must be beyond its type.

    choices: the values it may have; later: values of the schema that this version does not offer yet;
    test and wanted: a condition and its wording; instead_of: the key that may not stand beside this one;
    convert: reads a value whose type alone does not say how.
    """

    choices: tuple[str, ...] = ()
    later: tuple[str, ...] = ()
    test: Callable[[Any], bool] | None = None
    wanted: str = ""
    instead_of: str = ""
    convert: Callable[[object], object] | None = None


def rule(
    *,
    choices: tuple[str, ...] = (),
    later: tuple[str, ...] = (),
    test: Callable[[Any], bool] | None = None,
    wanted: str = "",
    instead_of: str = "",
    convert: Callable[[object], object] | None = None,
) -> dict[str, Rule]:
    """The metadata of a dataclass field that carries a `Rule`; arguments as there."""
    return {"rule": Rule(choices, later, test, wanted, instead_of, convert)}


def nearest(word: str, known: Iterable[str]) -> str:
    """A hint that names the known word closest to `word`, and the others; `known` has at least one."""
    names = sorted(set(known))
    closest = max(names, key=lambda name: difflib.SequenceMatcher(None, word.lower(), name.lower()).ratio())
    others = [name for name in names if name != closest]
    return f"did you mean '{closest}'?" + (f" (others: {', '.join(others[:15])})" if others else "")


def read_table(kind: type[T], table: Mapping[str, object], *, where: str, folder: Path) -> T:
    """An instance of the dataclass `kind` from a TOML table; `where` names the table, paths are relative to `folder`.

    Raises `ConfigurationError` on an unknown or missing key, a wrong type, a value that the key's `Rule` forbids.
    """
    fields = {field.name: field for field in dataclasses.fields(typing.cast("Any", kind))}
    for key in table:
        if key not in fields:
            raise ConfigurationError(f"unknown key '{key}' in {where}: {nearest(key, fields)}")
    _check_complete(fields.values(), table, where)
    hints = typing.get_type_hints(kind)
    values: dict[str, Any] = {}
    for key, value in table.items():
        place = _Place(key, where, folder)
        bounds: Rule = fields[key].metadata.get("rule", Rule())
        converted = bounds.convert(value) if bounds.convert else _convert(hints[key], value, place)
        _check_value(bounds, converted, place)
        values[key] = converted
    return kind(**values)


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a value stands, for messages and for relative paths."""

    key: str
    where: str
    folder: Path

    def __str__(self) -> str:
        return f"'{self.key}' in {self.where}"

    @property
    def table(self) -> str:
        """The table of that name, as it is written in TOML."""
        inner = self.where[1:-1] + "." if self.where.startswith("[") else ""
        return f"[{inner}{self.key}]"


def _check_complete(fields: Iterable[dataclasses.Field[Any]], table: Mapping[str, object], where: str) -> None:
    for field in fields:
        needed = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if needed and field.name not in table:
            raise ConfigurationError(f"the key '{field.name}' is missing in {where}; it has no default")
        other = field.metadata.get("rule", Rule()).instead_of
        if other and field.name in table and other in table:
            raise ConfigurationError(f"'{field.name}' and '{other}' in {where} say the same thing; give one of them")


def _check_value(bounds: Rule, value: object, place: _Place) -> None:
    for item in value if isinstance(value, tuple) else (value,):
        if item in bounds.later:
            raise ConfigurationError(
                f"{place} is '{item}', which this version of Palpate does not offer yet; use {_either(bounds.choices)}"
            )
        if bounds.choices and item not in bounds.choices:
            raise ConfigurationError(f"{place} is {item!r}: {nearest(str(item), bounds.choices)}")
    if bounds.test is not None and value is not None and not bounds.test(value):
        raise ConfigurationError(f"{place} is {_shown(value)}, but it must be {bounds.wanted}")


def _convert(hint: Any, value: object, place: _Place) -> object:
    """`value` as the type `hint`, which is one of those that the schema uses."""
    origin = typing.get_origin(hint)
    if origin is types.UnionType:  # X | None
        inner = next(arm for arm in typing.get_args(hint) if arm is not types.NoneType)
        return _convert(inner, value, place)
    if origin is tuple:
        return _convert_tuple(typing.get_args(hint), value, place)
    if dataclasses.is_dataclass(hint):
        return _convert_table(hint, value, place)
    if hint is Path:
        return place.folder / Path(_expect(value, str, "a path in quotes", place=place)).expanduser()
    if issubclass(hint, StrEnum):
        word = _expect(value, str, "a word in quotes", place=place)
        if word not in list(hint):
            raise ConfigurationError(f"{place} is '{word}': {nearest(word, list(hint))}")
        return hint(word)
    return _convert_plain(hint, value, place)


def _convert_plain(hint: Any, value: object, place: _Place) -> object:
    wanted = {float: "a number", int: "a whole number", str: "text in quotes", bool: "true or false"}[hint]
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is not bool and isinstance(value, bool):  # to Python, true is the number 1
        raise ConfigurationError(f"{place} is {_shown(value)}, but it must be {wanted}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigurationError(f"{place} is {value}, but it must be a finite number")
    return _expect(value, hint, wanted, place=place)


def _convert_table(kind: Any, value: object, place: _Place) -> object:
    return read_table(kind, _expect(value, dict, "a table", place=place), where=place.table, folder=place.folder)


def _convert_tuple(arms: tuple[Any, ...], value: object, place: _Place) -> object:
    kind = arms[0]
    if dataclasses.is_dataclass(kind) and isinstance(value, dict):  # [tissues.NAME]: the key is the name
        places = {name: _Place(name, place.table, place.folder) for name in value}
        tables = {name: _expect(table, dict, "a table", place=places[name]) for name, table in value.items()}
        return tuple(_convert_table(kind, {**table, "name": name}, places[name]) for name, table in tables.items())
    items = _expect(value, list, "a list in square brackets", place=place)
    if arms[-1] is not Ellipsis and len(items) != len(arms):
        raise ConfigurationError(f"{place} is {_shown(items)}, but it must hold {len(arms)} values")
    return tuple(_convert(kind, item, place) for item in items)


def _expect(value: object, kind: type[Any], wanted: str, *, place: _Place) -> Any:
    if not isinstance(value, kind):
        raise ConfigurationError(f"{place} is {_shown(value)}, but it must be {wanted}")
    return value


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        return str(list(value))
    return {True: "true", False: "false"}[value] if isinstance(value, bool) else repr(value)


def _either(words: tuple[str, ...]) -> str:
    return " or ".join(f"'{word}'" for word in words)
