"""Cases, --set values and label tables that are damaged at random, for `fuzz_cases.py`.

A valid case or table is a tree of values; its structure is changed in up to six places (types, sizes, nesting, huge
numbers, names of all scripts, keys doubled, moved, mistyped), it is written in one of the spellings that its format
allows, and in a third of them the text is changed, too.
"""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Raw:
    """Text that is written as it stands, where a value belongs."""

    text: str


CASES: tuple[dict[str, Any], ...] = (
    {
        "id": "sub-01",
        "patient": "sub-01",
        "stage": 2,
        "seed": 3,
        "images": {"before": "before.nii.gz", "after": ["after.nii.gz"], "align": "none"},
        "domain": {"extent": "margin", "margin_mm": 30.0, "outer_boundary": "sliding"},
        "tissues": {
            "prostate": {"label": 1, "role": "estimate", "poisson_ratio": 0.45},
            "rectum": {"label": [2], "role": "driver"},
            "soft tissue": {"label": "remaining", "role": "known", "youngs_modulus_kpa": 10.0, "density_kg_m3": 950},
        },
        "mechanics": {"law": "mooney-rivlin", "element": "auto", "c01_over_c10": 0.25},
        "mesh": {"edge_length_mm": 6.0},
        "driver": {"modes": 6, "kernel_mm": 20.0, "prior_mm": 5.0, "learn_prior": False},
        "noise": {"surface_sd_mm": 0.3, "correlation_length_mm": 6.0},
        "estimate": {
            "method": "gauss-newton",
            "parameters": ["youngs_modulus"],
            "starts_kpa": [9.0],
            "bounds_kpa": [1.0, 99.0],
        },
    },
    {
        "images": {"before": "before.nii.gz", "after": ["after.nii.gz"], "names": "names.json"},
        "pairs": [{"before": "before.nii.gz", "after": ["after.nii.gz", "./after.nii.gz"]}],
        "tissues": {
            "prostate": {"label": "prostate", "role": "estimate", "youngs_modulus_kpa": 60.0},
            "lumen": {"label": "rectum", "role": "void"},
            "rest": {"label": "remaining", "role": "known", "youngs_modulus_kpa": 10.0},
        },
        "loads": [
            {"kind": "pressure", "surface": "lumen", "pressure_kpa": 2.0, "following": False},
            {"kind": "traction", "surface": "outer", "traction_kpa": [0.0, -0.5, 0.0]},
            {"kind": "gravity", "acceleration_m_s2": [0, -9.81, 0]},
        ],
        "estimate": {"start_ratios": [0.5, 2.0], "bounds_ratio": [0.02, 200.0]},
    },
    {
        "phantom": {"kind": "pelvis", "seed": 7, "law": "linear"},
        "motion": {"filling_mm": 5.0},
        "tissues": {"prostate": {"role": "estimate"}},
    },
)
NAMES: dict[str, int] = {"prostate": 1, "rectum": 2, "left hip": 3, "bladder": 10}
WORDS = (
    *("", " ", "a", "estimate", "after", "remaining", "=cmd()", "organ;=cmd()", "\uff1dcmd()", "-1", "1_0", "\uff11"),
    *("../../x", "~", "~nobody-here/x", "/dev/zero", "x" * 200, "x" * 201, "x" * 5000, "\u202eabc", "a\x1b[2J", "a\0b"),
    *(
        "</script><img src=x onerror=alert(1)>",
        "größer",
        "肝臓",
        "e\u0301",
        "\U0001f9e0" * 60,
        "\ufeff",
        "a\nb",
        "a\rb",
    ),
    *("tissues", "images", "poisson_ratio", "a.b", "[x]", "'", '"', "\\", "%s%n", "{{7*7}}", "NaN", "null", "\u00a0"),
)
NUMBERS = (
    *(0, 1, -1, 2, 65535, 65536, 2**31, 2**53, 2**63, -(2**63), 10**400, Raw("9" * 5000), Raw("0x" + "f" * 5000)),
    *(0.0, -0.0, 1e-320, 1e-200, 1e200, 1e308, -1e308, float("nan"), float("inf"), float("-inf"), 0.5, 0.49999999999),
    *(Raw("1" + "0" * 400), Raw("1e999999"), Raw("1_000"), Raw("0b1"), Raw("1979-05-27T07:32:00Z"), Raw("07:32:00")),
)
BITS = (
    *(
        "[" * 60_000,
        "{a=" * 3000,
        "x" + ".a" * 20_000 + "=1\n",
        "[x" + ".a" * 40_000 + "]\n",
        "#" * 90_000,
        "\n" * 50_000,
    ),
    *("[[", "]]", "=", "==", ".", "..", '"', '"""', "'''", "\\u0000", "\\ud800", "\\U00110000", "\ufeff", "\0", "\x7f"),
    *("[tissues]\n", "[[tissues]]\n", "[images]\n", "x = 1\n", "\r", "\t", "\u2028", "{", "}", ",", "# \x07\n", "inf"),
)


