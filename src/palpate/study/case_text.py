"""A case as a case.toml again: every setting written out, as its reader takes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from palpate.images.named_labels import printable
from palpate.images.tissue import Role
from palpate.study.case import POISSON_RATIO, RATIO_SD, Case, CaseTissue
from palpate.study.schema import Rule
from palpate.study.toml_text import lasting_path, toml_key, toml_value

__all__ = ["case_tables", "case_text"]

HEADING = (
    "# The case of the result beside it, as it was run: every setting is written out. Files outside of this folder are"
    "\n# named by their whole paths, so that the folder may be moved."
)


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
        if case.estimate.seeks_poisson_ratios:
            stated = {t.name: t.poisson_ratio_sd or RATIO_SD for t in case.tissues if t.role is Role.ESTIMATE}
            tissues = tuple(replace(t, poisson_ratio_sd=stated.get(t.name)) for t in tissues)
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
