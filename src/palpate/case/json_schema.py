"""The JSON Schema of case.toml, made from the dataclasses and rules that read it."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from enum import StrEnum
from importlib import resources
from pathlib import Path
from typing import Any

from palpate.case.case import Case
from palpate.case.schema import MOST_LETTERS, Rule
from palpate.case.tissue import CaseTissue
from palpate.images.named_labels import MAX_LABEL, MAX_NAME

DIALECT = "https://json-schema.org/draft/2020-12/schema"
SCHEMAS = resources.files("palpate.case") / "schemas"  # case, result and sensitivity, as they are shipped
LABEL = {
    "description": "an integer, a list of integers, a name of the label table, or 'remaining'",
    "oneOf": [
        {"type": "integer", "minimum": 0, "maximum": MAX_LABEL},
        {"type": "array", "items": {"type": "integer", "minimum": 0, "maximum": MAX_LABEL}, "minItems": 1},
        {"type": "string", "minLength": 1, "maxLength": MAX_NAME},
    ],
}
PLAIN: Mapping[Any, str] = {float: "number", int: "integer", str: "string", bool: "boolean", Path: "string"}


def case_schema() -> dict[str, Any]:
    """The schema of a case.toml as the tables that TOML makes of it: types, choices, ranges and defaults.

    What ties several keys together stands in the code alone: a case that the schema takes may still be refused.
    """
    heading = {"$schema": DIALECT, "$id": "case.schema.json", "title": "case.toml of Palpate"}
    table = _table(Case)
    table["required"].remove("id")  # by default the file's name
    table["properties"]["tissues"]["additionalProperties"]["required"].remove("label")  # by default a phantom's own
    labelled = {"properties": {"tissues": {"additionalProperties": {"required": ["label"]}}}}
    return heading | table | {"if": {"required": ["images"]}, "then": labelled}


def _table(kind: Any) -> dict[str, Any]:
    """The object that the dataclass `kind` is read from."""
    hints, properties, required = typing.get_type_hints(kind), dict[str, Any](), []
    others: list[dict[str, Any]] = []
    for field in dataclasses.fields(kind):
        bounds: Rule = field.metadata.get("rule", Rule())
        for key, (least, most) in bounds.collects.items():
            properties[key] = {"type": "number", "minimum": least, "maximum": most}
        if bounds.collects or bounds.unwritten or (kind is CaseTissue and field.name == "name"):
            continue
        value, stated = _value(hints[field.name], bounds), field.default
        default = bounds.chosen if bounds.chosen else list(stated) if isinstance(stated, tuple) else stated
        written = isinstance(default, str | int | float | list) and default not in ("", [])
        properties[field.name] = value | ({"default": default} if written else {})
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            required.append(field.name)
        if bounds.instead_of:
            others.append({"not": {"required": [field.name, bounds.instead_of]}})
    table: dict[str, Any] = {"type": "object", "properties": properties, "additionalProperties": False}
    return table | ({"required": required} if required else {}) | ({"allOf": others} if others else {})


def _value(hint: Any, bounds: Rule) -> dict[str, Any]:
    """The schema of one value."""
    if isinstance(hint, types.UnionType):  # X | None: None is the key left out
        if bounds.convert:
            return LABEL
        arms = [_value(arm, bounds) for arm in typing.get_args(hint) if arm is not types.NoneType]
        stated = arms[0] if len(arms) == 1 else {"oneOf": arms}
        return {"oneOf": [{"const": bounds.chosen}, stated]} if bounds.chosen else stated
    if typing.get_origin(hint) is tuple:
        return _list(typing.get_args(hint), bounds)
    if dataclasses.is_dataclass(hint):
        return _table(hint)
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        return {"enum": list(bounds.choices) or [str(member) for member in hint]}
    value: dict[str, Any] = {"type": PLAIN[hint]}
    if bounds.choices:
        value = {"enum": list(bounds.choices)}
    elif hint in (str, Path):
        value |= {"maxLength": MOST_LETTERS} | ({"minLength": 1} if bounds.test else {})
    if bounds.between:
        value |= {"minimum": bounds.between[0], "maximum": bounds.between[1]}
    return value | ({"description": bounds.wanted} if bounds.wanted and not bounds.test else {})


def _list(arms: tuple[Any, ...], bounds: Rule) -> dict[str, Any]:
    if arms[0] is CaseTissue:
        return {"type": "object", "additionalProperties": _table(CaseTissue)}  # [tissues.NAME]
    listed: dict[str, Any] = {"type": "array", "items": _value(arms[0], dataclasses.replace(bounds, wanted=""))}
    if arms[-1] is not Ellipsis:
        return listed | {"minItems": len(arms), "maxItems": len(arms)}
    return listed | ({"minItems": 1} if bounds.test else {})
