"""Tables of a TOML file read into frozen dataclasses: types, allowed values and defaults stand in the classes."""

from __future__ import annotations

import dataclasses
import difflib
import heapq
import os
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from palpate.errors import ConfigurationError
from palpate.images.named_labels import printable

MOST_LETTERS = 4096  # of a text: the longest path that systems take
MOST_SHOWN = 80  # letters of a text in a sentence
MOST_OTHERS = 15  # known names that a hint lists
MOST_TABLES = 15  # that lack the same key, by name
MOST_COMPARED = 300  # names that are compared letter by letter with a mistyped one

T = TypeVar("T")
P = ParamSpec("P")


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """What a key's value must be beyond its type.

    choices: the values it may have; between: the least and the largest number, either of which it may be; test: a
    condition; wanted: what it must be, in words, beside the numbers; instead_of: the key that may not stand beside this
    one; convert: reads a value whose type alone does not say how; collects: keys of the same table, with their ranges,
    whose numbers the field holds; unwritten: the field is no key of the table; chosen: a word that may stand for the
    number, which is then chosen for the case: the field is None.
    """

    choices: tuple[str, ...] = ()
    between: tuple[float, float] | None = None
    test: Callable[[Any], bool] | None = None
    wanted: str = ""
    instead_of: str = ""
    convert: Callable[[object], object] | None = None
    collects: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    unwritten: bool = False
    chosen: str = ""


def _metadata(make: Callable[P, Rule]) -> Callable[P, dict[str, Rule]]:
    def metadata(*arguments: P.args, **named: P.kwargs) -> dict[str, Rule]:
        """The metadata of a dataclass field that carries a `Rule`; arguments as there."""
        return {"rule": make(*arguments, **named)}

    return metadata


rule = _metadata(Rule)


def nearest(word: str, known: Iterable[str]) -> str:
    """A hint that names the known word closest to `word`, and the others; `known` has at least one."""
    names = sorted(set(known))
    sought = word[:MOST_SHOWN].lower()
    letters = set(sought)
    # Comparing letter by letter is slow: only names of like length that share most letters are, where there are many.
    alike = heapq.nsmallest(
        MOST_COMPARED, names, key=lambda n: len(letters ^ set(n.lower())) + abs(len(n) - len(sought))
    )
    closest = max(alike, key=lambda name: difflib.SequenceMatcher(None, sought, name.lower()).ratio())
    others = [shortened(name) for name in names[: MOST_OTHERS + 1] if name != closest][:MOST_OTHERS]
    return f"did you mean '{shortened(closest)}'?" + (f" (others: {', '.join(others)})" if others else "")


def shortened(text: str) -> str:
    """`text` for a sentence: its beginning, printable."""
    shown = printable(text[:MOST_SHOWN])
    return shown if len(text) <= MOST_SHOWN else f"{shown}... ({len(text)} characters)"


def read_table(kind: type[T], table: Mapping[str, object], *, where: str, folder: Path) -> T:
    """An instance of the dataclass `kind` from a TOML table; `where` names the table, paths are relative to `folder`.

    Raises `ConfigurationError` on an unknown or missing key, a wrong type, a value that the key's `Rule` forbids.
    """
    fields = {field.name: field for field in dataclasses.fields(typing.cast("Any", kind))}
    rules = {name: field.metadata.get("rule", Rule()) for name, field in fields.items()}
    collected = {key: name for name, bounds in rules.items() for key in bounds.collects}
    keys = [*collected, *(name for name, bounds in rules.items() if not bounds.collects and not bounds.unwritten)]
    for key in table:
        if key not in keys:
            hint = f"{nearest(key, keys)}; correct the key, or remove it"
            raise ConfigurationError(f"unknown key '{shortened(key)}' in {where}: {hint}")
    _check_complete(fields.values(), table, where)
    hints = _hints(typing.cast("Any", kind))
    values: dict[str, Any] = {}
    for key, value in table.items():
        place = _Place(key, where, folder)
        if key in collected:
            _check_range(Rule(between=rules[collected[key]].collects[key]), value, place)
            values.setdefault(collected[key], {})[key] = _convert(float, value, place)
            continue
        bounds = rules[key]
        if bounds.chosen and isinstance(value, str):
            if value != bounds.chosen:
                raise ConfigurationError(f"{place} is {shown(value)}, but it must be a number or '{bounds.chosen}'")
            values[key] = None
            continue
        _check_range(bounds, value, place)
        if isinstance(value, str):  # before an enumeration names all of its words
            _check_choice(bounds, value, place)
        converted = bounds.convert(value) if bounds.convert else _convert(hints[key], value, place)
        for item in converted if isinstance(converted, tuple) else (converted,):
            _check_choice(bounds, item, place)
        if bounds.test is not None and converted is not None and not bounds.test(converted):
            raise ConfigurationError(f"{place} is {shown(converted)}, but it must be {bounds.wanted}")
        values[key] = converted
    return kind(**values)


