"""Who qualifies: what more later images of one patient are worth, what they cost, and what a cohort tells from them.

    python benchmarks/patients.py [--images 1,2,4,8] [--noise 0.15,0.3] [--laws linear] [--patients 4]
                                  [--cohort [8]] [--cohort-images 6] [--cohort-noise 0.3]
                                  [--alternating] [--first-seed 901] [--cache FOLDER] [--output FILE] [--json]
    python benchmarks/patients.py --summary [--output FILE]      # no run: tables of the lines that are there

Simulated patients, everything at once: one body, of which every later image shows another filling of the rectum (5 to
8 mm), a border that moves smoothly by 1 mm, a patient who lies 3 mm and 2 degrees elsewhere, and surfaces with errors
of their own (correlated over 6 mm); ln E varies by 0.3 (25 mm) in every tissue; voxels of 1 x 1 x 2 mm. The same images
serve every number of images. Each estimate runs in a process of its own, with default settings. One line of JSON an
estimate: moduli, truths, intervals, verdicts, seconds of processor and wall, peak memory.

--alternating: every second later image shows nearly the filling of the reference image (0 to 1 mm), so that errors in
drawing that image are told apart from what moved.

--cohort adds such patients, half of a lower and half of a higher stage (by turns), one joint estimate each. Prostates
of the higher stage are stiffer by a factor of 1.3; the moduli of all patients scatter by 0.2 in ln E. The effect of the
stage is that of `palpate statistics`. `--patients 0 --cohort` runs nothing else.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rows import Job, Result, collected, holds, median, parser_of, peak_gb, printed, rms, seeds_of

import palpate
from palpate.cohort.records import Record, modulus_of
from palpate.cohort.statistics.document import statistics_document
from palpate.cohort.task import Row
from scenes import EFFECT, MOST, Patient, patient_folder

KEYS = (*Patient._fields, "images")
SHOWN = ("tissue", "value", "interval95", "verdict", "truth")
KEPT = (*SHOWN, "parameter", "unit", "ratio", "ratio_interval95", "variance_shares", "profile")  # as statistics read it
STATED = ("identified", "weak")


def main() -> int:
    """Make what is not there, and run every estimate that the output does not hold yet."""
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(_estimated(Path(sys.argv[2]))))
        return 0
    parser = parser_of(__doc__ or "", output="patients.jsonl", first_seed=901, seeds=4, name="--patients")
    parser.add_argument("--images", default="1,2,4,8")
    parser.add_argument("--noise", default="0.15,0.3", help="standard deviations of the surfaces' errors, mm")
    parser.add_argument("--laws", default="linear")
    parser.add_argument("--alternating", action="store_true", help="every second later image as full as the first")
    parser.add_argument("--cohort", type=int, nargs="?", const=8, default=0, help="patients of the cohort")
    parser.add_argument("--cohort-images", type=int, default=6, help="later images of each of them")
    parser.add_argument("--cohort-noise", type=float, default=0.3, help="their surfaces' errors, mm")
    parser.add_argument("--cache", type=Path, default=Path("patients"))
    asked = parser.parse_args()
    wanted = list(_wanted(asked))
    if wrong := sorted({n for _, n in wanted if not 0 < n <= MOST}):
        parser.error(f"{wrong} later images: a patient has 1 to {MOST}")
    jobs = (Job({**of._asdict(), "images": n}, partial(_run, of, n, asked.cache)) for of, n in wanted)
    found = figures_of(collected(jobs, asked, KEYS))
    if asked.json:
        print(json.dumps({"simulated": True, **found}, indent=1))
        return 0
    printed(found["rows"], asked, COLUMNS)
    printed(found["cohort"]["rows"], asked, COHORT_COLUMNS)
    return 0


def _wanted(asked: argparse.Namespace) -> Iterator[tuple[Patient, int]]:
    """Each patient that is asked for, with a number of later images; the cohort comes last, its stages by turns."""
    for seed in seeds_of(asked):
        for law in asked.laws.split(","):
            for noise in map(float, asked.noise.split(",")):
                for n in map(int, asked.images.split(",")):
                    yield Patient(seed, law, noise, alternating=asked.alternating), n
    for k in range(asked.cohort):
        for law in asked.laws.split(","):
            yield Patient(asked.first_seed + k, law, asked.cohort_noise, k % 2), asked.cohort_images


def _run(patient: Patient, n: int, cache: Path) -> Result:
    """The estimate from the first n later images in a process of its own."""
    case = patient_folder(patient, cache) / f"case-{n}.toml"
    said = subprocess.run([sys.executable, __file__, "--one", case], capture_output=True, text=True, check=False)
    if said.returncode:
        return {"status": "failed", "reason": (said.stderr.strip().splitlines() or ["killed"])[-1]}
    return dict(json.loads(said.stdout.splitlines()[-1]))


def _estimated(path: Path) -> Result:
    """What an estimate finds and takes."""
    began, truth = time.perf_counter(), json.loads((path.parent / "truth.json").read_text())["moduli_kpa"]
    document = palpate.estimate(palpate.read_case(path), truth=truth).to_dict()
    spent = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "status": document["status"],
        "reason": document["reason"],
        "estimates": [{key: item[key] for key in KEPT} for item in document["estimates"]],
        "seconds": round(time.perf_counter() - began, 1),
        "processor_seconds": round(spent.ru_utime + spent.ru_stime, 1),
        "peak_gb": round(peak_gb(), 2),
        "warnings": sorted({warning["code"] for warning in document["warnings"]}),
    }


def figures_of(results: Sequence[Mapping[str, Any]]) -> Result:
    """Both tables: {"rows": by noise and images, "cohort": {"rows": by organ}}, without rows where none is there."""
    return {"rows": summary_of(results), "cohort": {"rows": stage_effects(results)}}


def summary_of(results: Sequence[Mapping[str, Any]]) -> dict[str, Result]:
    """By noise and number of later images: patients, errors of ln E, half-widths, intervals that hold, cost.

    rms, error: root mean square and median of |ln E / truth| over all moduli with a value; half_width: median of half
    of ln(high / low) over all intervals with two ends; stated: moduli that are `identified` or `weak`; held: of these,
    those whose interval holds the truth; seconds: median time of processors; peak_gb: the largest. None: no row says.
    """
    found = dict[str, Result]()
    for kind, own in _kinds([row for row in results if row.get("stage") is None]).items():
        law, noise, images, alternating = kind
        items = [item for row in own for item in row.get("estimates", ())]
        errors = [abs(np.log(item["value"] / item["truth"])) for item in items if item["value"] is not None]
        ends = [item["interval95"] for item in items if item["interval95"]]
        stated = [item for item in items if item["verdict"] in STATED]
        found[_name(*kind)] = {
            "law": law,
            "noise_mm": noise,
            "images": images,
            "alternating": alternating,
            "patients": len(own),
            "failed": sum(row["status"] != "converged" for row in own),
            "moduli": len(items),
            "rms": rms(errors, 2),
            "error": median(errors, 2),
            "half_width": median([0.5 * np.log(high / low) for low, high in ends if low and high], 2),
            "stated": len(stated),
            "held": sum(holds(item["interval95"], item["truth"]) for item in stated),
            "seconds": _rounded(_of(own, "processor_seconds", np.median), 1),
            "peak_gb": _rounded(_of(own, "peak_gb", np.max)),
        }
    return found


def stage_effects(results: Sequence[Mapping[str, Any]]) -> dict[str, Result]:
    """By organ: the factor of its moduli from the lower to the higher stage, as `palpate statistics` finds it.

    patients: of the lower and of the higher stage; stated, censored: those that the regression takes by their value,
    and by their interval alone; factor, interval95, p: of the regression of ln E on the stage; truth: the factor that
    the moduli were drawn with; drawn: ratio of the geometric means of those that were drawn, which scatters about it.
    """
    found = dict[str, Result]()
    kinds = _kinds([row for row in results if row.get("stage") is not None])
    for kind, own in kinds.items():
        document = statistics_document([_record(row) for row in own])
        for tissue, organ in document["organs"].items():
            regression = organ["regression"]
            drawn: tuple[list[float], list[float]] = ([], [])  # of each stage, ln E
            for row in own:
                truths = [item["truth"] for item in row.get("estimates", ()) if item["tissue"] == tissue]
                drawn[row["stage"]].extend(np.log(truths))
            found[tissue if len(kinds) == 1 else f"{tissue}, {_name(*kind)}"] = {
                "noise_mm": kind[1],
                "images": kind[2],
                "patients": [sum(row["stage"] == stage for row in own) for stage in (0, 1)],
                "stated": organ["used"]["scans"] - organ["used"]["censored"],
                "censored": organ["used"]["censored"],
                "factor": _rounded(regression.get("factor_per_stage")),
                "interval95": [_rounded(end) for end in regression.get("interval95", (None, None))],
                "p": _rounded(regression.get("p"), 3),
                "truth": EFFECT[tissue],
                "drawn": _rounded(np.exp(np.mean(drawn[1]) - np.mean(drawn[0])) if all(drawn) else None),
                "undefined": regression.get("undefined", ""),
            }
    return found


def _record(row: Mapping[str, Any]) -> Record:
    """A row of the cohort as the cohort's statistics take it: one scan of one patient."""
    name = f"{row['seed']}"
    of = Row(name, name, stage=row["stage"])
    if row["status"] != "converged":
        return Record(of, "failed", "solver", str(row["reason"]))
    moduli = tuple(modulus_of(item) for item in row["estimates"])
    return Record(of, "done", moduli=moduli, seconds=row["seconds"], warnings=tuple(row["warnings"]))


