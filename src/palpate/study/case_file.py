"""Reading case.toml, with overrides from the command line."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from palpate.errors import ConfigurationError
from palpate.study.case import Case
from palpate.study.schema import read_table

__all__ = ["read_case"]

LARGEST_FILE = 1_000_000  # bytes; a case is a page of text


def read_case(path: Path, overrides: Sequence[str] = ()) -> Case:
    """The case that the TOML file at `path` describes; paths in it are relative to the file.

    Each of `overrides` is `key.path=value` with a TOML value (text may go without quotes); it replaces the file's.
    Raises `ConfigurationError` when the file cannot be read or says something unknown or impossible.
    """
    table = _parse(_read_text(path), str(path))
    for override in overrides:
        table = _merged(table, _parse_override(override))
    table.setdefault("id", path.stem)
    tissues = table.get("tissues")
    if "phantom" in table and isinstance(tissues, dict):  # a phantom's tissues are known by name
        table["tissues"] = {
            name: {"label": name, **tissue} if isinstance(tissue, dict) else tissue for name, tissue in tissues.items()
        }
    return read_table(Case, table, where=path.name, folder=path.absolute().parent)


def _read_text(path: Path) -> str:
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise ConfigurationError(
                f"{path} is {path.stat().st_size} bytes long: this is no case file; give a case.toml"
            )
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigurationError(
            f"{path} is not UTF-8 text (byte {error.start}): give a case.toml saved as UTF-8"
        ) from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigurationError(f"cannot read the case file {path}: {reason}; check its path") from error


def _parse(text: str, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigurationError(f"{where} is not valid TOML: {error}") from error


def _parse_override(override: str) -> dict[str, Any]:
    key, equals, value = override.partition("=")
    if not equals or not key.strip():
        raise ConfigurationError(f"--set {override}: write key.path=value, as in --set mesh.edge_length_mm=3")
    try:
        return tomllib.loads(f"{key} = {value}")
    except tomllib.TOMLDecodeError:
        return _parse(f"{key} = {json.dumps(value.strip())}", f"--set {override}")


def _merged(table: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(table)
    for key, value in changes.items():
        below = merged.get(key)
        merged[key] = _merged(below, value) if isinstance(value, dict) and isinstance(below, dict) else value
    return merged
