"""The errors of estimates from image pairs with the faults of real ones, which the model does not have.

    python benchmarks/mismatch.py [--scenes still,crop,...] [--laws linear,neo-hookean] [--noise clean,0.3] [--bodies N]
        [--first-seed S] [--scenes-cache FOLDER] [--output FILE.jsonl] [--set key=value ...] [--keep FOLDER]
        [--make-only] [--summary] [--json]

Simulated data. Each scene (scenes.py) shows a random pelvis whose truth is larger and finer than what the estimate
meshes, in images of 1 mm voxels, and is a folder with a case.toml, which is estimated with the program's defaults and
what --set overrides. The truth of a tissue that is not homogeneous is the geometric mean of its modulus over its volume
in the part that the estimate meshes, which is what its case states. Making a truth takes minutes, so keep the scenes in
a folder: --scenes-cache. --keep writes each estimate's outputs, as `palpate estimate` does.

Of the table: "out" counts truths further from the estimate than two half-widths of its 95 % interval, in ln E, and
of these the ones with the verdict "identified"; an interval with open ends holds what lies on its closed side; an
interval that is not given is not counted.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path

from rows import Job, Result, collected, holds, mean, median, parser_of, printed, rms, said, seeds_of

import palpate
from scenes import KINDS, SceneKey, scene_folder

KEYS = ("scene", "seed", "law", "noise_mm", "set")
TOLD = ("alignment", "frame", "offsets", "heterogeneity", "layers")  # of result.json, where a version has them
INTERVALS = ("interval95", "interval95_given_model")
OUT = 2.0  # half-widths


def main() -> int:
    """Estimate the scenes that were asked for and print their summaries."""
    asked = _asked()
    keys = list(_scenes(asked))
    made = nullcontext(asked.scenes_cache) if asked.scenes_cache else tempfile.TemporaryDirectory()
    with made as name:
        cache = Path(name)
        if asked.make_only:
            for key in keys:
                said(_made(key, cache))
            return 0
        jobs = (Job(_named(key, asked.set), partial(_case, key, cache, asked.set, asked.keep)) for key in keys)
        found = [line for line in collected(jobs, asked, KEYS, _line) if line["set"] == asked.set]
    rows = {}
    for kind, law, noise in dict.fromkeys((key.kind, key.law, key.noise_mm) for key in keys):
        cases = [r for r in found if (r["scene"], r["law"], r["noise_mm"]) == (kind, law, noise)]
        if cases:
            rows[f"{kind}, {law}, {_noise_name(noise)}"] = summary_of(sorted(cases, key=lambda r: r["seed"]))
    printed(rows, asked, COLUMNS)
    return 0


def _asked() -> argparse.Namespace:
    parser = parser_of(__doc__ or "", output="mismatch.jsonl", first_seed=701, seeds=6)
    parser.add_argument("--scenes", default=",".join(KINDS), help=f"of {', '.join(KINDS)}")
    parser.add_argument("--laws", default="linear,neo-hookean", help="of the truth and of the estimate")
    parser.add_argument("--noise", default="clean,0.3", help="standard deviations of the surfaces, mm")
    parser.add_argument("--scenes-cache", type=Path, help="folder of truths and scenes, read and added to")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of the case; repeatable")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="for the outputs of each estimate")
    parser.add_argument("--make-only", action="store_true", help="make the scenes and estimate nothing")
    asked = parser.parse_args()
    if unknown := [name for name in asked.scenes.split(",") if name not in KINDS]:
        parser.error(f"no scenes are called {unknown}; there are {list(KINDS)}")
    if asked.make_only and not asked.scenes_cache:
        parser.error("--make-only needs the folder to make them in: --scenes-cache")
    return asked


def _scenes(asked: argparse.Namespace) -> Iterator[SceneKey]:
    """The scenes that were asked for, body after body: scenes of one body share their truths."""
    noises = [0.0 if part == "clean" else float(part) for part in asked.noise.split(",")]
    for seed in seeds_of(asked):
        for law in asked.laws.split(","):
            for noise in noises:
                for kind in asked.scenes.split(","):
                    yield SceneKey(kind, seed, law, noise)


def _named(key: SceneKey, overrides: Sequence[str]) -> Result:
    return {"scene": key.kind, "seed": key.seed, "law": key.law, "noise_mm": key.noise_mm, "set": list(overrides)}


def _made(key: SceneKey, cache: Path) -> str:
    """What became of the making of a scene."""
    began = time.perf_counter()
    try:
        what = str(scene_folder(key, cache))
    except Exception as error:  # the next scene is worth making
        what = f"{key.name}: {type(error).__name__}: {error}"
    return f"{what} ({time.perf_counter() - began:.0f} s)"


def _case(key: SceneKey, cache: Path, overrides: Sequence[str], keep: Path | None) -> Result:
    """One scene's estimate with its truth; an error is recorded as its outcome, and counted in the table."""
    began, line = time.perf_counter(), Result({"commit": _commit()})
    try:
        folder = scene_folder(key, cache)
    except Exception as error:  # the scene of another body is worth making
        return line | {"error": f"scene: {type(error).__name__}: {error}"}
    line["scene_seconds"] = round(time.perf_counter() - began, 1)
    truth = json.loads((folder / "truth.json").read_text())["moduli_kpa"]
    began = time.perf_counter()
    try:
        result = palpate.estimate(palpate.read_case(folder / "case.toml", list(overrides)), truth=truth)
        document = result.to_dict()
        if keep is not None:
            result.save(keep / key.name)
    except Exception as error:
        return line | {"error": f"{type(error).__name__}: {error}", "seconds": time.perf_counter() - began}
    return line | {
        "status": document["status"],
        "reason": document["reason"],
        "estimates": [held_beside(item, truth) for item in document["estimates"] if item["tissue"] in truth],
        "warnings": [warning["code"] for warning in document["warnings"]],
        "dofs": document["mesh"]["dofs"],
        "seconds": time.perf_counter() - began,
        "stages": document["seconds"],
        **{name: document[name] for name in TOLD if name in document},
    }


