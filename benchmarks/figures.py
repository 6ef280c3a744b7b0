"""Every figure that README and docs state of this program: `make figures`.

    python benchmarks/figures.py [PART ...] [--bodies N] [--processes N] [--browser CHROMIUM]
    python benchmarks/figures.py text      # no run: what the file says into the pages

A part is a command, and which entries of the JSON that it prints become figures. Parts run one after the other, about
two hours on two quiet cores; those that take hours must be named. Each replaces its own entry in docs/figures.json:
command, commit, machine, minutes, values. Then every page is written anew where it states a figure (figures_text.py).
Simulated data.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from figures_text import FILE, ROOT, complaints, digest, pages, read_figures, rewritten
from rows import read_lines, said
from scipy import stats

from palpate.parallel import processors

Values = dict[str, Any]  # of JSON: texts, numbers, lists of lines, and branches of these
Keys = Mapping[str, str | tuple[str, int]]  # figure -> the entry that it is, and to how many digits

TEXT = "text"
BUSY = 0.5  # processors that other programs use, beside which a time is not measured
CODE = ("src", "validation", "packages", "benchmarks", "examples", "pyproject.toml")  # on which figures depend
PICTURES = ROOT / "docs" / "pictures"
PALPATE = [sys.executable, "-m", "palpate"]
VERDICTS = ("identified", "weak", "not identified")


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
    began, words = time.perf_counter(), [str(word) for word in command]
    with subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, text=True, encoding="utf-8") as process:
        assert process.stdout is not None
        text = process.stdout.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, words, text)
    return Run(text, time.perf_counter() - began, used.ru_maxrss * 1024 / 1e9)


def script(command: str) -> list[str]:
    """The words that run a command of Python."""
    return [sys.executable, *shlex.split(command)[1:]]


def campaign(place: Place, name: str, *more: str) -> list[str]:
    """Run a campaign, its bodies shared by several processes on one thread each; the words that print its summary.

    Its lines take the place of those that the repository has.
    """
    words = [*script(place.command(name)), *more]
    output = place.folder / f"{name}.jsonl"
    counts = [int(count) for flag, count in pairwise(words) if flag in ("--bodies", "--cases")]
    processes = min(place.processes, *counts) if counts else 1  # one without a body has nothing to tell
    environment = os.environ | ({"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"} if processes > 1 else {})
    shares = [[*words, "--output", str(output), "--share", f"{k}/{processes}"] for k in range(processes)]
    running = [subprocess.Popen(of, cwd=ROOT, env=environment, stdout=sys.stderr) for of in shares]
    failed = [process.args for process in running if process.wait()]
    if failed:
        raise subprocess.CalledProcessError(1, str(failed[0]))
    kept = ROOT / "benchmarks" / "results" / output.name
    kept.write_bytes(output.read_bytes())
    return [*words, "--output", str(kept), "--summary", "--json"]


def rows_of(words: Sequence[str]) -> dict[str, Values]:
    """The rows of what a campaign prints."""
    rows: dict[str, Values] = json.loads(run(words).text)["rows"]
    return rows


def picked(row: Mapping[str, Any], keys: Keys) -> Values:
    """The figures that are entries of a row."""
    found = Values()
    for name, of in keys.items():
        entry, digits = (of, None) if isinstance(of, str) else of
        value = row.get(entry)
        found[name] = value if digits is None or value is None else round(value, digits)
    return found


def demo(place: Place) -> Values:
    """The demo as a user runs it."""
    folder = place.folder / "demo"
    found = run([*PALPATE, "demo", "--output", folder])
    document = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    table = [line for line in found.text.splitlines() if line][: 2 + len(document["estimates"])]
    words = [*PALPATE, "check", str(folder / "case.toml"), "--html", str(place.folder / "check.html")]
    predicted = json.loads(run([*words, "--json", "--quiet"]).text)["predicted"]["moduli"]
    return {
        "result": table,
        "seconds": round(found.seconds),
        "peak_gb": round(found.peak_gb, 1),
        "unknowns": f"{document['mesh']['dofs']:,}".replace(",", " "),
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
    (text,) = re.findall(r"^```python\n(from importlib.*?)^```$", page, flags=re.DOTALL | re.MULTILINE)
    run([sys.executable, "-c", text], folder=folder)
    typed = [line.split()[1:] for line in re.findall(r"^palpate .*$", page, flags=re.MULTILINE)]
    steps = {words[0]: words for words in typed if words[0] in ("init", "check", "estimate")}
    return {name: run([*PALPATE, *words], folder=folder).text.splitlines() for name, words in steps.items()}


EXAMPLES = {
    "spheres": "01_estimate_spheres",
    "gel": "05_markers_in_gel",
    "block": "06_dvc_block",
    "breast": "07_breast_by_gravity",
    "beam": "08_soft_beam",
    "skin": "09_skin",
}


def examples(place: Place) -> Values:
    """What those examples print whose output pages show."""
    del place
    return {name: run([sys.executable, f"examples/{of}.py"]).text.splitlines() for name, of in EXAMPLES.items()}


def inputs(place: Place) -> Values:
    """The demo's labels in four formats: value and interval of the prostate in words."""
    found = json.loads(run([*script(place.command("inputs")), "--json"]).text)
    rows = {"demo": found["demo"]} | {row["input"]: row["estimates"] for row in found["inputs"]}
    prostates = {name: estimates["prostate"] for name, estimates in rows.items()}
    ends = {name: "{:.3g} to {:.3g}".format(*of["interval"]) for name, of in prostates.items()}
    return {name: f"{of['value']:.3g} kPa ({ends[name]})" for name, of in prostates.items()}