_hints = cache(typing.get_type_hints)  # to resolve the types of a dataclass takes longer than to read its table


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a value stands, for messages and for relative paths."""

    key: str
    where: str
    folder: Path

    def __str__(self) -> str:
        return f"'{shortened(self.key)}' in {self.where}"

    @property
    def table(self) -> str:
        """The table of that name, as it is written in TOML."""
        inner = self.where[1:-1] + "." if self.where.startswith("[") else ""
        return f"[{inner}{shortened(self.key)}]"


def _check_complete(fields: Iterable[dataclasses.Field[Any]], table: Mapping[str, object], where: str) -> None:
    for field in fields:
        if _needed(field) and field.name not in table:
            raise ConfigurationError(f"the key '{field.name}' is missing in {where}; {_what_to_write(field)}")
        other = field.metadata.get("rule", Rule()).instead_of
        if other and field.name in table and other in table:
            raise ConfigurationError(f"'{field.name}' and '{other}' in {where} say the same thing; give one of them")


def _needed(field: dataclasses.Field[Any]) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _what_to_write(field: dataclasses.Field[Any]) -> str:
    choices = field.metadata.get("rule", Rule()).choices
    return "it has no default" + (f": write one of {', '.join(choices)}" if choices else "")


def _check_each_complete(kind: Any, tables: Mapping[str, Mapping[str, object]], places: Mapping[str, _Place]) -> None:
    """Name all tables of a kind that lack the same key, where several do."""
    for field in dataclasses.fields(kind):
        lacking = [places[name].table for name, table in tables.items() if field.name not in table]
        if _needed(field) and field.name != "name" and len(lacking) > 1:
            more = f" and {len(lacking) - MOST_TABLES} more" if len(lacking) > MOST_TABLES else ""
            places_of = ", ".join(lacking[:MOST_TABLES])
            raise ConfigurationError(f"the key '{field.name}' is missing in {places_of}{more}; {_what_to_write(field)}")


def _check_range(bounds: Rule, value: object, place: _Place) -> None:
    """Numbers are checked as they stand in the file: one of 400 digits is no float, and none of 5000 can be shown."""
    if bounds.between is None:
        return
    low, high = bounds.between
    for item in value if isinstance(value, list) else (value,):
        if isinstance(item, int | float) and not isinstance(item, bool) and not low <= item <= high:  # NaN fails, too
            words = f": {bounds.wanted}" if bounds.wanted else ""
            raise ConfigurationError(
                f"{place} is {shown(item)}, but it must be a number from {low:.16g} to {high:.16g}{words}"
            )


def _check_choice(bounds: Rule, value: object, place: _Place) -> None:
    if bounds.choices and value not in bounds.choices:
        raise ConfigurationError(f"{place} is {shown(value)}: {nearest(str(value), bounds.choices)}")


def _convert(hint: Any, value: object, place: _Place) -> object:
    """`value` as the type `hint`, which is one of those that the schema uses."""
    origin = typing.get_origin(hint)
    if origin is types.UnionType:  # X | None, or a number or several: X | tuple[X, X] | None
        arms = [arm for arm in typing.get_args(hint) if arm is not types.NoneType]
        listed = [arm for arm in arms if typing.get_origin(arm) is tuple]
        return _convert(listed[0] if listed and isinstance(value, list) else arms[0], value, place)
    if origin is tuple:
        return _convert_tuple(typing.get_args(hint), value, place)
    if dataclasses.is_dataclass(hint):
        return _convert_table(hint, value, place)
    if hint is Path:
        text = _expect(value, str, "a path in quotes", place=place)
        return place.folder / os.path.expanduser(text)  # noqa: PTH111 - a Path has forgotten that "./~x" is no home
    if issubclass(hint, StrEnum):
        word = _expect(value, str, "a word in quotes", place=place)
        if word not in list(hint):
            raise ConfigurationError(f"{place} is '{shortened(word)}': {nearest(word, list(hint))}")
        return hint(word)
    wanted = {float: "a number", int: "a whole number", str: "text in quotes", bool: "true or false"}[hint]
    if hint is not bool and isinstance(value, bool):  # to Python, true is the number 1
        raise ConfigurationError(f"{place} is {shown(value)}, but it must be {wanted}")
    if hint is float and isinstance(value, int):
        value = float(value)
    return _expect(value, hint, wanted, place=place)


def _convert_table(kind: Any, value: object, place: _Place) -> object:
    return read_table(kind, _expect(value, dict, "a table", place=place), where=place.table, folder=place.folder)


def _convert_tuple(arms: tuple[Any, ...], value: object, place: _Place) -> object:
    kind = arms[0]
    named = dataclasses.is_dataclass(kind) and "name" in {field.name for field in dataclasses.fields(kind)}
    if dataclasses.is_dataclass(kind) and isinstance(value, dict) and not named:
        raise ConfigurationError(f"{place} is one table, but it must be a list of them: [[{shortened(place.key)}]]")
    if isinstance(value, dict) and named:  # [tissues.NAME]: the key is the name
        places = {name: _Place(name, place.table, place.folder) for name in value}
        tables = {name: _expect(table, dict, "a table", place=places[name]) for name, table in value.items()}
        for name, table in tables.items():
            if "name" in table:
                raise ConfigurationError(f"unknown key 'name' in {places[name].table}: the table's own name is it")
        _check_each_complete(kind, tables, places)
        return tuple(_convert_table(kind, {**table, "name": name}, places[name]) for name, table in tables.items())
    items = _expect(value, list, "a list in square brackets", place=place)
    if arms[-1] is not Ellipsis and len(items) != len(arms):
        raise ConfigurationError(f"{place} is {shown(items)}, but it must hold {len(arms)} values")
    return tuple(_convert(kind, item, place) for item in items)


def _expect(value: object, kind: type[Any], wanted: str, *, place: _Place) -> Any:
    if isinstance(value, str) and len(value) > MOST_LETTERS:
        raise ConfigurationError(f"{place} is text of {len(value)} characters; at most {MOST_LETTERS} are taken")
    if not isinstance(value, kind):
        raise ConfigurationError(f"{place} is {shown(value)}, but it must be {wanted}")
    return value


def shown(value: object) -> str:
    """A value of a TOML file for a sentence: as it would be written, or its beginning."""
    if isinstance(value, bool):
        return "true" if value else "false"
    try:
        return shortened(repr(list(value) if isinstance(value, tuple) else value))
    except ValueError:  # Python does not write out whole numbers of over 4300 digits
        return "a number too long to be shown"
