"""Damage cases, --set values and label tables at random: each must end in an error message of its class.

    python benchmarks/fuzz_cases.py --runs 1000000 --commands 4000 --output fuzz_cases.json

The seed is fixed. A run changes a valid input in up to six places (types, sizes, nesting, huge numbers, keys) and, in a
third of them, its text, and reads it with the functions that the command line calls. `--commands` cases go through
`palpate check` itself, in their own process, and through `palpate estimate` up to where solving begins. These are
findings: an exception that is no `PalpateError`; an exit code of another class; a message with control characters,
several lines or over 2000 letters; a traceback; the request to report a bug; more than 2 s of processor time; different
answers of `check` and `estimate`. Prints JSON.
"""

from __future__ import annotations

import copy
import importlib
import json
import os
import random
import resource
import sys
import warnings
from pathlib import Path
from typing import Any, NoReturn

import nibabel
import numpy as np
from fuzz_readers import SLOW_SECONDS, counted, damaged, limited, outcome, parser_of

from palpate.case import read_case
from palpate.cli import main as palpate_command
from palpate.images import read_label_table

importlib.import_module("palpate.study.check")  # before processes are forked that would import it each
ESTIMATE = importlib.import_module("palpate.study.run")

COMMAND_SECONDS = 60  # of processor time of one `palpate check`, which reads images and predicts the cost
CASE_CODES, TABLE_CODES, COMMAND_CODES = {2}, {2, 3}, {0, 2, 3, 4, 6}
CASES: tuple[dict[str, Any], ...] = (
    {
        "id": "sub-01",
        "stage": 2,
        "images": {"before": "before.nii.gz", "after": ["after.nii.gz"], "align": "none"},
        "domain": {"extent": "margin", "margin_mm": 30.0, "outer_boundary": "sliding"},
        "tissues": {
            "prostate": {"label": 1, "role": "estimate", "poisson_ratio": 0.45},
            "rectum": {"label": [2], "role": "driver"},
            "soft tissue": {"label": "remaining", "role": "known", "youngs_modulus_kpa": 10.0, "density_kg_m3": 950},
        },
        "mechanics": {"law": "mooney-rivlin", "element": "auto", "c01_over_c10": 0.25},
        "driver": {"modes": 6, "kernel_mm": 20.0, "prior_mm": 5.0, "learn_prior": False},
        "noise": {"surface_sd_mm": 0.3, "correlation_length_mm": 6.0},
        "estimate": {"parameters": ["youngs_modulus"], "starts_kpa": [9.0], "bounds_kpa": [1.0, 99.0]},
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
            {"kind": "gravity", "acceleration_m_s2": [0, -9.81, 0]},
        ],
        "estimate": {"start_ratios": [0.5, 2.0], "bounds_ratio": [0.02, 200.0]},
    },
    {"phantom": {"kind": "pelvis", "seed": 7}, "motion": {"filling_mm": 5.0}, "tissues": {"rest": {"role": "void"}}},
)
NAMES: dict[str, int] = {"prostate": 1, "rectum": 2, "left hip": 3, "bladder": 10}
WORDS = ["", " ", "estimate", "remaining", "=cmd()", "\uff1dcmd()", "1_0", "../../x", "~nobody-here/x", "/dev/zero"]
WORDS += ["x" * 201, "x" * 5000, "\u202eabc", "a\x1b[2J", "a\0b", "<img src=x>", "größer", "肝臓", "\U0001f9e0" * 60]
WORDS += ["\ufeff", "a\nb", "tissues", "poisson_ratio", "a.b", "[x]", '"', "\\", "%s%n", "{{7*7}}", "NaN", "null"]
NUMBERS = [0, 1, -1, 65536, 2**53, 2**63, -(2**63), 10**400, -0.0, 1e-320, 1e200, -1e308, 0.5, 0.49999999999]
NUMBERS += [float("nan"), float("inf"), float("-inf"), True, False]


def random_value(rng: random.Random, depth: int = 0) -> Any:
    """A value of any type and size."""
    kind = rng.random()
    if kind < 0.45 or depth > 3:
        return rng.choice(NUMBERS)
    if kind < 0.75:
        return rng.choice(WORDS)
    if kind < 0.8:
        value: Any = 1
        for _ in range(rng.choice((3, 30, 150))):
            value = [value] if rng.random() < 0.5 else {"a": value}
        return value
    size = rng.choice((0, 1, 1, 2, 3, 40 if depth == 0 else 1))
    values = [random_value(rng, depth + 1) for _ in range(size)]
    return values if kind < 0.9 else {rng.choice(WORDS): value for value in values}


