"""Who qualifies: what more later images of one patient are worth, what they cost, and what a cohort tells from them.

    python benchmarks/patients.py [--images 1,2,4,8] [--noise 0.15,0.3] [--laws linear] [--patients 4]
                                  [--cohort [8]] [--cohort-images 6] [--cohort-noise 0.3]
                                  [--first-seed 901] [--cache FOLDER] [--output FILE]
    python benchmarks/patients.py --summary [--output FILE]      # no run: tables of the lines that are there

Simulated patients, everything at once: one body, of which every later image shows another filling of the rectum (5 to
8 mm), a border that moves smoothly by 1 mm, a patient who lies 3 mm and 2 degrees elsewhere, and surfaces with errors
of their own (correlated over 6 mm); ln E varies by 0.3 (25 mm) in every tissue; voxels of 1 x 1 x 2 mm. The same images
serve every number of images. Each estimate runs in a process of its own, with default settings. One line of JSON an
estimate: moduli, truths, intervals, verdicts, seconds of processor and wall, peak memory.

--cohort adds such patients, half of a lower and half of a higher stage (by turns), one joint estimate each. Prostates
of the higher stage are stiffer by a factor of 1.3; the moduli of all patients scatter by 0.2 in ln E. The effect of the
stage is that of `palpate statistics`. `--patients 0 --cohort` runs nothing else.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from figures_text import VIEWS
from numpy.typing import NDArray
from patients_rows import EFFECT, figures_of

import palpate
from palpate.images import write_label_image
from palpate.mechanics import law_named
from palpate.mesh import OUTER, LagrangeSpace, lagrange_space, tetrahedralise
from palpate.phantoms import (
    AffineMotion,
    BoundaryMotion,
    PelvisOptions,
    displacements,
    imaged,
    pelvis_anatomy,
    pelvis_grid,
    pelvis_motions,
    refuse_folded,
    rotation_about,
    smooth_field,
)
from palpate_validation.mismatch import patched
from palpate_validation.truth import ScaledMotion

ORGANS = ("prostate", "bladder")
MOST = 8  # later images of a patient that are made
SPACING_MM, FIELD_MM, TRUTH_EDGE_MM = (1.0, 1.0, 2.0), (140.0, 146.0, 146.0), 3.0
FILLING_MM, BORDER_MM, BORDER_LENGTH_MM = (5.0, 8.0), 1.0, 60.0
SHIFT_MM, SHIFT_DEG = 3.0, 2.0
FIELD_SD, FIELD_LENGTH_MM, NOISE_LENGTH_MM = 0.3, 25.0, 6.0
LOWER_KPA, SCATTER = {"prostate": 25.0, "bladder": 30.0}, 0.2  # of the cohort: of the lower stage; sd of ln E
SHOWN = ("tissue", "value", "interval95", "verdict", "truth")
KEPT = (*SHOWN, "parameter", "unit", "ratio", "ratio_interval95", "variance_shares", "profile")  # as statistics read it


class Patient(NamedTuple):
    """A simulated patient; stage: 0 or 1 in the cohort, None: a patient with the moduli of the seed."""

    seed: int
    law: str
    noise_mm: float
    stage: int | None = None

    @property
    def name(self) -> str:
        """Of the folder."""
        of_stage = "" if self.stage is None else f"-stage{self.stage}"
        return f"patient-{self.seed}-{self.law}-{self.noise_mm:g}mm{of_stage}"

    @property
    def moduli_kpa(self) -> dict[str, float] | None:
        """The moduli of a patient of the cohort: of its stage, scattered by the seed."""
        if self.stage is None:
            return None
        scatter = SCATTER * np.random.default_rng([self.seed, 90]).normal(size=len(ORGANS))
        return {
            organ: LOWER_KPA[organ] * EFFECT[organ] ** self.stage * float(np.exp(away))
            for organ, away in zip(ORGANS, scatter, strict=True)
        }


def main() -> int:
    """Make what is not there, and run every estimate that the output does not hold yet."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", default="1,2,4,8")
    parser.add_argument("--noise", default="0.15,0.3", help="standard deviations of the surfaces' errors, mm")
    parser.add_argument("--laws", default="linear")
    parser.add_argument("--patients", type=int, default=4)
    parser.add_argument("--first-seed", type=int, default=901)
    parser.add_argument("--cohort", type=int, nargs="?", const=8, default=0, help="patients of the cohort")
    parser.add_argument("--cohort-images", type=int, default=6, help="later images of each of them")
    parser.add_argument("--cohort-noise", type=float, default=0.3, help="their surfaces' errors, mm")
    parser.add_argument("--cache", type=Path, default=Path("patients"))
    parser.add_argument("--output", type=Path, default=Path("patients.jsonl"))
    parser.add_argument("--summary", action="store_true", help="run nothing: tables of the lines in the output")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.one:
        print(json.dumps(_estimated(Path(asked.one))))
        return 0
    rows = [json.loads(line) for line in asked.output.read_text().splitlines()] if asked.output.exists() else []
    if asked.summary:
        print("\n".join(_summary(rows)))
        return 0
    wanted = list(_wanted(asked))
    if wrong := sorted({n for _, n in wanted if not 0 < n <= MOST}):
        parser.error(f"{wrong} later images: a patient has 1 to {MOST}")
    done = {(row["seed"], row["law"], row["noise_mm"], row.get("stage"), row["images"]) for row in rows}
    for patient, n in wanted:
        if (*patient, n) in done:
            continue
        row = {**patient._asdict(), "images": n, **_run(_case(patient_folder(patient, asked.cache), n))}
        with asked.output.open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(json.dumps(row), file=sys.stderr, flush=True)
    return 0


