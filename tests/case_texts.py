"""Texts of case files: what most tests state alike stands here once."""

import json
import re

ORGAN = {"label": 1, "role": "estimate"}
REST = {"label": "remaining", "role": "known", "youngs_modulus_kpa": 10.0}
BALLS = {  # those of scenes.py
    "core": ORGAN,
    "shell": {"label": 2, "role": "estimate"},
    "frame": {"label": 3, "role": "driver"},
    "surroundings": REST,
}
LINEAR = {"law": "linear", "element": "P1"}


def toml(value) -> str:
    """A value on one line."""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {toml(item)}' for key, item in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml, value))}]"
    return json.dumps(value)


def case_text(tissues, *, before="before.nii.gz", after=("after.nii.gz",), images=(), **keys) -> str:
    """A case of images and of tissues by name; `keys` are further keys of the file, and tables as dicts.

    What is None is left out. Tables may be added at the end of the text.
    """
    paths = {"before": before, "after": after} | dict(images)
    tables = {"images": {key: path for key, path in paths.items() if path is not None}}
    tables |= {key: value for key, value in keys.items() if isinstance(value, dict)}
    for name, tissue in tissues.items():
        tables[f"tissues.{name if re.fullmatch('[a-z]+', name) else json.dumps(name)}"] = tissue
    lines = [f"{key} = {toml(value)}" for key, value in keys.items() if key not in tables]
    for name, table in tables.items():
        if table:
            lines += [f"[{name}]", *(f"{key} = {toml(value)}" for key, value in table.items())]
    return "\n".join([*lines, ""])