def random_value(rng: random.Random, depth: int = 0) -> Any:
    """A value of any type and size."""
    kind = rng.random()
    if kind < 0.35:
        return rng.choice(NUMBERS)
    if kind < 0.65:
        return rng.choice(WORDS)
    if kind < 0.75:
        return rng.choice((True, False, rng.randrange(-9, 99999), rng.uniform(-3.0, 300.0)))
    if kind < 0.8:
        return nested(rng)
    size = rng.choice((0, 1, 1, 2, 3, 5, 40 if depth == 0 else 1))
    if kind < 0.9:
        return [random_value(rng, depth + 1) if depth < 3 else 1 for _ in range(size)]
    return {rng.choice(WORDS): random_value(rng, depth + 1) if depth < 3 else 1 for _ in range(size)}


def nested(rng: random.Random) -> Any:
    """A list or table in itself, many times."""
    value: Any = rng.choice(NUMBERS)
    in_list = rng.random() < 0.5
    for _ in range(rng.choice((3, 30, 90, 150))):
        value = [value] if in_list else {"a": value}
    return value


def places(tree: Any) -> list[tuple[Any, Any]]:
    """Every place of a tree, as the container and the key or index in it."""
    keys = list(tree) if isinstance(tree, dict) else list(range(len(tree))) if isinstance(tree, list) else []
    found = [(tree, key) for key in keys]
    for key in keys:
        found += places(tree[key])
    return found


def mistyped(word: str, rng: random.Random) -> str:
    """A word with one letter more, less, or another."""
    at = rng.randrange(len(word) + 1)
    return word[:at] + rng.choice(("", "x", ".", "_", "\u0301", "É", " ")) + word[at + rng.randrange(2) :]


def change(tree: dict[str, Any], rng: random.Random) -> None:
    """One change of structure."""
    container, key = rng.choice(places(tree) or [(tree, "x")])  # an empty tree has no place yet, and None there
    value = container[key] if isinstance(container, list) else container.get(key)
    kind = rng.choice(("value", "value", "number", "drop", "rename", "copy", "wrap", "add", "swap", "many"))
    if kind == "number" and isinstance(value, int | float):
        small = -1e300 < value < 1e300 and rng.random() < 0.5
        container[key] = value * 10.0 ** rng.randrange(-320, 300) if small else rng.choice(NUMBERS)
    elif kind == "drop" and value is not None:
        del container[key]
    elif kind == "rename" and isinstance(container, dict):
        container[rng.choice((mistyped(str(key), rng), rng.choice(WORDS)))] = container.pop(key, None) or 1
    elif kind == "copy":
        target, other = rng.choice(places(tree) or [(tree, "x")])
        target[other] = copy.deepcopy(value)
    elif kind == "wrap":
        container[key] = rng.choice(([value], {str(key): value}, [[value]], [value, copy.deepcopy(value)]))
    elif kind == "add" and isinstance(value, dict):
        value[rng.choice(WORDS)] = random_value(rng)
    elif kind == "swap" and value is not None:
        target, other = rng.choice(places(tree) or [(tree, "x")])
        container[key], target[other] = copy.deepcopy(target[other]), copy.deepcopy(container[key])
    elif kind == "many" and isinstance(value, dict) and rng.random() < 0.1:
        value |= {
            f"organ {i}": copy.deepcopy(next(iter(value.values()), 1)) for i in range(rng.choice((10, 300, 2000)))
        }
    else:
        container[key] = random_value(rng)


def text_of(value: Any) -> str:
    """A value as TOML writes it on one line."""
    if isinstance(value, Raw):
        return value.text
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list):
        return "[" + ", ".join(map(text_of, value)) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key_of(key)} = {text_of(item)}" for key, item in value.items()) + "}"
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")


def key_of(key: object) -> str:
    """A key as TOML writes it."""
    word = str(key)
    plain = word.isascii() and word.replace("_", "a").replace("-", "a").isalnum()
    return word if plain else text_of(word)


def toml_of(tree: dict[str, Any], rng: random.Random, above: str = "") -> str:
    """A tree as a TOML file: tables under headings, in one line, or by dotted keys."""
    tables = {key: value for key, value in tree.items() if isinstance(value, dict) and rng.random() < 0.8}
    lines = [f"{key_of(key)} = {text_of(value)}" for key, value in tree.items() if key not in tables]
    for key, table in tables.items():
        if not above and rng.random() < 0.1:
            lines[:0] = [f"{key_of(key)}.{key_of(k)} = {text_of(v)}" for k, v in table.items()]
        else:
            lines.append(f"[{above}{key_of(key)}]\n{toml_of(table, rng, f'{above}{key_of(key)}.')}")
    return "\n".join(lines) + "\n"


