"""Spoil cases, --set values and label tables at random: nothing but sentences of their class may come of them.

    python benchmarks/fuzz_cases.py --runs 1000000 --commands 4000 --output fuzz_cases.json

With a fixed seed. A run takes a valid case or table as a tree of values, changes its structure in one to six places
(types, sizes, nesting, huge numbers, names of all scripts, keys doubled, moved, mistyped), writes it as text in one of
the spellings that the format allows, in a third of the runs changes the text, too, and reads it with the functions that
the command line calls. `--commands` cases go through `palpate check` itself, in a process of their own. A finding is an
exception that is no `PalpateError`, an exit code of another class, a sentence with control characters, of several lines
or of over 2000 letters, a traceback, the request to report a bug, or more than 2 s of processor time. Prints JSON.
"""

from __future__ import annotations

import argparse
import copy
import faulthandler
import json
import os
import random
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nibabel
import numpy as np

import palpate.study.check  # noqa: F401 - before processes are forked that would import it each
from palpate.cli import main as palpate_command
from palpate.errors import PalpateError
from palpate.images.label_table import read_label_table
from palpate.study.case_file import read_case

MEMORY_BYTES = 2 * 2**30
MOST_FINDINGS = 20
LONGEST_SENTENCE = 2000
SLOW_SECONDS = 2.0  # of processor time
COMMAND_SECONDS = 60  # of processor time of one `palpate check`, which reads images and predicts the cost
CASE_CODES, TABLE_CODES, COMMAND_CODES = {2}, {2, 3}, {0, 2, 3, 4, 6}


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
            "method": "lbfgs",
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
    container, key = rng.choice(places(tree) or [(tree, "x")])
    value = container[key] if isinstance(container, list) else container.get(key)
    kind = rng.choice(("value", "value", "number", "drop", "rename", "copy", "wrap", "add", "swap", "many"))
    if kind == "number" and isinstance(value, int | float):
        small = -1e300 < value < 1e300 and rng.random() < 0.5
        container[key] = value * 10.0 ** rng.randrange(-320, 300) if small else rng.choice(NUMBERS)
    elif kind == "drop":
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
    elif kind == "swap":
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


@dataclass(frozen=True, slots=True)
class Outcome:
    """Class name of what came out, seconds of processor time, and what should not have been."""

    kind: str
    seconds: float
    flaw: str = ""


def outcome(read: Callable[[], object], codes: set[int]) -> Outcome:
    """Read one spoilt input; `codes`: the exit codes that its refusal may have."""
    began = time.thread_time()
    try:
        read()
    except PalpateError as error:
        kind, sentence = type(error).__name__, str(error)
        flaw = "" if error.exit_code in codes else f"exit code {error.exit_code}: {sentence}"
        if "bug" in sentence or not sentence.isprintable() or len(sentence) > LONGEST_SENTENCE:
            flaw = f"{len(sentence)} letters: {sentence[:300]!r}"
    except Exception as error:
        kind, flaw = f"foreign {type(error).__name__}", traceback.format_exc(limit=-3)[-2000:]
    else:
        kind, flaw = "read", ""
    seconds = time.thread_time() - began
    return Outcome(kind, seconds, flaw or ("slow" if seconds > SLOW_SECONDS else ""))


def one_run(rng: random.Random, folder: Path) -> tuple[str, Outcome, bytes]:
    """Make one spoilt input and read it: what it was, what came of it, its text."""
    kind = rng.choice(("case", "case", "set", "table"))
    path = folder / "case.toml"
    if kind == "case":
        content = spoilt_case(rng)
        path.write_bytes(content)
        return kind, outcome(lambda: read_case(path), CASE_CODES), content
    if kind == "set":
        path.write_text(toml_of(rng.choice(CASES), random.Random(0)), encoding="utf-8")
        arguments = [override(rng) for _ in range(rng.choice((1, 1, 1, 2, 5)))]
        return kind, outcome(lambda: read_case(path, arguments), CASE_CODES), repr(arguments).encode()
    ending, content = spoilt_table(rng)
    table = folder / f"names{ending}"
    table.write_bytes(content)
    path.write_text(toml_of(CASES[1], random.Random(0)), encoding="utf-8")
    case = read_case(path, [f'tissues.prostate.label="{rng.choice(("prostate", "prostata", "x" * 200))}"'])
    return kind, outcome(lambda: case.resolve_tissues(read_label_table(table)), TABLE_CODES), content