def places(tree: Any) -> list[tuple[Any, Any]]:
    """Every place of a tree, as the container and the key or index in it."""
    keys = list(tree) if isinstance(tree, dict) else list(range(len(tree))) if isinstance(tree, list) else []
    return [(tree, key) for key in keys] + [place for key in keys for place in places(tree[key])]


def change(tree: dict[str, Any], rng: random.Random) -> None:
    """One place gets another value or key, goes, is wrapped, or gets more."""
    container, key = rng.choice(places(tree) or [(tree, "x")])
    value, kind = container.get(key) if isinstance(container, dict) else container[key], rng.random()
    if kind < 0.1:
        del container[key]
    elif kind < 0.25 and isinstance(container, dict):
        container[str(key)[: rng.randrange(8)] + rng.choice(WORDS)] = container.pop(key)
    elif kind < 0.4:
        container[key] = rng.choice(([value], {str(key): value}, [value, copy.deepcopy(value)]))
    elif kind < 0.5 and isinstance(value, dict):
        value |= {f"organ {i}": copy.deepcopy(next(iter(value.values()), 1)) for i in range(rng.choice((1, 10, 300)))}
    else:
        container[key] = random_value(rng)


def toml_of(value: Any) -> str:
    """A value as TOML writes it on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_of, value)) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml_of(str(key))} = {toml_of(item)}" for key, item in value.items()) + "}"
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")


def case_text(tree: dict[str, Any]) -> str:
    """A tree as a case file."""
    return "".join(f"{toml_of(str(key))} = {toml_of(value)}\n" for key, value in tree.items())


def as_bytes(text: str, rng: random.Random) -> bytes:
    """The text as UTF-8, a third of them with changes below its grammar."""
    content = text.encode("utf-8", errors="surrogatepass")
    return damaged(content, len(content), rng) if content and rng.random() < 0.3 else content


def spoilt_case(rng: random.Random, cases: tuple[dict[str, Any], ...] = CASES) -> bytes:
    """A case file with changes of structure and, in some, of text."""
    tree = copy.deepcopy(rng.choice(cases))
    for _ in range(rng.choice((0, 1, 1, 1, 2, 3, 6))):
        change(tree, rng)
    return as_bytes(case_text(tree), rng)


def override(rng: random.Random) -> str:
    """An argument of --set."""
    tree: Any = rng.choice(CASES)
    key = [rng.choice(list(tree))]
    while isinstance(tree := tree.get(key[-1], 1), dict) and rng.random() < 0.9:
        key.append(rng.choice([*tree, rng.choice(WORDS)]))
    value = toml_of(random_value(rng)) if rng.random() < 0.8 else rng.choice(WORDS)
    return ".".join(key) + rng.choice(("=", "=", "=", " = ", "==", "")) + value


def spoilt_table(rng: random.Random) -> tuple[str, bytes]:
    """A label table with its ending."""
    rows: list[tuple[Any, Any]] = [(number, name) for name, number in NAMES.items()]
    for _ in range(rng.choice((0, 1, 1, 2))):
        at = rng.randrange(len(rows))
        rows[at] = rng.choice(((random_value(rng), rows[at][1]), (rows[at][0], random_value(rng))))
    ending = rng.choice((".json", ".txt", ".ctbl", ".csv", ".tsv"))
    texts = {
        ".json": json.dumps({str(k): v for k, v in rows}),
        ".txt": "".join(f'{k} 255 0 0 1 1 1 "{v}"\n' for k, v in rows),
        ".ctbl": "".join(f"{k} {v} 255 0 0 255\n" for k, v in rows),
        ".csv": "LabelValue,Name,Color_R\n" + "".join(f'{k},"{v}",255\n' for k, v in rows),
        ".tsv": "index\tname\tcolor\n" + "".join(f"{k}\t{v}\t#ff0000\n" for k, v in rows),
    }
    return ending, as_bytes(texts[ending], rng)


def one_run(rng: random.Random, folder: Path) -> tuple[str, str, str, bytes]:
    """Make one spoilt input and read it: what it was, what came of it, what should not have been, its text."""
    kind, path = rng.choice(("case", "case", "set", "table")), folder / "case.toml"
    if kind == "case":
        content = spoilt_case(rng)
        path.write_bytes(content)
        return kind, *outcome(lambda: read_case(path), CASE_CODES), content
    if kind == "set":
        path.write_text(case_text(rng.choice(CASES)), encoding="utf-8")
        arguments = [override(rng) for _ in range(rng.choice((1, 1, 1, 2, 5)))]
        return kind, *outcome(lambda: read_case(path, arguments), CASE_CODES), repr(arguments).encode()
    ending, content = spoilt_table(rng)
    table = folder / f"names{ending}"
    table.write_bytes(content)
    path.write_text(case_text(CASES[1]), encoding="utf-8")
    case = read_case(path, [f'tissues.prostate.label="{rng.choice(("prostate", "prostata", "x" * 200))}"'])
    return kind, *outcome(lambda: case.resolve_tissues(read_label_table(table)), TABLE_CODES), content


def command_run(rng: random.Random, folder: Path) -> tuple[str, str, str, bytes]:
    """`palpate check` on one spoilt case whose images are there; an estimate must refuse it alike."""
    content = spoilt_case(rng, CASES[:2])
    (folder / "case.toml").write_bytes(content)
    (folder / "names.json").write_text(json.dumps(NAMES))
    case, out = str(folder / "case.toml"), str(folder / "out")
    code, words, seconds = said_by(["check", case, "--quiet"], folder)
    wrong = code not in COMMAND_CODES or "Traceback" in words or "report it" in words or (code != 0) != bool(words)
    flaw = f"exit code {code}: {words[-1000:]}" if wrong else ""
    ended, sentence, _ = said_by(["estimate", case, "--output", out, "--quiet"], folder)
    if ended != code or sentence.strip().removeprefix("palpate: ") not in words:
        flaw = flaw or f"check ends with {code}: {words[-500:]}; estimate with {ended}: {sentence[-500:]}"
    slow = "slow" if seconds > SLOW_SECONDS and code == 2 else ""
    return "command", f"exit code {code}", flaw or slow, content


def said_by(argv: list[str], folder: Path) -> tuple[int, str, float]:
    """Exit code, words and processor time (s) of a command in a process of its own; an estimate ends before solving."""
    with (folder / "said.txt").open("w+b") as said:
        pid = os.fork()
        if pid == 0:
            code = 99
            try:
                os.dup2(said.fileno(), 1)
                os.dup2(said.fileno(), 2)
                sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
                resource.setrlimit(resource.RLIMIT_CPU, (COMMAND_SECONDS, COMMAND_SECONDS))
                warnings.simplefilter("default")
                vars(ESTIMATE)["invert_case"] = solving_begins
                try:
                    code = palpate_command(argv)
                except SystemExit as stop:
                    code = stop.code if isinstance(stop.code, int) else 98
                sys.stdout.flush()
                sys.stderr.flush()
            finally:
                os._exit(code)
        _, status, usage = os.wait4(pid, 0)
        said.seek(0)
        words = said.read().decode("utf-8", errors="replace")
    return os.waitstatus_to_exitcode(status), words, usage.ru_utime + usage.ru_stime


def solving_begins(*_arguments: object, **_options: object) -> NoReturn:
    """Instead of an inversion."""
    raise SystemExit(0)


def save_images(folder: Path) -> None:
    """A ball (1) behind a tube (2) that fills, in two label images."""
    places_mm = np.stack(np.meshgrid(*[np.arange(20) * 2.0] * 3, indexing="ij"), axis=-1)
    for name, shift, radius in (("before", 0.0, 4.0), ("after", 0.8, 6.0)):
        labels = (np.linalg.norm(places_mm - [19.0, 25.0 + shift, 19.0], axis=-1) < 10.0).astype(np.uint8)
        labels[np.linalg.norm(places_mm[..., :2] - [19.0, 9.0], axis=-1) < radius] = 2
        nibabel.save(nibabel.Nifti1Image(labels, np.diag([2.0, 2.0, 2.0, 1.0])), folder / f"{name}.nii.gz")


def main() -> int:
    """Run the campaign; exit code 1 when something was found."""
    parser = parser_of(__doc__ or "")
    parser.add_argument("--commands", type=int, default=4000)
    asked = parser.parse_args()

    def work(folder: Path) -> dict[str, object]:
        """All runs in a folder."""
        save_images(folder)
        return counted([one_run] * asked.runs + [command_run] * asked.commands, asked.seed, folder)

    return limited(asked, work)


if __name__ == "__main__":
    sys.exit(main())
