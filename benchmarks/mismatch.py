"""The errors of estimates from image pairs with the faults of real ones, which the model does not have.

    python benchmarks/mismatch.py [--scenes still,crop,...] [--laws linear,neo-hookean] [--noise clean,0.3] [--bodies N]
        [--first-seed S] [--share k/n] [--scenes-cache FOLDER] [--output FILE.jsonl] [--set key=value ...]
        [--keep FOLDER] [--make-only] [--summary] [--json]

Simulated data. Each scene (mismatch_scenes.py) shows a random pelvis whose truth is larger and finer than what the
estimate meshes, in images of 1 mm voxels, and is a folder with a case.toml, which is estimated with the program's
defaults and what --set overrides. The truth of a tissue that is not homogeneous is the geometric mean of its modulus
over its volume in the part that the estimate meshes, which is what its case states. Each case is appended to FILE as
soon as it is done; one that is there, under the same --set, is not computed again. Making a truth takes minutes, so
keep the scenes in a folder: --scenes-cache. --keep writes each estimate's outputs, as `palpate estimate` does.

Of the table: "out" counts truths further from the estimate than two half-widths of its 95 % interval, in ln E, and
of these the ones with the verdict "identified"; an interval with open ends holds what lies on its closed side; an
interval that is not given is not counted.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from mismatch_scenes import KINDS, SceneKey, scene_folder

import palpate

Result = dict[str, Any]  # a line of JSON
Key = tuple[str, int, str, float, tuple[str, ...]]

TOLD = ("alignment", "frame", "offsets", "heterogeneity", "layers")  # of result.json, where a version has them
INTERVALS = ("interval95", "interval95_given_model")
OUT = 2.0  # half-widths


def main() -> int:
    """Estimate the scenes that were asked for and print their summaries."""
    arguments = _arguments()
    keys, overrides = _keys(arguments), tuple(arguments.set)
    done = read_lines(arguments.output)
    made = nullcontext(arguments.scenes_cache) if arguments.scenes_cache else tempfile.TemporaryDirectory()
    with made as cache:
        for key in () if arguments.summary else keys:
            place: Key = (key.kind, key.seed, key.law, key.noise_mm, overrides)
            if arguments.make_only:
                _say(_made(key, Path(cache)))
                continue
            if place not in done:
                done[place] = _case(key, Path(cache), overrides, arguments.keep)
                append_line(arguments.output, done[place])
            _say(_line(done[place]))
    if arguments.make_only:
        return 0
    rows = {}
    for kind, law, noise in dict.fromkeys((key.kind, key.law, key.noise_mm) for key in keys):
        cases = [r for k, r in sorted(done.items()) if (k[0], *k[2:]) == (kind, law, noise, overrides)]
        if cases:
            rows[f"{kind}, {law}, {_noise_name(noise)}"] = summary_of(cases)
    print(json.dumps({"simulated": True, "rows": rows}, indent=1) if arguments.json else table_of(rows))
    return 0


def _arguments() -> argparse.Namespace:
    summary, _, rest = (__doc__ or "").partition("\n")
    parser = argparse.ArgumentParser(
        description=summary, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", default=",".join(KINDS), help=f"of {', '.join(KINDS)}")
    parser.add_argument("--laws", default="linear,neo-hookean", help="of the truth and of the estimate")
    parser.add_argument("--noise", default="clean,0.3", help="standard deviations of the surfaces, mm")
    parser.add_argument("--bodies", type=int, default=6)
    parser.add_argument("--first-seed", type=int, default=701)
    parser.add_argument(
        "--share", default="0/1", help="k/n, k from 0 to n - 1: every n-th seed from the k-th, to run n at once"
    )
    parser.add_argument("--scenes-cache", type=Path, help="folder of truths and scenes, read and added to")
    parser.add_argument("--output", type=Path, default=Path("mismatch.jsonl"))
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of the case; repeatable")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="for the outputs of each estimate")
    parser.add_argument("--make-only", action="store_true", help="make the scenes and estimate nothing")
    parser.add_argument("--summary", action="store_true", help="of what FILE.jsonl has; estimate nothing")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.scenes.split(",") if name not in KINDS]
    if unknown:
        parser.error(f"no scenes are called {unknown}; there are {list(KINDS)}")
    if arguments.make_only and not arguments.scenes_cache:
        parser.error("--make-only needs the folder to make them in: --scenes-cache")
    return arguments


def _keys(arguments: argparse.Namespace) -> list[SceneKey]:
    """The scenes that were asked for, body after body: scenes of one body share their truths."""
    number, of = (int(part) for part in arguments.share.split("/"))
    if not 0 <= number < of:
        raise SystemExit(f"--share {arguments.share}: the first number must be 0 to {of - 1}, or seeds are left out")
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.bodies)[number::of]
    noises = [0.0 if part == "clean" else float(part) for part in arguments.noise.split(",")]
    return [
        SceneKey(kind, seed, law, noise)
        for seed in seeds
        for law in arguments.laws.split(",")
        for noise in noises
        for kind in arguments.scenes.split(",")
    ]


def _made(key: SceneKey, cache: Path) -> str:
    """What became of the making of a scene."""
    began = time.perf_counter()
    try:
        what = str(scene_folder(key, cache))
    except Exception as error:  # the next scene is worth making
        what = f"{key.name}: {type(error).__name__}: {error}"
    return f"{what} ({time.perf_counter() - began:.0f} s)"


def _case(key: SceneKey, cache: Path, overrides: tuple[str, ...], keep: Path | None) -> Result:
    """One scene's estimate with its truth; an error is recorded as its outcome."""
    began = time.perf_counter()
    line: Result = {"scene": key.kind, "seed": key.seed, "law": key.law, "noise_mm": key.noise_mm}
    line |= {"set": list(overrides), "commit": _commit()}
    try:
        folder = scene_folder(key, cache)
    except Exception as error:  # the scene of another body is worth making
        return line | {"error": f"scene: {type(error).__name__}: {error}"}
    line["scene_seconds"] = round(time.perf_counter() - began, 1)
    truth = json.loads((folder / "truth.json").read_text())["moduli_kpa"]
    began = time.perf_counter()
    try:
        case = palpate.read_case(folder / "case.toml", list(overrides))
        result = palpate.estimate(case, truth=truth)
        document = result.to_dict()
        if keep is not None:
            result.save(keep / key.name)
    except Exception as error:  # an outcome like others, counted in the table
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
            holds = (low or 0.0) <= true <= (high or math.inf)
            found[f"{name}_holds"] = None if low is None and high is None else holds
            found[f"{name}_ln_half_width"] = 0.5 * math.log(high / low) if low and high and high > low else None
    half: float = found["interval95_ln_half_width"] or 0.0
    return found | {"half_widths": abs(error) / half if error is not None and half else None}