def spoilt_text(text: str, rng: random.Random) -> bytes:
    """The text as UTF-8, with one to three changes below its grammar."""
    content = bytearray(text.encode("utf-8", errors="surrogatepass"))
    for _ in range(rng.choice((1, 1, 2, 3))):
        place = rng.randrange(len(content) + 1)
        kind = rng.random()
        if kind < 0.4:
            content[place : place + rng.choice((0, 0, 1, 5))] = rng.choice(BITS).encode()
        elif kind < 0.6:
            content[place : place + 1] = rng.randbytes(1)
        elif kind < 0.8:
            end = content.find(b"\n", place) + 1
            content[place:place] = content[place:end] * rng.choice((1, 2, 50))
        else:
            del content[place : len(content) if rng.random() < 0.2 else place + rng.randrange(40)]
    return bytes(content)


def spoilt_case(rng: random.Random, cases: tuple[dict[str, Any], ...] = CASES) -> bytes:
    """A case file with changes of structure and, in some, of text."""
    tree = copy.deepcopy(rng.choice(cases))
    try:
        for _ in range(rng.choice((0, 1, 1, 1, 2, 3, 6))):
            change(tree, rng)
        text = toml_of(tree, rng)
    except RecursionError:  # a nest in a nest in a nest
        text = "x = " + "[" * 3000
    return spoilt_text(text, rng) if rng.random() < 0.3 else text.encode("utf-8", errors="surrogatepass")


def override(rng: random.Random) -> str:
    """An argument of --set."""
    tree = rng.choice(CASES)
    key = [rng.choice(list(tree))]
    while isinstance(tree := tree.get(key[-1], 1), dict) and rng.random() < 0.9:
        key.append(rng.choice(list(tree)))
    words = [mistyped(word, rng) if rng.random() < 0.05 else word for word in map(key_of, key)]
    value = text_of(random_value(rng)) if rng.random() < 0.8 else rng.choice((*WORDS, *BITS))
    kind = rng.random()
    if kind < 0.02:
        return rng.choice((*WORDS, *BITS))
    return ".".join(words) + rng.choice(("=", "=", "=", " = ", "==", "")) + value


def spoilt_table(rng: random.Random) -> tuple[str, bytes]:
    """A label table with its ending."""
    rows: list[tuple[Any, Any]] = [(number, name) for name, number in NAMES.items()]
    if rng.random() < 0.01:
        rows += [(i, f"organ {i}") for i in range(100, rng.choice((200, 5000, 45_000)))]
    for _ in range(rng.choice((0, 1, 1, 2))):
        at = rng.randrange(len(rows))
        number = rng.choice((*NUMBERS, *WORDS, "\uff11\uff10", "\u00b2", "1_0", " 1", "+1", "1.0", "007", "0x1"))
        number = number.text if isinstance(number, Raw) else number
        rows[at] = rng.choice(
            ((number, rows[at][1]), (rows[at][0], rng.choice(WORDS)), (rows[at][0], random_value(rng)))
        )
    ending = rng.choice((".json", ".txt", ".ctbl", ".csv", ".tsv", ".label"))
    text = TABLES[ending](rows, rng)
    return ending, spoilt_text(text, rng) if rng.random() < 0.3 else text.encode("utf-8", errors="surrogatepass")


def json_table(rows: list[tuple[Any, Any]], rng: random.Random) -> str:
    """Number -> name, name -> number or both under "labels"."""
    forward = rng.random() < 0.5
    table = {str(k) if forward else str(v): v if forward else k for k, v in rows}
    return json.dumps({"labels": table} if rng.random() < 0.3 else table, default=lambda raw: raw.text)


TABLES: dict[str, Callable[[list[tuple[Any, Any]], random.Random], str]] = {
    ".json": json_table,
    ".txt": lambda rows, _: "".join(f'{k} 255 0 0 1 1 1 "{v}"\n' for k, v in rows),
    ".label": lambda rows, _: "".join(f'{k} 255 0 0 1 1 1 "{v}"\n' for k, v in rows),
    ".ctbl": lambda rows, _: "".join(f"{k} {v} 255 0 0 255\n" for k, v in rows),
    ".csv": lambda rows, _: "LabelValue,Name,Color_R\n" + "".join(f'{k},"{v}",255\n' for k, v in rows),
    ".tsv": lambda rows, _: "index\tname\tcolor\n" + "".join(f"{k}\t{v}\t#ff0000\n" for k, v in rows),
}