ACCURACY: Keys = {
    "moduli": "moduli",
    "rms": ("rms_ln_error", 4),
    "stated": "stated",
    "held": "held",
    "limit": ("cramer_rao_rms", 2),
}


def accuracy(place: Place) -> Values:
    """The rows of benchmarks/accuracy.py."""
    return {"rows": {name: picked(row, ACCURACY) for name, row in rows_of(campaign(place, "accuracy")).items()}}


FINITE = ("still", "fov", "organs", "shift", "crop", "driver", "all", "border")
SCENES = (*FINITE, "halves", "field", "field-organs", "sheath", "everything")
NOISY = ("still", "border", "all")


def mismatch(place: Place) -> Values:
    """The scenes of benchmarks/mismatch.py: without noise under both laws, and with 0.3 mm of it."""
    cache = ("--scenes-cache", str(place.folder / "scenes"))
    campaign(place, "mismatch", *cache, "--scenes", ",".join(SCENES), "--laws", "linear", "--noise", "clean")
    campaign(place, "mismatch", *cache, "--scenes", ",".join(FINITE), "--laws", "neo-hookean", "--noise", "clean")
    campaign(place, "mismatch", *cache, "--scenes", ",".join(NOISY), "--noise", "0.3")
    kept = ROOT / "benchmarks" / "results" / "mismatch.jsonl"
    words = [*script(place.command("mismatch")), "--output", str(kept), "--summary", "--json"]
    return mismatch_of(rows_of(words), read_lines(kept))


def mismatch_of(rows: Mapping[str, Values], lines: Sequence[Values]) -> Values:
    """The figures of these scenes."""
    kinds = {
        "linear": [(scene, "linear", "clean") for scene in SCENES],
        "finite": [(scene, "neo-hookean", "clean") for scene in FINITE],
        "noise": [(scene, law, "0.3 mm") for scene in NOISY for law in ("linear", "neo-hookean")],
    }
    found = Values()
    for kind, wanted in kinds.items():
        noisy = kind == "noise"
        keys = [of for of in wanted if ", ".join(of) in rows]
        own = {
            f"{scene}, {law}" if noisy else scene: scene_of(rows[f"{scene}, {law}, {noise}"], with_width=not noisy)
            for scene, law, noise in keys
        }
        held, stated = (sum(row[name] for row in own.values()) for name in ("held", "stated"))
        verdicts = [sum(row["verdicts"][k] for row in own.values()) for k in range(len(VERDICTS))]
        places = [(scene, law, 0.3 if noisy else 0.0) for scene, law, _ in keys]
        commits = {r["commit"] for r in lines if (r["scene"], r["law"], r["noise_mm"]) in places and not r["set"]}
        found[kind] = {"commit": ", ".join(sorted(commits)), "rows": own, "held": held, "stated": stated}
        if noisy:
            found[kind] |= {"pairs": sum(row["bodies"] for row in own.values()), "moduli": sum(verdicts)}
            found[kind] |= {"open": verdicts[-1]}
        else:
            found[kind] |= {"share": share(held, stated)}
    found["linear"] |= {
        "uncertain": round(
            100.0 / float(np.sqrt(2.0 * min(row["bodies"] for row in found["linear"]["rows"].values())))
        ),
        "border": worst(lines, ("border",)),
        "patchy": worst(lines, ("halves", "field", "field-organs")),
        "sheath": worst(lines, ("sheath",)),
    }
    return found