def held_beside(item: Result, truth: dict[str, float]) -> Result:
    """One of the "estimates" of result.json with its ln-error, and whether its intervals hold the truth (None: none).

    half_widths: the distance of the truth from the estimate in half-widths of its interval, in ln E; None without one.
    """
    true, value = truth[item["tissue"]], item["value"]
    error: float | None = math.log(value / true) if value else None
    found: Result = {name: item[name] for name in ("tissue", "value", "verdict")} | {"truth": true, "ln_error": error}
    for name in INTERVALS:
        if name in item:
            ends: list[float | None] = item[name] or [None, None]
            low, high = ends
            found[name] = item[name]
            found[f"{name}_holds"] = None if low is None and high is None else holds(ends, true)
            found[f"{name}_ln_half_width"] = 0.5 * math.log(high / low) if low and high and high > low else None
    half: float = found["interval95_ln_half_width"] or 0.0
    return found | {"half_widths": abs(error) / half if error is not None and half else None}


def summary_of(cases: Sequence[Result]) -> Result:
    """Of the cases of one kind, law and noise."""
    usable = [r for r in cases if "error" not in r]
    of = [item for r in usable for item in r["estimates"]]
    tissues = list(dict.fromkeys(item["tissue"] for item in of))
    errors = {name: [item["ln_error"] for item in of if item["tissue"] == name] for name in tissues}
    out = [item for item in of if (item["half_widths"] or 0.0) > OUT]
    verdicts = [item["verdict"] for item in of]
    found: Result = {
        "cases": len(cases),
        "errors": [f"{r['seed']}: {r['error']}" for r in cases if "error" in r],
        "not_converged": sum(r["status"] != "converged" for r in usable),
        "rms_ln_error": {name: rms(own) for name, own in errors.items()},
        "rms_ln_error_told": rms([i["ln_error"] for i in of if i["verdict"] in ("identified", "weak")]),
        "mean_ln_error": {name: mean(own) for name, own in errors.items()},
        "worst_ln_error": max((abs(i["ln_error"]) for i in of if i["ln_error"] is not None), default=None),
        "verdicts": {name: verdicts.count(name) for name in sorted(set(verdicts))},
        "out": len(out),
        "out_identified": sum(item["verdict"] == "identified" for item in out),
        "seconds": mean([r["seconds"] for r in usable]),
    }
    for name in INTERVALS:
        held = [item[f"{name}_holds"] for item in of if item.get(f"{name}_holds") is not None]
        found[f"{name}_holds"] = {"share": mean(held), "intervals": len(held)}
        found[f"{name}_median_ln_half_width"] = median([item.get(f"{name}_ln_half_width") for item in of])
    return found


def _held(row: Result, interval: str) -> str:
    held = row[f"{interval}_holds"]
    return f"{held['share']:.0%} of {held['intervals']}"


COLUMNS = {
    "cases (errors)": lambda row: f"{row['cases']} ({len(row['errors'])})",
    "RMS ln-error": lambda row: ", ".join(f"{tissue} {error:.3f}" for tissue, error in row["rms_ln_error"].items()),
    "of identified, weak": lambda row: f"{row['rms_ln_error_told']:.3f}",
    "worst": lambda row: f"{row['worst_ln_error']:.3f}",
    "95 % hold": lambda row: _held(row, INTERVALS[0]),
    "given the model": lambda row: _held(row, INTERVALS[1]),
    "out (identified)": lambda row: f"{row['out']} ({row['out_identified']})",
    "verdicts": lambda row: ", ".join(f"{count} {verdict}" for verdict, count in row["verdicts"].items()),
    "half-width": lambda row: f"{row['interval95_median_ln_half_width']:.3f}",
    "seconds": lambda row: f"{row['seconds']:.0f}",
}


def _line(result: Result) -> str:
    name = f"{result['scene']} {result['seed']} {result['law']} {_noise_name(result['noise_mm'])}"
    if "error" in result:
        return f"{name}: {result['error']}"
    found = [f"{e['tissue']} {e['value']} {e['interval95']} for {e['truth']:.1f}" for e in result["estimates"]]
    return f"{name}: {'; '.join(found)} ({result['status']}, {result['seconds']:.0f} s)"


def _noise_name(noise_mm: float) -> str:
    return f"{noise_mm:g} mm" if noise_mm else "clean"


def _commit() -> str:
    """The commit that is run, with a plus where files of the repository differ from it; "" outside of one."""
    run = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty=+", "--exclude=*"]
    return subprocess.run(run, capture_output=True, text=True, check=False).stdout.strip()


if __name__ == "__main__":
    raise SystemExit(main())