def summary_of(cases: Sequence[Result]) -> Result:
    """Of the cases of one kind, law and noise."""
    usable = [r for r in cases if "error" not in r]
    of = [item for r in usable for item in r["estimates"]]
    tissues = list(dict.fromkeys(item["tissue"] for item in of))
    out = [item for item in of if (item["half_widths"] or 0.0) > OUT]
    verdicts = [item["verdict"] for item in of]
    found: Result = {
        "cases": len(cases),
        "errors": [f"{r['seed']}: {r['error']}" for r in cases if "error" in r],
        "not_converged": sum(r["status"] != "converged" for r in usable),
        "rms_ln_error": {name: _rms([i["ln_error"] for i in of if i["tissue"] == name]) for name in tissues},
        "rms_ln_error_told": _rms([i["ln_error"] for i in of if i["verdict"] in ("identified", "weak")]),
        "mean_ln_error": {name: _mean([i["ln_error"] for i in of if i["tissue"] == name]) for name in tissues},
        "worst_ln_error": max((abs(i["ln_error"]) for i in of if i["ln_error"] is not None), default=None),
        "verdicts": {name: verdicts.count(name) for name in sorted(set(verdicts))},
        "out": len(out),
        "out_identified": sum(item["verdict"] == "identified" for item in out),
        "seconds": _mean([r["seconds"] for r in usable]),
    }
    for name in INTERVALS:
        holds = [item[f"{name}_holds"] for item in of if item.get(f"{name}_holds") is not None]
        widths = [item[f"{name}_ln_half_width"] for item in of if item.get(f"{name}_ln_half_width") is not None]
        found[f"{name}_holds"] = {"share": _mean(holds), "intervals": len(holds)}
        found[f"{name}_median_ln_half_width"] = float(np.median(widths)) if widths else None
    return found


