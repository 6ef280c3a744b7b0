"""What `make figures` runs: each part is a command or a few, and those figures of its outcome that pages state."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from figures_text import ROOT, digest
from mismatch import summary_of
from patients_rows import figures_of
from scipy import stats

__all__ = ["PARTS", "Part", "Place", "Run"]

Values = dict[str, Any]  # of JSON: texts, numbers, lists of lines, and branches of these

RESULTS = ROOT / "benchmarks" / "results"
PICTURES = ROOT / "docs" / "pictures"
PALPATE = [sys.executable, "-m", "palpate"]
STATED = ("identified", "weak")
VERDICTS = (*STATED, "not identified")


class Place(NamedTuple):
    """Where parts run: a folder that they share, how many processes at once, and a Chromium.

    bodies: how many bodies campaigns have, None: as many as `PARTS` says.
    """

    folder: Path
    processes: int
    browser: str | None = None
    bodies: int | None = None

    def command(self, name: str) -> str:
        """The command of a part, with that number of bodies."""
        stated = PARTS[name].command
        return stated if self.bodies is None else re.sub(r"(--bodies|--cases) \d+", rf"\1 {self.bodies}", stated)


class Run(NamedTuple):
    """What a command printed, the time that it took (s), and its peak memory (GB)."""

    text: str
    seconds: float
    peak_gb: float


class Part(NamedTuple):
    """The command as the docs name it, its time on two quiet cores (minutes), and what makes its figures.

    asked: it runs where it is named alone, for it takes hours.
    """

    command: str
    minutes: float
    values: Callable[[Place], Values]
    asked: bool = False


def run(command: Sequence[str | Path], *, folder: Path = ROOT) -> Run:
    """Run a command to its end; raises `CalledProcessError` where it fails."""
    began = time.perf_counter()
    words = [str(word) for word in command]
    with subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, text=True, encoding="utf-8") as process:
        assert process.stdout is not None
        text = process.stdout.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, words, text)
    return Run(text, time.perf_counter() - began, used.ru_maxrss * 1024 / 1e9)


def shared(command: str, place: Place) -> None:
    """Run a script of benchmarks/ whose bodies several processes take in turns, each on one thread."""
    words = [sys.executable, *shlex.split(command)[1:]]
    bodies = next(int(count) for name, count in pairwise(words) if name in ("--bodies", "--cases"))
    processes = min(place.processes, bodies)  # one without a body has nothing to tell
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    running = [
        subprocess.Popen([*words, "--share", f"{k}/{processes}"], cwd=ROOT, env=environment, stdout=sys.stderr)
        for k in range(processes)
    ]
    failed = [process.args for process in running if process.wait()]
    if failed:
        raise subprocess.CalledProcessError(1, str(failed[0]))


def lines_of(path: Path) -> list[Values]:
    """The rows of a campaign."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def kept(place: Place, name: str) -> Path:
    """The rows that a campaign has just written, put in the place of those that the repository had."""
    path = RESULTS / f"{name}.jsonl"
    path.write_bytes((place.folder / f"{name}.jsonl").read_bytes())
    return path


def demo(place: Place) -> Values:
    """The demo as a user runs it."""
    folder = place.folder / "demo"
    found = run([*PALPATE, "demo", "--output", folder])
    document = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    table = [line for line in found.text.splitlines() if line][: 2 + len(document["estimates"])]
    words: list[str | Path] = [
        *PALPATE,
        "check",
        folder / "case.toml",
        "--html",
        place.folder / "check.html",
        "--json",
        "--quiet",
    ]
    predicted = json.loads(run(words).text)["predicted"]["moduli"]
    return {
        "result": table,
        "seconds": round(found.seconds),
        "peak_gb": round(found.peak_gb, 1),
        "unknowns": spaced(document["mesh"]["dofs"]),
        "predicted": {each["tissue"]: to_each_side(each["interval95"]) for each in predicted},
        "found": {each["tissue"]: to_each_side(each["interval95"]) for each in document["estimates"]},
    }


def to_each_side(ends: Sequence[float]) -> float:
    """The factor by which an interval reaches from its middle in ln E to either end."""
    low, high = ends
    return round(float(np.sqrt(high / low)), 2)