def scene_of(row: Values, *, with_width: bool) -> Values:
    """The figures of one scene."""
    holds, width = row["interval95_holds"], row["interval95_median_ln_half_width"]
    return {
        "bodies": row["cases"],
        "rms": [round(value, 2) for value in row["rms_ln_error"].values()],
        "largest": round(row["worst_ln_error"], 2),
        "half_width": round(width, 2) if with_width and width is not None else None,
        "verdicts": [row["verdicts"].get(name, 0) for name in VERDICTS],
        "held": round((holds["share"] or 0.0) * holds["intervals"]),
        "stated": holds["intervals"],
    }


def worst(lines: Sequence[Values], scenes: Sequence[str]) -> int:
    """The largest error of a modulus in these scenes without noise, linear law, per cent of the truth."""
    own = [r for r in lines if r["scene"] in scenes and r["law"] == "linear" and not r["noise_mm"] and not r["set"]]
    return round(100.0 * max(abs(float(np.expm1(of["ln_error"]))) for line in own for of in line["estimates"]))


COVERAGE: Keys = {
    "moduli": "moduli",
    "verdicts": "verdicts",
    "stated": "stated",
    "held": "held",
    "given_model": "given_model",
    "error": ("median_error", 2),
}


def coverage(place: Place) -> Values:
    """The rows of benchmarks/coverage.py."""
    return coverage_of(rows_of(campaign(place, "coverage")))


def coverage_of(summaries: Mapping[str, Values]) -> Values:
    """The figures of these rows."""
    rows = {name: picked(row, COVERAGE) for name, row in summaries.items() if name != "all"}
    for row in rows.values():
        row["verdicts"] = [row["verdicts"].get(name, 0) for name in VERDICTS]
    total = {key: sum(row[key] for row in rows.values()) for key in ("moduli", "stated", "held", "given_model")}
    given = f"{total.pop('given_model') / max(total['stated'], 1):.0%}".replace("%", " %")
    return {"rows": rows} | total | {"share": share(total["held"], total["stated"]), "given_model": given}


PAIRS: Keys = {
    "patients": "converged",
    "one": ("one pair", 2),
    "four": ("four pairs", 2),
    "mean": ("robust mean of four", 2),
    "spoilt": ("joint, one of four spoilt", 2),
    "spoilt_mean": ("robust mean, one of four spoilt", 2),
}


def pairs(place: Place) -> Values:
    """Twenty patients with four pairs each."""
    (row,) = rows_of(campaign(place, "pairs")).values()
    return picked(row, PAIRS) | {"named": round(row["spoilt pair named"] * row["converged"])}


def patients(place: Place) -> Values:
    """Patients with more and more later images, and the cohort."""
    words = campaign(place, "patients", "--cache", str(place.folder / "patients"))
    found: Values = json.loads(run(words).text)
    return {name: found[name] for name in ("rows", "cohort")}


def speed(place: Place) -> Values:
    """The default case."""
    default = json.loads(run([*script(place.command("speed")), "--json"]).text)["default"]
    return {
        "laws": {
            name: {
                "unknowns": default[law]["dofs"],
                "seconds": round(default[law]["seconds"]),
                "peak_gb": round(default[law]["peak_mb"] * 1024**2 / 1e9, 1),
                "held_seconds": round(default["held"][law]["seconds"]),
            }
            for name, law in {"linear": "linear", "neo-Hookean": "neo-hookean"}.items()
        }
    }


FAMILIES = ["B0", "B1 to B3", *(f"B{k}" for k in range(4, 11)), "B11 to B13", "B16", "E1", "E2, E5, E6", "E3", "E4"]


def verification(place: Place) -> Values:
    """The problems with known answers: the check of each family that comes nearest to its tolerance, per cent."""
    folder = place.folder / "verification"
    run([*PALPATE, "verify", "--output", folder, "--quiet"])
    return verification_of(json.loads((folder / "verification.json").read_text(encoding="utf-8"))["problems"])