def _wanted(asked: argparse.Namespace) -> Iterator[tuple[Patient, int]]:
    """Each patient that is asked for, with a number of later images; the cohort comes last, its stages by turns."""
    for seed in range(asked.first_seed, asked.first_seed + asked.patients):
        for law in asked.laws.split(","):
            for noise in map(float, asked.noise.split(",")):
                for n in map(int, asked.images.split(",")):
                    yield Patient(seed, law, noise), n
    for k in range(asked.cohort):
        for law in asked.laws.split(","):
            yield Patient(asked.first_seed + k, law, asked.cohort_noise, k % 2), asked.cohort_images


def _summary(rows: list[dict[str, Any]]) -> list[str]:
    """Both tables, as the pages have them."""
    found = figures_of(rows)
    lines = [*VIEWS["patients.table"].table(found), "", *VIEWS["patients.cohort-table"].table(found["cohort"])]
    undefined = {name: row["undefined"] for name, row in found["cohort"]["rows"].items() if row["undefined"]}
    failed = [f"{name}: {row['failed']} failed" for name, row in found["rows"].items() if row["failed"]]
    return lines + [f"{name}: {words}" for name, words in undefined.items()] + failed


def _run(case: Path) -> dict[str, Any]:
    """The estimate of a case in a process of its own."""
    command = [sys.executable, __file__, "--one", str(case)]
    said = subprocess.run(command, capture_output=True, text=True, check=False)
    if said.returncode:
        return {"status": "failed", "reason": (said.stderr.strip().splitlines() or ["killed"])[-1]}
    return dict(json.loads(said.stdout.splitlines()[-1]))


def _estimated(path: Path) -> dict[str, Any]:
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
        "peak_gb": round(spent.ru_maxrss * 1024 / 1e9, 2),
        "warnings": sorted({warning["code"] for warning in document["warnings"]}),
    }


def _case(folder: Path, n: int) -> Path:
    """The case of a patient's first n later images."""
    path, truth = folder / f"case-{n}.toml", json.loads((folder / "truth.json").read_text())
    after = json.dumps([f"after-{k}.nii.gz" for k in range(1, n + 1)])
    lines = [f'id = "{folder.name}-{n}"  # simulated', "[images]", 'before = "before.nii.gz"', f"after = {after}"]
    lines += ["[mechanics]", f'law = "{truth["law"]}"']
    for name, entry in truth["tissues"].items():
        lines += [f"[tissues.{name}]", *(f"{key} = {json.dumps(value)}" for key, value in entry.items())]
    path.write_text("\n".join(lines) + "\n")
    return path