def tutorial(place: Place) -> Values:
    """The tutorial's steps on the masks that its script writes."""
    folder, page = place.folder / "tutorial", (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    folder.mkdir(exist_ok=True)
    (script,) = re.findall(r"^```python\n(from importlib.*?)^```$", page, flags=re.DOTALL | re.MULTILINE)
    run([sys.executable, "-c", script], folder=folder)
    typed = [line.split()[1:] for line in re.findall(r"^palpate .*$", page, flags=re.MULTILINE)]
    steps = {words[0]: words for words in typed if words[0] in ("init", "check", "estimate")}
    return {name: run([*PALPATE, *words], folder=folder).text.splitlines() for name, words in steps.items()}


EXAMPLES = {
    "spheres": "01_estimate_spheres",
    "gel": "05_markers_in_gel",
    "block": "06_dvc_block",
    "breast": "07_breast_by_gravity",
    "beam": "08_soft_beam",
}


def examples(place: Place) -> Values:
    """What those examples print whose output pages show."""
    del place
    return {name: run([sys.executable, f"examples/{script}.py"]).text.splitlines() for name, script in EXAMPLES.items()}


def inputs(place: Place) -> Values:
    """The demo's labels in four formats."""
    del place
    found = json.loads(run([sys.executable, *shlex.split(PARTS["inputs"].command)[1:], "--json"]).text)
    rows = {"demo": found["demo"]} | {row["input"]: row["estimates"] for row in found["inputs"]}
    return {name: of_prostate(estimates["prostate"]) for name, estimates in rows.items()}


def of_prostate(estimate: Values) -> str:
    """Value and interval in words."""
    low, high = estimate["interval"]
    return f"{estimate['value']:.3g} kPa ({low:.3g} to {high:.3g})"


def accuracy(place: Place) -> Values:
    """The rows of benchmarks/accuracy.py."""
    shared(f"{place.command('accuracy')} --output {place.folder / 'accuracy.jsonl'}", place)
    return accuracy_of(lines_of(kept(place, "accuracy")))


def accuracy_of(results: Sequence[Values]) -> Values:
    """The figures of these rows."""
    rows = dict[str, Values]()
    for name in dict.fromkeys(result["row"] for result in results):
        own = [result for result in results if result["row"] == name]
        errors = [error for result in own for error in result["ln_error"]]
        truths = [truth for result in own for truth in result["truth_ratio"]]
        ends = [end for result in own for end in result.get("interval95", [])]
        stated = [(end, truth) for end, truth in zip(ends, truths, strict=bool(ends)) if end is not None]
        limit = [sd for result in own for sd in result.get("cramer_rao_sd", [])]
        rows[name] = {
            "moduli": len(errors),
            "rms": rms(errors, 4),
            "stated": len(stated),
            "held": sum(low <= truth <= high for (low, high), truth in stated),
            "limit": rms(limit, 2) if limit else None,
        }
    return {"rows": rows}


def mismatch(place: Place) -> Values:
    """The scenes of benchmarks/mismatch.py: without noise under both laws, and with 0.3 mm of it."""
    file = f"--scenes-cache {place.folder / 'scenes'} --output {place.folder / 'mismatch.jsonl'}"
    scenes = "--scenes " + ",".join(SCENES)
    script = f"{place.command('mismatch')} {file}"
    shared(f"{script} {scenes} --laws linear --noise clean", place)
    shared(f"{script} --scenes {','.join(FINITE)} --laws neo-hookean --noise clean", place)
    shared(f"{script} --scenes {','.join(NOISY)} --noise 0.3", place)
    return mismatch_of(lines_of(kept(place, "mismatch")))


FINITE = ("still", "fov", "organs", "shift", "crop", "driver", "all", "border")
SCENES = (*FINITE, "halves", "field", "field-organs", "sheath", "everything")
NOISY = ("still", "border", "all")


def mismatch_of(results: Sequence[Values]) -> Values:
    """The figures of these scenes."""
    kinds = {
        "linear": [(scene, "linear", 0.0) for scene in SCENES],
        "finite": [(scene, "neo-hookean", 0.0) for scene in FINITE],
        "noise": [(scene, law, 0.3) for scene in NOISY for law in ("linear", "neo-hookean")],
    }
    found = Values()
    for kind, wanted in kinds.items():
        rows, commits = dict[str, Values](), set[str]()
        for scene, law, noise in wanted:
            own = [r for r in results if (r["scene"], r["law"], r["noise_mm"]) == (scene, law, noise) and not r["set"]]
            commits |= {result["commit"] for result in own}
            if own:
                rows[f"{scene}, {law}" if kind == "noise" else scene] = scene_of(own, with_width=noise == 0.0)
        held, stated = (sum(row[name] for row in rows.values()) for name in ("held", "stated"))
        verdicts = [sum(row["verdicts"][k] for row in rows.values()) for k in range(len(VERDICTS))]
        found[kind] = {"commit": ", ".join(sorted(commits)), "rows": rows, "held": held, "stated": stated}
        if kind == "linear":
            found[kind] |= {
                "uncertain": round(100.0 / float(np.sqrt(2.0 * min(row["bodies"] for row in rows.values())))),
                "border": worst(results, ("border",), "linear"),
                "patchy": worst(results, ("halves", "field", "field-organs"), "linear"),
                "sheath": worst(results, ("sheath",), "linear"),
            }
        if kind == "noise":
            found[kind] |= {"pairs": sum(row["bodies"] for row in rows.values()), "moduli": sum(verdicts)}
            found[kind] |= {"open": verdicts[-1]}
        else:
            found[kind] |= {"share": share(held, stated)}
    return found


def worst(results: Sequence[Values], scenes: Sequence[str], law: str) -> int:
    """The largest error of a modulus in these scenes without noise, per cent of the truth."""
    own = [r for r in results if r["scene"] in scenes and r["law"] == law and not r["noise_mm"] and not r["set"]]
    errors = [abs(np.expm1(each["ln_error"])) for result in own for each in result["estimates"]]
    return round(100.0 * float(max(errors)))


def scene_of(cases: Sequence[Values], *, with_width: bool) -> Values:
    """The figures of one scene."""
    summary = summary_of(cases)
    holds, width = summary["interval95_holds"], summary["interval95_median_ln_half_width"]
    return {
        "bodies": summary["cases"],
        "rms": [round(value, 2) for value in summary["rms_ln_error"].values()],
        "largest": round(summary["worst_ln_error"], 2),
        "half_width": round(width, 2) if with_width and width is not None else None,
        "verdicts": [summary["verdicts"].get(name, 0) for name in VERDICTS],
        "held": round((holds["share"] or 0.0) * holds["intervals"]),
        "stated": holds["intervals"],
    }


def coverage(place: Place) -> Values:
    """The rows of benchmarks/coverage.py."""
    words = shlex.split(place.command("coverage"))[1:]
    run([sys.executable, *words, "--output", place.folder / "coverage.jsonl"])
    return coverage_of(lines_of(kept(place, "coverage")))


def coverage_of(results: Sequence[Values]) -> Values:
    """The figures of these rows."""
    rows = dict[str, Values]()
    for name in dict.fromkeys(result["row"] for result in results):
        draws = [draw for result in results if result["row"] == name for draw in result["draws"]]
        moduli = [modulus for draw in draws for modulus in draw["moduli"]]
        stated = [modulus for modulus in moduli if modulus["verdict"] in STATED]
        rows[name] = {
            "moduli": len(moduli),
            "verdicts": [sum(modulus["verdict"] == word for modulus in moduli) for word in VERDICTS],
            "stated": len(stated),
            "held": sum(inside(modulus["interval"]) for modulus in stated),
            "given_model": sum(inside(modulus["given_model"]) for modulus in stated),
            "error": round(float(np.median([abs(modulus["error"]) for modulus in moduli])), 2),
        }
    total = {key: sum(row[key] for row in rows.values()) for key in ("moduli", "stated", "held", "given_model")}
    given = f"{total.pop('given_model') / max(total['stated'], 1):.0%}".replace("%", " %")
    return {"rows": rows} | total | {"share": share(total["held"], total["stated"]), "given_model": given}


def inside(interval: Sequence[float | None]) -> bool:
    """Whether an interval less the truth holds it; an open end does."""
    low, high = interval
    return (low is None or low <= 0.0) and (high is None or high >= 0.0)


def pairs(place: Place) -> Values:
    """Twenty patients with four pairs each."""
    words = shlex.split(PARTS["pairs"].command)[1:]
    run([sys.executable, *words, "--output", place.folder / "pairs.jsonl"])
    return pairs_of(lines_of(kept(place, "pairs")))


def pairs_of(results: Sequence[Values]) -> Values:
    """The figures of these patients."""
    whole = [r for r in results if all(r[name]["status"] == "converged" for name in ("one", "four", "spoilt"))]

    def error(name: str, kind: str) -> float:
        """RMS of ln E of one estimate."""
        return rms([error for result in whole for error in result[name][kind]], 2)

    return {
        "patients": len(whole),
        "one": error("one", "joint"),
        "four": error("four", "joint"),
        "mean": error("four", "robust"),
        "spoilt": error("spoilt", "joint"),
        "spoilt_mean": error("spoilt", "robust"),
        "named": sum(bool(result["spoilt"]["named"][-1]) for result in whole),
    }


def patients(place: Place) -> Values:
    """Patients with more and more later images, and the cohort."""
    words = shlex.split(PARTS["patients"].command)[1:]
    out = place.folder / "patients.jsonl"
    run([sys.executable, *words, "--cache", place.folder / "patients", "--output", out])
    return figures_of(lines_of(kept(place, "patients")))


def speed(place: Place) -> Values:
    """The default case."""
    del place
    found = json.loads(run([sys.executable, *shlex.split(PARTS["speed"].command)[1:], "--json"]).text)
    return speed_of(found)


def speed_of(found: Mapping[str, Any]) -> Values:
    """The figures of this run."""
    laws = {"linear": "linear", "neo-Hookean": "neo-hookean"}
    default = found.get("default", found)
    return {
        "laws": {
            name: {
                "unknowns": default[law]["dofs"],
                "seconds": round(default[law]["seconds"]),
                "peak_gb": round(default[law]["peak_mb"] * 1024**2 / 1e9, 1),
                "held_seconds": round(default["held"][law]["seconds"]),
            }
            for name, law in laws.items()
        }
    }


def verification(place: Place) -> Values:
    """The problems with known answers."""
    folder = place.folder / "verification"
    run([*PALPATE, "verify", "--output", folder, "--quiet"])
    return verification_of(json.loads((folder / "verification.json").read_text(encoding="utf-8"))["problems"])


FAMILIES = {  # of problems, by their numbers
    "B0": range(1),
    "B1 to B3": range(1, 4),
    **{f"B{k}": range(k, k + 1) for k in range(4, 11)},
    "B11 to B13": range(11, 14),
    "B16": range(16, 17),
    "E1": (1,),
    "E2, E5, E6": (2, 5, 6),
    "E3": (3,),
    "E4": (4,),
}


def verification_of(rows: Sequence[Mapping[str, Any]]) -> Values:
    """The check of each family that comes nearest to its tolerance, per cent."""
    families = dict[str, list[float]]()
    for name, numbers in FAMILIES.items():
        ids = {f"{name[0]}{number}" for number in numbers}
        own = [row for row in rows if re.sub(r"(?<=\d)\D.*$", "", str(row["id"])) in ids]
        worst = max(own, key=lambda row: row["error_percent"] / max(row["tolerance_percent"], 1e-12))
        families[name] = [float(f"{worst[key]:.2g}") for key in ("error_percent", "tolerance_percent")]
    return {"problems": len({row["id"] for row in rows}), "checks": len(rows), "families": families}


def pictures(place: Place) -> Values:
    """The pictures of README and docs, from the demo's output; their digests."""
    folder = place.folder / "demo"
    if not (folder / "report.html").exists():
        demo(place)
    browser = ["--browser", place.browser] if place.browser else []
    for script, flags in (("draw.py", browser), ("gallery.py", [])):
        if (PICTURES / script).exists():
            run([sys.executable, PICTURES / script, folder, *flags])
    drawn = [PICTURES / "demo.png", PICTURES / "report.jpg", *sorted(PICTURES.glob("gallery-*.*"))]
    return {picture.name: digest(picture) for picture in drawn}


def rms(values: Iterable[float], digits: int) -> float:
    """Root mean square."""
    return round(float(np.sqrt(np.mean(np.square(list(values))))), digits)


def share(held: int, stated: int) -> str:
    """95 % bounds of the share that holds (Clopper and Pearson 1934)."""
    if not stated:
        return "0 to 100 %"
    bounds = stats.binomtest(held, stated).proportion_ci()
    return f"{100.0 * bounds.low:.0f} to {100.0 * bounds.high:.0f} %"


def spaced(number: int) -> str:
    """With a space for thousands."""
    return f"{number:,}".replace(",", " ")


PARTS = {
    "demo": Part("palpate demo", 1.5, demo),
    "tutorial": Part("palpate init, check, estimate", 2.5, tutorial),
    "examples": Part("python examples/NAME.py", 3, examples),
    "inputs": Part("python benchmarks/inputs.py", 6, inputs),
    "accuracy": Part("python benchmarks/accuracy.py --cases 2 --first-seed 601", 20, accuracy),
    "mismatch": Part("python benchmarks/mismatch.py --bodies 2 --first-seed 701", 35, mismatch),
    "coverage": Part("python benchmarks/coverage.py --bodies 1 --draws 4 --first-seed 501", 35, coverage),
    "speed": Part("python benchmarks/speed.py --parts default", 5, speed),
    "verification": Part("palpate verify", 5, verification),
    "pictures": Part("python docs/pictures/draw.py", 3, pictures),
    "patients": Part("python benchmarks/patients.py --cohort", 280, patients, asked=True),
    "pairs": Part("python benchmarks/pairs.py --patients 20 --first-seed 701", 300, pairs, asked=True),
}