def verification_of(rows: Sequence[Mapping[str, Any]]) -> Values:
    """The figures of these problems."""
    families = dict[str, list[float]]()
    for name in FAMILIES:
        numbers = [int(number) for number in re.findall(r"\d+", name)]
        ids = {f"{name[0]}{k}" for k in (range(numbers[0], numbers[-1] + 1) if " to " in name else numbers)}
        own = [row for row in rows if re.sub(r"(?<=\d)\D.*$", "", str(row["id"])) in ids]
        nearest = max(own, key=lambda row: row["error_percent"] / max(row["tolerance_percent"], 1e-12))
        families[name] = [float(f"{nearest[key]:.2g}") for key in ("error_percent", "tolerance_percent")]
    return {"problems": len({row["id"] for row in rows}), "checks": len(rows), "families": families}


def pictures(place: Place) -> Values:
    """The pictures of README and docs, from the demo's output; their digests."""
    folder = place.folder / "demo"
    if not (folder / "report.html").exists():
        demo(place)
    browser = ["--browser", place.browser] if place.browser else []
    run([sys.executable, PICTURES / "draw.py", folder, *browser])
    run([sys.executable, PICTURES / "gallery.py", folder])
    drawn = [PICTURES / "demo.png", PICTURES / "report.jpg", *sorted(PICTURES.glob("gallery-*.*"))]
    return {picture.name: digest(picture) for picture in drawn}


def share(held: int, stated: int) -> str:
    """95 % bounds of the share that holds (Clopper and Pearson 1934)."""
    if not stated:
        return "0 to 100 %"
    bounds = stats.binomtest(held, stated).proportion_ci()
    return f"{100.0 * bounds.low:.0f} to {100.0 * bounds.high:.0f} %"


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


def main() -> int:
    """Run parts and write file and pages; exit code 1 where a page states a figure that the file has not."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; or {TEXT} alone")
    parser.add_argument("--processes", type=int, default=processors(), help="that share a campaign")
    parser.add_argument("--bodies", type=int, help="of accuracy, mismatch and coverage, instead of few")
    parser.add_argument("--browser", help="a Chromium, for the pictures")
    asked = parser.parse_args()
    if unknown := set(asked.parts) - {*PARTS, TEXT}:
        parser.error(f"no part is called {sorted(unknown)}; there are {[*PARTS, TEXT]}")
    names = [name for name in asked.parts if name != TEXT]
    if not asked.parts:
        names = [name for name, part in PARTS.items() if not part.asked]
    commit = commit_of_code()
    folder = ROOT / "build" / "figures" / commit  # a run that was interrupted goes on there
    folder.mkdir(parents=True, exist_ok=True)
    place = Place(folder, asked.processes, asked.browser, asked.bodies)
    for name in names:
        said(f"{name}: {place.command(name)} (about {PARTS[name].minutes:g} minutes on two quiet cores)")
        if (load := os.getloadavg()[0]) > BUSY:
            said(f"other programs keep {load:.1f} processors busy: times that are measured now are too long")
        began = time.perf_counter()
        values = PARTS[name].values(place)
        minutes, figures = (time.perf_counter() - began) / 60.0, read_figures() if FILE.exists() else {}
        told = {"command": place.command(name), "commit": commit, "machine": machine(), "minutes": round(minutes, 1)}
        figures[name] = told | {"values": values}
        ordered = {part: figures[part] for part in PARTS if part in figures}
        FILE.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return write_pages()


def write_pages() -> int:
    """Every page with the figures of the file; what stays wrong is said."""
    figures, texts = read_figures(), dict[str, str]()
    for page in pages():
        text = page.read_text(encoding="utf-8")
        try:
            new = rewritten(text, figures)
        except KeyError:
            new = text  # is said below
        if new != text:
            page.write_text(new, encoding="utf-8")
            said(f"{page.relative_to(ROOT)} is written anew")
        texts[page.relative_to(ROOT).as_posix()] = new
    found = list(complaints(texts, figures))
    said("\n".join(found))
    return int(bool(found))


def commit_of_code() -> str:
    """The commit that runs, with a plus where its code was changed since."""

    def git(*words: str) -> str:
        """What git answers."""
        return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()

    changed = git("status", "--porcelain", "--", *CODE)
    return git("rev-parse", "--short=8", "HEAD") + "+" * bool(changed)


def machine() -> str:
    """The machine in words."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    return f"{os.cpu_count()} cores ({platform.machine()}, {memory:.0f} GB)"


if __name__ == "__main__":
    raise SystemExit(main())
