"""What more later images of one patient are worth, and what they cost.

    python benchmarks/patients.py [--images 1,2,4,8] [--noise 0.15,0.3] [--laws linear] [--patients 4]
                                  [--first-seed 901] [--cache FOLDER] [--output FILE]

Simulated patients, everything at once: one body, of which every later image shows another filling of the rectum (5 to
8 mm), a border that moves smoothly by 1 mm, a patient who lies 3 mm and 2 degrees elsewhere, and surfaces with errors
of their own (correlated over 6 mm); ln E varies by 0.3 (25 mm) in every tissue; voxels of 1 x 1 x 2 mm. The same images
serve every number of images. Each estimate runs in a process of its own, with default settings. One line of JSON an
estimate: moduli, truths, intervals, verdicts, seconds of processor and wall, peak memory.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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


def main() -> int:
    """Make what is not there, and run every estimate that the output does not hold yet."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", default="1,2,4,8")
    parser.add_argument("--noise", default="0.15,0.3", help="standard deviations of the surfaces' errors, mm")
    parser.add_argument("--laws", default="linear")
    parser.add_argument("--patients", type=int, default=4)
    parser.add_argument("--first-seed", type=int, default=901)
    parser.add_argument("--cache", type=Path, default=Path("patients"))
    parser.add_argument("--output", type=Path, default=Path("patients.jsonl"))
    parser.add_argument("--one", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.one:
        print(json.dumps(_estimated(Path(asked.one))))
        return 0
    rows = [json.loads(line) for line in asked.output.read_text().splitlines()] if asked.output.exists() else []
    done = {(row["seed"], row["law"], row["noise_mm"], row["images"]) for row in rows}
    for seed in range(asked.first_seed, asked.first_seed + asked.patients):
        for law in asked.laws.split(","):
            for noise in map(float, asked.noise.split(",")):
                for n in map(int, asked.images.split(",")):
                    if (seed, law, noise, n) in done:
                        continue
                    folder = patient_folder(seed, law, noise, asked.cache)
                    row = {"seed": seed, "law": law, "noise_mm": noise, "images": n, **_run(_case(folder, n))}
                    with asked.output.open("a") as file:
                        file.write(json.dumps(row) + "\n")
                    print(json.dumps(row), file=sys.stderr, flush=True)
    return 0


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
    kept = ("tissue", "value", "interval95", "verdict", "truth")
    return {
        "status": document["status"],
        "reason": document["reason"],
        "estimates": [{key: item[key] for key in kept} for item in document["estimates"]],
        "seconds": round(time.perf_counter() - began, 1),
        "processor_seconds": round(spent.ru_utime + spent.ru_stime, 1),
        "peak_gb": round(spent.ru_maxrss / 2**20, 2),
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


def patient_folder(seed: int, law: str, noise_mm: float, cache: Path) -> Path:
    """The folder of a patient in `cache`, made if it is not there: before, eight later images, truth.json."""
    folder = cache / f"patient-{seed}-{law}-{noise_mm:g}mm"
    if (folder / "truth.json").exists():
        return folder
    rng = np.random.default_rng([seed, 89])
    options = PelvisOptions(seed, field_mm=FIELD_MM, truth_edge_mm=TRUTH_EDGE_MM, spacing_mm=SPACING_MM, law=law)
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
    truth = {"simulated": True, "seed": seed, "law": law, "noise_mm": noise_mm, "moduli_kpa": moduli}
    (made / "truth.json").write_text(json.dumps({**truth, "tissues": tissues}, indent=1))
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