def patient_folder(patient: Patient, cache: Path) -> Path:
    """The folder of a patient in `cache`, made if it is not there: before, eight later images, truth.json."""
    folder = cache / patient.name
    if (folder / "truth.json").exists():
        return folder
    seed, law, noise_mm, stage = patient
    rng = np.random.default_rng([seed, 89])
    options = PelvisOptions(seed, field_mm=FIELD_MM, truth_edge_mm=TRUTH_EDGE_MM, spacing_mm=SPACING_MM, law=law)
    options = replace(options, moduli_kpa=patient.moduli_kpa)
    space = lagrange_space(tetrahedralise(pelvis_anatomy(options), edge_length_mm=TRUTH_EDGE_MM), "P2")
    motions = [_motion(options, number, space, rng) for number in range(1, MOST + 1)]
    patchy = patched(space.mesh, _patches(space, rng))
    found = displacements(replace(space, mesh=patchy), motions, law=law_named(law))
    made = folder.with_name(f".{folder.name}.{os.getpid()}")
    made.mkdir(parents=True)
    noises = np.random.default_rng([seed, 1]).spawn(MOST + 1)
    grid = pelvis_grid(options)
    still = np.zeros_like(space.points)
    for number, (moved, of) in enumerate(zip([still, *found], noises, strict=True)):
        refuse_folded(space, moved)
        lies = still if number == 0 else _lies(rng).at(space.points + moved)
        warp = smooth_field(of, sd_mm=noise_mm, correlation_mm=NOISE_LENGTH_MM).warp
        name = f"after-{number}" if number else "before"
        write_label_image(made / f"{name}.nii.gz", imaged(space, moved + lies, grid, warp=warp))
    tissues = dict[str, dict[str, Any]]()
    for label, tissue in enumerate(space.mesh.tissues, start=1):
        known = tissue.name == "surroundings"
        tissues[tissue.name] = {"label": "remaining" if known else label, "role": str(tissue.role)}
        tissues[tissue.name] |= {"poisson_ratio": tissue.poisson_ratio} if tissue.meshed else {}
        tissues[tissue.name] |= {"youngs_modulus_kpa": tissue.youngs_modulus_kpa} if known else {}
    moduli = {t.name: t.youngs_modulus_kpa for t in space.mesh.tissues if t.name in ORGANS}
    truth = {"simulated": True, "seed": seed, "law": law, "noise_mm": noise_mm, "stage": stage}
    (made / "truth.json").write_text(json.dumps({**truth, "moduli_kpa": moduli, "tissues": tissues}, indent=1))
    made.rename(folder)
    return folder


def _motion(options: PelvisOptions, number: int, space: LagrangeSpace, rng: np.random.Generator) -> BoundaryMotion:
    """How the boundary moves in one later image: another filling, and a smooth motion of the border of 1 mm rms."""
    filling = float(rng.uniform(*FILLING_MM))
    walls = pelvis_motions(replace(options, filling_mm=filling, motion_seed=number))
    drawn = smooth_field(rng, sd_mm=1.0, correlation_mm=BORDER_LENGTH_MM)
    points = space.points[np.unique(space.facets(space.mesh.boundary[space.mesh.beyond == OUTER]))]
    rms = float(np.sqrt(np.mean(np.sum(drawn.at(points) ** 2, axis=1))))
    return BoundaryMotion(walls, ScaledMotion(drawn, BORDER_MM / rms))


def _patches(space: LagrangeSpace, rng: np.random.Generator) -> NDArray[np.float64]:
    """Factors of E (n_tets,), in ln: a Gaussian field of its own in every tissue."""
    mesh = space.mesh
    drawn = smooth_field(rng, sd_mm=FIELD_SD, correlation_mm=FIELD_LENGTH_MM).at(mesh.nodes[mesh.tets].mean(axis=1))
    factors = np.zeros(len(mesh.tets))
    for component, name in enumerate(("surroundings", *ORGANS)):
        here = mesh.region == mesh.tissue_index(name)
        factors[here] = drawn[here, component]
    return factors


def _lies(rng: np.random.Generator) -> AffineMotion:
    """Where the patient lies in a later image: 3 mm and 2 degrees elsewhere."""
    way = rng.normal(size=3)
    way *= SHIFT_MM / np.linalg.norm(way)
    return AffineMotion(rotation_about(rng.normal(size=3), SHIFT_DEG) - np.eye(3), np.zeros(3), way)


if __name__ == "__main__":
    raise SystemExit(main())