def _rms(values: Sequence[float | None]) -> float | None:
    found = [value for value in values if value is not None]
    return float(np.sqrt(np.mean(np.square(found)))) if found else None


def _mean(values: Sequence[float | None]) -> float | None:
    found = [value for value in values if value is not None]
    return float(np.mean(found)) if found else None


def table_of(rows: dict[str, Result]) -> str:
    """The rows as they stand in the docs; half-widths are those of ln E."""
    head = "simulated scene | cases (errors) | RMS ln-error | of identified, weak | worst | 95 % hold | given the model"
    head += " | out (identified) | verdicts | half-width (given the model) | seconds"
    lines = [f"| {head} |", "|" + "---|" * 11]
    for name, row in rows.items():
        holds = [row[f"{interval}_holds"] for interval in INTERVALS]
        held = [f"{100 * h['share']:.0f} % of {h['intervals']}" if h["intervals"] else "-" for h in holds]
        widths = [_number(row[f"{interval}_median_ln_half_width"]) for interval in INTERVALS]
        cells = [name, f"{row['cases']} ({len(row['errors'])})"]
        cells += [", ".join(f"{tissue} {_number(rms)}" for tissue, rms in row["rms_ln_error"].items())]
        cells += [_number(row["rms_ln_error_told"]), _number(row["worst_ln_error"]), *held]
        cells += [f"{row['out']} ({row['out_identified']})"]
        cells += [", ".join(f"{count} {verdict}" for verdict, count in row["verdicts"].items())]
        cells += [f"{widths[0]} ({widths[1]})", f"{row['seconds']:.0f}" if row["seconds"] else "-"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _ends(interval: Sequence[float | None] | None) -> str:
    return "-" if interval is None else f"[{', '.join(_number(end) for end in interval)}]"


def _line(result: Result) -> str:
    name = f"{result['scene']} {result['seed']} {result['law']} {_noise_name(result['noise_mm'])}"
    if "error" in result:
        return f"{name}: {result['error']}"
    found = [
        f"{e['tissue']} {_number(e['value'])} {_ends(e['interval95'])} for {e['truth']:.1f}, {e['verdict']}"
        for e in result["estimates"]
    ]
    return f"{name}: {'; '.join(found)} ({result['status']}, {result['seconds']:.0f} s)"


def _noise_name(noise_mm: float) -> str:
    return f"{noise_mm:g} mm" if noise_mm else "clean"


def _commit() -> str:
    """The commit that is run, with a plus where files of the repository differ from it; "" outside of one."""
    here = Path(__file__).parent
    run = ["git", "-C", str(here), "describe", "--always", "--dirty=+", "--exclude=*"]
    found = subprocess.run(run, capture_output=True, text=True, check=False)
    return found.stdout.strip()


def read_lines(path: Path) -> dict[Key, Result]:
    """The cases that are there; a line that a killed run left unfinished is computed anew."""
    found: dict[Key, Result] = {}
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            result = json.loads(line)
        except json.JSONDecodeError:
            _say(f"{path}: an unfinished line is left out")
            continue
        found[result["scene"], result["seed"], result["law"], result["noise_mm"], tuple(result["set"])] = result
    return found


def append_line(path: Path, result: Result) -> None:
    """Append a line; a broken last line of a killed run is ended first."""
    unfinished = path.exists() and path.read_bytes()[-1:] not in (b"", b"\n")
    with path.open("a") as file:
        file.write("\n" * unfinished + json.dumps(result) + "\n")


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