def command_run(rng: random.Random, folder: Path) -> tuple[str, Outcome, bytes]:
    """`palpate check` on one spoilt case whose images are there, in a process of its own."""
    content = spoilt_case(rng, CASES[:2])
    (folder / "case.toml").write_bytes(content)
    (folder / "names.json").write_text(json.dumps(NAMES))
    arguments = [word for _ in range(rng.choice((0, 0, 1))) for word in ("--set", override(rng))]
    if any("\0" in word or "phantom" in word for word in arguments) or b"phantom" in content:
        arguments = []  # no argument of a process holds a zero byte, and phantoms take minutes
    with (folder / "said.txt").open("w+b") as said:
        pid = os.fork()
        if pid == 0:
            become_command(["check", str(folder / "case.toml"), "--quiet", *arguments], said.fileno())
        _, status, usage = os.wait4(pid, 0)
        said.seek(0)
        words = said.read().decode("utf-8", errors="replace")
    code = os.waitstatus_to_exitcode(status)
    wrong = code not in COMMAND_CODES or "Traceback" in words or "report it" in words or (code != 0) != bool(words)
    flaw = f"exit code {code}: {words[-1000:]}" if wrong else ""
    seconds = usage.ru_utime + usage.ru_stime
    slow = "slow" if seconds > SLOW_SECONDS and code == 2 else ""
    return "command", Outcome(f"exit code {code}", seconds, flaw or slow), content + repr(arguments).encode()


def become_command(argv: list[str], said: int) -> None:
    """The forked process: run `palpate` with these arguments under limits, say everything into `said`, and end."""
    code = 99
    try:
        os.dup2(said, 1)
        os.dup2(said, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        resource.setrlimit(resource.RLIMIT_CPU, (COMMAND_SECONDS, COMMAND_SECONDS))
        warnings.simplefilter("default")
        try:
            code = palpate_command(argv)
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 98
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def save_images(folder: Path) -> None:
    """A ball (1) behind a tube (2) that fills, in two label images."""
    places_mm = np.stack(np.meshgrid(*[np.arange(20) * 2.0] * 3, indexing="ij"), axis=-1)
    for name, shift, radius in (("before", 0.0, 4.0), ("after", 0.8, 6.0)):
        labels = (np.linalg.norm(places_mm - [19.0, 25.0 + shift, 19.0], axis=-1) < 10.0).astype(np.uint8)
        labels[np.linalg.norm(places_mm[..., :2] - [19.0, 9.0], axis=-1) < radius] = 2
        nibabel.save(nibabel.Nifti1Image(labels, np.diag([2.0, 2.0, 2.0, 1.0])), folder / f"{name}.nii.gz")


def campaign(runs: int, commands: int, seed: int, folder: Path) -> dict[str, object]:
    """All runs; the document to be printed."""
    rng = random.Random(seed)
    save_images(folder)
    kinds: dict[str, Counter[str]] = {kind: Counter() for kind in ("case", "set", "table", "command")}
    findings: list[dict[str, str]] = []
    slowest = dict.fromkeys(kinds, 0.0)
    began, before = time.perf_counter(), peak_mebibytes()
    for number in range(runs + commands):
        kind, result, content = (one_run if number < runs else command_run)(rng, folder)
        kinds[kind][result.kind] += 1
        slowest[kind] = max(slowest[kind], result.seconds)
        if result.flaw and len(findings) < MOST_FINDINGS and result.flaw not in {f["flaw"] for f in findings}:
            shown = content[:3000].decode("utf-8", errors="backslashreplace")
            findings.append({"kind": kind, "run": str(number), "flaw": result.flaw, "input": shown})
    return {
        "runs": runs,
        "commands": commands,
        "seed": seed,
        "seconds": round(time.perf_counter() - began, 1),
        "outcomes": {kind: dict(sorted(counts.items())) for kind, counts in kinds.items()},
        "findings": findings,
        "slowest_processor_seconds": {kind: round(seconds, 3) for kind, seconds in slowest.items()},
        "memory_limit_mib": MEMORY_BYTES // 2**20,
        "peak_memory_mib": peak_mebibytes(),
        "memory_before_mib": before,
    }


def peak_mebibytes() -> int:
    """Largest resident size of this process so far, MiB."""
    scale = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // scale


def main() -> int:
    """Run the campaign; exit code 1 when something was found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--commands", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    faulthandler.enable()
    warnings.simplefilter("error")
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, hard))
    memory_disk = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory_disk if memory_disk.is_dir() else None) as folder:
        document = campaign(arguments.runs, arguments.commands, arguments.seed, Path(folder))
    text = json.dumps(document, indent=1)
    if arguments.output:
        arguments.output.write_text(text + "\n", encoding="utf-8")
    print(text)
    return 1 if document["findings"] else 0


if __name__ == "__main__":
    sys.exit(main())