def _kinds(rows: Sequence[Mapping[str, Any]]) -> dict[tuple[str, float, int, bool], list[Mapping[str, Any]]]:
    """The rows by law, noise (mm), number of later images, and whether fillings alternate, in their order."""
    of = [(row["law"], row["noise_mm"], row["images"], row.get("alternating", False)) for row in rows]
    return {key: [row for row, own in zip(rows, of, strict=True) if own == key] for key in sorted(set(of))}


def _name(law: str, noise: float, images: int, alternating: bool) -> str:
    return f"{law}, {noise:g} mm, {images}{', alternating' * alternating}"


def _of(rows: Sequence[Mapping[str, Any]], key: str, what: Any) -> Any:
    """What the rows that have that key come to; None where none has it."""
    values = [row[key] for row in rows if key in row]
    return what(values) if values else None


def _rounded(value: Any, digits: int = 2) -> float | None:
    return None if value is None else round(float(value), digits)


COLUMNS = {
    "patients (failed)": lambda row: f"{row['patients']} ({row['failed']})",
    "error of ln E (RMS, median)": lambda row: f"{row['rms']:.2f}, {row['error']:.2f}",
    "half-width (median)": lambda row: f"{row['half_width']:.2f}",
    "stated moduli": lambda row: f"{row['stated']} of {row['moduli']}",
    "95 % intervals that hold": lambda row: f"{row['held']} of {row['stated']}",
    "time of one processor": lambda row: f"{row['seconds']:.0f} s",
    "peak memory": lambda row: f"{row['peak_gb']:.1f} GB",
}
COHORT_COLUMNS = {
    "patients": lambda row: str(row["patients"]),
    "with a value, with an interval alone": lambda row: f"{row['stated']}, {row['censored']}",
    "factor found": lambda row: row["undefined"] or f"{row['factor']:.2f}",
    "its 95 % interval": lambda row: str(row["interval95"]),
    "p": lambda row: f"{row['p']:.3f}",
    "true factor": lambda row: f"{row['truth']:.2f}",
    "of the moduli that were drawn": lambda row: f"{row['drawn']:.2f}",
}

if __name__ == "__main__":
    raise SystemExit(main())
