"""Reading case.toml, with overrides from the command line."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.errors import ConfigurationError
from palpate.images.input_file import read_input
from palpate.study.case import Case
from palpate.study.schema import read_table, shortened

__all__ = ["read_case"]

LARGEST_FILE = 100_000  # bytes; a case is a page of text, and one of a hundred tissues has 40 000
MOST_DOTS = 100  # in a line: keys of thousands of parts would take the parser minutes


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
    table = change(_parse(_read_text(path), str(path)))
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


def _read_text(path: Path) -> str:
    try:
        content, _ = read_input(path, LARGEST_FILE)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigurationError(f"cannot read the case file {path}: {reason}; check its path") from error
    if len(content) > LARGEST_FILE:
        raise ConfigurationError(f"{path} is over {LARGEST_FILE} bytes long: this is no case file; give a case.toml")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigurationError(
            f"{path} is not UTF-8 text (byte {error.start}), so it is no case.toml; from images alone an estimate needs"
            " two or more, the one before and those after"
        ) from error


def _parse(text: str, where: str) -> dict[str, Any]:
    if max(line.count(".") for line in text.split("\n")) > MOST_DOTS:
        raise ConfigurationError(
            f"{where} has a line with over {MOST_DOTS} dots, and keys are not read that deep; break a long list into"
            " several lines"
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
        raise ConfigurationError(f"{shown} is longer than a case file may be")
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
